"""`vertiwm ppo`: train a driving policy by PPO."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("ppo")
