"""The shipped Verti-WM in PyTorch, a batch of vehicles at a time."""

from dataclasses import fields
from types import SimpleNamespace
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.peers import torch_motion as motion
from benchmarks.peers.torch_mechanics import Memory, Simulator
from benchmarks.peers.torch_networks import Cache, Encoder, Gate, SpecialistNetwork
from benchmarks.peers.torch_query import Ground, patches, tensor
from benchmarks.peers.torch_touch import WHEELS
from vertiwm_jax.mechanics.vehicle import GRAVITY
from vertiwm_jax.models.config import ModelConfig
from vertiwm_jax.networks.gate import HIDDEN
from vertiwm_jax.world_model import nesam_inputs
from vertiwm_jax.world_model.nesam_inputs import DEPTH, FIRM, LARGEST, TRAVEL, StepFeatures
from vertiwm_jax.world_model.normalization import LOCAL
from vertiwm_jax.world_model.verti_wm import VertiWM, VertiWMParams

_SHIPPED = ModelConfig(encoders="shared")
_WHEEL_FEATURES = 14
_GROUPS = torch.tensor([0, 0, 1, 2, 2, 3])
_LOCAL = tensor(LOCAL)


class History(NamedTuple):
    """As `VertiWMHistory`, as far as steps read it.

    nesam: of `[2 B]` tokens, those of all vehicles and then those of their mirror images.
    expected: `[B, 12]` what physics alone had made of the current state.
    hidden: `[G, B, 64]` of the gates.
    latent: `[B, 36, 16, 16]` the ground at the current state.
    """

    transformer: Cache
    nesam: Cache
    memory: Memory
    expected: Tensor
    hidden: Tensor
    latent: Tensor


class TorchVertiWM(nn.Module):
    """`VertiWM` as it ships, and its parameters."""

    def __init__(self, model: VertiWM, params: VertiWMParams):
        """Raises `ValueError` for a model of another form than the one that ships."""
        super().__init__()
        if model != _SHIPPED.verti_wm:
            raise ValueError(f"model: expected {_SHIPPED.verti_wm}, found {model}")
        transformer, nesam, (encoders,) = params.transformer, params.nesam, params.encoders
        assert transformer and nesam and params.gate
        size = _SHIPPED.transformer.size
        self.elevation = Encoder(encoders.elevation["params"])
        self.semantic = Encoder(encoders.semantic["params"])
        self.transformer = SpecialistNetwork(transformer.network["params"], size, encoders.reduce)
        self.nesam = SpecialistNetwork(nesam.network["params"], size)
        gates = params.gate.network["params"]
        self.gates = nn.ModuleList(
            Gate(jax.tree.map(lambda x, number=number: x[number], gates))
            for number in range(len(params.gate))
        )
        self.gate_mean, self.gate_scale = tensor(params.gate.mean), tensor(params.gate.scale)
        self.normalization = constants(transformer.normalization)
        self.deviations = constants(nesam.normalization)
        self.correction_scale = tensor(nesam.correction_scale)
        self.vehicle = constants(params.vehicle)
        self.vehicle.wheelbase = float(params.vehicle.wheelbase)
        self.simulator = Simulator(
            self.vehicle,
            constants(nesam.contact),
            float(nesam.stiffening),
            _SHIPPED.nesam.simulator.substeps,
        )
        self.mirror_signs, self.mirror_places = _mirror()
        self.motion_signs = tensor(nesam_inputs.MOTION_SIGNS)

    def init(self, ground: Ground, state: Tensor) -> History:
        """Histories of vehicles at `[B, 12]`, and a look at the ground."""
        batch = len(state)
        return History(
            transformer=self.transformer.empty_cache(batch),
            nesam=self.nesam.empty_cache(2 * batch),
            memory=self.simulator.init(ground, state),
            expected=state.clone(),
            hidden=torch.zeros(len(self.gates), batch, HIDDEN),
            latent=self.look(ground, state),
        )

    def step(
        self, ground: Ground, history: History, state: Tensor, command: Tensor
    ) -> tuple[Tensor, History]:
        """States `[B, 12]` and commands `[B, 2]` to the next states; caches change in place."""
        first, transformer = self.by_transformer(history, state, command)
        physics, memory = self.simulator.step(ground, history.memory, state, command)
        second, nesam = self.by_nesam(history, state, command, physics, memory)
        state, hidden = self.fuse(history, state, command, first, second)
        latent = self.look(ground, state)
        return state, History(transformer, nesam, memory, physics, hidden, latent)

    def rollout(self, worlds: Ground, world: Tensor, state: Tensor, commands: Tensor) -> Tensor:
        """`[B, 12]` on worlds `[B]` and commands `[B, T, 2]` to the next states `[B, T, 12]`."""
        ground = worlds.select(world)
        history = self.init(ground, state)
        states = []
        for command in commands.unbind(1):
            state, history = self.step(ground, history, state, command)
            states.append(state)
        return torch.stack(states, dim=1)

    def compiled(self) -> Self:
        """Itself with its parts through `torch.compile`, but for the look at the ground.

        Apart, because sub-steps are alike: one graph of a whole step holds five of them, and had
        not compiled after nine minutes. The look is left to PyTorch's own `grid_sample` and
        convolutions, which took 52 ms where what was compiled took 85 (256 vehicles, one core).
        """
        for owner, name in (
            (self, "by_transformer"),
            (self.simulator, "substep"),
            (self, "by_nesam"),
            (self, "fuse"),
        ):
            part = torch.compile(getattr(owner, name), fullgraph=True, dynamic=False)
            setattr(owner, name, part)
        return self

    def look(self, ground: Ground, state: Tensor) -> Tensor:
        """The encoded ground `[B, 36, 16, 16]` at states `[B, 12]`."""
        elevation, colors = patches(ground, state)
        return torch.cat([self.elevation(elevation), self.semantic(colors)], dim=1)

    def by_transformer(
        self, history: History, state: Tensor, command: Tensor
    ) -> tuple[Tensor, Cache]:
        """The next state `[B, 12]` as the Transformer has it."""
        scale = self.normalization
        features = torch.cat(
            [
                (state[:, _LOCAL] - scale.state_mean) / scale.state_deviation,
                (command - scale.command_mean) / scale.command_deviation,
            ],
            dim=-1,
        )
        output, cache = self.transformer(features, history.latent, history.transformer)
        transition = scale.transition_mean + scale.transition_deviation * output
        return motion.advance(state, transition), cache

    def by_nesam(
        self, history: History, state: Tensor, command: Tensor, physics: Tensor, memory: Memory
    ) -> tuple[Tensor, Cache]:
        """The next state `[B, 12]` as NeSAM has it, who corrects that of physics."""
        seen = self._features(history.expected, state, command, physics, memory)
        mirrored = self.mirror_signs * seen[:, self.mirror_places]
        outputs, cache = self.nesam(torch.cat([seen, mirrored]), None, history.nesam)
        straight, turned = outputs.chunk(2)
        correction = self.correction_scale * 0.5 * (straight + self.motion_signs * turned)
        return motion.corrected(physics, correction), cache

    def fuse(
        self, history: History, state: Tensor, command: Tensor, first: Tensor, second: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The next state `[B, 12]` from the Transformer's and NeSAM's, and the gates' memory."""
        by_first, by_second = motion.increment(state, first), motion.increment(state, second)
        apart, seen = by_second - by_first, history.latent.mean((-2, -1))
        context = torch.cat([seen, state, command, by_second, by_first, apart], dim=-1)
        seen = (context - self.gate_mean) * self.gate_scale
        each = [gate(seen, hidden) for gate, hidden in zip(self.gates, history.hidden, strict=True)]
        outputs, hidden = (torch.stack(found) for found in zip(*each, strict=True))
        # Planar and vertical motion, tilt and yaw share a coefficient each.
        beta = (0.5 + 1.5 * torch.tanh(outputs)).mean(0)[:, _GROUPS]
        twist = first[:, 6:] + beta * (second[:, 6:] - first[:, 6:])
        return motion.moved(state, by_first + beta * apart, twist), hidden

    def _features(
        self, expected: Tensor, state: Tensor, command: Tensor, physics: Tensor, memory: Memory
    ) -> Tensor:
        """`StepFeatures.flat`, `[B, 91]`."""
        vehicle, scale, touch = self.vehicle, self.deviations, memory.wheels
        kc, kphi = touch.soil[..., 0], touch.soil[..., 1]
        modulus = torch.where(touch.soft, kphi + kc / vehicle.wheel_width, FIRM)
        slip = vehicle.wheel_radius * memory.wheel_speed - physics[:, 6:7]
        wheels = [
            torch.asinh(slip),
            (memory.travel - vehicle.free_travel) / TRAVEL,
            memory.sinkage / DEPTH,
            torch.cat([torch.zeros_like(memory.rut), memory.rut], dim=-1) / DEPTH,
            *(memory.force / (vehicle.mass * GRAVITY / 4)).unbind(-1),
            touch.soft.float(),
            touch.edge.float(),
            touch.friction,
            torch.log(modulus / FIRM),
            touch.depth / DEPTH,
            touch.normal[..., 0],
            touch.normal[..., 1],
        ]
        features = [
            state[:, _LOCAL] / scale.state_deviation,
            command / scale.command_deviation,
            motion.transition(state, physics) / scale.transition_deviation,
            motion.difference(expected, state) / self.correction_scale,
            memory.steering[:, None] / vehicle.steering_limit,
            torch.stack(wheels, dim=-1).flatten(1),
        ]
        return torch.cat(features, dim=-1).clamp(-LARGEST, LARGEST)


def constants(struct: Any) -> Any:
    """The scalars of a flax struct as floats and its arrays as tensors, under their own names."""
    values = {field.name: np.asarray(getattr(struct, field.name)) for field in fields(struct)}
    return SimpleNamespace(**{k: tensor(x) if x.ndim else float(x) for k, x in values.items()})


def _mirror() -> tuple[Tensor, Tensor]:
    """Signs and places `[91]` of what a mirror makes of features, found by mirroring places."""
    places = jnp.arange(1, nesam_inputs.SIZE + 1)
    body, wheels = jnp.split(places, [nesam_inputs.SIZE - WHEELS * _WHEEL_FEATURES])
    seen = StepFeatures(body, wheels.reshape(WHEELS, -1)).mirrored
    mirrored = np.concatenate([seen.body, np.ravel(seen.wheels)])
    return tensor(np.sign(mirrored).astype(np.float32)), tensor(np.abs(mirrored) - 1).long()
