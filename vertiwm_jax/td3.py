"""`python -m vertiwm_jax.td3`: train a driving policy by TD3 and show how well it drives."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from vertiwm_jax import policy_training
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.policy_training import TrainConfig
from vertiwm_jax.rl import task
from vertiwm_jax.rl.off_policy import OffPolicy
from vertiwm_jax.rl.td3 import TD3, TD3Config


@dataclass(frozen=True)
class TD3Training(TrainConfig):
    """Train an off-road driving policy by TD3 inside a model of the vehicle."""

    name: ClassVar[str] = "td3"
    td3: TD3Config = TD3Config()
    """The algorithm."""

    def algorithm(self, env: NavigationEnv) -> OffPolicy:
        return OffPolicy(self.repeated(env), TD3(self.td3), task.outcomes, env.senses)


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; expected failures end in one line and a status that is not 0."""
    policy_training.main(TD3Training, argv)


if __name__ == "__main__":
    main()
