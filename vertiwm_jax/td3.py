"""`vertiwm td3`: train a driving policy by TD3."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("td3")
elif __name__ == "vertiwm_jax.td3":
    from functools import partial

    from vertiwm_jax.rl.experiment import train as _train
    from vertiwm_jax.rl.td3 import TD3, TD3Config

    train = partial(_train, "td3")
    __all__ = ["TD3", "TD3Config", "train"]
