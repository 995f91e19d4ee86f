"""PyTorch's Verti-WM, which benchmarks compare with, takes the same steps as ours."""

from dataclasses import replace

import jax
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `peers`")

from benchmarks import torch_peer  # noqa: E402
from benchmarks.peers import torch_query  # noqa: E402
from benchmarks.peers.torch_vertiwm import TorchVertiWM  # noqa: E402
from vertiwm_jax.models.registry import load_model  # noqa: E402
from vertiwm_jax.terrain import patches  # noqa: E402
from vertiwm_jax.terrain.worlds import WorldConfig, labels  # noqa: E402

VEHICLES = 2 * torch_peer.WORLDS
STEPS = 4


@pytest.fixture(scope="module")
def drives():
    return torch_peer.Drives.draw(VEHICLES, STEPS)


@pytest.fixture(scope="module")
def states(drives):
    """`[B, T, 12]` of ours and of PyTorch's."""
    model, params = load_model("vertiwm")
    ours = torch_peer.ours(model, params)(drives)()
    theirs = torch_peer.theirs(TorchVertiWM(model, params), drives)()
    return np.asarray(ours), np.asarray(theirs)


def test_the_drives_are_on_ground_of_every_kind():
    kinds = {kind for _, kind in labels(WorldConfig(), torch_peer.WORLDS)}
    assert kinds == {"rigid", "deformable", "mixed"}


def test_one_step_is_the_same_in_every_component(states):
    ours, theirs = (x[:, 0] for x in states)
    np.testing.assert_allclose(theirs, ours, atol=1e-3)
    assert np.median(np.abs(theirs - ours)) < 2e-6


def test_a_few_steps_are_the_same(states):
    figures = torch_peer.agreement(*states)
    assert figures["last_largest_m"] < 2e-4
    ours, theirs = states
    np.testing.assert_allclose(theirs, ours, atol=1e-2)


def test_the_vehicles_move_each_its_own_way(states, drives):
    moved = np.linalg.norm(states[0][:, -1, :2] - np.asarray(drives.starts.position)[:, :2], axis=1)
    assert moved.min() > 0.02
    assert len(np.unique(moved.round(4))) == VEHICLES


def test_patches_are_the_same(drives):

    def look(world, state):
        return patches.query(drives.terrain.select(world), state.position, state.rpy[2])

    seen = jax.jit(jax.vmap(look))(drives.worlds, drives.starts)
    worlds = torch_query.tensor(drives.worlds).long()
    ground = torch_query.Ground.of(drives.terrain).select(worlds)
    elevation, colours = torch_query.patches(ground, torch_query.tensor(drives.starts.vector))
    np.testing.assert_allclose(elevation[:, 0], seen.elevation, atol=2e-5)
    # A pixel on the border of two cells may take the colour of either.
    apart = np.abs(colours.permute(0, 2, 3, 1).numpy() - np.asarray(seen.rgb))
    different = np.any(apart > 1e-5, axis=-1)
    assert different.mean() < 1e-4


@pytest.mark.parametrize("step", [0, -1])
def test_other_states_are_not_timed(states, step):
    ours, other = states[0], states[1].copy()
    other[:, step, 0] += 0.01
    with pytest.raises(ValueError, match="expected 95% within"):
        torch_peer.agreement(ours, other)


def test_states_that_are_no_numbers_are_not_timed(states):
    ours, other = states[0], states[1].copy()
    other[0, 0] = np.nan
    with pytest.raises(ValueError, match="largest_m': inf"):
        torch_peer.agreement(ours, other)


def test_a_model_of_another_form_is_refused():
    model, params = load_model("vertiwm")
    with pytest.raises(ValueError, match="model: expected VertiWM"):
        TorchVertiWM(replace(model, gate_terrain="both"), params)
