"""Bags of ROS 1 and ROS 2, written as robots write them."""

from pathlib import Path

import numpy as np
from importers.logged import Logged
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from vertiwm_jax.importers.rosbag import DEFINITIONS

ROS1_GRID_MAP_INFO = """
    std_msgs/Header header
    float64 resolution
    float64 length_x
    float64 length_y
    geometry_msgs/Pose pose"""
ROS1_GRID_MAP = """
    grid_map_msgs/GridMapInfo info
    string[] layers
    string[] basic_layers
    std_msgs/Float32MultiArray[] data
    uint16 outer_start_index
    uint16 inner_start_index"""


class Bag:
    """A bag to write to: `.bag` is of ROS 1, another name is the folder of one of ROS 2."""

    def __init__(
        self,
        path: Path,
        store: StoragePlugin = StoragePlugin.SQLITE3,
        compression: CompressionMode = CompressionMode.NONE,
    ) -> None:
        self._is1 = path.suffix == ".bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self._is1 else Stores.ROS2_HUMBLE)
        texts = dict(DEFINITIONS)
        if self._is1:
            texts["grid_map_msgs/msg/GridMapInfo"] = ROS1_GRID_MAP_INFO
            texts["grid_map_msgs/msg/GridMap"] = ROS1_GRID_MAP
        for kind, text in texts.items():
            self.store.register(get_types_from_msg(text, kind))
        if self._is1:
            self._writer = rosbag1.Writer(path)
        else:
            self._writer = rosbag2.Writer(path, version=9, storage_plugin=store)
            self._writer.set_compression(compression, CompressionFormat.ZSTD)
        self._connections, self._latest = {}, {}

    def __enter__(self):
        self._writer.open()
        return self

    def __exit__(self, *_):
        self._writer.close()

    def make(self, kind: str, *values):
        return self.store.types[kind](*values)

    def header(self, stamp: float, frame: str = "odom"):
        seconds = int(stamp)
        time = self.make("builtin_interfaces/msg/Time", seconds, round((stamp - seconds) * 1e9))
        sequence = (0,) if self._is1 else ()
        return self.make("std_msgs/msg/Header", *sequence, time, frame)

    def write(self, topic: str, received: float, message, length: int | None = None) -> None:
        """length: bytes that are left of a message that was cut off."""
        kind = message.__msgtype__
        if topic not in self._connections:
            connection = self._writer.add_connection(topic, kind, typestore=self.store)
            self._connections[topic] = connection
        serialize = self.store.serialize_ros1 if self._is1 else self.store.serialize_cdr
        data = bytes(serialize(message, kind))[:length]
        # Stamps may fall back, the clock of the recorder does not.
        received = max(received, self._latest.get(topic, 0.0) + 1e-3)
        self._latest[topic] = received
        self._writer.write(self._connections[topic], round(received * 1e9), data)

    def vector(self, xyz, kind: str = "Vector3"):
        return self.make(f"geometry_msgs/msg/{kind}", *(float(value) for value in xyz))

    def twist(self, linear, angular):
        return self.make("geometry_msgs/msg/Twist", self.vector(linear), self.vector(angular))

    def pose(self, position, quaternion):
        return self.make(
            "geometry_msgs/msg/Pose",
            self.vector(position, "Point"),
            self.vector(quaternion, "Quaternion"),
        )

    def odometry(self, seen: Logged, cut_off: int | None = None) -> None:
        """All poses on `/odom`, received 0.03 s after their stamps; one may be cut off."""
        variance, rotation = np.zeros(36), seen.rotation.as_quat()
        for k, stamp in enumerate(seen.time):
            twist = self.twist(seen.state[k, 6:9], seen.state[k, 9:12])
            message = self.make(
                "nav_msgs/msg/Odometry",
                self.header(stamp),
                "base_link",
                self.make(
                    "geometry_msgs/msg/PoseWithCovariance",
                    self.pose(seen.position[k], rotation[k]),
                    variance,
                ),
                self.make("geometry_msgs/msg/TwistWithCovariance", twist, variance),
            )
            self.write("/odom", stamp + 0.03, message, 60 if k == cut_off else None)

    def poses(self, seen: Logged) -> None:
        """The same on `/pose`, without velocities."""
        variance, rotation = np.zeros(36), seen.rotation.as_quat()
        for k, stamp in enumerate(seen.time):
            pose = self.pose(seen.position[k], rotation[k])
            known = self.make("geometry_msgs/msg/PoseWithCovariance", pose, variance)
            kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
            self.write("/pose", stamp + 0.03, self.make(kind, self.header(stamp, "map"), known))

    def ackermann(self, time, command) -> None:
        """Stamped commands on `/cmd`."""
        for stamp, (speed, steering) in zip(time, command, strict=True):
            drive = self.make(
                "ackermann_msgs/msg/AckermannDrive", float(steering), 0.0, float(speed), 0.0, 0.0
            )
            kind = "ackermann_msgs/msg/AckermannDriveStamped"
            self.write("/cmd", stamp + 0.03, self.make(kind, self.header(stamp), drive))

    def twists(self, time, command, stamped: bool = False) -> None:
        """Speed and yaw rate on `/cmd_vel`."""
        for stamp, (speed, turn) in zip(time, command, strict=True):
            message = self.twist([speed, 0, 0], [0, 0, turn])
            if stamped:
                kind = "geometry_msgs/msg/TwistStamped"
                message = self.make(kind, self.header(stamp), message)
            self.write("/cmd_vel", stamp, message)

    def grid_map(
        self, stamp: float, layers: dict[str, np.ndarray], centre, resolution: float, start=(0, 0)
    ) -> None:
        """On `/map`: layers `[rows, columns]`, whose x and y fall, rolled to begin at `start`."""
        rows, columns = next(iter(layers.values())).shape
        dimension = "std_msgs/msg/MultiArrayDimension"
        layout = self.make(
            "std_msgs/msg/MultiArrayLayout",
            [
                self.make(dimension, "column_index", columns, rows * columns),
                self.make(dimension, "row_index", rows, rows),
            ],
            0,
        )
        data = [
            self.make(
                "std_msgs/msg/Float32MultiArray",
                layout,
                np.roll(layer, start, (0, 1)).ravel(order="F").astype(np.float32),
            )
            for layer in layers.values()
        ]
        header = self.header(stamp)
        pose = self.pose([*centre, 0], [0, 0, 0, 1])
        lengths = (resolution, rows * resolution, columns * resolution, pose)
        info = self.make(
            "grid_map_msgs/msg/GridMapInfo", *([header] if self._is1 else []), *lengths
        )
        values = (info, list(layers), [], data, *start)
        message = self.make("grid_map_msgs/msg/GridMap", *([] if self._is1 else [header]), *values)
        self.write("/map", stamp, message)
