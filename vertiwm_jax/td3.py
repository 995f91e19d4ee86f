"""`vertiwm td3`: train a driving policy by TD3."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("td3")
