"""Whatever bytes a log or its settings hold, one line says what is wrong, or they are read."""

from dataclasses import replace

import pyarrow
import pytest
import yaml
from faults.border import refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from importers.bags import Bag
from importers.logged import SETTINGS, logged, terrain
from pyarrow import parquet
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from vertiwm_jax import config
from vertiwm_jax.config import ConfigError
from vertiwm_jax.importers import imports, rosbag, table
from vertiwm_jax.importers.settings import ImportSettings, Resampling, Table, Topics
from vertiwm_jax.learning.schema import DataError

pytestmark = pytest.mark.slow
STORES = {
    "log.bag": (),
    "db3": (StoragePlugin.SQLITE3,),
    "mcap": (StoragePlugin.MCAP,),
    "mcap of chunks": (StoragePlugin.MCAP, CompressionMode.STORAGE),
    "db3 of messages": (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    "db3.zstd": (StoragePlugin.SQLITE3, CompressionMode.FILE),
    "mcap.zstd": (StoragePlugin.MCAP, CompressionMode.FILE),
}
COLUMNS = Table(
    "t", ("x", "y", "z"), "speed", "steer", quaternion=("qx", "qy", "qz", "qw"), drive="run"
)
FOUND = replace(
    SETTINGS,
    table=COLUMNS,
    rosbag=Topics("/odom", "/cmd"),
    resampling=Resampling(shortest=2, longest=10),
)
fuzzed = settings(
    max_examples=200,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
places = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=20)
"""Where in a file, as a share of its length, a byte has another value."""
length = st.one_of(st.just(1.0), st.floats(0, 1))
"""The share of a file that is left."""


def damaged(whole, wrong, left):
    data = bytearray(whole)
    for place, value in wrong:
        data[int(place * (len(data) - 1))] = value
    return bytes(data[: int(left * len(data))])


def columns():
    seen = logged(seconds=1)
    rotation = seen.rotation.as_quat()
    return {
        "run": ["dawn" if k < 20 else "dusk" for k in range(len(seen.time))],
        "t": seen.time,
        **{axis: seen.position[:, i] for i, axis in enumerate("xyz")},
        **{f"q{axis}": rotation[:, i] for i, axis in enumerate("xyzw")},
        "speed": seen.command[:, 0],
        "steer": seen.command[:, 1],
    }


@pytest.fixture
def csv_file(tmp_path):
    made = columns()
    lines = [",".join(made)] + [",".join(map(str, row)) for row in zip(*made.values(), strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    return tmp_path / "log.csv"


@pytest.fixture
def parquet_file(tmp_path):
    parquet.write_table(pyarrow.table(columns()), tmp_path / "log.parquet")
    return tmp_path / "log.parquet"


@pytest.fixture(params=STORES)
def bag_file(tmp_path, request):
    path, seen = tmp_path / request.param, logged(seconds=1)
    with Bag(path, *STORES[request.param]) as bag:
        bag.odometry(seen)
        bag.ackermann(seen.time, seen.command)
    if path.is_file():
        return path
    (file,) = (part for part in path.iterdir() if part.name != "metadata.yaml")
    return file


def ends_well(path, read):
    """The bytes of a file in any state are imported, or refused in one line that names it."""
    whole, refusals, ground = path.read_bytes(), set(), terrain()

    def use():
        imports._import(path, read(path, FOUND), FOUND, ground, [])

    assert not refusal(use, DataError)

    @fuzzed
    @given(places, length)
    def fuzz(wrong, left):
        path.write_bytes(damaged(whole, wrong, left))
        said = refusal(use, DataError)
        assert not said or str(path) in said
        refusals.add(bool(said))

    fuzz()
    assert True in refusals


def test_csv(csv_file):
    ends_well(csv_file, table.read)


def test_parquet(parquet_file):
    ends_well(parquet_file, table.read)


def test_bags(bag_file):
    ends_well(bag_file, rosbag.read)


text = yaml.safe_dump(
    {
        "vehicle": {"wheelbase": 2.0, "track": 1.2, "logged_point": [0.0, 0.1, 0.2]},
        "units": {"angle": 0.0175},
        "frames": {"axes": "z_up"},
        "resampling": {"gap": 0.5, "shortest": 32},
        "table": {"time": "t", "position": ["x", "y"], "yaw": "w", "left": "l", "right": "r"},
        "rosbag": {"odometry": "/odom", "command": "/cmd", "grid_map": {"topic": "/map"}},
    }
)
scalars = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.just("skid")
)
values = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=5,
)


@fuzzed
@given(places, length)
def test_bytes_of_settings(tmp_path_factory, wrong, left):
    path = tmp_path_factory.getbasetemp() / "settings.yaml"
    path.write_bytes(damaged(text.encode(), wrong, left))
    refusal(lambda: config.load(ImportSettings, path), ConfigError)


@fuzzed
@given(st.sampled_from(list(vars(SETTINGS))), st.data())
def test_values_of_settings(tmp_path_factory, section, data):
    tree = yaml.safe_load(text)
    inside = tree.get(section)
    if isinstance(inside, dict) and data.draw(st.booleans()):
        inside[data.draw(st.sampled_from([*inside, "scale", "brake", "delay", "origin"]))] = (
            data.draw(values)
        )
    else:
        tree[section] = data.draw(values)
    path = tmp_path_factory.getbasetemp() / "settings.yaml"
    path.write_text(yaml.safe_dump(tree, allow_unicode=True), encoding="utf-8")
    refusal(lambda: config.load(ImportSettings, path), ConfigError)


def test_settings_that_are_not_damaged_are_read(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text(text.replace("track", "steered: skid\n  track"))
    found = config.load(ImportSettings, path)
    assert found.table is not None and found.resampling == Resampling(shortest=32)
