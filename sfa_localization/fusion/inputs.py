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

SPEED_STD_FLOOR, RATE_STD_FLOOR = 0.01, 0.005
"""Least standard deviations of a reading (m/s, rad/s): drivers understate what encoders resolve."""
POSITION_STD, _UNKNOWN_YAW_STD = 0.3, 0.2
"""Standard deviations (m, rad) of a measurement whose message has no covariance."""
POSITION_STD_FLOOR, YAW_STD_FLOOR = 0.05, 0.02
"""Least standard deviations of a measurement (m, rad): no map from images is better everywhere."""
YAW_STD_LIMIT = 1.0
"""A heading less certain than this (rad) is left out: its error is not Gaussian any more."""
COMMAND_RATE_STD = 0.2
"""Of a turn rate that was commanded, rad/s: small robots turn at half of it, by a third more or less."""
_COMMANDS, _REPEATED = 200, 0.5
"""Twists, some seconds of them, of which so many are repeated by odometry that repeats commands:
0.66 to 0.82 on four small robots."""
_LARGEST_COORDINATE = 1e9  # m
_LARGEST_TWIST = 100.0  # m/s and rad/s
_LARGEST_YAW = 1e6  # rad, beyond which an angle has no digits left
_LARGEST_ENTRY = 1e12  # of a covariance, beyond which products overflow
_SINGULAR = 1e-10  # determinant over the product of the variances: a correlation of 1


class OpenLoop:
    """Whether odometry repeats commands, as controllers without encoders do: measured twists of a
    robot that moves are hardly ever equal. The robot follows commands later, and not exactly.
    """

    def __init__(self) -> None:
        self._last, self._share = (0.0, 0.0), 0.0

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
    v: float,
    omega: float,
    variances: Sequence[float] | Array,
    config: FilterConfig,
    open_loop: bool = False,
) -> Twist:
    """A reading with the noise to expect of it, from the `variances` (2,) in its message.

    Raises DataError, with the reason, for one that is impossible.
    """
    v, omega = float(v), float(omega)
    if not (math.isfinite(v) and math.isfinite(omega)):
        raise DataError('not finite')
    if abs(v) > _LARGEST_TWIST or abs(omega) > _LARGEST_TWIST:
        raise DataError('absurdly fast')
    v_variance, omega_variance = variances
    factor = config.odometry_factor
    rate_std = max(config.rate_std, COMMAND_RATE_STD) if open_loop else config.rate_std
    return Twist(
        v,
        omega,
        _variance(v_variance, factor, SPEED_STD_FLOOR, config.speed_std),
        _variance(omega_variance, factor, RATE_STD_FLOOR, rate_std),
    )


def _variance(claimed: float, factor: float, floor: float, default: float) -> float:
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
    # In plain numbers from here: arrays of two or three cost more than what is done with them.
    pose, rows = given.tolist(), matrix.tolist()
    if not (abs(pose[0]) <= _LARGEST_COORDINATE and abs(pose[1]) <= _LARGEST_COORDINATE):
        raise DataError('position is not finite')
    if len(pose) == 3 and not _has_yaw(pose[2], rows):
        pose, rows = pose[:2], [row[:2] for row in rows[:2]]
    if not any(map(any, rows)):
        stds = [POSITION_STD, POSITION_STD, _UNKNOWN_YAW_STD][: len(rows)]
        rows = np.diag(np.square(stds)).tolist()
    if not _is_positive(rows):
        raise DataError('covariance is not symmetric positive')
    if rows[0][0] >= LARGEST_VARIANCE or rows[1][1] >= LARGEST_VARIANCE:
        raise DataError('covariance means that nothing is known')
    return np.array(pose), _conditioned(rows, factor)


def _has_yaw(yaw: float, rows: list[list[float]]) -> bool:
    variance = rows[2][2]
    if not (abs(yaw) < _LARGEST_YAW and variance <= YAW_STD_LIMIT**2):
        return False
    return variance > 0 or not any(map(any, rows))


def _is_positive(rows: list[list[float]]) -> bool:
    """Finite, symmetric, and with leading minors well above 0: positive definite (Sylvester)."""
    if len(rows) == 2:
        (a, b), (b2, d) = rows
        largest, skew = max(a, d), abs(b - b2)
        determinant = a * d - b * b
        limit = _SINGULAR * a * d
    else:
        (a, b, c), (b2, d, e), (c2, e2, f) = rows
        largest, skew = max(a, d, f), abs(b - b2) + abs(c - c2) + abs(e - e2)
        if not (f > 0 and a * d - b * b > _SINGULAR * a * d):
            return False
        determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
        limit = _SINGULAR * a * d * f
    # Comparisons with NaN are false, so that one anywhere ends here; so do infinities.
    return a > 0 and d > 0 and determinant > limit and skew <= 1e-6 * largest < _LARGEST_ENTRY


def _conditioned(rows: list[list[float]], factor: float) -> Array:
    """Symmetric, with the factor applied, then what is below the floor raised to it."""
    half, floor = factor / 2, POSITION_STD_FLOOR**2
    xx = max((rows[0][0] + rows[0][0]) * half, floor)
    xy = (rows[0][1] + rows[1][0]) * half
    yy = max((rows[1][1] + rows[1][1]) * half, floor)
    if len(rows) == 2:
        return np.array([[xx, xy], [xy, yy]])
    xt, yt = (rows[0][2] + rows[2][0]) * half, (rows[1][2] + rows[2][1]) * half
    tt = max((rows[2][2] + rows[2][2]) * half, YAW_STD_FLOOR**2)
    return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])


def lower_root(covariance: Array, factor: float) -> list[list[float]]:
    """`factor` times the lower triangular root (Cholesky) of a covariance (2, 2) or (3, 3)."""
    rows = covariance.tolist()
    a = math.sqrt(rows[0][0])
    b = rows[1][0] / a
    d = math.sqrt(rows[1][1] - b * b)
    if len(rows) == 2:
        return [[factor * a, 0.0], [factor * b, factor * d]]
    c = rows[2][0] / a
    e = (rows[2][1] - b * c) / d
    f = math.sqrt(rows[2][2] - c * c - e * e)
    return [
        [factor * a, 0.0, 0.0],
        [factor * b, factor * d, 0.0],
        [factor * c, factor * e, factor * f],
    ]


def read_pose(pose: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array]:
    """A pose (3,) and covariance (3, 3) set from outside; DataError where they cannot be one."""
    value, matrix = np.asarray(pose, float), np.asarray(covariance, float)
    if value.shape != (3,) or not np.all(np.isfinite(value)):
        raise DataError(f'initial pose {pose!r} is not x, y, yaw')
    if np.abs(value).max() > _LARGEST_COORDINATE:
        raise DataError(f'initial pose {pose!r} is absurdly far away')
    if matrix.shape != (3, 3) or not _is_covariance(matrix):
        raise DataError('covariance of the initial pose is not a symmetric positive (3, 3) one')
    return value, symmetric(matrix)


def _is_covariance(matrix: Array) -> bool:
    """Finite, symmetric and positive definite."""
    if not np.all(np.isfinite(matrix)):
        return False
    scale = float(np.abs(matrix).max())
    if not 0 < scale < _LARGEST_ENTRY or float(np.abs(matrix - matrix.T).max()) > 1e-6 * scale:
        return False
    return bool(np.linalg.eigvalsh(symmetric(matrix))[0] > 0)


def symmetric(matrix: Array) -> Array:
    """The symmetric part."""
    total: Array = matrix + matrix.T
    total *= 0.5
    return total
