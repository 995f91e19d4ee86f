"""A driving policy in NumPy alone: observations to actions, and actions to commands.

`python -m vertiwm_jax.export` puts this file beside the weights. It needs Python 3.10 and NumPy,
and no other file of the package.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

About = dict[str, Any]
Weights = dict[str, np.ndarray]


@dataclass(frozen=True)
class Policy:
    """An exported policy, called at every step of `about["step_seconds"]`.

    about: the content of `policy.json`. weights: the arrays of `policy.npz`, float32.
    """

    about: About
    weights: Weights

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """`[..., O]` observations to `[..., 2]` float32 actions in [-1, 1].

        Another O, and numbers that are not finite, raise `ValueError`.
        """
        observation = np.asarray(observation, np.float32)
        size = self.about["observation"]["size"]
        if observation.shape[-1:] != (size,):
            raise ValueError(f"observation: expected [..., {size}], found {observation.shape}")
        if not np.isfinite(observation).all():
            raise ValueError("observation: expected finite numbers, found others")
        flat = observation.reshape(-1, size)
        return act(self.about, self.weights, flat).reshape(*observation.shape[:-1], 2)

    def command(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`[..., 2]` actions to `[...]` speeds, m/s, and front-wheel angles, rad, left positive."""
        action = np.clip(action, -1, 1)
        low, high = self.about["action"]["speed_range"]
        speed = low + (action[..., 0] + 1) / 2 * (high - low)
        return speed, action[..., 1] * self.about["action"]["steering_limit"]


def load(folder: str | Path) -> Policy:
    """Loads the policy from an exported folder."""
    about = json.loads((Path(folder) / "policy.json").read_text(encoding="utf-8"))
    with np.load(Path(folder) / "policy.npz", allow_pickle=False) as file:
        return Policy(about, dict(file))


def act(about: About, weights: Weights, observation: np.ndarray) -> np.ndarray:
    """`[B, O]` float32 observations to `[B, 2]` actions in [-1, 1].

    What is not finite is not acted on: the vehicle is to stand still.
    This function and those that it calls do not read shapes of arrays, so that the export can
    record them as an ONNX graph.
    """
    action = np.clip(_learned(about, weights, observation), -1, 1)
    if about["base"] is not None:
        bases = {"look ahead": _look_ahead, "straight to goal": _straight_to_goal}
        base = bases[about["base"]["name"]](about, observation)
        action = np.clip(base + action, -1, 1)
    total = np.sum(np.abs(observation), axis=1, keepdims=True)  # Neither of NaN nor of infinity.
    return np.where(total < np.inf, action, _float32(about["action"]["standing"]))


def _learned(about: About, weights: Weights, observation: np.ndarray) -> np.ndarray:
    """The learned network: attention over arcs, if it sees them, then dense layers."""
    limit = about["network"]["normalised_limit"]
    seen = np.clip((observation - weights["mean"]) / weights["std"], -limit, limit)
    shown = [_compressed(about, weights, seen)] if about["network"]["embedding"] else []
    if about["arcs"]:
        features, steered = _attended(about, weights, seen, shown)
    else:
        features = np.concatenate([seen[:, : _slice(about, "backing").stop], *shown], axis=-1)
        steered = _float32(0)
    *hidden, (kernel, bias) = _layers(weights, "MLP_0")
    for inner, inner_bias in hidden:
        features = np.tanh(features @ inner + inner_bias)
    # Further columns of some networks are standard deviations, which are not used here.
    mean = features @ kernel[:, :2] + bias[:2] + steered * _float32([0, 1])
    return np.tanh(mean) if about["network"]["squashed"] else mean


def _attended(
    about: About, weights: Weights, seen: np.ndarray, shown: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Features `[B, F]` after attention over arcs of constant steering, and the mean steering."""
    steering = _float32(about["arcs"]["steering"])[:, None]
    ground = ("height", "crown", "rise", "bank", "twist", "route")

    before, after = _slice(about, "height").start, _slice(about, "route").stop
    here = [_part(about, seen, name)[:, :1] for name in ground]
    classes = seen[:, after : _slice(about, "sinkage").stop]
    rest = np.concatenate([seen[:, :before], *here, classes, *shown], axis=-1)
    arcs = np.concatenate([_arcs(about, seen, name) for name in ground], axis=-1)

    (context, _), (kernel, bias), *more, (score, score_bias) = _layers(weights, "Attention_0")
    # The last row of the kernel is for the steering that an arc stands for.
    x = np.tanh(arcs @ kernel[:-1] + steering @ kernel[-1:] + bias + (rest @ context)[:, None])
    for kernel, bias in more:
        x = np.tanh(x @ kernel + bias)
    share = _softmax(x @ score + score_bias, axis=1)
    features = np.concatenate([np.sum(share * x, axis=1), np.max(x, axis=1), rest], axis=-1)
    return features, np.sum(share * steering, axis=1)


def _compressed(about: About, weights: Weights, seen: np.ndarray) -> np.ndarray:
    """Compresses the terrain embedding to `[B, 16]`: first each tile, then all tiles together."""
    rows, columns, channels = about["network"]["embedding"]
    (kernel, bias), (together, last_bias) = _layers(weights, "ImageEncoder_0")
    shape = (-1, rows * columns // 16, 16 * channels)
    tiles = np.tanh(np.reshape(_part(about, seen, "embedding"), shape) @ kernel + bias)
    return np.tanh(np.reshape(tiles, (-1, len(together))) @ together + last_bias)


def _look_ahead(about: About, observation: np.ndarray) -> np.ndarray:
    """Steers along the arc that keeps level and leads on to the goal."""
    base, weight = about["base"], about["base"]["difficulty"]
    crown, rise, bank, twist, route = (
        _arcs(about, observation, name) for name in ("crown", "rise", "bank", "twist", "route")
    )
    hard = (
        weight["bank"] * np.square(np.maximum(np.abs(bank) - weight["tolerated"], 0))
        + weight["rise"] * np.square(np.maximum(np.abs(rise) - weight["tolerated"], 0))
        + weight["twist"] * np.square(twist)
        + weight["crown"] * np.square(np.maximum(crown, 0))
    )
    near_first = np.exp(-np.array(about["arcs"]["stations"]) / base["reach"])
    cost = np.sum(hard * _float32(near_first), axis=2)
    first, end = base["far"]
    meters = about["observation"]["parts"]["route"]["scale"] / (end - first)
    left = meters * np.sum(route[:, :, first:end], axis=2)
    share = _softmax(-(cost + base["onward"] * left) / base["spread"], axis=1)
    limit, steering = about["action"]["steering_limit"], _float32(about["arcs"]["steering"])
    ahead = _action(about, limit * np.sum(share * steering, axis=1))
    if about["action"]["speed_range"][0] >= 0:
        return ahead
    # Where the vehicle has stalled, it backs up straight; both are whole steps of 0.1 s.
    scale, back = about["observation"]["parts"]["stalled"]["scale"], _float32([-1, 0])
    stalled = scale * _part(about, observation, "stalled")
    backing = scale * _part(about, observation, "backing")
    begins = np.where(stalled < base["patience"] - 0.05, ahead, back)
    goes_on = np.where(backing < base["run_up"] - 0.05, back, ahead)
    return np.where(backing < 0.05, begins, goes_on)


def _straight_to_goal(about: About, observation: np.ndarray) -> np.ndarray:
    """Steers straight to the goal and ignores the ground."""
    towards = _part(about, observation, "goal bearing")
    return _action(about, about["base"]["gain"] * np.arctan2(towards[:, 1], towards[:, 0]))


def _action(about: About, steering: np.ndarray) -> np.ndarray:
    """`[B]` rad to `[B, 2]` actions at the base's speed."""
    low, high = about["action"]["speed_range"]
    speed = (about["base"]["speed"] - low) / (high - low) * 2 - 1
    steering = (steering / about["action"]["steering_limit"])[:, None]
    return np.clip(steering * _float32([0, 1]) + _float32([speed, 0]), -1, 1)


def _arcs(about: About, observation: np.ndarray, name: str) -> np.ndarray:
    """The parts of the observation about places ahead, `[B, arcs, stations]`."""
    shape = (-1, len(about["arcs"]["steering"]), len(about["arcs"]["stations"]))
    return np.reshape(_part(about, observation, name)[:, 1:], shape)


def _part(about: About, observation: np.ndarray, name: str) -> np.ndarray:
    return observation[:, _slice(about, name)]


def _slice(about: About, name: str) -> slice:
    return slice(*about["observation"]["parts"][name]["slice"])


def _layers(weights: Weights, network: str) -> list[tuple[np.ndarray, Any]]:
    """Kernel and bias of each dense layer, the first to be computed first."""
    names = [f"{network}.Dense_{i}" for i in range(len(weights))]
    kernels = [name for name in names if f"{name}.kernel" in weights]
    return [(weights[f"{name}.kernel"], weights.get(f"{name}.bias")) for name in kernels]


def _softmax(x: np.ndarray, axis: int) -> np.ndarray:
    raised = np.exp(x - np.max(x, axis=axis, keepdims=True))
    return raised / np.sum(raised, axis=axis, keepdims=True)


def _float32(numbers: Any) -> np.ndarray:
    return np.asarray(numbers, np.float32)
