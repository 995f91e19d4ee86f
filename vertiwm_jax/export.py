"""`vertiwm export`: a learned policy as robots can run it."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("export")
