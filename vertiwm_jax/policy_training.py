"""What the commands that train driving policies share: all but the algorithm."""

import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

import jax

from vertiwm_jax import config as configuration
from vertiwm_jax import machine, runs
from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.env import suites
from vertiwm_jax.env.action_repeat import ActionRepeat, Controller
from vertiwm_jax.env.agent import Agent, Policy
from vertiwm_jax.env.controllers import REFERENCE, baselines
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams
from vertiwm_jax.evaluation import plots, report
from vertiwm_jax.rl import task
from vertiwm_jax.rl.learned import Corrected, MeanAction, TwinValue, Value
from vertiwm_jax.rl.loop import LoopConfig, prepare, restore, train
from vertiwm_jax.rl.planning import Planner, PlanningConfig
from vertiwm_jax.rl.settings import LearningConfig
from vertiwm_jax.rl.task import TaskConfig
from vertiwm_jax.runs import Run
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.training import Algorithm, failures_in_one_line, keep_compiled

Rows = dict[str, Policy | Agent]


class Learning(Algorithm[Any], Protocol):
    """An algorithm that learns a policy from environments."""

    def policy(self, env_params: TaskParams, state: Any, /) -> MeanAction:
        """What `state` has learned."""
        ...

    def value(self, env_params: TaskParams, state: Any, /) -> Value | TwinValue:
        """What `state` expects of its policy."""
        ...


CURVES = {
    "episode_return": "return",
    "success": "success",
    "episode_length": "episode [steps]",
    "entropy": "entropy [nats]",
    "value_loss": "value loss",
    "kl": "KL divergence",
    "explained_variance": "explained variance",
}


@dataclass(frozen=True)
class TrainConfig(TaskConfig, ABC):
    """Settings of every such command; `name` is that of its algorithm's settings among them."""

    name: ClassVar[str]

    runs: Path = Path("runs")
    """Folder in which the folder of this run is made."""
    resume: Path | None = None
    """Folder of an earlier run to go on with; what is set beside changes its configuration."""
    wandb: str | None = None
    """Project of Weights & Biases that gets the metrics too; needs the package `wandb`."""
    compile_cache: Path | None = None
    """Folder that keeps compiled programs for later runs."""
    action_repeat: int = 4
    """Steps of 0.1 s that an action is held while learning; `transitions` count actions."""
    base: Literal["look ahead", "straight to goal", "none"] = "look ahead"
    """The controller that the policy learns to correct; it acts at every step."""
    planning: PlanningConfig | None = None
    """How the policy plans in tests, besides driving as it is; learning does not need it."""
    loop: LoopConfig = LoopConfig()
    """Seeds and checkpoints."""

    @property
    def schedule(self) -> LearningConfig:
        """The algorithm's settings."""
        return getattr(self, self.name)

    @abstractmethod
    def algorithm(self, env: NavigationEnv) -> Learning:
        """The algorithm on the task, as configured."""

    def repeated(self, env: NavigationEnv) -> ActionRepeat:
        """The task as algorithms see it."""
        return ActionRepeat(env, self.action_repeat, _base(self))


def main(kind: type[TrainConfig], argv: Sequence[str] | None = None) -> None:
    """Runs the command; expected failures end in one line and a status that is not 0."""
    program = f"python -m vertiwm_jax.{kind.name}"
    config = configuration.parse_resumable(kind, kind.name, argv, program)
    with failures_in_one_line():
        run_folder = train_and_report(config)
    print(f"all of it is in {run_folder}")


def learned(config: TrainConfig, terrain: TerrainMap, run: Path) -> Rows:
    """The policies of the run in the folder `run`, one a seed; `CheckpointError` if none.

    terrain: any worlds that tests can be drawn on.
    """
    dynamics, weights = task.dynamics(config, config.model)
    env = NavigationEnv(dynamics, config.asked, config.variation)
    params = env.shapes(weights, terrain, suites.test_tasks(config.ground, terrain))
    algorithm = config.algorithm(env)
    restored = restore(algorithm, params, run, config.loop.seeds)
    if restored is None:
        raise CheckpointError(f"{run}: expected checkpoints of a training, found none")
    return _policies(config, algorithm, params, restored[1])


def _base(config: TrainConfig) -> Controller | None:
    return None if config.base == "none" else baselines(config.asked)[config.base]


def _policies(config: TrainConfig, algorithm: Learning, params: TaskParams, state: Any) -> Rows:
    base, rows = _base(config), {}
    for seed in range(config.loop.seeds):
        of_seed = jax.tree.map(lambda x, seed=seed: x[seed], state)
        policy, name = algorithm.policy(params, of_seed), config.name
        if config.loop.seeds > 1:
            name = f"{config.name}, seed {seed}"
        rows[name] = Corrected(base, policy) if base else policy
        if config.planning:
            dynamics, weights = task.dynamics(config, config.planning.model)
            rows[f"{name} with planning"] = Planner(
                env=NavigationEnv(dynamics, config.asked),
                dynamics=weights,
                policy=policy,
                value=algorithm.value(params, of_seed),
                base=base,
                interval=config.action_repeat,
                discount=config.schedule.discount,
                config=config.planning,
            )
    return rows


def train_and_report(config: TrainConfig) -> Path:
    """Trains, or goes on with, a policy, tests it, and gives the folder of the run."""
    keep_compiled(config.compile_cache)
    config = replace(config, operands=config.multiplied)  # So that it goes on as it began.
    print("drawing worlds ...", flush=True)
    with _on_usable_ground():
        terrain, pool, held_out = task.training_ground(config)
        machine.forget_programs()
        dynamics, weights = task.dynamics(config, config.model)
        env = NavigationEnv(dynamics, config.asked, config.variation)
        shapes = env.shapes(weights, terrain, pool)
    algorithm, schedule, seeds = config.algorithm(env), config.schedule, config.loop.seeds
    steps = schedule.collected * config.action_repeat
    restored = restore(algorithm, shapes, config.resume, seeds) if config.resume else None
    if not restored or restored[0] < schedule.iterations:
        # Now, while there are no vehicles yet that fill the memory.
        prepare(algorithm, shapes, seeds, schedule.shareable)
    print(f"placing vehicles for {len(pool.world):,} tasks ...", flush=True)
    with _on_usable_ground():
        params = env.make_params(weights, terrain, pool)
    machine.forget_programs()
    with Run.begin(config, config.name, restored[0] if restored else 0, config.wandb) as run:
        print(f"run folder {run.folder}", flush=True)
        products = "" if config.model == "builtin" else f", multiplying {config.operands}"
        print(f"training in {config.model} on {terrain.worlds} worlds{products}", flush=True)
        key = config.key("training")
        state = train(
            algorithm,
            params,
            key,
            run,
            schedule.iterations,
            steps,
            schedule.shareable,
            config.loop,
            restored,
        )
        policies = _policies(config, algorithm, params, state) | baselines(config.asked)
        _draw_learning(run, config)
        del params, state  # Tests need the memory.
        machine.forget_programs()
        with _on_usable_ground():
            test = task.test_environment(config, held_out)
        groups = report.drive(test.env, test.params, policies, config.key("testing"))
        print(f"\n{report.markdown(groups, REFERENCE)}\n")
        ground_driven, radius = test.params.terrain, config.navigation.goal_radius
        report.write(run.folder, groups, REFERENCE, ground_driven, radius)
    return run.folder


@contextmanager
def _on_usable_ground() -> Iterator[None]:
    """Ends the command where something is wrong with the maps, or with the tasks on them."""
    try:
        yield
    except ValueError as error:
        sys.exit(f"error: {error}")


def _draw_learning(run: Run, config: TrainConfig) -> None:
    columns = runs.read_columns(run.folder)
    labels = {name: label for name, label in CURVES.items() if name in columns}
    figure = plots.learning_curves({config.name: columns}, "transitions", labels, "transitions")
    plots.save(figure, run.folder / "learning_curves.png")
