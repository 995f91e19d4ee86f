"""`vertiwm ppo`: train a driving policy by PPO."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("ppo")
elif __name__ == "vertiwm_jax.ppo":
    from functools import partial

    from vertiwm_jax.rl.experiment import train as _train
    from vertiwm_jax.rl.ppo import PPO, PPOConfig

    train = partial(_train, "ppo")
    __all__ = ["PPO", "PPOConfig", "train"]
