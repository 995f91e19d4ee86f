"""`vertiwm evaluate`: how well models predict and policies drive."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("evaluate")
elif __name__ == "vertiwm_jax.evaluate":
    raise ImportError(
        "evaluate is a command, and a function: `import vertiwm_jax` and call vertiwm_jax.evaluate"
    )
