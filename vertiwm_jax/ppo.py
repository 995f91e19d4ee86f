"""`python -m vertiwm_jax.ppo`: train a driving policy by PPO and show how well it drives."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from vertiwm_jax import policy_training
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.policy_training import TrainConfig
from vertiwm_jax.rl import task
from vertiwm_jax.rl.ppo import PPO, PPOConfig


@dataclass(frozen=True)
class PPOTraining(TrainConfig):
    """Train an off-road driving policy by PPO inside a model of the vehicle."""

    name: ClassVar[str] = "ppo"
    ppo: PPOConfig = PPOConfig()
    """The algorithm."""

    def algorithm(self, env: NavigationEnv) -> PPO:
        return PPO(self.repeated(env), self.ppo, task.outcomes, env.senses)


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; expected failures end in one line and a status that is not 0."""
    policy_training.main(PPOTraining, argv)


if __name__ == "__main__":
    main()
