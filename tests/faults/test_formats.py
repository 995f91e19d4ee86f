"""What becomes of each defect of a log in each format: a table, written before the code.

read     all of it, as if the defect were not there
told     what is usable is read; what is left out is told with file and reason
cut      the same, and the drive ends there and another begins
lifted   height, roll and pitch are those of the ground
refused  in one line that names file and reason
either   any of these
"""

import csv
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from faults.border import outcome
from importers.bags import Bag
from importers.logged import SETTINGS, Logged, commands, logged, states, terrain
from pyarrow import parquet
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from scipy.spatial.transform import Rotation

from vertiwm_jax import config
from vertiwm_jax.errors import UserError
from vertiwm_jax.importers.imports import import_drives
from vertiwm_jax.importers.settings import (
    Frames,
    GridMapSettings,
    ImportSettings,
    Resampling,
    Table,
    Topics,
    VehicleSettings,
)
from vertiwm_jax.learning import schema
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import TerrainMap

TABLE = """
defect                    csv      parquet  bag      db3      mcap     chunks   db3.zstd mcap.zstd
none                      read     read     read     read     read     read     read     read
file named directly       read     read     read     read     read     read     read     read
folder without notes      read     read     read     read     read     read     read     read
blank line                read     -        -        -        -        -        -        -
bad row or message        told     -        told     told     told     told     told     told
not a number              told     told     told     told     told     told     told     told
a leap and back           cut      cut      cut      cut      cut      cut      cut      cut
a leap that stays         cut      cut      cut      cut      cut      cut      cut      cut
one pose alone            cut      cut      cut      cut      cut      cut      cut      cut
duplicated stamp          told     told     told     told     told     told     told     told
swapped stamps            told     told     told     told     told     told     told     told
clock set back            cut      cut      cut      cut      cut      cut      cut      cut
gap                       cut      cut      cut      cut      cut      cut      cut      cut
cut off at nine tenths    told     refused  refused  either   refused  refused  refused  refused
bytes flipped             either   either   either   either   either   either   either   either
attitudes in degrees      refused  refused  -        -        -        -        -        -
compass headings          refused  refused  refused  refused  refused  refused  refused  refused
velocities of the world   refused  refused  refused  refused  refused  refused  refused  refused
planar                    lifted   lifted   lifted   lifted   lifted   lifted   lifted   lifted
x, y and yaw alone        lifted   lifted   lifted   lifted   lifted   lifted   lifted   lifted
planar without a map      lifted   lifted   lifted   lifted   lifted   lifted   lifted   lifted
3 mm on a small vehicle   read     read     read     read     read     read     read     read
commands act late         told     told     told     told     told     told     told     told
yaw rates                 read     read     read     read     read     read     read     read
wheel speeds              read     read     -        -        -        -        -        -
turns on the spot         read     read     read     read     read     read     read     read
one bad log of four       told     told     told     told     told     told     told     told
three bad logs of four    refused  refused  refused  refused  refused  refused  refused  refused
one bad drive of four     told     told     -        -        -        -        -        -
GridMap that jumps        -        -        refused  refused  refused  refused  refused  refused
UTM                       read     read     read     read     read     read     read     read
"""
FORMATS, CELLS = TABLE.split("\n")[1].split()[1:], {}
for _line in TABLE.strip().split("\n")[1:]:
    _defect, *_cells = re.split(r"  +", _line)[0], *_line[26:].split()
    CELLS |= {(_defect, kind): cell for kind, cell in zip(FORMATS, _cells, strict=True)}
STORES = {
    "bag": (),
    "db3": (StoragePlugin.SQLITE3,),
    "mcap": (StoragePlugin.MCAP,),
    "chunks": (StoragePlugin.MCAP, CompressionMode.STORAGE),
    "db3.zstd": (StoragePlugin.SQLITE3, CompressionMode.FILE),
    "mcap.zstd": (StoragePlugin.MCAP, CompressionMode.FILE),
}
SECONDS, RATE, START = 8, 25, 100.0
RADIUS, SLOPE = 0.4, (0.1, -0.06)
VEHICLE = VehicleSettings(2.0, 1.2)
COLUMNS = Table(
    "t", ("x", "y", "z"), "speed", "steer", quaternion=("qx", "qy", "qz", "qw"), drive="drive"
)
TOPICS = Topics("/odom", "/cmd")
BASE = replace(  # as the names of columns and topics are below
    SETTINGS, vehicle=VEHICLE, table=COLUMNS, rosbag=TOPICS, resampling=Resampling(shortest=10)
)
MIDDLE, SAMPLES = SECONDS * RATE // 2, np.arange(SECONDS * RATE)
AWAY = np.abs(SAMPLES - MIDDLE)


def with_(seen: Logged, index: object, **changes: np.ndarray | float) -> Logged:
    """The log with other values at some places of some of its arrays."""
    found = {name: getattr(seen, name).copy() for name in changes}
    for name, value in changes.items():
        found[name][index] = value
    return replace(seen, **found)


def rows(seen: Logged, chosen: np.ndarray) -> Logged:
    """Some of the samples, in this order."""
    names = ("time", "state", "command", "position", "rotation")
    return replace(seen, **{name: getattr(seen, name)[chosen] for name in names})


def headed(rpy: np.ndarray, zero: list[float]) -> Rotation:
    """Attitudes whose headings are counted to the right, from elsewhere."""
    return Rotation.from_euler("ZYX", (rpy * [1, 1, -1] + zero)[:, ::-1])


def leap(samples: slice) -> Callable[[Logged], Logged]:
    return lambda seen: replace(
        seen, position=seen.position + np.isin(SAMPLES, SAMPLES[samples])[:, None] * [0, 9.0, 0]
    )


def planar(seen: Logged) -> Logged:
    level = Rotation.from_euler("ZYX", seen.state[:, 5:2:-1] * [1, 0, 0])
    moved = level.inv().apply(seen.rotation.apply(seen.state[:, 6:9])) * [1, 1, 0]
    found = with_(seen, np.s_[:, 6:9], state=moved)
    return replace(found, position=seen.position * [1, 1, 0], rotation=level)


def of_the_world(seen: Logged) -> Logged:
    return with_(seen, np.s_[:, 6:9], state=seen.rotation.apply(seen.state[:, 6:9]))


def small(seen: Logged) -> Logged:
    """A tenth as large and half as fast, with 3 mm of noise at 40 Hz."""
    error = 0.003 * np.random.default_rng(1).normal(size=seen.position.shape)
    return replace(
        with_(seen, np.s_[:, 6:9], state=seen.state[:, 6:9] / 10**0.5 / 2),
        time=START + 2 * (seen.time - START) / 10**0.5,
        position=seen.position / 10 + error,
    )


def obedient(seen: Logged) -> Logged:
    """A drive on level ground that does what it is told, 0.2 s later."""
    fine = START - 1 + 0.001 * np.arange(1000 * (SECONDS + 1))
    sudden = np.random.default_rng(2).uniform([1.5, -0.3], [3.5, 0.3], (99, 2))

    def told(time: np.ndarray) -> np.ndarray:
        return sudden[np.floor((time - START) / 0.4 + 1e-6).astype(int)]

    speed, angle = told(fine - 0.2).T
    turn = speed * np.tan(angle) / VEHICLE.wheelbase
    yaw, sideways = 0.001 * np.cumsum(turn), turn * VEHICLE.wheelbase / 2
    course = np.stack([np.cos(yaw), np.sin(yaw)]), np.stack([-np.sin(yaw), np.cos(yaw)])
    xy = 0.001 * np.cumsum(speed * course[0] + sideways * course[1], axis=1)
    none = np.zeros(len(fine))
    path = np.stack([*xy, none, none, none, yaw, speed, sideways, none, none, none, turn], 1)
    state = np.stack([np.interp(seen.time, fine, column) for column in path.T], 1)
    rotation = Rotation.from_euler("ZYX", state[:, 5:2:-1])
    return Logged(seen.time, state, told(seen.time), state[:, :3], rotation)


def turning(seen: Logged) -> Logged:
    """Told to turn on the spot for a while, in speeds and yaw rates."""
    return with_(seen, (SAMPLES > 80) & (SAMPLES < 120), command=np.array([0.0, 1.0]))


def of_bags(**topics: object) -> Callable[[ImportSettings], ImportSettings]:
    return lambda settings: replace(settings, rosbag=replace(TOPICS, **topics))


def of_tables(**columns: object) -> Callable[[ImportSettings], ImportSettings]:
    return lambda settings: replace(settings, table=replace(COLUMNS, **columns))


def both(first: Callable, second: Callable) -> Callable[[ImportSettings], ImportSettings]:
    return lambda settings: second(first(settings))


def of_vehicle(**changes: object) -> Callable[[ImportSettings], ImportSettings]:
    return lambda settings: replace(settings, vehicle=replace(VEHICLE, **changes))


def flipped(whole: bytes) -> bytes:
    data = np.frombuffer(whole, np.uint8).copy()
    data[np.random.default_rng(3).integers(0, len(data), 20)] ^= 0x55
    return data.tobytes()


@dataclass(frozen=True)
class Defect:
    """What is wrong with a log, and how one knows what became of it.

    change: of what is logged; damage: of the written file; settings: of the import; words: in what
    is said; drives: how many there are then; error: of positions, m; pace: how fast it was driven;
    yaw_rates: what commands are; written: what is written beside or instead of the usual; bad:
    which of several files are damaged.
    """

    change: Callable[[Logged], Logged] = lambda seen: seen
    damage: Callable[[bytes], bytes] = lambda whole: whole
    settings: Callable[[ImportSettings], ImportSettings] = lambda settings: settings
    words: str = ""
    drives: int = 1
    error: float = 0.02
    written: str = ""
    pace: float = 1.0
    yaw_rates: bool = False
    bad: tuple[bool, ...] = (True,)


YAW_RATES = both(of_tables(steering=None, yaw_rate="steer"), of_bags(command="/cmd_vel"))
SKID = both(YAW_RATES, of_vehicle(steered="skid"))
ON_WHEELS = of_vehicle(wheel_radius=RADIUS)
ALONE = both(
    both(of_bags(odometry="/pose"), ON_WHEELS),
    of_tables(position=("x", "y"), quaternion=None, yaw="yaw"),
)
DEFECTS = {
    "none": Defect(),
    "file named directly": Defect(written="alone"),
    "folder without notes": Defect(written="folder"),
    "blank line": Defect(damage=lambda whole: whole.replace(b"\n", b"\n\n \n", 9) + b"\n"),
    "bad row or message": Defect(written="cut off", words=": left out"),
    "not a number": Defect(
        lambda seen: with_(seen, MIDDLE, position=np.nan), words="position: expected finite numbers"
    ),
    "a leap and back": Defect(leap(np.s_[MIDDLE : MIDDLE + 1]), words="leap", drives=2),
    "a leap that stays": Defect(leap(np.s_[MIDDLE:]), words="leap", drives=2, error=9.1),
    "one pose alone": Defect(
        lambda seen: rows(seen, SAMPLES[(AWAY > RATE) | (AWAY == 0)]), words="shorter", drives=2
    ),
    "duplicated stamp": Defect(
        lambda seen: with_(seen, MIDDLE, time=seen.time[MIDDLE - 1]), words="stamps that increase"
    ),
    "swapped stamps": Defect(
        lambda seen: rows(seen, np.r_[:MIDDLE, MIDDLE + 1, MIDDLE, MIDDLE + 2 : len(SAMPLES)]),
        words="stamps that increase",
    ),
    "clock set back": Defect(
        lambda seen: rows(seen, np.r_[SAMPLES, SAMPLES]), words="is set back", drives=2
    ),
    "gap": Defect(lambda seen: rows(seen, SAMPLES[AWAY > RATE]), words="| 2 ", drives=2),
    "cut off at nine tenths": Defect(damage=lambda whole: whole[: len(whole) * 9 // 10]),
    "bytes flipped": Defect(damage=flipped),
    "attitudes in degrees": Defect(
        settings=of_tables(quaternion=None, rpy=("roll", "pitch", "yaw_degrees")), words="attitude"
    ),
    "compass headings": Defect(
        lambda seen: replace(seen, rotation=headed(seen.state[:, 3:6], [0, 0, np.pi / 2])),
        words="degrees off",
    ),
    "velocities of the world": Defect(
        of_the_world, settings=of_tables(velocity=("vx", "vy", "vz")), words="velocity"
    ),
    "planar": Defect(planar, settings=ON_WHEELS, words="z, roll and pitch", error=0.05),
    "x, y and yaw alone": Defect(planar, settings=ALONE, words="z, roll and pitch", error=0.05),
    "planar without a map": Defect(
        planar, settings=ON_WHEELS, written="no map", words="a plane", error=0.05
    ),
    "3 mm on a small vehicle": Defect(
        small,
        settings=both(of_bags(odometry="/pose"), of_vehicle(wheelbase=0.2, track=0.12, scale=10.0)),
        error=0.15,
        pace=0.5,
    ),
    "commands act late": Defect(
        obedient, settings=ON_WHEELS, words="commands act 0.2", error=np.inf
    ),
    "yaw rates": Defect(settings=YAW_RATES, yaw_rates=True),
    "wheel speeds": Defect(
        settings=both(
            of_vehicle(steered="skid"),
            of_tables(speed=None, steering=None, left="left", right="right"),
        ),
    ),
    "turns on the spot": Defect(turning, settings=SKID, error=np.inf),
    "one bad log of four": Defect(
        damage=lambda whole: b"?" * 99, bad=(False, True, False, False), drives=3, words="1.log"
    ),
    "three bad logs of four": Defect(
        damage=lambda whole: b"?" * 99, bad=(True, True, False, True), words="3 of 4"
    ),
    "one bad drive of four": Defect(written="four drives", drives=3, words="drive 1"),
    "GridMap that jumps": Defect(
        settings=of_bags(grid_map=GridMapSettings("/map")), written="jumping map", words="/map"
    ),
    "UTM": Defect(
        lambda seen: replace(seen, position=seen.position + [512345.0, 5234567.0, 80.0]),
        settings=lambda settings: replace(
            settings, frames=Frames(origin=(512345.0, 5234567.0, 80.0))
        ),
    ),
}


def columns(seen: Logged, drive: int) -> dict[str, np.ndarray]:
    speed, turn = seen.command.T
    rpy = seen.rotation.as_euler("ZYX")[:, ::-1]
    named = {
        ("x", "y", "z"): seen.position,
        ("qx", "qy", "qz", "qw"): seen.rotation.as_quat(),
        ("roll", "pitch", "yaw"): rpy,
        ("vx", "vy", "vz"): seen.state[:, 6:9],
    }
    return {
        "drive": np.full(len(seen.time), drive),
        "t": seen.time,
        **{name: x[:, i] for names, x in named.items() for i, name in enumerate(names)},
        "yaw_degrees": np.degrees(rpy[:, 2]),
        "speed": speed,
        "steer": turn,
        # As if `turn` were a yaw rate.
        "left": speed - VEHICLE.track / 2 * turn,
        "right": speed + VEHICLE.track / 2 * turn,
    }


def write_table(path: Path, seen: Logged, written: str) -> None:
    drives = [columns(seen, 0)]
    if written == "four drives":
        wrong = replace(seen, position=100 * seen.position)
        drives = [columns(log, drive) for drive, log in enumerate([seen, wrong, seen, seen])]
    joined = {name: np.concatenate([drive[name] for drive in drives]) for name in drives[0]}
    if path.suffix == ".parquet":
        parquet.write_table(pyarrow.table(joined), path)
        return
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(joined)
        for k, row in enumerate(zip(*joined.values(), strict=True)):
            writer.writerow(row[:7] if (written, k) == ("cut off", MIDDLE) else row)


def write_bag(path: Path, store: tuple, seen: Logged, written: str) -> None:
    with Bag(path, *store) as bag:
        bag.odometry(seen, MIDDLE if written == "cut off" else None)
        bag.poses(seen)
        bag.ackermann(seen.time, seen.command)
        bag.twists(seen.time, seen.command)
        for k in range(2 if written == "jumping map" else 0):
            bag.grid_map(START + k, {"elevation": np.zeros((9, 9))}, (3e6 * k, 0.0), 0.5)


def write(folder: Path, kind: str, number: int, seen: Logged, defect: Defect) -> Path:
    """Writes a log, and gives what is to be imported."""
    path = folder / f"{number}.log.{kind}"
    if kind not in STORES:
        write_table(path, seen, defect.written)
        file = path
    elif kind == "bag":
        write_bag(path, (), seen, defect.written)
        file = path
    else:
        path = folder / f"{number}.log"
        write_bag(path, STORES[kind], seen, defect.written)
        (file,) = (part for part in path.iterdir() if part.name != "metadata.yaml")
    if defect.bad[number]:
        file.write_bytes(defect.damage(file.read_bytes()))
    if defect.written == "folder":
        (folder / "logs").mkdir()
        file.rename(folder / "logs" / file.name)
        return folder / "logs"
    return file if defect.written == "alone" else path


def slope() -> TerrainMap:
    """Ground that falls and rises, `[2]` m a m."""
    x, y = np.meshgrid(np.arange(-30, 31), np.arange(30, -31, -1))
    return TerrainMap.from_array(SLOPE[0] * x + SLOPE[1] * y, "grass")


def expected_states(seen: Logged, word: str, on_plane: bool) -> np.ndarray:
    """`[N, 12]` what is known of the drive, often."""
    fine = states(np.arange(START - 0.1, START + SECONDS + 0.1, 0.002))
    if word != "lifted":
        return fine
    before = fine.copy()
    rise = np.zeros(2) if on_plane else np.array(SLOPE)
    up = np.append(-rise, 1) / np.linalg.norm(np.append(-rise, 1))
    fine[:, 2] = fine[:, :2] @ rise + RADIUS / up[2]
    ahead = np.cos(fine[:, 5]) * rise[0] + np.sin(fine[:, 5]) * rise[1]
    aside = -np.sin(fine[:, 5]) * rise[0] + np.cos(fine[:, 5]) * rise[1]
    fine[:, 4] = -np.arctan(ahead)
    moved = Rotation.from_euler("ZYX", before[:, 5:2:-1]).apply(fine[:, 6:9])
    moved[:, 2] = moved[:, :2] @ rise
    fine[:, 3] = np.arctan(aside * np.cos(fine[:, 4]))
    fine[:, 6:9] = Rotation.from_euler("ZYX", fine[:, 5:2:-1]).inv().apply(moved)
    return fine


def check_drives(defect: Defect, word: str, seen: Logged, output: Path) -> None:
    drives = [schema.read(path)[0] for path in sorted(output.glob("*.npz"))]
    found = [
        state[: length + 1]
        for arrays in drives
        for state, length in zip(arrays["state"], arrays["length"], strict=True)
    ]
    assert len(found) == defect.drives
    if not np.isfinite(defect.error):
        return
    truth = expected_states(seen, word, defect.written == "no map")
    for state in found:
        away = np.linalg.norm(state[:, None, :2] - truth[None, :, :2], axis=-1)
        nearest = truth[away.argmin(1)]
        error = state - nearest
        error[:, 3:6] = (error[:, 3:6] + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(error[:, :3]).max() < defect.error
        if defect.error < 1:
            assert np.abs(error[:, 3:6]).max() < 0.02 + defect.error / 10
            fast = state[:, 6:9] - defect.pace * nearest[:, 6:9]
            assert np.abs(fast).max() < 0.1 + 3 * defect.error


def check_commands(yaw_rates: bool, control: np.ndarray) -> None:
    """control: `[T, 2]` of a drive from the first sample on."""
    speed, turn = commands(START + 0.1 * np.arange(len(control))).T
    angle = np.arctan(VEHICLE.wheelbase * turn / speed) if yaw_rates else turn
    np.testing.assert_allclose(control, np.stack([speed, angle], 1), atol=0.03)


@pytest.mark.parametrize(("defect", "kind"), [pair for pair, cell in CELLS.items() if cell != "-"])
def test_a_defect_in_a_format(tmp_path, defect, kind):
    word, made = CELLS[defect, kind], DEFECTS[defect]
    whole = logged(seconds=SECONDS, rate=RATE, start=START, even=True)
    seen = made.change(whole)
    sources = [write(tmp_path, kind, number, seen, made) for number in range(len(made.bad))]
    config.save(made.settings(BASE), tmp_path / "settings.yaml")
    ground = None
    if made.written not in ("no map", "jumping map"):
        lifted = word == "lifted"
        ground = tmp_path / "ground.npz"
        files.save(slope() if lifted else terrain(), ground)

    def read() -> str:
        return import_drives(sources, tmp_path / "out", tmp_path / "settings.yaml", map=ground)

    said, refused = outcome(read, UserError)
    if word == "either":
        return
    if word == "refused":
        assert refused is not None and ".log" in refused and made.words in refused
        return
    assert refused is None
    assert said is not None and made.words in said
    check_drives(made, word, whole, tmp_path / "out")
    if made.drives == made.pace == 1 and np.isfinite(made.error):
        (path,) = (tmp_path / "out").glob("*.npz")
        check_commands(made.yaw_rates, np.load(path)["control"][0])
