"""Steps of Verti-WM a second, beside PyTorch's, which first has to arrive at the same states."""

import time
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import torch

from benchmarks._harness import Figures, measure, parser, report
from benchmarks.peers.torch_query import Ground, tensor
from benchmarks.peers.torch_vertiwm import TorchVertiWM
from vertiwm_jax import machine, parallel
from vertiwm_jax.dynamics import rollout
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.models.registry import load_model
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import worlds
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.worlds import WorldConfig
from vertiwm_jax.world_model.verti_wm import VertiWM, VertiWMParams

BATCHES = (20, 256)
STEPS = 16
WORLDS = 9
"""Rigid, soft and mixed ones, each flat, middling and steep."""
ONE_STEP, ALL_STEPS = 1e-4, 2e-3
"""Most that positions may be apart after one step and after all of them, m, of `NEARLY_ALL`."""
NEARLY_ALL = 0.95
"""19 of 20: contact jumps, and roundings alone carry a few vehicles of ours as far from itself."""
ROUNDING = 2**-23
_OURS = "vertiwm_jax"
Way = Literal["eager", "compiled"]
Roll = Callable[[], jax.Array | torch.Tensor]


class Drives(NamedTuple):
    """worlds `[B]` of a map; vehicles that stand or roll, leaves `[B, 3]`; commands `[B, T]`."""

    terrain: TerrainMap
    worlds: jax.Array
    starts: VehicleState
    commands: Command

    @classmethod
    def draw(cls, batch: int, steps: int) -> "Drives":
        """Random ones, from 0 to 3 m/s."""
        terrain = worlds.generate(jax.random.split(jax.random.key(0), WORLDS), WorldConfig())
        keys = jax.random.split(jax.random.key(1), 5)
        world = jnp.arange(batch) % WORLDS

        def placed(world: jax.Array, xy: jax.Array, yaw: jax.Array, speed: jax.Array):
            return place(terrain.select(world), xy, yaw, speed=speed)

        starts = jax.jit(jax.vmap(placed))(
            world,
            jax.random.uniform(keys[0], (batch, 2), minval=-40.0, maxval=40.0),
            jax.random.uniform(keys[1], (batch,), minval=-jnp.pi, maxval=jnp.pi),
            jax.random.uniform(keys[2], (batch,), maxval=3.0),
        )
        commands = Command(
            speed=jax.random.uniform(keys[3], (batch, steps), maxval=4.0),
            steering=jax.random.uniform(keys[4], (batch, steps), minval=-0.3, maxval=0.3),
        )
        return cls(terrain, world, starts, commands)


def ours(model: VertiWM, params: VertiWMParams) -> Callable[[Drives], Roll]:
    """What rolls out drives that it holds, to states `[B, T, 12]`, on all cores, as one program."""

    def drive(
        params: VertiWMParams,
        terrain: TerrainMap,
        world: jax.Array,
        start: VehicleState,
        commands: Command,
    ) -> jax.Array:
        ground = terrain.select(world)
        history = model.init(params, ground, start)
        return rollout(model, params, ground, start, commands, history).vector

    many = jax.jit(parallel.vmap(drive, in_axes=(None, None, 0, 0, 0)))

    def holding(drives: Drives) -> Roll:
        mesh = parallel.mesh(len(drives.worlds))
        held = parallel.place(mesh, (params, *drives))

        def roll() -> jax.Array:
            with jax.set_mesh(mesh):
                return many(*held)

        return roll

    return holding


def theirs(model: TorchVertiWM, drives: Drives) -> Roll:
    """The same by PyTorch, of drives that it holds as tensors."""
    # Inference tensors from the start: compiled code is specialised to what it is given first.
    with torch.inference_mode():
        ground, world = Ground.of(drives.terrain), tensor(drives.worlds).long()
        start = tensor(drives.starts.vector).clone()
        commands = tensor(drives.commands.vector).clone()

    def roll() -> torch.Tensor:
        with torch.inference_mode():
            return model.rollout(ground, world, start, commands)

    return roll


def distances(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """How far apart positions of states `[B, T, 12]` are, m; a NaN is infinitely far."""
    apart = np.linalg.norm(ours[..., :3] - theirs[..., :3], axis=-1)
    first, last = np.where(np.isnan(apart), np.inf, apart)[:, [0, -1]].T
    return {
        "one_step_within": float(np.mean(first <= ONE_STEP)),
        "one_step_largest_m": float(np.max(first)),
        "last_within": float(np.mean(last <= ALL_STEPS)),
        "last_median_m": float(np.median(last)),
        "last_largest_m": float(np.max(last)),
    }


def agreement(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """`distances`, or `ValueError` if these are not the same drives."""
    found = distances(ours, theirs)
    least = min(found["one_step_within"], found["last_within"])
    if least < NEARLY_ALL or found["last_largest_m"] == np.inf:
        raise ValueError(
            f"torch_peer: expected {NEARLY_ALL:.0%} within {ONE_STEP:g} m after one step and "
            f"within {ALL_STEPS:g} m after all, found {found}"
        )
    return found


def rates(ways: Sequence[Way], batch: int, repeats: int) -> dict[str, Figures]:
    """Steps a second at one batch, once they are known to be the same steps."""
    drives = Drives.draw(batch, STEPS)
    model, params = load_model("vertiwm")
    assert isinstance(model, VertiWM)
    roll_ours = ours(model, params)
    rolls: dict[str, Roll] = {_OURS: roll_ours(drives)}
    for way in ways:
        peer = TorchVertiWM(model, params)
        rolls[f"torch, {way}"] = theirs(peer.compiled() if way == "compiled" else peer, drives)

    states: dict[str, np.ndarray] = {}
    first_calls: dict[str, float] = {}
    for name, roll in rolls.items():
        start = time.perf_counter()
        states[name] = np.asarray(roll())
        first_calls[name] = time.perf_counter() - start
    reference = states.pop(_OURS)
    agreements = {name: agreement(reference, found) for name, found in states.items()}
    # How far ours gets from itself by a rounding is what no other program can be asked to beat.
    nudged = jax.tree.map(lambda x: x * (1 + jnp.float32(ROUNDING)), drives.starts)
    itself = np.asarray(roll_ours(drives._replace(starts=nudged))())

    timed = {name: measure(roll, repeats=repeats) for name, roll in rolls.items()}
    results: dict[str, Figures] = {
        f"{name}, batch {batch}": {
            "steps_per_s": batch * STEPS / figures["median_s"],
            "ours_times_faster": figures["median_s"] / timed[_OURS]["median_s"],
            **figures,
            "first_call_s": first_calls[name],
            **agreements.get(name, {}),
        }
        for name, figures in timed.items()
    }
    case = f"{_OURS}, starts a rounding away, batch {batch}"
    return results | {case: distances(reference, itself)}


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--ways", nargs="+", choices=get_args(Way), default=get_args(Way))
    arguments.add_argument("--batches", nargs="+", type=int, default=BATCHES)
    arguments.add_argument("--repeats", type=int, default=10, help="timed rollouts, at least")
    chosen = arguments.parse_args()
    torch.set_num_threads(machine.cores())
    results: dict[str, Figures] = {}
    for batch in chosen.batches:
        results |= rates(chosen.ways, batch, chosen.repeats)
    threads = torch.get_num_threads()
    also = {"torch": torch.__version__, "torch_threads": threads}
    report("torch_peer", results, chosen.json, also)


if __name__ == "__main__":
    main()
