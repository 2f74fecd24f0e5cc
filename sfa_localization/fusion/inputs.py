# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Sensor values made fit for the filter: checked, with floors and factors on their noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import LARGEST_TWIST_VARIANCE, LARGEST_VARIANCE
from sfa_localization.fusion.motion import Twist
from sfa_localization.fusion.settings import FilterConfig

POSITION_STD = 0.3
"""Standard deviation (m) of a measurement whose message has no covariance."""
YAW_STD_LIMIT = 1.0
"""A heading less certain than this (rad) is left out: its error is not Gaussian any more."""
COMMAND_RATE_STD = 0.2
"""Of a turn rate that was commanded, rad/s: robots turn at half of it, by a third more or less."""
_UNKNOWN_STDS = np.array([POSITION_STD, POSITION_STD, 0.2])  # m, m, rad
# Least standard deviations: drivers understate what encoders resolve (m/s, rad/s), and no map from
# images is better everywhere (m, m, rad).
_LEAST_TWIST_STDS, _LEAST_VARIANCES = (0.01, 0.005), (0.05**2, 0.05**2, 0.02**2)
# Twists, some seconds of them, of which so many are repeated by odometry that repeats commands:
# 0.66 to 0.82 on four small robots.
_COMMANDS, _REPEATED = 200, 0.5
_LARGEST_M, _LARGEST_TWIST = 1e9, 100.0  # m; m/s and rad/s: beyond, nothing is a robot's
_SKEW = 1e-6  # of the largest entry: rounding
_NO_COVARIANCE = 'covariance is not symmetric positive'


class OpenLoop:
    """Whether odometry repeats commands, as controllers without encoders do: measured twists of a
    robot that moves are hardly ever equal. The robot follows commands later, and not exactly.
    """

    def __init__(self) -> None:
        self._last, self._share = (0.0, 0.0), 0.0

    @classmethod
    def of(cls, twists: Array) -> OpenLoop:
        """From the twists (N, 2) of a recorded drive."""
        loop = cls()
        for v, omega in twists.tolist():
            loop.add(v, omega)
        return loop

    def add(self, v: float, omega: float) -> None:
        """Take the next twist."""
        if v or omega:
            self._share += ((v, omega) == self._last) / _COMMANDS - self._share / _COMMANDS
        self._last = v, omega

    @property
    def found(self) -> bool:
        """Whether at least half of the latest twists were that before."""
        return self._share > _REPEATED


def read_twist(
    v: float, omega: float, variances: Sequence[float] | Array, config: FilterConfig, commands: bool
) -> Twist:
    """A reading with the noise to expect of it, from the `variances` (2,) in its message, or of
    `commands`. Raises DataError, with the reason, for one that is impossible.
    """
    v, omega = float(v), float(omega)
    if not (abs(v) <= _LARGEST_TWIST and abs(omega) <= _LARGEST_TWIST):
        raise DataError('not finite, or absurdly fast')
    (of_v, of_omega), factor = variances, config.odometry_factor
    rate_std = max(config.rate_std, COMMAND_RATE_STD) if commands else config.rate_std
    v_variance = _variance(factor, of_v, _LEAST_TWIST_STDS[0], config.speed_std)
    return Twist(v, omega, v_variance, _variance(factor, of_omega, _LEAST_TWIST_STDS[1], rate_std))


def _variance(factor: float, claimed: float, floor: float, default: float) -> float:
    if not 0 < claimed < LARGEST_TWIST_VARIANCE:
        return default**2
    return max(factor * float(claimed), floor**2)


def read_measurement(value: ArrayLike, covariance: ArrayLike, factor: float) -> tuple[Array, Array]:
    """A position (2,) or pose (3,) and its covariance, times a factor, as they are fused.

    A heading too uncertain is left out. Raises DataError, with the reason, where nothing is left.
    """
    pose, matrix = np.asarray(value, float), np.asarray(covariance, float)
    if pose.shape not in ((2,), (3,)) or matrix.shape != (pose.size, pose.size):
        raise DataError('shape is not that of a position or a pose')
    # Numbers: arrays of two or three cost more than what is done with them.
    (x, y, *yaw), rows = pose.tolist(), matrix.tolist()
    if not (abs(x) <= _LARGEST_M and abs(y) <= _LARGEST_M):
        raise DataError('position is not finite')
    known = bool(yaw) and math.isfinite(yaw[0]) and rows[2][2] <= YAW_STD_LIMIT**2
    if yaw and not (known and (rows[2][2] > 0 or not matrix.any())):
        pose, rows = pose[:2], [row[:2] for row in rows[:2]]
    if not any(map(any, rows)):
        rows = np.diag(np.square(_UNKNOWN_STDS[: pose.size])).tolist()
    make_symmetric(rows)
    if max(rows[0][0], rows[1][1]) >= LARGEST_VARIANCE:
        raise DataError('covariance means that nothing is known')
    noise = [[factor * entry for entry in row] for row in rows]
    for i, row in enumerate(noise):
        row[i] = max(row[i], _LEAST_VARIANCES[i])
    return pose, np.array(noise)


def read_pose(pose: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array]:
    """A pose (3,) and covariance (3, 3) set from outside; DataError where they cannot be one."""
    value, matrix = np.asarray(pose, float), np.asarray(covariance, float)
    if value.shape != (3,) or not np.abs(value).max() <= _LARGEST_M:
        raise DataError(f'initial pose {pose!r} is not x, y, yaw')
    if matrix.shape != (3, 3):
        raise DataError('covariance of the initial pose is not (3, 3)')
    rows = matrix.tolist()
    make_symmetric(rows)
    root(rows)
    return value, np.array(rows)


def make_symmetric(rows: list[list[float]]) -> None:
    """Round off. Raises DataError where it is not nearly so, or the diagonal is not positive."""
    fits, largest = True, max(map(max, rows))
    for i, row in enumerate(rows):
        for j in range(i):
            fits &= abs(row[j] - rows[j][i]) <= _SKEW * largest
            row[j] = rows[j][i] = (row[j] + rows[j][i]) * 0.5
        fits &= 0 < row[i] < math.inf
    if not fits:
        raise DataError(_NO_COVARIANCE)


def root(rows: list[list[float]]) -> list[list[float]]:
    """Rows, two or three, of the lower triangular root (Cholesky). Raises DataError for none."""
    try:
        a = math.sqrt(rows[0][0])
        b = rows[1][0] / a
        c = math.sqrt(rows[1][1] - b * b)
        found, last = [[a], [b, c]], c
        if len(rows) == 3:
            d = rows[2][0] / a
            e = (rows[2][1] - d * b) / c
            last = math.sqrt(rows[2][2] - d * d - e * e)
            found.append([d, e, last])
    except (ValueError, ZeroDivisionError):
        last = 0.0
    if not last > 0:
        raise DataError(_NO_COVARIANCE)
    return found


def symmetric(matrix: Array) -> Array:
    """The symmetric part."""
    total: Array = matrix + matrix.T
    total *= 0.5
    return total
