# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Messages mean the same whether they come from a bag or from a topic."""

import math
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

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


def quaternion(yaw, length=1.0, roll=0.0):
    half = np.array([math.sin(roll / 2), 0.0, 0.0, math.cos(roll / 2)])
    turn = math.cos(yaw / 2), math.sin(yaw / 2)
    x, y, z, w = turn[0] * half[0], turn[1] * half[0], turn[1] * half[3], turn[0] * half[3]
    return SimpleNamespace(x=length * x, y=length * y, z=length * z, w=length * w)


def test_the_length_of_a_quaternion_changes_nothing_but_for_none():
    for length, roll in ((0.01, 0.0), (1.5, 0.1), (1e4, 0.0)):
        for yaw in np.linspace(-3.1, 3.1, 13):
            assert read_yaw(quaternion(yaw, length, roll)) == pytest.approx(yaw, abs=1e-9)
    for length, reason in ((0.0, 'zero'), (1e-5, 'zero'), (math.nan, 'finite'), (1e200, 'large')):
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
    twist = SimpleNamespace(linear=SimpleNamespace(x=1.0), angular=SimpleNamespace(z=0.5))
    for unknown in (0.0, -1.0, math.nan, math.inf, 1e6):
        covariance = np.zeros(36)
        covariance[0], covariance[35] = unknown, 0.01
        part = SimpleNamespace(twist=twist, covariance=covariance)
        assert read_twist(SimpleNamespace(twist=part)) == (1.0, 0.5, 0.0, 0.01)
    imu = SimpleNamespace(
        angular_velocity=SimpleNamespace(z=0.2), angular_velocity_covariance=np.zeros(9)
    )
    assert read_yaw_rate(imu) == (0.2, 0.0)
    imu.angular_velocity_covariance[0] = -1.0
    with pytest.raises(MessageError, match='unknown'):
        read_yaw_rate(imu)


def imu_of(roll, pitch, yaw=0.0):
    """An Imu message with an orientation."""
    a, b, c = np.cos(np.array([roll, pitch, yaw]) / 2)
    d, e, f = np.sin(np.array([roll, pitch, yaw]) / 2)
    imu = blank(get_typestore(Stores.ROS2_JAZZY), 'sensor_msgs/msg/Imu')
    imu.orientation.w, imu.orientation.x = a * b * c + d * e * f, d * b * c - a * e * f
    imu.orientation.y, imu.orientation.z = a * e * c + d * b * f, a * b * f - d * e * c
    return imu


def test_roll_and_pitch_of_an_imu():
    for roll, pitch, yaw in ((0.1, -0.2, 3.0), (-0.3, 0.05, -1.0), (0.0, 0.0, 2.0)):
        assert read_tilt(imu_of(roll, pitch, yaw)) == pytest.approx((roll, pitch))
        with pytest.raises(MessageError, match='axes of the IMU'):
            read_tilt(imu_of(roll + np.pi, pitch, yaw))
    unknown = imu_of(0.1, 0.0)
    unknown.orientation_covariance[0] = -1.0
    with pytest.raises(MessageError, match='no orientation'):
        read_tilt(unknown)


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
                bag.message('/imu', at, sent)
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
