"""`vertiwm view`: a drive in three dimensions and over time."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("view")
