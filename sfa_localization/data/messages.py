# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Fields of ROS messages as numbers, for messages of bags and of topics.

Takes any object with the fields of the message, and needs neither ROS nor rosbags. Stamps are
integer nanoseconds, poses (x m, y m, yaw rad). An unusable message raises MessageError with a short
reason, so that reasons can be counted.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sfa_localization.data.errors import MessageError
from sfa_localization.data.geometry import Array

NANOSECONDS = 1_000_000_000
NO_STAMP = 'zero or negative stamp'
IMPOSSIBLE_STAMP = 'impossible stamp'
_LARGEST = 1e9
"""No robot reaches this number of m, rad, m/s or rad/s: the field was never set."""
LARGEST_VARIANCE = 1e6
"""Drivers, and the nodes, mark an unknown variance by numbers this large (SI units)."""
LARGEST_TWIST_VARIANCE = 1e2
"""The same for speeds and turn rates: a standard deviation of 10 m/s or rad/s says nothing."""
LARGEST_SCALE = 1.5
"""A larger scale of odometry is no error of wheels, but another unit."""
_SHORTEST_QUATERNION = 1e-3
"""A shorter quaternion has no direction; normalized ones have length 1."""
PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
TWIST = np.ix_([0, 5], [0, 5])
"""Rows and columns of x, y and yaw, and of v and omega, in the covariances of messages."""
_FIXED = np.diag([1e-6] * 6)
"""Covariance of z, roll and pitch, which a planar estimate fixes."""
_STEEPEST = math.radians(45.0)
"""No robot on wheels rolls or pitches this much: the axes of the IMU are others, as z down."""


def read_stamp(stamp: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    if not 0 <= stamp.nanosec < NANOSECONDS:
        raise MessageError(IMPOSSIBLE_STAMP)
    total = int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
    if total <= 0:
        raise MessageError(NO_STAMP)
    return total


def read_yaw(q: Any) -> float:
    """Heading of a Quaternion of any length above _SHORTEST_QUATERNION."""
    norm = _length(q)
    sine = q.w * q.z + q.x * q.y
    cosine = norm * norm / 2 - (q.y * q.y + q.z * q.z)
    return math.atan2(sine, cosine)


def read_planar(position: Any, orientation: Any) -> tuple[float, float, float]:
    """Pose in the plane of a position (or translation) and a Quaternion."""
    x = float(position.x)
    y = float(position.y)
    require_sane('pose', x, y)
    return x, y, read_yaw(orientation)


def read_odometry(
    message: Any,
) -> tuple[tuple[float, float, float] | None, tuple[float, float, float, float]]:
    """Pose of an Odometry, None where it is not filled with one, and its twist: see read_twist."""
    twist = read_twist(message)
    try:
        return read_planar(message.pose.pose.position, message.pose.pose.orientation), twist
    except MessageError:
        return None, twist


def read_twist(message: Any) -> tuple[float, float, float, float]:
    """v m/s and omega rad/s of an Odometry, and their variances, 0 if unknown."""
    twist = message.twist.twist
    covariance = message.twist.covariance
    v = float(twist.linear.x)
    omega = float(twist.angular.z)
    require_sane('twist', v, omega)
    return v, omega, _variance(covariance[0]), _variance(covariance[35])


def read_yaw_rate(message: Any) -> tuple[float, float]:
    """omega rad/s of an Imu about its z axis, and its variance, 0 if unknown."""
    if message.angular_velocity_covariance[0] == -1.0:
        raise MessageError('the message marks its yaw rate as unknown')
    omega = float(message.angular_velocity.z)
    require_sane('yaw rate', omega)
    return omega, _variance(message.angular_velocity_covariance[8])


def read_tilt(message: Any) -> tuple[float, float]:
    """Roll and pitch rad of an Imu whose axes are the robot's: x forward, y left, z up."""
    if message.orientation_covariance[0] == -1.0:
        raise MessageError('no orientation (a node such as imu_filter_madgwick estimates it)')
    q = message.orientation
    norm = _length(q)
    x = q.x / norm
    y = q.y / norm
    z = q.z / norm
    w = q.w / norm
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(min(max(2 * (w * y - z * x), -1.0), 1.0))
    if max(abs(roll), abs(pitch)) > _STEEPEST:
        raise MessageError('on its side: are the axes of the IMU those of the robot?')
    return roll, pitch


def full_covariance(covariance: Array, places: Any = PLANAR) -> Array:
    """The covariance (36,) of a message from its rows and columns at `places`."""
    full = _FIXED.copy()
    full[places] = covariance
    return full.ravel()


def _length(q: Any) -> float:
    norm = math.hypot(q.x, q.y, q.z, q.w)
    require_sane('quaternion', norm)
    if norm < _SHORTEST_QUATERNION:
        raise MessageError('quaternion is zero')
    return norm


def require_sane(name: str, *numbers: float) -> None:
    """Raise MessageError for numbers that are not finite, or larger than _LARGEST."""
    if not all(map(math.isfinite, numbers)):
        raise MessageError(f'{name} is not finite')
    if any(abs(number) > _LARGEST for number in numbers):
        raise MessageError(f'{name} is absurdly large')


def _variance(value: float) -> float:
    """A variance of a twist, or 0 (unknown) for an impossible one."""
    return float(value) if math.isfinite(value) and 0 < value < LARGEST_TWIST_VARIANCE else 0.0
