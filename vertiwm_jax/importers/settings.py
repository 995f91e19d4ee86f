"""What an importer must be told of a log: the vehicle, units, frames, and where its data lie."""

from dataclasses import dataclass
from typing import Literal

from vertiwm_jax.config import Positive, settings
from vertiwm_jax.terrain.classes import STANDARD

Triple = tuple[float, float, float]
Names = tuple[str, str, str]


@settings
class VehicleSettings:
    """The wheels, and what the log calls the pose of the vehicle."""

    wheelbase: Positive
    """m between the axles."""
    track: Positive
    """m between left and right wheels."""
    logged_point: Triple = (0.0, 0.0, 0.0)
    """The point whose position is logged, in the body frame of this project (x forward, y left,
    z up, from the point between the four wheel centres), m."""
    scale: Positive = 1.0
    """m at full size that 1 m of the vehicle is, as in its file; drives and map become as large,
    and times and speeds its root times as large, before `resampling`."""

    @property
    def wheels_in_body_xy(self) -> list[list[float]]:
        """FL, FR, RL, RR, m at full size."""
        x, y = self.scale * self.wheelbase / 2, self.scale * self.track / 2
        return [[x, y], [x, -y], [-x, y], [-x, -y]]


@settings
class Units:
    """How many SI units one unit of the log is: 1e-9 s for nanoseconds, 0.27778 m/s for km/h."""

    time: float = 1.0
    """s."""
    position: float = 1.0
    """m."""
    angle: float = 1.0
    """rad; angular velocities are such angles a second."""
    velocity: float = 1.0
    """m/s, of logged velocities."""
    speed: float = 1.0
    """m/s, of commanded speeds; where a throttle is logged, the speed that 1 stands for."""
    steering: float = 1.0
    """rad of the front wheels, rad/s of commanded yaw rates; negative where right is positive."""

    def check(self):
        for name, value in vars(self).items():
            if value == 0:
                raise ValueError(f"{name}: expected how many SI units one unit is, found 0")


@dataclass(frozen=True)
class Frames:
    """Which frames the log is in."""

    axes: Literal["z_up", "z_down"] = "z_up"
    """x forward, y left, z up in a world whose z is up; or forward-right-down in one whose z is
    down (north-east-down)."""
    velocity: Literal["body", "world"] = "body"
    """Frame of logged velocities; ROS's odometry has them in the body."""
    angular_velocity: Literal["body", "world"] = "body"
    """Frame of logged angular velocities."""
    origin: Triple = (0.0, 0.0, 0.0)
    """What becomes the origin of the world, in the world of the log once z is up, m."""


@settings
class Resampling:
    """How a log becomes drives at 10 Hz."""

    gap: Positive = 0.5
    """s without a pose that end a drive; the next one begins after them."""
    command_gap: Positive = 0.5
    """The same for commands; the last one is held as long."""
    window: Positive = 0.5
    """s over which a parabola is fitted to poses, where velocities are not logged."""
    shortest: int = 32
    """Drives of fewer steps are left out; a window of `fit` has 32."""
    longest: int = 250
    """Drives of more steps are cut into equal pieces: `fit` learns from the first 20 drives of
    each 25, and tests on the last 3."""

    def check(self):
        if not 1 <= self.shortest <= self.longest / 2:
            raise ValueError(
                f"shortest: expected 1 or more, and half of longest ({self.longest}) at most, so "
                f"that no piece is too short; found {self.shortest}"
            )


@settings
class Table:
    """Names of the columns of a CSV or Parquet file, a row a moment."""

    time: str
    """When the row was logged."""
    position: Names
    """x, y, z."""
    speed: str
    """Commanded speed, or throttle."""
    steering: str
    """Commanded angle of the front wheels."""
    rpy: Names | None = None
    """Roll, pitch and yaw, R = Rz Ry Rx; or else"""
    quaternion: tuple[str, str, str, str] | None = None
    """x, y, z, w."""
    velocity: Names | None = None
    """From the positions by default."""
    angular_velocity: Names | None = None
    """From the attitudes by default."""
    brake: str | None = None
    """What is subtracted from `speed`, where that is a throttle."""
    drive: str | None = None
    """Tells drives apart; by default a file is one drive."""

    def check(self):
        if (self.rpy is None) == (self.quaternion is None):
            raise ValueError("rpy, quaternion: expected one of them")


@settings
class GridMapSettings:
    """Ground from all messages of a grid_map_msgs/GridMap topic; the newest height counts."""

    topic: str
    """Name of the topic."""
    elevation: str = "elevation"
    """Layer of heights, m."""
    semantic: str | None = None
    """Layer of class ids; by default all ground is of one class."""
    ground: str = "grass"
    """That class, also where the layer has none."""

    def check(self):
        if self.ground not in STANDARD.names:
            names = ", ".join(STANDARD.names)
            raise ValueError(f"ground: expected one of {names}, found {self.ground}")


@dataclass(frozen=True)
class Topics:
    """Topics of a ROS bag."""

    odometry: str
    """nav_msgs/Odometry."""
    command: str
    """ackermann_msgs/AckermannDrive or geometry_msgs/Twist, either with or without a stamp."""
    twist: Literal["yaw_rate", "steering"] = "yaw_rate"
    """What angular.z of a Twist is; linear.x is the speed."""
    stamps: Literal["header", "bag"] = "header"
    """When a message counts: by its header, if it has one, or when it was received."""
    grid_map: GridMapSettings | None = None
    """Ground, unless a map is given."""


@dataclass(frozen=True)
class Trajectories:
    """Names in a trajectory of TartanDrive."""

    state: str = "state"
    """The observation, or the folder, that holds p, q (x, y, z, w) and perhaps velocities."""
    command: str = "cmd"
    """The folder that holds throttle and steering."""


@dataclass(frozen=True)
class ImportSettings:
    """All that `import_drives` reads from its settings file."""

    vehicle: VehicleSettings
    units: Units = Units()
    frames: Frames = Frames()
    resampling: Resampling = Resampling()
    table: Table | None = None
    """Of CSV and Parquet."""
    rosbag: Topics | None = None
    """Of ROS bags."""
    tartandrive: Trajectories = Trajectories()
    """Of TartanDrive."""
