# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Arrays of odometry, yaw rates and trajectories from the stamped values of streams."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

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
"""Stamps in ns, each with the value of its message."""
_DRIVING_MPS = 0.01  # above the noise of wheel encoders at rest


def _stamps(values: StampedValues) -> Stamps:
    return np.array([stamp for stamp, _ in values], np.int64)


def to_trajectory(values: StampedValues) -> Trajectory:
    """Poses at stamps."""
    return Trajectory(_stamps(values), np.array([pose for _, pose in values], float).reshape(-1, 3))


def to_yaw_rate(values: StampedValues) -> YawRate:
    """Yaw rates at stamps; the values are omega and its variance."""
    rates = np.array([rate for _, rate in values], float).reshape(-1, 2)
    return YawRate(_stamps(values), rates[:, 0], rates[:, 1])


def to_points(values: StampedValues, lever: complex = 0j) -> Points:
    """Measured places of what is `lever` ahead + i left of base_link, m; the values are x, y and a
    standard deviation, POINT_STD_M where it is 0.
    """
    return Points.of([
        (f'point of {stamp_ns * 1e-9:.1f} s', stamp_ns, complex(x, y), std or POINT_STD_M, lever)
        for stamp_ns, (x, y, std) in values
    ])  # fmt: skip


def to_odometry(values: StampedValues) -> tuple[Odometry, str]:
    """Odometry, and a sentence on a peculiarity of it, or ''.

    The values are a pose with v, omega and their variances, or with None where messages have only
    poses: then twists are the differences of poses.
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
    return odometry, ''
