"""`vertiwm sac`: train a driving policy by SAC."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("sac")
