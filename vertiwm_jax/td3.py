"""`vertiwm td3`: train a driving policy by TD3."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("td3")
elif __name__ == "vertiwm_jax.td3":
    from vertiwm_jax.rl.td3 import TD3, TD3Config

    __all__ = ["TD3", "TD3Config"]
