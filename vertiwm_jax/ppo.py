"""`python -m vertiwm_jax.ppo`: train a driving policy by PPO and show how well it drives."""

import argparse
import json
import sys
from collections.abc import Sequence
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
from vertiwm_jax.mechanics.simulator import Simulator, SimulatorParams
from vertiwm_jax.mechanics.vehicle import hmmwv
from vertiwm_jax.rl import ground
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
    """Folder of an earlier run to go on with, under its own configuration."""
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
        print("stopped; the newest checkpoint is good, go on from it with --resume and the run")
        sys.exit(130)
    except (ValueError, RunError, CheckpointError, TrainingError) as error:
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


def _train_and_report(config: TrainConfig) -> Path:
    if config.compile_cache:
        jax.config.update("jax_compilation_cache_dir", str(config.compile_cache.absolute()))
    world_key, task_key, train_key, test_key = jax.random.split(jax.random.key(config.seed), 4)
    terrain, held_out = ground.grounds(config.ground, config.worlds, world_key)
    env = NavigationEnv(config.simulator, config.navigation)
    chassis = config.navigation.chassis
    tasks = ground.training_tasks(config.ground, terrain, chassis, task_key)
    vehicle = SimulatorParams(hmmwv())
    env_params = env.make_params(vehicle, terrain, tasks)
    test = env.make_params(vehicle, held_out, ground.test_tasks(config.ground, held_out))

    algorithm = PPO(env, config.ppo, outcomes)
    with _open(config) as run:
        print(f"run folder {run.folder}: {terrain.worlds} worlds to train on")
        state = train(
            algorithm,
            env_params,
            train_key,
            run,
            config.ppo.iterations,
            config.ppo.batch,
            config.loop,
        )
        policies = {
            "ppo" if config.loop.seeds == 1 else f"ppo, seed {seed}": algorithm.policy(
                env_params, jax.tree.map(lambda x, seed=seed: x[seed], state)
            )
            for seed in range(config.loop.seeds)
        }
        policies |= {REFERENCE: StraightToGoal(config.navigation), "random": RandomActions()}
        print(f"driving {test.pool_size} tasks on {held_out.worlds} worlds not trained on ...")
        results = {name: evaluate(env, test, p, test_key) for name, p in policies.items()}
        _report(run, config, test, results)
    return run.folder


def _open(config: TrainConfig) -> Run:
    if config.resume is None:
        return Run.create(config.runs, "ppo", config)
    from vertiwm_jax.rl import checkpoints

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

    metrics = runs.read_metrics(run.folder)
    columns = {name: [line.get(name, np.nan) for line in metrics] for name in metrics[-1]}
    labels = {name: label for name, label in CURVES.items() if name in columns}
    figure = plots.learning_curves({"ppo": columns}, "transitions", labels, "transitions")
    figure.savefig(run.folder / "learning_curves.png")
    for name, group in groups.items():
        first = next(iter(group.values()))
        world = int(first.world[0])
        drives = {policy: result.path(0) for policy, result in group.items()}
        figure = plots.trajectories(
            test.terrain,
            world,
            drives,
            np.asarray(first.goal[0]),
            config.navigation.goal_radius,
            STEP_SECONDS,
        )
        figure.savefig(run.folder / f"trajectories_{name}.png")


if __name__ == "__main__":
    main()
