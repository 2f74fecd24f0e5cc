# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Arrays of odometry, yaw rates and poses from the values that the streams of a bag give."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfa_localization.data.geometry import Array, compose, invert, relative
from sfa_localization.data.run import Odometry, Stamps, Trajectory, YawRate, differences, integrate

Values = list[tuple[int, Any]]
"""Stamps in ns, each with what its message tells."""


def _stamps(values: Values) -> Stamps:
    return np.array([stamp for stamp, _ in values], np.int64)


def to_trajectory(values: Values) -> Trajectory:
    """Poses at stamps."""
    return Trajectory(_stamps(values), np.array([pose for _, pose in values], float).reshape(-1, 3))


def to_yaw_rate(values: Values) -> YawRate:
    """Yaw rates at stamps; the values are omega and its variance."""
    rates = np.array([rate for _, rate in values], float).reshape(-1, 2)
    return YawRate(_stamps(values), rates[:, 0], rates[:, 1])


def to_odometry(values: Values, jump_m: float) -> tuple[Odometry, int]:
    """Odometry, and how many resets in it were joined.

    The values are a pose, with v, omega and their variances, or with None where only poses are
    told: then twists are the poses' differences. A reset is a move of `jump_m` beyond the twist.
    """
    stamps = _stamps(values)
    poses = np.array([pose for _, (pose, _) in values], float).reshape(-1, 3)
    if not values or values[0][1][1] is None:
        twists = differences(stamps, poses)
        return Odometry(stamps, poses, twists, np.zeros_like(twists)), 0
    motion = np.array([twist for _, (_, twist) in values], float).reshape(-1, 4)
    poses, resets = _rejoined(stamps, poses, motion[:, :2], jump_m)
    return Odometry(stamps, poses, motion[:, :2], motion[:, 2:]), resets


def poses_stand(odometry: Odometry) -> bool:
    """Whether all poses are one while twists say that the robot drives: no pose is kept."""
    if len(odometry.stamps_ns) < 2 or np.ptp(odometry.poses, axis=0).any():
        return False
    return bool(np.abs(odometry.twists[:, 0]).max() > _DRIVES_MPS)


_DRIVES_MPS = 0.01


def _rejoined(stamps: Stamps, poses: Array, twists: Array, jump_m: float) -> tuple[Array, int]:
    """Poses whose jumps are replaced by what the twist says happened, and their number."""
    step, seconds = relative(poses[:-1], poses[1:]), np.diff(stamps) * 1e-9
    speed = np.maximum(np.abs(twists[:-1, 0]), np.abs(twists[1:, 0]))
    resets = np.flatnonzero(np.hypot(step[:, 0], step[:, 1]) > speed * seconds + jump_m) + 1
    joined = poses.copy()
    for reset in resets:
        before = slice(reset - 1, reset + 1)
        expected = integrate(stamps[before], twists[before], joined[reset - 1])[-1]
        joined[reset:] = compose(compose(expected, invert(poses[reset])), poses[reset:])
    return joined, len(resets)
