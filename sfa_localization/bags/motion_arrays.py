# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Arrays of odometry, yaw rates and trajectories from the stamped values of streams."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Mask, relative
from sfa_localization.data.odometry_steps import IN_TURN, Orientation, beside
from sfa_localization.data.run import (
    POINT_STD_M,
    Odometry,
    Points,
    Stamps,
    Trajectory,
    YawRate,
    chained,
    differences,
    integrate,
)

StampedValues = list[tuple[int, Any]]
"""Stamps in ns, each with the value of its message."""
_DRIVING_MPS = 0.01  # above the noise of wheel encoders at rest
_UNKNOWN = (0.0, 0.0, 0.0, 0.0)  # twist and variances of messages that have only poses


def stamps_of(values: StampedValues) -> Stamps:
    """The stamps (N,) of values."""
    return np.array([stamp for stamp, _ in values], np.int64)


def to_trajectory(values: StampedValues) -> Trajectory:
    """Poses at stamps."""
    return Trajectory(
        stamps_of(values), np.array([pose for _, pose in values], float).reshape(-1, 3)
    )


def to_yaw_rate(values: StampedValues) -> YawRate | None:
    """Yaw rates at stamps, None without any; the values are omega and its variance."""
    if not values:
        return None
    rates = np.array([rate for _, rate in values], float)
    return YawRate(stamps_of(values), rates[:, 0], rates[:, 1])


def to_points(values: StampedValues, lever: complex = 0j) -> Points:
    """Measured places of what is `lever` ahead + i left of base_link, m; the values are x, y and a
    standard deviation, POINT_STD_M where it is 0.
    """
    return Points.of([
        (f'point of {stamp_ns * 1e-9:.1f} s', stamp_ns, complex(x, y), std or POINT_STD_M, lever)
        for stamp_ns, (x, y, std) in values
    ])  # fmt: skip


def to_odometry(values: StampedValues, topic: str) -> tuple[Odometry, list[str], dict[str, int]]:
    """Odometry of a topic, sentences on its peculiarities, and the count of faults by reason.

    The values are a pose, NaN where it is not filled, with v, omega and their variances, or with
    None where messages have only poses: then twists are the differences of poses. Raises DataError
    for two publishers, and where nothing is filled.
    """
    stamps = stamps_of(values)
    motion = [(*pose, *(twist or _UNKNOWN)) for _, (pose, twist) in values]
    rows = np.array(motion, float).reshape(-1, 7)
    empty = _empty(rows)
    if len(rows) and empty.all():
        raise DataError(f'{topic}: neither poses nor twists are filled')
    aside = _aside(stamps, rows, topic)
    kept = ~(empty | aside)
    stamps = stamps[kept]
    poses, twists, variances = np.split(rows[kept], (3, 5), axis=1)
    if values and values[0][1][1] is None:
        twists = differences(stamps, poses)
    odometry, oddity = _filled(Odometry(stamps, poses, twists, variances))
    counts = {'neither pose nor twist': int(empty.sum()), 'pose beside the path': int(aside.sum())}
    faults = {reason: count for reason, count in counts.items() if count}
    said = [f'{n} of {len(rows)} messages left out: {why}' for why, n in faults.items()]
    return odometry, [*said, oddity] if oddity else said, faults


def _aside(stamps: Stamps, rows: Array, topic: str) -> Mask:
    """Which messages (N, 7) have a pose beside the path. Raises DataError for two publishers."""
    posed = np.flatnonzero(np.isfinite(rows[:, 0]))
    seconds = np.asarray((stamps[posed] - stamps[:1]) * 1e-9, float)
    aside = np.zeros(len(rows), bool)
    aside[posed], in_turn = beside(seconds, rows[posed, :3], rows[posed, 3:5])
    if in_turn > IN_TURN:
        raise DataError(
            f'two publishers on {topic}: its messages lead along two paths in turn; stop one, or '
            'record each on a topic of its own and choose one with --odom-topic'
        )
    return aside


def _empty(rows: Array) -> Mask:
    """Which messages (N, 7) of neither pose nor twist show nothing: those of a robot that stands
    do, where other messages have a twist and no pose either.
    """
    posed = np.isfinite(rows[:, 0])
    moves = rows[:, 3:5].any(axis=1)
    alone = np.append(False, posed[:-1]) & np.append(posed[1:], False)
    return np.asarray(~posed & ~moves & (alone | ~moves.any()))


def _oriented(odometry: Odometry) -> bool:
    orientation = Orientation()
    seconds = (odometry.stamps_ns - odometry.stamps_ns[0]) * 1e-9
    yaws = odometry.poses[:, 2].tolist()
    rates = odometry.twists[:, 1].tolist()
    for message in zip(seconds.tolist(), yaws, rates, strict=True):
        orientation.add(*message)
    return orientation.is_filled


def _filled(odometry: Odometry) -> tuple[Odometry, str]:
    """Odometry with twists integrated where there are no poses, and a sentence on that or ''."""
    stamps = odometry.stamps_ns
    poses = odometry.poses
    twists = odometry.twists
    lacks = np.isnan(poses[:, :1])
    drives = np.abs(twists[:, 0]).max(initial=0) > _DRIVING_MPS
    if lacks.any():
        count = f'{lacks.sum()} of {len(stamps)} messages'
        text = f'{count} have no pose (NaN, or a quaternion of zeros)'
    elif len(stamps) > 1 and drives and not np.ptp(poses, axis=0).any():
        lacks = ~lacks
        text = 'the pose is constant'
    elif len(stamps) > 1 and drives and not _oriented(odometry):
        lacks = ~lacks
        text = 'the orientation is never filled'
    else:
        return odometry, ''
    by_twist = integrate(stamps, twists)
    step = relative(poses[:-1], poses[1:])
    integrated = relative(by_twist[:-1], by_twist[1:])
    step = np.where(lacks[1:] | np.isnan(step), integrated, step)
    poses = chained(np.zeros(3) if lacks[0] else poses[0], step)
    return replace(odometry, poses=poses), f'{text}; the twist is integrated instead'
