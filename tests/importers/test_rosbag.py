"""Bags of ROS 1 and ROS 2."""

import sqlite3
import sys
from dataclasses import replace

import numpy as np
import pytest
from importers.bags import Bag
from importers.logged import SETTINGS, VEHICLE, commands, logged
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from vertiwm_jax.errors import UserError
from vertiwm_jax.importers import rosbag
from vertiwm_jax.importers.commands import steering
from vertiwm_jax.importers.settings import ImportSettings, Topics, Units
from vertiwm_jax.learning.schema import DataError

TOPICS = Topics(odometry="/odom", command="/cmd")
ACKERMANN = replace(SETTINGS, rosbag=TOPICS)
TWIST = replace(SETTINGS, rosbag=replace(TOPICS, command="/cmd_vel"))
COMMAND_TIME = 99.0 + 0.05 * np.arange(100)


@pytest.fixture(scope="module")
def seen():
    return logged(seconds=4)


@pytest.fixture(scope="module", params=["drive.bag", "drive"])
def bag(request, seen, tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / request.param
    with Bag(path) as writer:
        writer.odometry(seen)
        writer.ackermann(COMMAND_TIME, commands(COMMAND_TIME))
        writer.twists(COMMAND_TIME, commands(COMMAND_TIME))
    return path


def test_odometry_and_ackermann_commands(bag, seen):
    (log,) = rosbag.read(bag, ACKERMANN)
    np.testing.assert_allclose(log.time, seen.time, atol=1e-8)
    np.testing.assert_allclose(log.position, seen.state[:, :3])
    assert (log.rotation.inv() * seen.rotation).magnitude().max() < 1e-9
    np.testing.assert_allclose(log.velocity, seen.state[:, 6:9])
    np.testing.assert_allclose(log.angular_velocity, seen.state[:, 9:12])
    np.testing.assert_allclose(log.command_time, COMMAND_TIME, atol=1e-8)
    np.testing.assert_allclose(log.command, commands(COMMAND_TIME), atol=1e-6)
    received = replace(ACKERMANN, rosbag=replace(TOPICS, stamps="bag"))
    (late,) = rosbag.read(bag, received)
    np.testing.assert_allclose(late.time, seen.time + 0.03, atol=1e-8)


def test_a_twist_turns_by_its_yaw_rate(bag):
    (log,) = rosbag.read(bag, TWIST)
    np.testing.assert_allclose(log.command_time, COMMAND_TIME, atol=1e-8)
    speed, angle = log.command.T
    # The bicycle without slip: yaw rate = v tan(angle) / wheelbase.
    turn = speed * np.tan(angle) / VEHICLE.wheelbase
    np.testing.assert_allclose(np.stack([speed, turn], 1), commands(COMMAND_TIME))
    angles = replace(
        TWIST, rosbag=replace(TWIST.rosbag, twist="steering"), units=Units(steering=-2)
    )
    (log,) = rosbag.read(bag, angles)
    np.testing.assert_allclose(log.command, commands(COMMAND_TIME) * [1, -2])


def test_a_small_vehicle_steers_as_far_at_full_size(bag):
    (log,) = rosbag.read(bag, TWIST)
    (rover,) = rosbag.read(bag, replace(TWIST, vehicle=replace(VEHICLE, scale=9.0)))
    np.testing.assert_allclose(rover.command, log.command * [3, 1])


def test_wheels_stay_as_they_were_where_a_twist_stands():
    speed, turn = np.array([0, 2, 0, 0, -2.0]), np.array([1, 0.5, 0.7, 0, 0.5])
    angle = np.arctan(0.5)
    np.testing.assert_allclose(steering(speed, turn, 2.0), [0, angle, angle, angle, -angle])


def test_stamped_twists(seen, tmp_path):
    """As TartanDrive's bags have them: throttle and steering of the driver."""
    with Bag(tmp_path / "a.bag") as writer:
        writer.odometry(seen)
        writer.twists(COMMAND_TIME, commands(COMMAND_TIME), stamped=True)
    settings = replace(TWIST, rosbag=replace(TWIST.rosbag, twist="steering"))
    (log,) = rosbag.read(tmp_path / "a.bag", settings)
    np.testing.assert_allclose(log.command, commands(COMMAND_TIME))


def test_bags_that_do_not_say_what_they_hold(seen, tmp_path):
    """As ROS 2 up to Humble writes them."""
    with Bag(tmp_path / "a") as writer:
        writer.odometry(seen)
        writer.ackermann(COMMAND_TIME, commands(COMMAND_TIME))
    (database,) = (tmp_path / "a").glob("*.db3")
    with sqlite3.connect(database) as connection:
        connection.execute("DELETE FROM message_definitions")
    (log,) = rosbag.read(tmp_path / "a", ACKERMANN)
    np.testing.assert_allclose(log.command, commands(COMMAND_TIME), atol=1e-6)


@pytest.mark.parametrize("store", StoragePlugin)
def test_messages_that_are_compressed_each(seen, tmp_path, store):
    """Only the file beside the bag says that they are."""
    with Bag(tmp_path / "a", store, CompressionMode.MESSAGE) as writer:
        writer.odometry(seen)
        writer.ackermann(COMMAND_TIME, commands(COMMAND_TIME))
    (bag,) = (path for path in (tmp_path / "a").iterdir() if path.suffix != ".yaml")
    for path in (tmp_path / "a", bag):
        (log,) = rosbag.read(path, ACKERMANN)
        np.testing.assert_allclose(log.position, seen.state[:, :3])
        np.testing.assert_allclose(log.command, commands(COMMAND_TIME), atol=1e-6)


def test_bags_that_cannot_be_used_are_named(bag, seen, tmp_path):
    def message(path, settings):
        with pytest.raises(DataError) as error:
            rosbag.read(path, settings)
        assert "\n" not in str(error.value)
        return str(error.value).removeprefix(f"{path}: ")

    other = replace(ACKERMANN, rosbag=replace(TOPICS, odometry="/pose"))
    assert message(bag, other) == (
        "/pose: expected messages of nav_msgs/msg/Odometry or "
        "geometry_msgs/msg/PoseWithCovarianceStamped or geometry_msgs/msg/PoseStamped, found none; "
        "there is /cmd, /cmd_vel, /odom"
    )
    other = replace(ACKERMANN, rosbag=replace(TOPICS, odometry="/cmd_vel"))
    assert message(bag, other).endswith("PoseStamped, found geometry_msgs/msg/Twist")
    assert "a section `rosbag`" in message(bag, ImportSettings(VEHICLE))
    broken = tmp_path / "broken.bag"
    broken.write_bytes(b"#ROSBAG V2.0\nno more")
    assert message(broken, ACKERMANN).startswith("expected a ROS bag: ")
    (tmp_path / "empty").mkdir()
    assert message(tmp_path / "empty", ACKERMANN).startswith("expected a ROS bag: ")
    with Bag(tmp_path / "torn") as writer:
        writer.odometry(seen)
    (database,) = (tmp_path / "torn").glob("*.db3")
    database.write_bytes(b"SQLite format 3" + bytes(200))
    assert message(tmp_path / "torn", ACKERMANN).startswith("expected a ROS bag: ")


def test_bags_need_a_package(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(UserError, match=r'package rosbags.* pip install "vertiwm-jax\[logs\]"'):
        rosbag.read(tmp_path / "a.bag", ACKERMANN)


def test_a_stamp_that_repeats_is_left_out_and_said(seen, tmp_path):
    repeated = np.where(np.arange(len(seen.time)) == 6, seen.time[5], seen.time)
    with Bag(tmp_path / "mixed.bag") as writer:
        writer.odometry(replace(seen, time=repeated))
        writer.ackermann(COMMAND_TIME, commands(COMMAND_TIME))
    (log,) = rosbag.read(tmp_path / "mixed.bag", ACKERMANN)
    assert len(log.time) == len(seen.time) - 1
    (remark,) = log.remarks
    assert remark.startswith(f"{tmp_path / 'mixed.bag'}: time: expected stamps that increase, fo")
