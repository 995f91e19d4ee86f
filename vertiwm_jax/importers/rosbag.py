"""Reads odometry and commands from ROS 1 and ROS 2 bags."""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from vertiwm_jax.errors import needs, refusing
from vertiwm_jax.importers.log import Log, converted
from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning.schema import DataError

_POSES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PoseStamped",
)
_ACKERMANN = ("ackermann_msgs/msg/AckermannDriveStamped", "ackermann_msgs/msg/AckermannDrive")
_TWIST = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist")
_ZSTD = bytes.fromhex("28b52ffd")
_MEND = "`rosbag reindex`, `ros2 bag reindex` or `mcap recover` mend what was cut off"

# Bags of ROS 2 up to Humble do not say what their messages hold; these are not in its base.
DEFINITIONS = {
    "ackermann_msgs/msg/AckermannDrive": """
        float32 steering_angle
        float32 steering_angle_velocity
        float32 speed
        float32 acceleration
        float32 jerk""",
    "ackermann_msgs/msg/AckermannDriveStamped": """
        std_msgs/Header header
        ackermann_msgs/AckermannDrive drive""",
    "grid_map_msgs/msg/GridMapInfo": """
        float64 resolution
        float64 length_x
        float64 length_y
        geometry_msgs/Pose pose""",
    "grid_map_msgs/msg/GridMap": """
        std_msgs/Header header
        grid_map_msgs/GridMapInfo info
        string[] layers
        string[] basic_layers
        std_msgs/Float32MultiArray[] data
        uint16 outer_start_index
        uint16 inner_start_index""",
}


def read(path: Path, settings: ImportSettings) -> list[Log]:
    """Reads the log of a bag: a `.bag` file of ROS 1, a folder of ROS 2, or a file of one.

    Raises `DataError` naming bag, topic and expectation.
    """
    names = settings.rosbag
    if names is None:
        raise DataError(f"{path}: expected settings with a section `rosbag` that names its topics")
    by_header, said = names.stamps == "header", dict[str, int]()
    poses = [
        (_stamp(received, message, by_header), *_pose(message))
        for received, message in messages(path, names.odometry, _POSES, said)
    ]
    commands = [
        (_stamp(received, message, by_header), *_command(message))
        for received, message in messages(path, names.command, (*_ACKERMANN, *_TWIST), said)
    ]
    time, position, attitude, *velocities = (np.array(x) for x in zip(*poses, strict=True))
    velocity, omega = velocities or (None, None)
    command_time, speed, turn, is_twist = (np.array(x) for x in zip(*commands, strict=True))
    found = Log(
        time=time,
        position=position,
        attitude=attitude,
        velocity=velocity,
        angular_velocity=omega,
        command_time=command_time,
        command=np.stack([speed, turn], axis=1),
        kind=names.twist if is_twist[0] else "steering",
    )
    return converted(found, path, settings, said.items())


def messages(
    path: Path,
    topic: str,
    kinds: Sequence[str],
    said: dict[str, int],
    needed: bool = True,
) -> Iterator[tuple[int, Any]]:
    """The messages of a topic, each with the time at which it was received, ns.

    Messages that cannot be read are left out; said: what is said of them, and how many there are.

    Raises `DataError` where the bag or most of its messages cannot be read, or none is `needed`.
    """
    with needs("rosbags", "logs", path):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    store = get_typestore(Stores.ROS2_HUMBLE)
    for kind, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, kind))
    with (
        refusing(lambda found: DataError(f"{path}: expected a ROS bag: {found}; {_MEND}")),
        _unpacked(path) as file,
        AnyReader([file], default_typestore=store) as reader,
    ):
        found = [c for c in reader.connections if c.topic == topic]
        others = sorted({c.msgtype for c in found} - set(kinds))
        expected = f"{path}: {topic}: expected messages of {' or '.join(kinds)}"
        if others:
            raise DataError(f"{expected}, found {', '.join(others)}")
        read, wrong = 0, list[str]()
        each = reader.messages(found) if found else iter(())
        while True:
            try:
                connection, received, data = next(each)
            except StopIteration:
                break
            except Exception as error:  # Damaged bytes lead rosbags to errors of any kind.
                # Where a part of the file cannot be read, nobody knows where the next begins.
                lost = max(sum(c.msgcount for c in found) - read, 1)
                wrong += [f"a bag that cannot be read after {read} messages: {error}"] * lost
                break
            try:
                message = reader.deserialize(_plain(data), connection.msgtype)
            except Exception as error:
                wrong.append(f"one received at {1e-9 * received:.10g} that cannot be read: {error}")
                continue
            yield received, message
            read += 1
        if wrong:
            told = " ".join(f"{expected}, found {wrong[0]}; {len(wrong)} such".split())
            if len(wrong) > read:
                raise DataError(told)
            said[f"{told}: left out"] = len(wrong)
        if needed and not read:
            every = ", ".join(sorted({c.topic for c in reader.connections}))
            raise DataError(f"{expected}, found none; there is {every or 'nothing'}")


@contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """The bag without the compression of its file, for as long as the context lasts."""
    if path.suffix != ".zstd":
        yield path
        return
    with needs("pyarrow", "logs", path):
        import pyarrow
    with TemporaryDirectory() as folder:
        whole = Path(folder) / path.stem
        with pyarrow.input_stream(path, compression="zstd") as packed, whole.open("wb") as file:
            shutil.copyfileobj(packed, file)
        yield whole


def _plain(data: bytes) -> bytes:
    """A message without the compression that is told only beside the file."""
    if bytes(data[:4]) != _ZSTD:
        return data
    import pyarrow  # It comes with rosbags in the extra.

    return pyarrow.input_stream(pyarrow.py_buffer(data), compression="zstd").read()


def _stamp(received: int, message: Any, by_header: bool) -> float:
    """s."""
    if by_header and hasattr(message, "header"):
        stamp = message.header.stamp
        return stamp.sec + 1e-9 * stamp.nanosec
    return 1e-9 * received


def _pose(message: Any) -> tuple[list[float], ...]:
    """Position, quaternion, and in odometry linear and angular velocity."""
    pose = getattr(message.pose, "pose", message.pose)
    q = pose.orientation
    found = _xyz(pose.position), [q.x, q.y, q.z, q.w]
    if not hasattr(message, "twist"):
        return found
    twist = message.twist.twist
    return (*found, _xyz(twist.linear), _xyz(twist.angular))


def _command(message: Any) -> tuple[float, float, bool]:
    """Speed, what turns, and whether that is of a Twist."""
    if message.__msgtype__ in _ACKERMANN:
        drive = getattr(message, "drive", message)
        return drive.speed, drive.steering_angle, False
    twist = getattr(message, "twist", message)
    return twist.linear.x, twist.angular.z, True


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]
