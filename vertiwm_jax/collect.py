"""`vertiwm collect`: record drives in a simulator."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("collect")
