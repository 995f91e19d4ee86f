"""`vertiwm compare`: train in several models and judge all alike."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("compare")
