"""Reads odometry and commands from ROS 1 and ROS 2 bags."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vertiwm_jax.errors import needs, refusing
from vertiwm_jax.importers.log import Log, converted
from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning.schema import DataError

_ODOMETRY = ("nav_msgs/msg/Odometry",)
_ACKERMANN = ("ackermann_msgs/msg/AckermannDriveStamped", "ackermann_msgs/msg/AckermannDrive")
_TWIST = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist")
_SLOWEST = 0.05  # m/s at full size
_FARTHEST = np.radians(45)

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
    """Reads the log of a bag: a `.bag` file of ROS 1, or a folder of ROS 2.

    Raises `DataError` naming bag, topic and expectation.
    """
    names = settings.rosbag
    if names is None:
        raise DataError(f"{path}: expected settings with a section `rosbag` that names its topics")
    by_header = names.stamps == "header"
    poses = [
        (_stamp(received, message, by_header), *_odometry(message))
        for received, message in messages(path, names.odometry, _ODOMETRY)
    ]
    commands = [
        (_stamp(received, message, by_header), *_command(message))
        for received, message in messages(path, names.command, (*_ACKERMANN, *_TWIST))
    ]
    time, position, attitude, velocity, omega = (np.array(x) for x in zip(*poses, strict=True))
    command_time, speed, turn, is_twist = (np.array(x) for x in zip(*commands, strict=True))
    found = Log(
        time=time,
        position=position,
        attitude=attitude,
        velocity=velocity,
        angular_velocity=omega,
        command_time=command_time,
        command=np.stack([speed, turn], axis=1),
    )
    logs = converted(found, path, settings)
    if not (is_twist[0] and names.twist == "yaw_rate"):
        return logs
    # At full size the wheelbase is `scale` times as long; the yaw rate is still the vehicle's.
    wheelbase = settings.vehicle.wheelbase * settings.vehicle.scale**0.5
    angles = [steering(log.command[:, 0], log.command[:, 1], wheelbase) for log in logs]
    return [
        replace(log, command=np.stack([log.command[:, 0], angle], axis=1))
        for log, angle in zip(logs, angles, strict=True)
    ]


def steering(speed: np.ndarray, yaw_rate: np.ndarray, wheelbase: float) -> np.ndarray:
    """`[M]` m/s and rad/s to the `[M]` front-wheel angles, rad, that turn so without slip.

    No wheel turns beyond `_FARTHEST`. At next to no speed a yaw rate gives no angle: the wheels
    keep theirs, and are straight at first.
    """
    moving = np.abs(speed) >= _SLOWEST
    angle = np.arctan(wheelbase * yaw_rate / np.where(moving, speed, 1))
    angle = np.clip(angle, -_FARTHEST, _FARTHEST)
    latest = np.maximum.accumulate(np.where(moving, np.arange(len(speed)), -1))
    return np.where(latest >= 0, angle[latest], 0)


def messages(path: Path, topic: str, kinds: Sequence[str]) -> Iterator[tuple[int, Any]]:
    """The messages of a topic, each with the time at which it was received, ns.

    Raises `DataError` where the bag cannot be read, or has no such messages.
    """
    with needs("rosbags", "logs", path):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    if path.suffix in (".db3", ".mcap"):  # Of a folder that says what is in it.
        path = path.parent
    store = get_typestore(Stores.ROS2_HUMBLE)
    for kind, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, kind))
    with (
        refusing(lambda found: DataError(f"{path}: expected a ROS bag: {found}")),
        AnyReader([path], default_typestore=store) as reader,
    ):
        found = [c for c in reader.connections if c.topic == topic]
        others = sorted({c.msgtype for c in found} - set(kinds))
        expected = f"{path}: {topic}: expected messages of {' or '.join(kinds)}"
        if others:
            raise DataError(f"{expected}, found {', '.join(others)}")
        read = 0
        for connection, received, data in reader.messages(found) if found else ():
            yield received, reader.deserialize(data, connection.msgtype)
            read += 1
        if not read:
            every = ", ".join(sorted({c.topic for c in reader.connections}))
            raise DataError(f"{expected}, found none; there is {every or 'nothing'}")


def _stamp(received: int, message: Any, by_header: bool) -> float:
    """s."""
    if by_header and hasattr(message, "header"):
        stamp = message.header.stamp
        return stamp.sec + 1e-9 * stamp.nanosec
    return 1e-9 * received


def _odometry(message: Any) -> tuple[list[float], ...]:
    """Position, quaternion, linear and angular velocity."""
    pose, twist = message.pose.pose, message.twist.twist
    q = pose.orientation
    return (_xyz(pose.position), [q.x, q.y, q.z, q.w], _xyz(twist.linear), _xyz(twist.angular))


def _command(message: Any) -> tuple[float, float, bool]:
    """Speed, what turns, and whether that is of a Twist."""
    if message.__msgtype__ in _ACKERMANN:
        drive = getattr(message, "drive", message)
        return drive.speed, drive.steering_angle, False
    twist = getattr(message, "twist", message)
    return twist.linear.x, twist.angular.z, True


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]
