"""Forces on wheels in PyTorch: `vertiwm_jax.mechanics.scm`, and friction on rigid ground."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from vertiwm_jax.mechanics.wheel import MAX_SINKAGE

_MIN_SINKAGE = 1e-6
_SHORTEST = 0.02


class WheelForces(NamedTuple):
    """As `mechanics.wheel.WheelForces`, all `[B, 4]`, N and N m."""

    longitudinal: Tensor
    lateral: Tensor
    normal: Tensor
    torque: Tensor


def scm_forces(
    vehicle: Any,
    contact: Any,
    soil: Tensor,
    sinkage: Tensor,
    velocity_x: Tensor,
    velocity_y: Tensor,
    omega: Tensor,
    rut: Tensor,
    quadrature: tuple[Tensor, Tensor],
) -> WheelForces:
    """Forces at a given sinkage, all `[B, 4]`; soil `[B, 4, 6]`, else as `ScmParams.forces`.

    quadrature: points and weights of `gauss_legendre`, which make a trailing axis of nodes.
    """
    radius, width, creep = vehicle.wheel_radius, vehicle.wheel_width, contact.creep_speed
    kc, kphi, n, cohesion, friction_angle, shear_modulus = soil.unbind(-1)
    ahead = torch.where(velocity_x + radius * omega >= 0, 1.0, -1.0)
    hub, rim = ahead * velocity_x, ahead * radius * omega
    fresh = hub * torch.rsqrt(hub**2 + contact.fresh_speed**2)

    depth = ((sinkage - rut) / radius).clamp(0.0, MAX_SINKAGE)
    touching = depth > _MIN_SINKAGE
    depth = depth.clamp(min=_MIN_SINKAGE)
    entry = _contact_angle(depth).clamp(max=torch.pi / 2)
    length = (radius * torch.sin(entry)).clamp(min=_SHORTEST)
    keq = kc * (1 / width + 1 / length) + kphi
    overtaken = (hub / rim.clamp(min=creep / 100)).clamp(0.0, 1.0)
    turn = torch.minimum(_contact_angle(1 - overtaken), entry)

    def slipped(angle: Tensor, hub: Tensor, rim: Tensor) -> Tensor:
        sin = torch.sin(angle)
        return rim * (angle + sin * torch.cos(angle)) / 2 - hub * sin

    at_entry, at_turn = slipped(entry, hub, rim), slipped(turn, hub, rim)
    speed = torch.sqrt(hub**2 + creep**2)

    # First the piece where the rim drags the soil back, then the one where it pushes it ahead.
    points, weights = quadrature
    pieces = torch.stack([turn, entry - turn], dim=-1)[..., None]
    starts = torch.stack([torch.zeros_like(turn), turn], dim=-1)[..., None]
    angle = (starts + points * pieces).flatten(-2)
    sin, cos = torch.sin(angle), torch.cos(angle)
    hubs, rims, ruts, drift = (x[..., None] for x in (hub, rim, rut, velocity_y))
    z = (radius * (cos - 1 + depth[..., None]) + ruts).clamp(min=1e-9)
    sigma = keq[..., None] * z ** n[..., None] + contact.damping * rims.clamp(min=0.0) * sin

    here = slipped(angle, hubs, rims)
    dragged = (2 * at_turn - at_entry)[..., None] - here[..., : len(points)]
    path = torch.cat([dragged, here[..., len(points) :] - at_entry[..., None]], dim=-1)
    side = drift * (torch.sin(entry)[..., None] - sin)
    path = torch.sqrt(path**2 + side**2 + (1e-3 * creep) ** 2) * radius / speed[..., None] + ruts
    along = rims * cos - hubs
    strength = cohesion[..., None] + sigma * torch.tan(friction_angle)[..., None]
    tau = strength * -torch.expm1(-path / shear_modulus[..., None])
    tau = tau * torch.rsqrt(along**2 + drift**2 + creep**2)
    moment = tau * along * cos + fresh[..., None] * sigma * sin
    weight = (weights * pieces).flatten(-2) * cos * touching[..., None]
    area = radius * width
    return WheelForces(
        longitudinal=ahead * area * (weight * tau * along).sum(-1),
        lateral=-area * (weight * tau * drift).sum(-1),
        normal=area * (weight * sigma).sum(-1),
        torque=ahead * area * radius * (weight * moment).sum(-1),
    )


def rigid_forces(
    radius: float,
    friction: Tensor,
    load: Tensor,
    velocity_x: Tensor,
    velocity_y: Tensor,
    omega: Tensor,
    creep_speed: float,
) -> WheelForces:
    """Coulomb friction on rigid ground, all `[B, 4]`, as `mechanics.wheel.rigid_forces`."""
    slip_x = radius * omega - velocity_x
    scale = friction * load * torch.rsqrt(slip_x**2 + velocity_y**2 + creep_speed**2)
    return WheelForces(scale * slip_x, -scale * velocity_y, load, radius * scale * slip_x)


def _contact_angle(depth: Tensor) -> Tensor:
    return 2 * torch.asin(torch.sqrt(depth.clamp(min=0.0) / 2))


def gauss_legendre(nodes: int) -> tuple[Tensor, Tensor]:
    """Points and weights `[nodes]` on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    return torch.tensor((x + 1) / 2).float(), torch.tensor(w / 2).float()
