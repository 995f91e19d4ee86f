"""`vertiwm import_drives`: logs of other origin as drives to fit to and to test on."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("import_drives")
