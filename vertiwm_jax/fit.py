"""`vertiwm fit`: fit Verti-WM to recorded drives."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("fit")
elif __name__ == "vertiwm_jax.fit":
    raise ImportError(
        "fit is a command, and a function: `import vertiwm_jax` and call vertiwm_jax.fit"
    )
