"""Poses and transitions in PyTorch: `vertiwm_jax.geometry` and `world_model.motion` over a batch.

A state is one tensor `[..., 12]` in the order of `VehicleState.vector`: position (m), roll, pitch
and yaw (rad), v_body (m/s), omega_body (rad/s). Quaternions are `[..., 4]`, w first.
"""

import torch
from torch import Tensor

from vertiwm_jax.state import STEP_SECONDS

_LARGEST_SINE = 1 - 2**-24


def quaternion(rpy: Tensor) -> Tensor:
    """`[..., 3]` roll, pitch, yaw, rad, to the quaternion `[..., 4]` from body to world."""
    (cr, cp, cy), (sr, sp, sy) = (f(rpy / 2).unbind(-1) for f in (torch.cos, torch.sin))
    return torch.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        dim=-1,
    )


def rpy(quaternion: Tensor) -> Tensor:
    """The inverse of `quaternion`."""
    w, x, y, z = quaternion.unbind(-1)
    roll = torch.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = torch.asin((2 * (w * y - z * x)).clamp(-_LARGEST_SINE, _LARGEST_SINE))
    yaw = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return torch.stack([roll, pitch, yaw], dim=-1)


def matrix(quaternion: Tensor) -> Tensor:
    """Unit quaternions `[..., 4]` to rotation matrices `[..., 3, 3]`."""
    w, x, y, z = quaternion.unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def multiply(first: Tensor, second: Tensor) -> Tensor:
    """The product of quaternions `[..., 4]`."""
    w, v = first[..., :1], first[..., 1:]
    s, u = second[..., :1], second[..., 1:]
    scalar = w * s - (v * u).sum(-1, keepdim=True)
    return torch.cat([scalar, w * u + s * v + torch.linalg.cross(v, u)], dim=-1)


def conjugate(quaternion: Tensor) -> Tensor:
    """The inverse of unit quaternions `[..., 4]`."""
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], dim=-1)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Vectors `[..., 3]` turned by unit quaternions `[..., 4]`."""
    w, v = quaternion[..., :1], quaternion[..., 1:]
    twice = 2 * torch.linalg.cross(v, vector)
    return vector + w * twice + torch.linalg.cross(v, twice)


def exp_rotation(omega: Tensor) -> Tensor:
    """Rotation vectors `[..., 3]`, rad, to quaternions `[..., 4]`."""
    half = omega / 2
    angle = torch.linalg.vector_norm(half, dim=-1, keepdim=True)
    # torch's sinc is of pi x, and exact at zero.
    return torch.cat([torch.cos(angle), torch.sinc(angle / torch.pi) * half], dim=-1)


def log_rotation(quaternion: Tensor) -> Tensor:
    """The inverse of `exp_rotation`, rad up to pi."""
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    w, v = quaternion[..., :1], quaternion[..., 1:]
    sine = torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    small = sine < 1e-4
    factor = 2 * torch.atan2(sine, w) / torch.where(small, 1.0, sine)
    return torch.where(small, 2.0, factor) * v


def exp(xi: Tensor) -> tuple[Tensor, Tensor]:
    """`[..., 6]` m and rad to a translation `[..., 3]` and a quaternion `[..., 4]`."""
    v, omega = xi[..., :3], xi[..., 3:]
    square = (omega * omega).sum(-1, keepdim=True)
    small = square < 1e-2
    safe = torch.where(small, 1.0, square)
    angle = safe.sqrt()
    series = 1 / 2 - square / 24 + square**2 / 720
    a = torch.where(small, series, (1 - torch.cos(angle)) / safe)
    series = 1 / 6 - square / 120 + square**2 / 5040
    b = torch.where(small, series, (angle - torch.sin(angle)) / (safe * angle))
    once = torch.linalg.cross(omega, v)
    return v + a * once + b * torch.linalg.cross(omega, once), exp_rotation(omega)


def log(translation: Tensor, quaternion: Tensor) -> Tensor:
    """The inverse of `exp`."""
    omega = log_rotation(quaternion)
    square = (omega * omega).sum(-1, keepdim=True)
    small = square < 1e-2
    safe = torch.where(small, 1.0, square)
    half = safe.sqrt() / 2
    series = 1 / 12 + square / 720
    c = torch.where(small, series, (1 - half * torch.cos(half) / torch.sin(half)) / safe)
    once = torch.linalg.cross(omega, translation)
    v = translation - once / 2 + c * torch.linalg.cross(omega, once)
    return torch.cat([v, omega], dim=-1)


def increment(before: Tensor, after: Tensor) -> Tensor:
    """`[..., 6]` the pose of the second state in the body frame of the first, m and rad."""
    back = conjugate(quaternion(before[..., 3:6]))
    translation = rotate(back, after[..., :3] - before[..., :3])
    return log(translation, multiply(back, quaternion(after[..., 3:6])))


def transition(before: Tensor, after: Tensor) -> Tensor:
    """`[..., 12]` as `world_model.motion.transition`."""
    change = after[..., 6:] - before[..., 6:]
    rest = increment(before, after) - STEP_SECONDS * (before[..., 6:] + 0.5 * change)
    return torch.cat([rest, change], dim=-1)


def difference(expected: Tensor, state: Tensor) -> Tensor:
    """`[..., 12]` increment from the first to the second, m and rad, and change of velocities."""
    return torch.cat([increment(expected, state), state[..., 6:] - expected[..., 6:]], dim=-1)


def moved(state: Tensor, increment: Tensor, twist: Tensor) -> Tensor:
    """The state moved by `[..., 6]` m and rad, with velocities `[..., 6]`."""
    translation, turn = exp(increment)
    start = quaternion(state[..., 3:6])
    position = state[..., :3] + rotate(start, translation)
    return torch.cat([position, rpy(multiply(start, turn)), twist], dim=-1)


def advance(state: Tensor, transition: Tensor) -> Tensor:
    """The next state after a `[..., 12]` transition."""
    rest, change = transition[..., :6], transition[..., 6:]
    velocity = state[..., 6:]
    return moved(state, STEP_SECONDS * (velocity + 0.5 * change) + rest, velocity + change)


def corrected(state: Tensor, correction: Tensor) -> Tensor:
    """A state moved by a `[..., 12]` correction: the inverse of `difference`."""
    return moved(state, correction[..., :6], state[..., 6:] + correction[..., 6:])
