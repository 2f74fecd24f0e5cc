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
_LEAST_TWIST_STDS, _LEAST_STDS = (0.01, 0.005), (0.05, 0.05, 0.02)
# Twists, some seconds of them, of which so many are repeated by odometry that repeats commands:
# 0.66 to 0.82 on four small robots.
_COMMANDS, _REPEATED = 200, 0.5
# m; m/s and rad/s; rad, beyond which an angle has no digits left; and of a covariance.
_LARGEST_COORDINATE, _LARGEST_TWIST, _LARGEST_YAW, _LARGEST_ENTRY = 1e9, 100.0, 1e6, 1e12
_SINGULAR = 1e-10  # part of a variance that is left where a correlation is 1
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
    if not (math.isfinite(v) and math.isfinite(omega)):
        raise DataError('not finite')
    if abs(v) > _LARGEST_TWIST or abs(omega) > _LARGEST_TWIST:
        raise DataError('absurdly fast')
    rate_std = max(config.rate_std, COMMAND_RATE_STD) if commands else config.rate_std
    known = zip(variances, _LEAST_TWIST_STDS, (config.speed_std, rate_std), strict=True)
    return Twist(v, omega, *(_variance(config.odometry_factor, *each) for each in known))


def _variance(factor: float, claimed: float, floor: float, default: float) -> float:
    if not (math.isfinite(claimed) and 0 < claimed < LARGEST_TWIST_VARIANCE):
        return default**2
    return max(factor * float(claimed), floor**2)


def read_measurement(value: ArrayLike, covariance: ArrayLike, factor: float) -> tuple[Array, Array]:
    """A position (2,) or pose (3,) and its covariance, times a factor, as they are fused.

    A heading too uncertain is left out. Raises DataError, with the reason, where nothing is left.
    """
    given, matrix = np.asarray(value, float), np.asarray(covariance, float)
    if given.shape not in ((2,), (3,)) or matrix.shape != (given.size, given.size):
        raise DataError('shape is not that of a position or a pose')
    pose, size = given.tolist(), given.size
    if not (abs(pose[0]) <= _LARGEST_COORDINATE and abs(pose[1]) <= _LARGEST_COORDINATE):
        raise DataError('position is not finite')
    if size == 3 and not _has_yaw(pose[2], matrix):
        size, matrix = 2, matrix[:2, :2]
    if not matrix.any():
        matrix = np.diag(np.square(_UNKNOWN_STDS[:size]))
    rows = matrix.tolist()  # arrays of two or three cost more than what is done with them
    lower_root(rows, 1.0)
    largest = max(map(max, rows))
    skew = max(abs(rows[i][j] - rows[j][i]) for i in range(size) for j in range(i))
    if not largest < _LARGEST_ENTRY or skew > 1e-6 * largest:
        raise DataError(_NO_COVARIANCE)
    if max(rows[0][0], rows[1][1]) >= LARGEST_VARIANCE:
        raise DataError('covariance means that nothing is known')
    noise = factor * symmetric(matrix)
    for k in range(size):
        noise[k, k] = max(factor * rows[k][k], _LEAST_STDS[k] ** 2)
    return np.array(pose[:size]), noise


def _has_yaw(yaw: float, matrix: Array) -> bool:
    variance = matrix[2, 2]
    known = abs(yaw) < _LARGEST_YAW and variance <= YAW_STD_LIMIT**2
    return bool(known and (variance > 0 or not matrix.any()))


def lower_root(rows: list[list[float]], factor: float) -> list[list[float]]:
    """`factor` times the lower triangular root (Cholesky) of a covariance (2, 2) or (3, 3).

    Raises DataError where there is none; for NaN, comparisons are false.
    """
    xx, (xy, yy) = rows[0][0], rows[1][:2]
    a = math.sqrt(xx) if xx > 0 else math.nan
    b = xy / a
    d = math.sqrt(yy - b * b) if yy - b * b > _SINGULAR * yy else math.nan
    root = [[factor * a, 0.0], [factor * b, factor * d]]
    if len(rows) == 3:
        xt, yt, tt = rows[2]
        c = xt / a
        e = (yt - b * c) / d
        left = tt - c * c - e * e
        f = math.sqrt(left) if left > _SINGULAR * tt else math.nan
        root = [[*root[0], 0.0], [*root[1], 0.0], [factor * c, factor * e, factor * f]]
    if not math.isfinite(root[-1][-1]):
        raise DataError(_NO_COVARIANCE)
    return root


def read_pose(pose: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array]:
    """A pose (3,) and covariance (3, 3) set from outside; DataError where they cannot be one."""
    value, matrix = np.asarray(pose, float), np.asarray(covariance, float)
    if value.shape != (3,) or not np.all(np.isfinite(value)):
        raise DataError(f'initial pose {pose!r} is not x, y, yaw')
    if np.abs(value).max() > _LARGEST_COORDINATE:
        raise DataError(f'initial pose {pose!r} is absurdly far away')
    wrong = 'covariance of the initial pose is not a symmetric positive (3, 3) one'
    if matrix.shape != (3, 3) or not np.allclose(matrix, matrix.T, 1e-6, 1e-6 * abs(matrix[0, 0])):
        raise DataError(wrong)
    if not np.abs(matrix).max() < _LARGEST_ENTRY or np.linalg.eigvalsh(symmetric(matrix))[0] <= 0:
        raise DataError(wrong)
    return value, symmetric(matrix)


def symmetric(matrix: Array) -> Array:
    """The symmetric part."""
    total: Array = matrix + matrix.T
    total *= 0.5
    return total
