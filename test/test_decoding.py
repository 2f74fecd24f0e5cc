# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Messages mean the same whether they come from a bag or from a topic."""

import math
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from sfa_localization.bags.drives import ReadingRecipe, read_drive
from sfa_localization.bags.writer import BagWriter, blank
from sfa_localization.camera.leveling import leveled
from sfa_localization.camera.settings import CameraConfig
from sfa_localization.data.errors import BagError, MessageError
from sfa_localization.data.messages import (
    read_planar,
    read_stamp,
    read_tilt,
    read_twist,
    read_yaw,
    read_yaw_rate,
)
from sfa_localization.inspection import inspect

START = 1_700_000_000_000_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)


def quaternion(yaw, length=1.0, roll=0.0, pitch=0.0):
    turn = length * Rotation.from_euler('ZYX', [yaw, pitch, roll]).as_quat()
    return SimpleNamespace(**dict(zip('xyzw', turn.tolist(), strict=True)))


def test_the_length_of_a_quaternion_changes_nothing_but_for_none():
    for length, roll in ((0.01, 0.0), (1.5, 0.1), (1e4, 0.0)):
        for yaw in np.linspace(-3.1, 3.1, 13):
            assert read_yaw(quaternion(yaw, length, roll)) == pytest.approx(yaw, abs=1e-9)
    for length, reason in ((1e-5, 'zero'), (math.nan, 'finite'), (1e200, 'large')):
        with pytest.raises(MessageError, match=reason):
            read_yaw(quaternion(1.0, length))


def test_impossible_stamps_and_poses_are_refused():
    for sec, nanosec, reason in ((0, 0, 'zero'), (-5, 7, 'negative'), (5, 10**9, 'impossible')):
        with pytest.raises(MessageError, match=reason):
            read_stamp(SimpleNamespace(sec=sec, nanosec=nanosec))
    assert read_stamp(SimpleNamespace(sec=5, nanosec=7)) == 5_000_000_007
    with pytest.raises(MessageError, match='pose is absurdly large'):
        read_planar(SimpleNamespace(x=1e10, y=0.0), quaternion(0.0))


def test_unknown_variances_are_zero():
    for unknown in (-1.0, math.nan, math.inf, 1e6):
        odometry = blank(STORE, 'nav_msgs/msg/Odometry')
        odometry.twist.twist.linear.x, odometry.twist.twist.angular.z = 1.0, 0.5
        odometry.twist.covariance[[0, 35]] = unknown, 0.01
        assert read_twist(odometry) == (1.0, 0.5, 0.0, 0.01)
    imu = blank(STORE, 'sensor_msgs/msg/Imu')
    imu.angular_velocity.z = 0.2
    assert read_yaw_rate(imu) == (0.2, 0.0)
    imu.angular_velocity_covariance[0] = -1.0
    with pytest.raises(MessageError, match='unknown'):
        read_yaw_rate(imu)


def imu_of(roll, pitch, yaw=0.0):
    """An Imu message with an orientation."""
    imu, turn = blank(STORE, 'sensor_msgs/msg/Imu'), quaternion(yaw, 1.0, roll, pitch)
    imu.orientation = STORE.types['geometry_msgs/msg/Quaternion'](**vars(turn))
    return imu


def test_roll_and_pitch_of_an_imu():
    for roll, pitch, yaw in ((0.1, -0.2, 3.0), (-0.3, 0.05, -1.0)):
        assert read_tilt(imu_of(roll, pitch, yaw)) == pytest.approx((roll, pitch))
        with pytest.raises(MessageError, match='axes of the IMU'):
            read_tilt(imu_of(roll + np.pi, pitch, yaw))


def test_panoramas_of_a_bag_are_leveled_by_its_imu(tmp_path):
    """As omnicam_node does; `inspect` says how far."""
    image = np.random.default_rng(0).integers(0, 256, (12, 72, 3), np.uint8)
    recipe = ReadingRecipe(camera=CameraConfig(level_by_imu=True))

    def recorded(name, late_ns=0, measured=True):
        with BagWriter(tmp_path / name) as bag:
            for k in range(4):
                at, sent = START + k * 10**9, imu_of(0.1 * k, -0.05)
                sent.header.stamp.sec, sent.header.stamp.nanosec = divmod(at + late_ns, 10**9)
                sent.orientation_covariance[0] = 0.0 if measured else -1.0
                bag.odometry('/odom', at, (0.1 * k, 0, 0), (0.1, 0), (0, 0))
                bag.image('/panorama', at, image, 'camera')
                bag.message('/imu', at + late_ns, sent)
        return tmp_path / name

    run = read_drive(recorded('bag'), tmp_path / 'cache', recipe)
    expected = [leveled(image, (0.1 * k, -0.05), recipe.panorama.sphere) for k in range(4)]
    off = run.panoramas.read(0, 4).astype(int) - expected
    assert np.abs(off).max() <= 1 and len({level.tobytes() for level in expected}) == 4
    assert inspect(tmp_path / 'bag').facts['ground'] == 'tilts the robot by 3.2 degrees'
    for given, reason in (({'late_ns': 10**7}, ''), ({'late_ns': 5 * 10**9}, 'near 4 of 4 images'),
                          ({'measured': False}, 'no orientation')):  # fmt: skip
        path = recorded(f'{given}', **given)
        with pytest.raises(BagError, match=reason) if reason else nullcontext():
            read_drive(path, tmp_path / 'cache', recipe)
