"""`vertiwm sac`: train a driving policy by SAC."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("sac")
elif __name__ == "vertiwm_jax.sac":
    from functools import partial

    from vertiwm_jax.rl.experiment import train as _train
    from vertiwm_jax.rl.sac import SAC, SACConfig

    train = partial(_train, "sac")
    __all__ = ["SAC", "SACConfig", "train"]
