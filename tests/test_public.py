"""The public face: what `import vertiwm_jax` offers, and short programs that use it alone."""

import ast
import pkgutil
from importlib import import_module
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import vertiwm_jax as vw
from vertiwm_jax.cli import COMMANDS


def test_every_public_name_is_there_and_documented():
    source = ast.parse(Path(vw.__file__).read_text())
    typed = [
        alias.name
        for node in ast.walk(source)
        if isinstance(node, ast.ImportFrom) and node.module != "typing"
        for alias in node.names
        if alias.asname
    ]
    assert sorted(typed) == sorted(vw.__all__)
    for name in vw.__all__:
        assert getattr(vw, name).__doc__
        assert name in dir(vw)
    with pytest.raises(AttributeError, match="no attribute 'fly'"):
        vw.fly  # noqa: B018


@pytest.mark.smoke
def test_every_module_is_one_for_this_python():
    """Without the packages of extras, too; entry points of commands are no modules to import."""
    names = [found.name for found in pkgutil.walk_packages(vw.__path__, "vertiwm_jax.")]
    modules = [name for name in names if name.removeprefix("vertiwm_jax.") not in COMMANDS]
    for name in modules:
        import_module(name)
    assert len(modules) > 100


@pytest.mark.integration
def test_a_vehicle_is_driven_on_a_map():
    ground = vw.make_worlds(1)
    model, params = vw.load_model("builtin", vehicle=vw.load_vehicle("hmmwv"))
    commands = vw.Command(jnp.full(5, 3.0), jnp.full(5, 0.1))
    states = vw.rollout(model, params, ground, vw.place(ground, speed=3.0), commands)
    assert states.position.shape == (5, 3)
    x, y = states.position[-1, :2]
    assert 1 < x < 2 and 0 < y < 0.2


def test_a_map_is_made_of_an_array():
    x, y = np.meshgrid(np.arange(129) - 64.0, 64.0 - np.arange(129))
    ground = vw.TerrainMap.from_array(4 + 3 * np.exp(-(x**2 + y**2) / 400), "grass")
    placed = vw.place(ground)
    assert isinstance(placed, vw.VehicleState)
    np.testing.assert_allclose(placed.position[:2], 0)
    assert 7 < placed.position[2] < 8
    aside = vw.place(ground, (10.0, 0.0), yaw=np.pi / 2, vehicle=vw.load_vehicle("rover"))
    assert aside.rpy[0] > 0.1  # down to the right
    with pytest.raises(ValueError, match=r"classes: expected one of .*, found 'gras'"):
        vw.TerrainMap.from_array(np.zeros((9, 9)), "gras")
