# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What sensors tell, made fit for the filter: checked, with floors and factors on their noise."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from sfa_localization.config import FilterConfig
from sfa_localization.errors import DataError
from sfa_localization.geometry import Array
from sfa_localization.motion import Twist

_LARGEST_VARIANCE = 1e6
_LARGEST_COORDINATE = 1e9
_LARGEST_TWIST = 100.0
_UNKNOWN_YAW_STD = 0.2


def read_twist(v: float, omega: float, variances: ArrayLike, config: FilterConfig) -> Twist:
    """A reading with the noise it is believed to have; DataError says why it cannot be one."""
    if not (math.isfinite(v) and math.isfinite(omega)):
        raise DataError('not finite')
    if abs(v) > _LARGEST_TWIST or abs(omega) > _LARGEST_TWIST:
        raise DataError('absurdly fast')
    told = np.asarray(variances, float)
    return Twist(
        float(v),
        float(omega),
        _variance(told[0], config.speed_std_floor, config.speed_std, config),
        _variance(told[1], config.rate_std_floor, config.rate_std, config),
    )


def _variance(told: float, floor: float, default: float, config: FilterConfig) -> float:
    if not (math.isfinite(told) and 0 < told < _LARGEST_VARIANCE):
        return default**2
    return max(config.odometry_factor * float(told), floor**2)


def read_measurement(
    value: ArrayLike, covariance: ArrayLike, config: FilterConfig
) -> tuple[Array, Array]:
    """A position (2,) or pose (3,) and its covariance as they are fused.

    A heading that is not known well enough is left out. DataError says why there is nothing left.
    """
    value, covariance = np.asarray(value, float), np.asarray(covariance, float)
    if value.shape not in ((2,), (3,)) or covariance.shape != (value.size, value.size):
        raise DataError('shape is not that of a position or a pose')
    if not np.all(np.isfinite(value[:2])) or np.abs(value[:2]).max() > _LARGEST_COORDINATE:
        raise DataError('position is not finite')
    size = 3 if value.size == 3 and _knows_yaw(value, covariance, config) else 2
    value, covariance = value[:size].copy(), covariance[:size, :size]
    if not np.any(covariance):
        stds = [config.position_std, config.position_std, _UNKNOWN_YAW_STD]
        covariance = np.diag(np.square(stds[:size]))
    if not is_covariance(covariance):
        raise DataError('covariance is not symmetric positive')
    if np.diag(covariance).max() >= _LARGEST_VARIANCE:
        raise DataError('covariance tells that nothing is known')
    return value, _conditioned(covariance, config)


def _knows_yaw(value: Array, covariance: Array, config: FilterConfig) -> bool:
    variance = float(covariance[2, 2])
    known = math.isfinite(value[2]) and math.isfinite(variance) and abs(value[2]) < 1e6
    told = variance > 0 or not np.any(covariance)
    return bool(known and told and variance <= config.yaw_std_limit**2)


def _conditioned(covariance: Array, config: FilterConfig) -> Array:
    """Apply the factor, then raise what is below the floor."""
    floors = [config.position_std_floor, config.position_std_floor, config.yaw_std_floor]
    made = config.measurement_factor * symmetric(covariance)
    lacking = np.square(floors[: len(made)]) - np.diag(made)
    return np.asarray(made + np.diag(np.maximum(lacking, 0.0)))


def read_pose(pose: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array]:
    """A pose (3,) and covariance (3, 3) set from outside; DataError where they are none."""
    value, spread = np.asarray(pose, float), np.asarray(covariance, float)
    if value.shape != (3,) or not np.all(np.isfinite(value)):
        raise DataError(f'initial pose {pose!r} is not x, y, yaw')
    if np.abs(value).max() > _LARGEST_COORDINATE:
        raise DataError(f'initial pose {pose!r} is absurdly far away')
    if spread.shape != (3, 3) or not is_covariance(spread):
        raise DataError('covariance of the initial pose is not a symmetric positive (3, 3) one')
    return value, symmetric(spread)


def is_covariance(matrix: Array) -> bool:
    """Finite, symmetric and positive definite."""
    if not np.all(np.isfinite(matrix)):
        return False
    scale = float(np.abs(matrix).max())
    if not 0 < scale < 1e12 or float(np.abs(matrix - matrix.T).max()) > 1e-6 * scale:
        return False
    return bool(np.linalg.eigvalsh(symmetric(matrix))[0] > 0)


def symmetric(matrix: Array) -> Array:
    """The symmetric part."""
    return np.asarray((matrix + matrix.T) * 0.5)
