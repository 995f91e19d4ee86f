"""`python -m vertiwm_jax.sac`: train a driving policy by SAC and show how well it drives."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from vertiwm_jax import policy_training
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.policy_training import TrainConfig
from vertiwm_jax.rl import task
from vertiwm_jax.rl.off_policy import OffPolicy
from vertiwm_jax.rl.sac import SAC, SACConfig


@dataclass(frozen=True)
class SACTraining(TrainConfig):
    """Train an off-road driving policy by SAC inside a model of the vehicle."""

    name: ClassVar[str] = "sac"
    sac: SACConfig = SACConfig()
    """The algorithm."""

    def algorithm(self, env: NavigationEnv) -> OffPolicy:
        return OffPolicy(self.repeated(env), SAC(self.sac), task.outcomes, env.senses)


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; expected failures end in one line and a status that is not 0."""
    policy_training.main(SACTraining, argv)


if __name__ == "__main__":
    main()
