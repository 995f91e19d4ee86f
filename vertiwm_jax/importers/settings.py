"""Settings that describe a log: the vehicle, units, frames, and the names of its data."""

from dataclasses import dataclass
from typing import Annotated, Literal

from vertiwm_jax.config import Bounds, NotNegative, Positive, settings
from vertiwm_jax.state import Turn
from vertiwm_jax.terrain.classes import STANDARD

Triple = tuple[float, float, float]
Names = tuple[str, str, str]
GroundName = Annotated[
    str, Bounds(f"one of {', '.join(STANDARD.names)}", lambda name: name in STANDARD.names)
]


@settings
class VehicleSettings:
    """Geometry of the vehicle, and the point whose pose was logged."""

    wheelbase: Positive
    """m between the axles."""
    track: Positive
    """m between left and right wheels."""
    logged_point: Triple = (0.0, 0.0, 0.0)
    """The point whose position is logged, in the body frame of this project (x forward, y left,
    z up, from the point between the four wheel centers), m."""
    wheel_radius: Positive | None = None
    """m; needed to set logs of x, y and yaw alone on the ground."""
    steered: Literal["front", "skid"] = "front"
    """By wheels that turn, or by different speeds of the wheels of both sides. Yaw rates that no
    front wheel can follow are followed as far as it turns."""
    scale: Positive = 1.0
    """The factor from the vehicle to full size, as in its file: 10 for a 1/10-scale rover. Drives
    and map are enlarged by it, times and speeds by its square root, before `resampling`."""

    @property
    def turn(self) -> Turn:
        """What the second of the commands of its drives is."""
        return "yaw_rate" if self.steered == "skid" else "steering"

    @property
    def wheels_in_body_xy(self) -> list[list[float]]:
        """FL, FR, RL, RR, m at full size."""
        x, y = self.scale * self.wheelbase / 2, self.scale * self.track / 2
        return [[x, y], [x, -y], [-x, y], [-x, -y]]


_Factor = Annotated[float, Bounds("how many SI units one unit is", bool)]


@settings
class Units:
    """How many SI units one unit of the log is: 1e-9 s for nanoseconds, 0.27778 m/s for km/h."""

    time: _Factor = 1.0
    """s."""
    position: _Factor = 1.0
    """m."""
    angle: _Factor = 1.0
    """rad; angular velocities are such angles a second."""
    velocity: _Factor = 1.0
    """m/s, of logged velocities."""
    speed: _Factor = 1.0
    """m/s, of commanded speeds. Where a throttle was logged: the speed at a throttle of 1. Where
    wheel speeds were logged in rad/s: the radius of a wheel, m."""
    steering: _Factor = 1.0
    """rad of the front wheels, rad/s of commanded yaw rates; negative where right is positive."""


@dataclass(frozen=True)
class Frames:
    """Frames of the log."""

    axes: Literal["z_up", "z_down"] = "z_up"
    """x forward, y left, z up in a world whose z is up; or forward-right-down in one whose z is
    down (north-east-down)."""
    velocity: Literal["body", "world"] = "body"
    """Frame of logged velocities; ROS odometry uses the body frame."""
    angular_velocity: Literal["body", "world"] = "body"
    """Frame of logged angular velocities."""
    origin: Triple = (0.0, 0.0, 0.0)
    """Point of the log's world that becomes the origin, m, after z has been turned up."""


@settings
class Resampling:
    """How a log becomes drives at 10 Hz."""

    gap: Positive = 0.5
    """A drive ends where poses are missing for longer than this, s; the next begins after that."""
    command_gap: Positive = 0.5
    """The same for commands. A command is held for up to this time."""
    window: Positive = 0.5
    """s over which a parabola is fitted to poses, where velocities are not logged; more, up to 1.5,
    where noise of the positions would make them rougher than 0.05 m/s."""
    delay: NotNegative = 0.0
    """s of the vehicle's own by which commands are moved later, because they act later or poses
    have later stamps; the command tells how much there is."""
    shortest: int = 32
    """Drives of fewer steps are left out; a window of `fit` has 32."""
    longest: int = 250
    """Drives of more steps are cut into equal pieces, which are drives of their own."""

    def check(self):
        if not 1 <= self.shortest <= self.longest / 2:
            raise ValueError(
                f"shortest: expected 1 or more, and half of longest ({self.longest}) at most, so "
                f"that no piece is too short; found {self.shortest}"
            )


@settings
class Table:
    """Names of the columns of a CSV or Parquet file with one row per time stamp."""

    time: str
    """Time stamp of the row: a number in `units.time`, or a date in Parquet."""
    position: Names | tuple[str, str]
    """x, y, z; or x, y, with `yaw`."""
    speed: str | None = None
    """Commanded speed, or throttle."""
    steering: str | None = None
    """Commanded angle of the front wheels. Give this or `yaw_rate`, or instead of both and the
    speed `left` and `right`."""
    yaw_rate: str | None = None
    """Commanded yaw rate, left positive."""
    left: str | None = None
    """Commanded speed of the wheels on the left of a skid-steered vehicle."""
    right: str | None = None
    """The same on the right."""
    rpy: Names | None = None
    """Roll, pitch and yaw, R = Rz Ry Rx. Give this, `quaternion` or `yaw`."""
    quaternion: tuple[str, str, str, str] | None = None
    """x, y, z, w."""
    yaw: str | None = None
    """Where a log has x, y and yaw alone: height, roll and pitch are those of the ground."""
    velocity: Names | None = None
    """Estimated from the positions by default."""
    angular_velocity: Names | None = None
    """Estimated from the attitudes by default."""
    brake: str | None = None
    """Column that is subtracted from `speed`, where that is a throttle."""
    drive: str | None = None
    """Column whose value differs between drives; by default a file is one drive."""

    def check(self):
        given = {name for name, value in vars(self).items() if value is not None}
        if len(given & {"rpy", "quaternion", "yaw"}) != 1:
            raise ValueError("rpy, quaternion, yaw: expected one of them")
        if ("yaw" in given) != (len(self.position) == 2):
            raise ValueError("position: expected x, y and z, or x and y with `yaw`")
        commands = given & {"speed", "steering", "yaw_rate", "left", "right"}
        if commands not in ({"speed", "steering"}, {"speed", "yaw_rate"}, {"left", "right"}):
            raise ValueError(
                "speed, steering: expected columns of speed and steering, speed and yaw_rate, or "
                f"left and right; found {', '.join(sorted(commands)) or 'none'}"
            )
        if "brake" in given and "left" in given:
            raise ValueError("brake: expected a column of speed to subtract it from, found none")


@settings
class GridMapSettings:
    """How the map is built from a grid_map_msgs/GridMap topic; the newest height counts."""

    topic: str
    """Name of the topic."""
    elevation: str = "elevation"
    """Layer of heights, m."""
    semantic: str | None = None
    """Layer of class ids; by default all ground is of one class."""
    ground: GroundName = "grass"
    """Ground class where there is no such layer, or where it has no value."""


@dataclass(frozen=True)
class Topics:
    """Topics of a ROS bag."""

    odometry: str
    """nav_msgs/Odometry, or geometry_msgs/PoseStamped with or without a covariance."""
    command: str
    """ackermann_msgs/AckermannDrive or geometry_msgs/Twist, either with or without a stamp."""
    twist: Literal["yaw_rate", "steering"] = "yaw_rate"
    """Meaning of angular.z of a Twist; linear.x is the speed."""
    stamps: Literal["header", "bag"] = "header"
    """Time of a message: its header's, where it has one, or the time at which it was received."""
    grid_map: GridMapSettings | None = None
    """Builds the map from the bag, unless a map is given."""


@settings
class ImportSettings:
    """The settings file of `import_drives`."""

    vehicle: VehicleSettings
    units: Units = Units()
    frames: Frames = Frames()
    resampling: Resampling = Resampling()
    table: Table | None = None
    """Columns of CSV and Parquet files."""
    rosbag: Topics | None = None
    """Topics of ROS bags."""
    plane: GroundName = "grass"
    """Ground class of the plane on which logs of x, y and yaw alone are set without a map."""

    def check(self):
        if self.table is not None and self.table.left and self.vehicle.steered != "skid":
            raise ValueError(
                "vehicle.steered: expected skid, as table.left and table.right name wheel speeds, "
                f"found {self.vehicle.steered}"
            )
