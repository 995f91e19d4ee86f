"""F_N, NeSAM: the simulator's mechanics and a causal Transformer that corrects them (Sec. IV-B)."""

from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.mechanics.simulator import Simulator, SimulatorHistory, SimulatorParams
from vertiwm_jax.networks.encoder import LATENT_CHANNELS
from vertiwm_jax.networks.soil_predictor import SoilPredictor
from vertiwm_jax.networks.transformer import KeyValueCache
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import Soil
from vertiwm_jax.world_model import motion, step_features
from vertiwm_jax.world_model.normalisation import Normalisation
from vertiwm_jax.world_model.perception import (
    EncoderParams,
    Exteroception,
    Glance,
    Perception,
    Remembers,
    View,
    glance,
    latents,
)
from vertiwm_jax.world_model.sizes import BASE, TransformerSize
from vertiwm_jax.world_model.specialist_network import SpecialistNetwork
from vertiwm_jax.world_model.step_features import StepFeatures

_SOIL = SoilPredictor()
SoilSource = Literal["map", "predicted"]
NUDGE = 0.05
"""Change of velocities, m/s and rad/s, by which `calibrate` measures how physics answers."""


@struct.dataclass
class NesamParams:
    """network: what is learned; encoders: frozen by default; soil: weights of the `SoilPredictor`.

    correction_scale: `[12]` root mean square of what physics misses in a step, as
        `motion.difference` has it.
    response: `[12, 6]` change of a proposed `motion.transition` per change of the velocities that
        it starts from, as physics typically has it.
    Both are measured by `calibrate`, and never learned.
    """

    network: Any
    encoders: EncoderParams
    soil: Any
    simulator: SimulatorParams
    normalisation: Normalisation
    correction_scale: jax.Array
    response: jax.Array


@struct.dataclass
class NesamHistory:
    """simulator: physical memory; cache: of the past tokens, None without the correction.

    physics: what physics alone had made of the current state, which tells what it missed.
    perception: of the current state; None in a model that keeps it elsewhere.
    """

    simulator: SimulatorHistory
    cache: KeyValueCache | None
    physics: VehicleState
    perception: Perception | Glance | None


@dataclass(frozen=True)
class Nesam:
    """The `Dynamics` F_N: a step of the simulator, whose next state is then corrected.

    The correction depends on neither place, height nor heading, and is mirrored when the vehicle
    and its ground are: the network reads every step twice, the second time as in a mirror, and the
    mean of both answers counts. It sees the ground through what physics makes of it, so a rollout
    that nobody asks what it saw needs no encoders.

    residual: whether physics is corrected at all.
    gradient: "exact" through the simulator; or "mean", several times cheaper, as if what it
        proposes depended on the velocities alone, and on them linearly (`NesamParams.response`).
        Values are the same.
    soil: whose parameters physics uses: those that the "map" has for each class of ground, or
        those "predicted" from what the ground at the vehicle looks like, the same for all wheels.
    exteroception: how it looks at patches.
    remembers: what its history has of a look; to predict soils, the latents.
    """

    size: TransformerSize = BASE
    residual: bool = True
    gradient: Literal["exact", "mean"] = "mean"
    soil: SoilSource = "map"
    exteroception: Exteroception = Exteroception()
    simulator: Simulator = Simulator()
    remembers: Remembers = "latents"

    def __post_init__(self) -> None:
        if self.remembers == "glance" and self.soil == "predicted":
            raise ValueError("remembers: expected latents to predict soils, found glance")

    def init_params(
        self,
        key: jax.Array,
        simulator: SimulatorParams,
        normalisation: Normalisation | None = None,
    ) -> NesamParams:
        """Physics as it is, and a network that leaves it so; see `calibrate` before learning."""
        encoder_key, network_key, soil_key = jax.random.split(key, 3)
        latent = jnp.zeros((16, 16, LATENT_CHANNELS))
        return NesamParams(
            network=self._network.init(network_key, jnp.zeros((1, step_features.SIZE)), None),
            encoders=self.exteroception.init_params(encoder_key),
            soil=_SOIL.init(soil_key, latent, jnp.float32(0)),
            simulator=simulator,
            normalisation=normalisation or Normalisation.unit(),
            correction_scale=jnp.ones(12),
            response=jnp.zeros((12, 6)),
        )

    def init(self, params: NesamParams, terrain: TerrainMap, state: VehicleState) -> NesamHistory:
        """The simulator's history, an empty cache and a look at the ground."""
        begun = self.begin(params, terrain, state)
        return replace(begun, perception=self.look(params, terrain, state))

    def begin(self, params: NesamParams, terrain: TerrainMap, state: VehicleState) -> NesamHistory:
        """`init` without the look."""
        empty = self._network.apply(params.network, (2,), method=SpecialistNetwork.empty_cache)
        cache = cast(KeyValueCache, empty) if self.residual else None
        memory = self.simulator.init(params.simulator, terrain, state)
        return NesamHistory(memory, cache, state, None)

    def step(
        self,
        params: NesamParams,
        terrain: TerrainMap,
        history: NesamHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, NesamHistory]:
        """The next state, and a look at the ground there."""
        state, history = self.propose(params, terrain, history, state, command)
        return state, replace(history, perception=self.look(params, terrain, state))

    def propose(
        self,
        params: NesamParams,
        terrain: TerrainMap,
        history: NesamHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, NesamHistory]:
        """`step` up to the next state; `history.perception` is still that of `state`."""
        ground = self._ground(params, terrain, history.perception)
        physics, memory = self._physics(params, ground, history.simulator, state, command)
        following = replace(history, simulator=memory, physics=physics)
        if not self.residual:
            return physics, following
        features = _features(params, history.physics, state, command, physics, memory)
        outputs, cache = cast(
            tuple[jax.Array, KeyValueCache],
            self._network.apply(
                params.network, features, None, history.cache, method=SpecialistNetwork.step
            ),
        )
        correction = _correction(params, outputs)
        return motion.corrected(physics, correction), replace(following, cache=cache)

    def follow(
        self,
        params: NesamParams,
        terrain: TerrainMap,
        states: VehicleState,
        commands: Command,
    ) -> VehicleState:
        """A step from every state of a recorded drive: leaves `[T, 3]`, commands `[T]`.

        What `step` gives from each of them with the history of those before. Physics goes step by
        step, without a gradient, and the network over all of them at once.
        """
        physics, memories = _fixed(self.physics_along(params, terrain, states, commands))
        if not self.residual:
            return physics
        expected = jax.tree.map(lambda x, y: jnp.concatenate([x[:1], y[:-1]]), states, physics)
        features = _features(params, expected, states, commands, physics, memories)
        outputs = cast(jax.Array, self._network.apply(params.network, features, None))
        return motion.corrected(physics, _correction(params, outputs))

    def physics_along(
        self,
        params: NesamParams,
        terrain: TerrainMap,
        states: VehicleState,
        commands: Command,
    ) -> tuple[VehicleState, SimulatorHistory]:
        """What physics alone proposes from every recorded state, and its memory after each.

        Leaves `[T, 3]` and commands `[T]`; no weight enters, so a drive needs this only once.
        """

        def advance(memory: SimulatorHistory, inputs: tuple[VehicleState, Command]):
            ground = self._ground(params, terrain, self.look(params, terrain, inputs[0]))
            proposed, memory = self.simulator.step(params.simulator, ground, memory, *inputs)
            return memory, (proposed, memory)

        first = jax.tree.map(lambda x: x[0], states)
        memory = self.simulator.init(params.simulator, terrain, first)
        return jax.lax.scan(advance, memory, (states, commands))[1]

    @property
    def _network(self) -> SpecialistNetwork:
        return SpecialistNetwork(self.size)

    def look(
        self, params: NesamParams, terrain: TerrainMap, state: VehicleState
    ) -> Perception | Glance:
        """What it remembers of a look at the ground."""
        return self.exteroception.look((self.view(params),), terrain, state)[0]

    def view(self, params: NesamParams) -> View:
        """How it looks at patches."""
        return View(params.encoders, latents if self.remembers == "latents" else glance)

    def _ground(
        self, params: NesamParams, terrain: TerrainMap, perception: Perception | Glance | None
    ) -> TerrainMap:
        """The map with the soils that physics is to use."""
        if self.soil == "map":
            return terrain
        assert isinstance(perception, Perception), "without latents it cannot predict the soil"
        predicted = cast(Soil, _SOIL.apply(params.soil, perception.semantic, jnp.float32(0)))
        return terrain.with_soils(replace(predicted, unit_weight=query.soils(terrain).unit_weight))

    def _physics(
        self,
        params: NesamParams,
        terrain: TerrainMap,
        memory: SimulatorHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, SimulatorHistory]:
        """A step of the simulator, with the gradient that was asked for."""
        if self.gradient == "exact":
            return self.simulator.step(params.simulator, terrain, memory, state, command)
        given = _fixed((params.simulator, terrain, memory, state, command))
        proposed, memory = _fixed(self.simulator.step(*given))
        start = given[3]
        gained = motion.twist(state) - motion.twist(start)  # zero, but for its gradient
        transition = motion.transition(start, proposed) + _fixed(params.response) @ gained
        tracked = motion.advance(state, transition)
        return jax.tree.map(lambda x, y: x + (y - _fixed(y)), proposed, tracked), memory


def calibrate(
    model: Nesam, params: NesamParams, terrain: TerrainMap, states: VehicleState, commands: Command
) -> NesamParams:
    """The parameters with `correction_scale` and `response` measured on recorded drives.

    states: leaves `[N, T + 1, 3]` on the worlds `terrain.world` `[N]`; commands: leaves `[N, T]`.
    """

    def one(
        world: jax.Array, states: VehicleState, commands: Command
    ) -> tuple[jax.Array, jax.Array]:
        ground = terrain.select(world)
        before, after = (
            jax.tree.map(lambda x, part=part: x[part], states)
            for part in (slice(None, -1), slice(1, None))
        )
        proposed, memories = model.physics_along(params, ground, before, commands)
        # The last but one memory goes with the last state.
        memory = jax.tree.map(lambda x: x[-2], memories)
        start, command = jax.tree.map(lambda x: x[-1], (before, commands))

        def answer(twist: jax.Array) -> jax.Array:
            moving = replace(start, velocity=twist[:3], angular_velocity=twist[3:])
            later, _ = model.simulator.step(params.simulator, ground, memory, moving, command)
            return motion.transition(moving, later)

        # Differences over about what physics misses: at a point, contacts are either on or off.
        nudges = NUDGE * jnp.concatenate([jnp.eye(6), -jnp.eye(6)])
        above, below = jnp.split(jax.vmap(answer)(motion.twist(start) + nudges), 2)
        return jax.vmap(motion.difference)(proposed, after), (above - below).T / (2 * NUDGE)

    missed, response = jax.vmap(one)(terrain.world, states, commands)
    # A few crashes would make up most of the squares.
    missed = jnp.abs(missed.reshape(-1, 12))
    missed = jnp.minimum(missed, jnp.percentile(missed, 99.0, axis=0))
    scale = jnp.sqrt(jnp.mean(missed**2, axis=0))
    return replace(params, correction_scale=scale, response=jnp.median(response, axis=0))


def _features(
    params: NesamParams,
    expected: VehicleState,
    state: VehicleState,
    command: Command,
    physics: VehicleState,
    memory: SimulatorHistory,
) -> jax.Array:
    """What the network reads of any number of steps `[...]`, and in a mirror: `[2, ..., F]`."""
    constants, scale, vehicle = _fixed(
        (params.normalisation, params.correction_scale, params.simulator.vehicle)
    )
    seen = StepFeatures.of(constants, scale, vehicle, expected, state, command, physics, memory)
    return jnp.stack([seen.flat, seen.mirrored.flat])


def _correction(params: NesamParams, outputs: jax.Array) -> jax.Array:
    """`[..., 12]` of the outputs `[2, ..., 12]` for a step and its mirror image."""
    mean = 0.5 * (outputs[0] + step_features.MOTION_SIGNS * outputs[1])
    return _fixed(params.correction_scale) * mean


def _fixed(tree: Any) -> Any:
    return jax.lax.stop_gradient(tree)
