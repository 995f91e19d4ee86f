"""`python -m vertiwm_jax.ppo`: train a driving policy by PPO and show how well it drives."""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from vertiwm_jax import config as configuration
from vertiwm_jax import runs
from vertiwm_jax.env.navigation import NavigationConfig, NavigationEnv, NavigationParams
from vertiwm_jax.env.termination import Ending
from vertiwm_jax.evaluation import plots, report
from vertiwm_jax.evaluation.controllers import RandomActions, StraightToGoal
from vertiwm_jax.evaluation.navigation import NavigationResult, evaluate
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import hmmwv
from vertiwm_jax.rl import checkpoints, ground
from vertiwm_jax.rl.checkpoints import CheckpointError
from vertiwm_jax.rl.ground import GroundConfig
from vertiwm_jax.rl.loop import LoopConfig, TrainingError, TrainingInterrupted, train
from vertiwm_jax.rl.ppo import PPO, Metrics, PPOConfig
from vertiwm_jax.runs import Run, RunError
from vertiwm_jax.state import STEP_SECONDS

REFERENCE = "straight to goal"
CURVES = {
    "episode_return": "return",
    "success": "success",
    "episode_length": "episode [steps]",
    "entropy": "entropy [nats]",
    "kl": "KL divergence",
    "explained_variance": "explained variance",
}


@dataclass(frozen=True)
class TrainConfig:
    """Train an off-road driving policy by PPO inside the built-in simulator."""

    seed: int = 0
    """Decides everything that is random."""
    worlds: Path | None = None
    """A Verti-Bench checkout or a folder of .npz maps; procedural worlds by default."""
    runs: Path = Path("runs")
    """Folder in which the folder of this run is made."""
    resume: Path | None = None
    """Folder of an earlier run to go on with; its configuration holds, save what is set beside."""
    compile_cache: Path | None = None
    """Folder that keeps compiled programs for later runs."""
    ground: GroundConfig = GroundConfig()
    """What worlds and tasks."""
    navigation: NavigationConfig = NavigationConfig()
    """What the task is."""
    simulator: Simulator = Simulator()
    """What moves the vehicle."""
    ppo: PPOConfig = PPOConfig()
    """The algorithm."""
    loop: LoopConfig = LoopConfig()
    """Seeds and checkpoints."""


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; expected failures end in one line and a status that is not 0."""
    config = _configuration(argv)
    try:
        run_folder = _train_and_report(config)
    except TrainingInterrupted as stopped:
        print(stopped)
        sys.exit(130)
    except KeyboardInterrupt:
        print("stopped at once; go on from the newest checkpoint with --resume and the run folder")
        sys.exit(130)
    except (RunError, CheckpointError, TrainingError) as error:
        sys.exit(f"error: {error}")
    print(f"all of it is in {run_folder}")


def outcomes(info: dict[str, jax.Array]) -> Metrics:
    """What is reported of an episode's last step."""
    ending = info["ending"]
    return {
        "success": ending == Ending.GOAL,
        "timed_out": ending == Ending.TIMED_OUT,
        "final_distance": info["distance"],
    }


def _configuration(argv: Sequence[str] | None) -> TrainConfig:
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--resume", type=Path)
    resume = first.parse_known_args(argv)[0].resume
    file = resume / "config.yaml" if resume else configuration.default_config("ppo")
    return configuration.parse(TrainConfig, file, argv, "python -m vertiwm_jax.ppo")


def environment(config: TrainConfig) -> tuple[NavigationEnv, NavigationParams, NavigationParams]:
    """The environment, its parameters to train with, and those to test with."""
    world_key, task_key = jax.random.split(jax.random.key(config.seed))
    env = NavigationEnv(config.simulator, config.navigation)
    params = chrono_like(hmmwv())
    terrain, held_out = ground.grounds(config.ground, config.worlds, world_key)
    chassis = config.navigation.chassis
    tasks = ground.training_tasks(config.ground, terrain, chassis, task_key)
    test_tasks = ground.test_tasks(config.ground, held_out)
    return (
        env,
        env.make_params(params, terrain, tasks),
        env.make_params(params, held_out, test_tasks),
    )


def _train_and_report(config: TrainConfig) -> Path:
    if config.compile_cache:
        jax.config.update("jax_compilation_cache_dir", str(config.compile_cache.absolute()))
    try:
        env, params, test = environment(config)
    except ValueError as error:  # what is wrong with the maps, or with the tasks on them
        sys.exit(f"error: {error}")
    algorithm = PPO(env, config.ppo, outcomes)
    train_key, test_key = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), 1))
    iterations, batch = config.ppo.iterations, config.ppo.batch
    with _open(config) as run:
        print(f"run folder {run.folder}; training on {params.terrain.worlds} worlds", flush=True)
        state = train(algorithm, params, train_key, run, iterations, batch, config.loop)
        seeds = range(config.loop.seeds)
        policies = {
            "ppo" if len(seeds) == 1 else f"ppo, seed {seed}": algorithm.policy(
                params, jax.tree.map(lambda x, seed=seed: x[seed], state)
            )
            for seed in seeds
        }
        policies |= {REFERENCE: StraightToGoal(config.navigation), "random": RandomActions()}
        tested = f"{test.pool_size} tasks on {test.terrain.worlds} worlds not trained on"
        print(f"driving {tested} ...", flush=True)
        results = {name: evaluate(env, test, p, test_key) for name, p in policies.items()}
        _report(run, config, test, results)
    return run.folder


def _open(config: TrainConfig) -> Run:
    if config.resume is None:
        return Run.create(config.runs, "ppo", config)
    newest = checkpoints.latest(config.resume / "checkpoints")
    return Run.open(config.resume, int(newest.name) if newest else 0)


def _report(
    run: Run,
    config: TrainConfig,
    test: NavigationParams,
    results: dict[str, NavigationResult],
) -> None:
    groups = report.by_difficulty(results, ground.difficulties(test.terrain))
    table = report.markdown(groups, REFERENCE)
    print(f"\n{table}\n")
    runs.write_atomic(run.folder / "summary.md", table + "\n")
    numbers = json.dumps(report.summary(groups, REFERENCE), indent=2)
    runs.write_atomic(run.folder / "summary.json", numbers + "\n")

    _draw(run, config, test, groups)


def _draw(
    run: Run, config: TrainConfig, test: NavigationParams, groups: Mapping[str, report.Results]
) -> None:
    """Learning curves, and for each difficulty a drive to a goal that is hard to reach."""
    metrics = runs.read_metrics(run.folder)
    names = dict.fromkeys(name for line in metrics for name in line)
    columns = {name: [line.get(name, np.nan) for line in metrics] for name in names}
    labels = {name: label for name, label in CURVES.items() if name in columns}
    figure = plots.learning_curves({"ppo": columns}, "transitions", labels, "transitions")
    figure.savefig(run.folder / "learning_curves.png")
    for name, results in groups.items():
        reference = results[REFERENCE]
        task = int(np.argmin(reference.success))  # the first failure, if there is one
        figure = plots.trajectories(
            test.terrain,
            int(reference.world[task]),
            {policy: result.path(task) for policy, result in results.items()},
            np.asarray(reference.goal[task]),
            config.navigation.goal_radius,
            STEP_SECONDS,
        )
        figure.savefig(run.folder / f"trajectories_{name}.png")


if __name__ == "__main__":
    main()
