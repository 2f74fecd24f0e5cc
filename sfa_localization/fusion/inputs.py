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
from sfa_localization.fusion.belief import symmetric
from sfa_localization.fusion.motion import Twist
from sfa_localization.fusion.settings import FilterConfig

POSITION_STD = 0.3
"""Standard deviation (m) of a measurement whose message has no covariance."""
YAW_STD_LIMIT = 1.0
"""A heading less certain than this (rad) is left out: its error is not Gaussian any more."""
COMMAND_RATE_STD = 0.1
"""Of a turn rate that was commanded, rad/s: robots turn at half of it, by a third more or less."""
_UNKNOWN_STDS = np.array([POSITION_STD, POSITION_STD, 0.2])  # m, m, rad
# Least standard deviations: drivers understate what encoders resolve (m/s, rad/s), and no map from
# images is better everywhere (m, m, rad).
_LEAST_TWIST_STDS = (0.01, 0.005)
_LEAST_VARIANCES = np.square([0.05, 0.05, 0.02])
# Twists, some seconds of them, of which so many are repeated by odometry that repeats commands:
# 0.66 to 0.82 on four small robots.
_COMMANDS = 200
_REPEATED = 0.5
# m; m/s and rad/s: beyond, nothing is a robot's
_LARGEST_M = 1e9
_LARGEST_TWIST = 100.0
_SKEW = 1e-6  # of the largest entry: rounding


class OpenLoop:
    """Whether odometry repeats commands, as controllers without encoders do: measured twists of a
    robot that moves are hardly ever equal. The robot follows commands later, and not exactly.
    """

    def __init__(self) -> None:
        self._last = (0.0, 0.0)
        self._share = 0.0

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
            self._share += (((v, omega) == self._last) - self._share) / _COMMANDS
        self._last = v, omega

    @property
    def repeats(self) -> bool:
        """Whether at least half of the latest twists were that before."""
        return self._share > _REPEATED


def read_twist(
    v: float, omega: float, variances: Sequence[float] | Array, config: FilterConfig, commands: bool
) -> Twist:
    """A reading with the noise to expect of it, from the `variances` (2,) in its message, or of
    `commands`. Raises DataError, with the reason, for an impossible one.
    """
    if not (abs(v) <= _LARGEST_TWIST and abs(omega) <= _LARGEST_TWIST):
        raise DataError('not finite, or absurdly fast')
    rate_std = max(config.rate_std, COMMAND_RATE_STD) if commands else config.rate_std
    defaults = config.speed_std, rate_std
    v_variance, omega_variance = (
        max(config.odometry_factor * float(claimed), least**2)
        if 0 < claimed < LARGEST_TWIST_VARIANCE
        else default**2
        for claimed, least, default in zip(variances, _LEAST_TWIST_STDS, defaults, strict=True)
    )
    return Twist(float(v), float(omega), v_variance, omega_variance)


def read_measurement(value: ArrayLike, covariance: ArrayLike, factor: float) -> tuple[Array, Array]:
    """A position (2,) or pose (3,) and its covariance, times a factor, as they are fused.

    A heading too uncertain is left out. Raises DataError, with the reason, where nothing remains.
    """
    pose = np.asarray(value, float)
    matrix = np.asarray(covariance, float)
    if pose.shape not in ((2,), (3,)) or matrix.shape != (pose.size, pose.size):
        raise DataError('shape is not that of a position or a pose')
    if not np.all(np.abs(pose[:2]) <= _LARGEST_M):
        raise DataError('position is not finite')
    if pose.size == 3:
        certain = 0 < matrix[2, 2] <= YAW_STD_LIMIT**2 or not matrix.any()
        if not (certain and math.isfinite(pose[2])):
            pose = pose[:2]
            matrix = matrix[:2, :2]
    if not matrix.any():
        matrix = np.diag(_UNKNOWN_STDS[: pose.size] ** 2)
    matrix = _positive(matrix)
    if matrix.diagonal()[:2].max() >= LARGEST_VARIANCE:
        raise DataError('covariance means that nothing is known')
    noise = factor * matrix
    np.fill_diagonal(noise, np.maximum(noise.diagonal(), _LEAST_VARIANCES[: pose.size]))
    return pose, noise


def read_pose(pose: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array]:
    """A pose (3,) and covariance (3, 3) set from outside; DataError where they cannot be one."""
    value = np.asarray(pose, float)
    matrix = np.asarray(covariance, float)
    if value.shape != (3,) or not np.abs(value).max() <= _LARGEST_M:
        raise DataError(f'initial pose {pose!r} is not x, y, yaw')
    if matrix.shape != (3, 3):
        raise DataError('covariance of the initial pose is not (3, 3)')
    return value, _positive(matrix)


def _positive(matrix: Array) -> Array:
    """Symmetric part of a covariance. Raises DataError unless symmetric and positive definite."""
    try:
        if np.abs(matrix - matrix.T).max() <= _SKEW * matrix.max():
            np.linalg.cholesky(symmetric(matrix))
            return symmetric(matrix)
    except np.linalg.LinAlgError:
        pass
    raise DataError('covariance is not symmetric positive')
