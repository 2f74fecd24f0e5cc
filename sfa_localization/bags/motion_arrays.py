# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry, yaw rates and trajectories as arrays, from the stamped values of a bag's streams."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.run import (
    POINT_STD_M,
    Odometry,
    Points,
    Stamps,
    Trajectory,
    YawRate,
    differences,
    integrate,
)

StampedValues = list[tuple[int, Any]]
"""Stamps in ns, each with the value that was read from its message."""
_DRIVING_MPS = 0.01
"""A robot this fast is driving (m/s): above the noise of wheel encoders at rest."""

_COMPARED_S, _COUNTED = 1.0, 0.05
"""Motion of poses and twists is compared by the second, from so much on (m, rad): a robot that
stands for long adds up noise."""
_ENOUGH, _UNEQUAL = 3.0, 1.5
"""From such a sum on (m, rad) a larger factor between them is none of wheels or of sampling."""


def _stamps(values: StampedValues) -> Stamps:
    return np.array([stamp for stamp, _ in values], np.int64)


def to_trajectory(values: StampedValues) -> Trajectory:
    """Poses at stamps."""
    return Trajectory(_stamps(values), np.array([pose for _, pose in values], float).reshape(-1, 3))


def to_yaw_rate(values: StampedValues) -> YawRate:
    """Yaw rates at stamps; the values are omega and its variance."""
    rates = np.array([rate for _, rate in values], float).reshape(-1, 2)
    return YawRate(_stamps(values), rates[:, 0], rates[:, 1])


def to_points(values: StampedValues) -> Points:
    """Measured places; the values are x, y and a standard deviation, POINT_STD_M where it is 0."""
    return Points.of([
        (f'point of {stamp_ns * 1e-9:.1f} s', stamp_ns, complex(x, y), std or POINT_STD_M)
        for stamp_ns, (x, y, std) in values
    ])  # fmt: skip


def to_odometry(values: StampedValues) -> tuple[Odometry, str]:
    """Odometry, and what is odd about it, in words.

    The values are a pose, with v, omega and their variances, or with None where the messages hold
    poses only: then twists are the differences of the poses.
    """
    stamps = _stamps(values)
    poses = np.array([pose for _, (pose, _) in values], float).reshape(-1, 3)
    if not values or values[0][1][1] is None:
        twists = differences(stamps, poses)
        odometry = Odometry(stamps, poses, twists, np.zeros_like(twists))
    else:
        motion = np.array([twist for _, (_, twist) in values], float).reshape(-1, 4)
        odometry = Odometry(stamps, poses, motion[:, :2], motion[:, 2:])
    speeds = np.abs(odometry.twists[:, 0])
    if len(stamps) > 1 and not np.ptp(poses, axis=0).any() and speeds.max() > _DRIVING_MPS:
        integrated = replace(odometry, poses=integrate(stamps, odometry.twists))
        return integrated, 'the pose is constant; the twist is integrated instead'
    return odometry, _disagreement(odometry) if values else ''


def _disagreement(odometry: Odometry) -> str:
    """How poses and twists drive or turn another way in sum, in words; '' where they agree.

    Twists may lag, and average over any time; one that is always 0 claims nothing.
    """
    seconds, at = _by_second(odometry)
    twisted = integrate(odometry.stamps_ns, odometry.twists)
    turned = np.cumsum(odometry.twists[1:, 1] * np.diff(seconds))
    turned = np.concatenate([[0.0], turned])[at]
    driven = [np.hypot(*np.diff(poses[at, :2], axis=0).T) for poses in (odometry.poses, twisted)]
    even = np.diff(seconds[at]) < 2 * _COMPARED_S  # odometry that paused shows the motion by poses
    turns = np.abs([wrap_angle(np.diff(odometry.poses[at, 2])), np.diff(turned)])
    for verb, unit, steps in ('turn', 'rad', turns), ('drive', 'm', np.array(driven)):
        counted = steps[:, even & (steps > _COUNTED).any(axis=0)]
        # Of a usual second: in one, poses may jump.
        usual = np.median(counted, axis=1) if counted.size else np.zeros(2)
        by_pose, by_twist = (counted.shape[1] * usual).tolist()
        least, most = sorted([by_pose, by_twist])
        if by_twist > 0 and most > _ENOUGH and most > _UNEQUAL * least:
            differ = f'poses {verb} {by_pose:.3g} {unit}, twists {by_twist:.3g} {unit}'
            return f'{differ}: are both in meters, radians and seconds?'
    return ''


def _by_second(odometry: Odometry) -> tuple[Array, NDArray[np.int64]]:
    """Seconds (N,) since the first message, and indices of the first one in each _COMPARED_S."""
    seconds = (odometry.stamps_ns - odometry.stamps_ns[0]) * 1e-9
    return seconds, np.flatnonzero(np.diff(seconds // _COMPARED_S, prepend=-1.0))
