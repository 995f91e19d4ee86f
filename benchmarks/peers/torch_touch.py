"""Where vehicles touch the ground, in PyTorch: `vertiwm_jax.mechanics.contact` over a batch."""

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.peers.torch_query import Ground, surface
from vertiwm_jax.mechanics.contact import LEAST_YIELD, SHARED_DEPTH, TREAD_ANGLES

WHEELS = 4
RIM_POINTS = 2 * len(TREAD_ANGLES)
_RIM_ANGLES = torch.tensor(TREAD_ANGLES).repeat_interleave(2)[:, None]
_RIM_SIN, _RIM_COS = torch.sin(_RIM_ANGLES), torch.cos(_RIM_ANGLES)
_RIM_SIDE = torch.tensor([0.5, -0.5]).repeat(len(TREAD_ANGLES))[:, None]


class Touch(NamedTuple):
    """Contacts `[B, C]`, as `mechanics.contact.GroundContact`.

    Vectors are `[B, C, 3]` in body components.
    soil: `[B, C, 6]`, in the order of `torch_query.SOIL`.
    """

    point: Tensor
    normal: Tensor
    depth: Tensor
    friction: Tensor
    soft: Tensor
    soil: Tensor
    edge: Tensor


def touch(
    vehicle: Any,
    ground: Ground,
    position: Tensor,
    rotation: Tensor,
    travel: Tensor,
    steering: Tensor,
    sinkage: Tensor,
) -> tuple[Touch, Touch]:
    """Contacts of the wheels `[B, 4]` and of the deepest hull point `[B, 1]`.

    position: `[B, 3]` m; rotation: `[B, 3, 3]` from body to world; travel, steering and sinkage:
    `[B, 4]`, m and rad.
    """
    tread = _tread(vehicle, travel, steering).flatten(1, 2)
    hull = vehicle.hull.expand(len(tread), -1, -1)
    points = torch.cat([tread, hull], dim=1)
    world = position[:, None] + points @ rotation.mT
    below = surface(ground, world[..., :2])
    up = torch.rsqrt(1 + below.gradient.square().sum(-1))
    normal = torch.cat([-below.gradient, torch.ones_like(up)[..., None]], -1) * up[..., None]
    normal = normal @ rotation
    depth = (below.height - world[..., 2]) * up

    count = tread.shape[1]
    deepest = count + depth[:, count:].argmax(dim=1, keepdim=True)
    vehicles = torch.arange(len(depth))[:, None]
    semantic = below.semantic[vehicles, deepest]
    on_hull = Touch(
        point=points[vehicles, deepest],
        normal=normal[vehicles, deepest],
        depth=depth[vehicles, deepest],
        friction=below.friction[vehicles, deepest],
        soft=ground.deformable[semantic],
        soil=ground.soils[semantic],
        edge=torch.zeros_like(semantic, dtype=torch.bool),
    )
    samples = [
        x[:, :count].unflatten(1, (RIM_POINTS, WHEELS))
        for x in (points, normal, depth, below.friction, below.semantic)
    ]
    return _wheel_contacts(ground, samples, steering, sinkage), on_hull


def _wheel_contacts(
    ground: Ground, samples: list[Tensor], steering: Tensor, sinkage: Tensor
) -> Touch:
    """One contact `[B, 4]` of each wheel, shared by its points.

    samples: point, normal, depth, friction and class id of them, `[B, 10, 4, ...]`.
    """
    point, normal, depth, friction, semantic = samples
    soft = ground.deformable[semantic]
    carried = depth - soft * sinkage.clamp(min=LEAST_YIELD)[:, None]
    share = torch.softmax(carried / SHARED_DEPTH, dim=1)
    in_soil = (share * soft).sum(1) > 0.5
    share = share * (soft == in_soil[:, None])
    share = share / share.sum(1, keepdim=True)

    lowest = len(TREAD_ANGLES) - 1, len(TREAD_ANGLES)
    edge = ~in_soil & soft[:, lowest[0]] & soft[:, lowest[1]]
    ahead, up = (share * _RIM_SIN).sum(1), (share * _RIM_COS).sum(1)
    to_axle = torch.stack([-ahead * torch.cos(steering), -ahead * torch.sin(steering), up], dim=-1)
    to_axle = F.normalize(to_axle, dim=-1)
    upright = F.normalize((share[..., None] * normal).sum(1), dim=-1)
    below = semantic.gather(1, share.argmax(dim=1, keepdim=True))[:, 0]
    return Touch(
        point=(share[..., None] * point).sum(1),
        normal=torch.where(edge[..., None], to_axle, upright),
        depth=(share * depth).sum(1) * torch.where(edge, to_axle[..., 2], 1.0),
        friction=(share * friction).sum(1),
        soft=in_soil,
        soil=ground.soils[below],
        edge=edge,
    )


def _tread(vehicle: Any, travel: Tensor, steering: Tensor) -> Tensor:
    """Points `[B, 10, 4, 3]` on both rims of the lower half of each wheel, from the origin, m."""
    ahead, left = vehicle.wheel_radius * _RIM_SIN, vehicle.wheel_width * _RIM_SIDE
    cos, sin = torch.cos(steering)[:, None], torch.sin(steering)[:, None]
    x, y = vehicle.wheel_position.unbind(-1)
    z = travel[:, None] - vehicle.wheel_radius * _RIM_COS
    return torch.stack([x + ahead * cos - left * sin, y + ahead * sin + left * cos, z], dim=-1)
