"""`vertiwm ppo`: train a driving policy by PPO."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("ppo")
elif __name__ == "vertiwm_jax.ppo":
    from vertiwm_jax.rl.ppo import PPO, PPOConfig

    __all__ = ["PPO", "PPOConfig"]
