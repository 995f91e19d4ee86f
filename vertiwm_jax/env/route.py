"""How hard ground is to drive on, and what it costs to drive on to a goal from anywhere.

A route goes through the middles of cells that tile the map, by moves to sixteen cells around. A
move costs its length, and more where the ground would tilt, twist or ground the vehicle, or where
an obstacle stands. The cost to go is that of the cheapest route (Bellman's equation, solved by
value iteration).
"""

import functools
from dataclasses import dataclass, replace
from typing import Annotated, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax import kept, machine, parallel
from vertiwm_jax.config import Bounds, NotNegative, settings
from vertiwm_jax.env.termination import edge_distance
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.terrain import _raster, obstacles, query
from vertiwm_jax.terrain.map import TerrainMap

CLEARANCE = 0.3
"""Clearance to obstacles, m."""
SLOPE_SCALE = 0.4
TWIST_SCALE = 0.2
CROWN_SCALE = 0.2  # m
_MOVES = np.array([(1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)])
_PLACES = np.array([0.0, 0.5, 1.0])  # of a move, where the ground is looked at
_ROUNDS = 16  # of value iteration, before it is looked whether anything still changes
_REACH = 2  # cells, of the longest moves along an axis
_NEAR = 1.5  # cells from a goal within which the way to it is straight


@struct.dataclass
class Footprint:
    """The ground below a vehicle, leaves `[...]`.

    mean: height under the wheels, m.
    crown: height of the ground between the wheels above that, which the belly touches, over 0.2 m.
    rise, bank: slopes from rear to front and from right to left, over 0.4.
    twist: difference of the slopes at both axles, which lifts wheels, over 0.2.
    """

    mean: jax.Array
    crown: jax.Array
    rise: jax.Array
    bank: jax.Array
    twist: jax.Array


def places(
    vehicle: Vehicle, xy: jax.Array | np.ndarray, heading: jax.Array | np.ndarray
) -> jax.Array:
    """The middles and wheels of vehicles at `[..., 2]`, m, with `[...]` heading: `[5, ..., 2]`."""
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    forward = jnp.stack([cos, sin], axis=-1) * vehicle.wheelbase / 2
    left = jnp.stack([-sin, cos], axis=-1) * vehicle.track / 2
    corners = (forward + left, forward - left, -forward + left, -forward - left)
    return jnp.stack([xy, *(xy + corner for corner in corners)])


def footprint(vehicle: Vehicle, heights: jax.Array) -> Footprint:
    """Of heights `[5, ...]`, m, at `places`."""
    middle, fl, fr, rl, rr = heights
    mean = (fl + fr + rl + rr) / 4
    return Footprint(
        mean=mean,
        crown=(middle - mean) / CROWN_SCALE,
        rise=(fl + fr - rl - rr) / (2 * vehicle.wheelbase * SLOPE_SCALE),
        bank=(fl + rl - fr - rr) / (2 * vehicle.track * SLOPE_SCALE),
        twist=(fl + rr - fr - rl) / (2 * vehicle.track * TWIST_SCALE),
    )


@dataclass(frozen=True)
class TraversabilityCost:
    """The difficulty of ground.

    bank, rise, twist, crown: weights of the squares of the parts of a `Footprint`.
    tolerated: bank and rise that cost nothing.
    """

    bank: float = 1.0
    rise: float = 1.45
    twist: float = 2.3
    crown: float = 1.1
    tolerated: float = 0.4

    def __call__(
        self, crown: jax.Array, rise: jax.Array, bank: jax.Array, twist: jax.Array
    ) -> jax.Array:
        """`[...]`, 0 on ground that is level."""
        return (
            self.bank * jnp.maximum(jnp.abs(bank) - self.tolerated, 0.0) ** 2
            + self.rise * jnp.maximum(jnp.abs(rise) - self.tolerated, 0.0) ** 2
            + self.twist * twist**2
            + self.crown * jnp.maximum(crown, 0.0) ** 2
        )


@settings
class RouteConfig:
    """Costs of routes on a known map; static.

    cells: number along each side of the map.
    difficulty: how hard ground is to drive on.
    detour: extra cost of a meter of difficulty 1, in meters of level ground.
    blocked: extra cost of a meter that touches an obstacle or the edge of the map.
    """

    cells: Annotated[int, Bounds("at least 4", lambda x: x >= 4)] = 64
    difficulty: TraversabilityCost = TraversabilityCost()
    detour: NotNegative = 2.0
    blocked: NotNegative = 10.0


@struct.dataclass
class Routes:
    """Costs to go to P goals, of which one is selected.

    cost: `[P, n, n]` m of level ground, from the middles of cells; row 0 is the northernmost.
    number: `[]` int32, of the selected goal.
    """

    cost: jax.Array
    number: jax.Array

    def select(self, number: jax.Array) -> Self:
        """The same with goal `[]` selected. Under `vmap` only the number is batched: no copy."""
        return replace(self, number=jnp.asarray(number, jnp.int32))

    def cost_to_go(self, terrain: TerrainMap, xy: jax.Array) -> jax.Array:
        """Cost to go `[...]`, m, from points `[..., 2]`; bilinear, off the map that of its edge."""
        cells = self.cost.shape[-1]
        place = (xy - terrain.origin) * jnp.array([1.0, -1.0]) / _cell_size(terrain, cells) - 0.5
        # `where` and not `clip`: NaN becomes 0, and its gradient too.
        place = jnp.minimum(jnp.where(place > 0, place, 0.0), cells - 1.0)
        corner = jnp.minimum(place.astype(jnp.int32), cells - 2)
        across, down = jnp.moveaxis(place - corner, -1, 0)
        index = (self.number * cells + corner[..., 1]) * cells + corner[..., 0]
        at = functools.partial(_raster.gather, self.cost)
        upper = at(index) * (1 - across) + at(index + 1) * across
        lower = at(index + cells) * (1 - across) + at(index + cells + 1) * across
        return upper * (1 - down) + lower * down


def plan(
    config: RouteConfig, terrain: TerrainMap, vehicle: Vehicle, world: jax.Array, goal: jax.Array
) -> Routes:
    """Routes to goals `[P, 2]`, m, in worlds `[P]`, computed by all devices."""
    to_goals = parallel.shared_out(functools.partial(_plan, config), len(world))
    return Routes(to_goals(vehicle, terrain, world, goal), jnp.int32(0))


def plan_one(config: RouteConfig, terrain: TerrainMap, vehicle: Vehicle, goal: jax.Array) -> Routes:
    """The route to the goal `[2]`, m, in the selected world; can be compiled."""
    costs = _costs(config, vehicle, terrain, terrain.world)
    route = _costs_to_go(terrain, costs[None], jnp.int32(0), goal)
    return Routes(route[None], jnp.int32(0))


def straight(config: RouteConfig, terrain: TerrainMap, goal: jax.Array) -> Routes:
    """Routes to goals `[P, 2]`, m, on unknown ground: straight distances."""
    offset = goal[:, None, None] - _middles(terrain, config.cells)
    return Routes(jnp.linalg.norm(offset, axis=-1), jnp.int32(0))


@functools.partial(kept.jit, static_argnames="config", brief=False)
def _plan(
    config: RouteConfig, vehicle: Vehicle, terrain: TerrainMap, world: jax.Array, goal: jax.Array
) -> jax.Array:
    """`[P, n, n]` m"""
    together = machine.together(cpu=1, accelerator=256)
    of_worlds = parallel.vmap(functools.partial(_costs, config), (None, None, 0), together)
    costs = of_worlds(vehicle, terrain, jnp.arange(terrain.worlds))
    return parallel.vmap(_costs_to_go, (None, None, 0, 0), together)(terrain, costs, world, goal)


def _costs(
    config: RouteConfig, vehicle: Vehicle, terrain: TerrainMap, world: jax.Array
) -> jax.Array:
    """`[16, n, n]` costs of moves from cells, those of `_MOVES` and back, m of level ground."""
    terrain = terrain.select(world)
    move = _MOVES * _cell_size(terrain, config.cells)
    length, heading = jnp.linalg.norm(move, axis=-1), jnp.arctan2(move[:, 1], move[:, 0])
    on_the_way = (_PLACES[:, None, None] * move)[:, :, None, None]
    xy = _middles(terrain, config.cells) + on_the_way  # [3, 8, n, n, 2]
    heading = jnp.broadcast_to(heading[:, None, None], xy.shape[:-1])
    ground = footprint(vehicle, query.height(terrain, places(vehicle, xy, heading)))
    hard = config.difficulty(ground.crown, ground.rise, ground.bank, ground.twist)
    size = vehicle.length + 2 * CLEARANCE, vehicle.width + 2 * CLEARANCE
    blocked = obstacles.collides(terrain, xy[1], heading[1], *size)
    blocked |= edge_distance(terrain, xy[1]) < vehicle.length / 2
    each = 1 + config.detour * jnp.mean(hard, axis=0) + config.blocked * blocked
    there = length[:, None, None] * each
    # A move back is as hard as the one there, which begins where it ends.
    back = [_window(_padded(cost), -move) for cost, move in zip(there, _MOVES, strict=True)]
    return jnp.concatenate([there, jnp.stack(back)])


def _costs_to_go(
    terrain: TerrainMap, costs: jax.Array, world: jax.Array, goal: jax.Array
) -> jax.Array:
    """`[n, n]` m to the goal `[2]`, by the costs `[W, 16, n, n]` of moves."""
    costs, cells = costs[world], costs.shape[-1]
    offset = (goal - _middles(terrain, cells)) / _cell_size(terrain, cells)
    near = jnp.max(jnp.abs(offset), axis=-1) <= _NEAR
    distance = jnp.linalg.norm(offset * _cell_size(terrain, cells), axis=-1)

    moves = np.concatenate([_MOVES, -_MOVES])

    def improve(cost: jax.Array, _: None) -> tuple[jax.Array, None]:
        around = _padded(cost)
        onward = [
            of_move + _window(around, move) for move, of_move in zip(moves, costs, strict=True)
        ]
        return functools.reduce(jnp.minimum, onward, cost), None

    def go_on(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        cost, _ = carry
        better, _ = jax.lax.scan(improve, cost, length=_ROUNDS)
        return better, jnp.any(better < cost)

    begin = jnp.where(near, distance, jnp.inf), jnp.bool(True)
    return jax.lax.while_loop(lambda carry: carry[1], go_on, begin)[0]


def _padded(values: jax.Array) -> jax.Array:
    """Values `[n, n]` with a border of inf as wide as moves reach."""
    return jnp.pad(values, _REACH, constant_values=jnp.inf)


def _window(padded: jax.Array, move: np.ndarray) -> jax.Array:
    """The padded values at the cells that a move leads to, `[n, n]`."""
    east, north = (int(x) for x in move)
    rows, columns = (size - 2 * _REACH for size in padded.shape)
    return padded[_REACH - north :, _REACH + east :][:rows, :columns]


def _cell_size(terrain: TerrainMap, cells: int) -> jax.Array:
    """`[2]` m along x and y."""
    return terrain.size / cells


def _middles(terrain: TerrainMap, cells: int) -> jax.Array:
    """`[n, n, 2]` m, of cells."""
    place = np.stack(np.meshgrid(*2 * [np.arange(cells) + 0.5]), axis=-1).astype(np.float32)
    return terrain.origin + place * _cell_size(terrain, cells) * jnp.array([1.0, -1.0])
