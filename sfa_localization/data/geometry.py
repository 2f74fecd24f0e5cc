# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Planar geometry: angles, poses in SE(2), rigid alignment.

A pose is (x m, y m, yaw rad): x forward, y left, yaw counterclockwise (REP-103).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

SPOT_RADIUS_M = 0.1
"""A robot whose turning radius is smaller turns on the spot: slip there loses no distance."""


def wrap_angle(angle_rad: Array | float) -> Array:
    """Wrap to [-pi, pi)."""
    return np.asarray((np.asarray(angle_rad) + np.pi) % (2 * np.pi) - np.pi)


def rotation(yaw_rad: float) -> Array:
    """Rotation matrix (2, 2) of a counterclockwise rotation."""
    c = np.cos(yaw_rad)
    s = np.sin(yaw_rad)
    return np.array([[c, -s], [s, c]])


def compose(a: Array, b: Array) -> Array:
    """Pose `b`, given in the frame of pose `a`, expressed in a's parent frame; (..., 3) each."""
    a = np.asarray(a, float)
    b = np.asarray(b, float)
    c = np.cos(a[..., 2])
    s = np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrap_angle(a[..., 2] + b[..., 2])], axis=-1)


def relative(a: Array, b: Array) -> Array:
    """Pose of `b` seen from `a`; (..., 3) each."""
    a, step = np.asarray(a, float), np.asarray(b, float) - a
    c = np.cos(a[..., 2])
    s = np.sin(a[..., 2])
    x = c * step[..., 0] + s * step[..., 1]
    y = c * step[..., 1] - s * step[..., 0]
    return np.stack([x, y, wrap_angle(step[..., 2])], axis=-1)


def invert(a: Array) -> Array:
    """Inverse of poses (..., 3): compose(invert(a), a) is the identity."""
    return relative(a, np.zeros(3))


@dataclass(frozen=True, slots=True)
class RigidTransform:
    """A rotation and a translation of the plane: p -> R(yaw) p + (x, y)."""

    x_m: float
    y_m: float
    yaw_rad: float

    @property
    def pose(self) -> Array:
        """Where it leads the origin (3,) [x m, y m, yaw rad]: it composes with poses."""
        return np.array([self.x_m, self.y_m, self.yaw_rad])

    def apply(self, points: Array) -> Array:
        """Transform points (N, 2) in meters."""
        return np.asarray(points @ rotation(self.yaw_rad).T + [self.x_m, self.y_m])


def align(source: Array, target: Array) -> RigidTransform:
    """Least-squares rotation and translation (no scale, no reflection) from source to target.

    Both (N, 2), N >= 2. Raises DataError for fewer points or mismatched shapes.
    """
    source = np.asarray(source, float)
    target = np.asarray(target, float)
    if source.shape != target.shape or source.ndim != 2 or len(source) < 2:
        raise DataError(f'cannot align points of shapes {source.shape} and {target.shape}')
    turn, shift = align_complex(source @ np.array([1.0, 1j]), target @ np.array([1.0, 1j]))
    return RigidTransform(shift.real, shift.imag, float(np.angle(turn)))


def align_complex(
    source: Complex, target: Complex, weights: Array | None = None
) -> tuple[complex, complex]:
    """Unit rotation and shift of points x + iy (N,) with turn * source + shift = target.

    Minimizes squared distances, with `weights` (N,). Points without extent are not turned.
    """
    a = np.average(source, weights=weights)
    b = np.average(target, weights=weights)
    products = np.conj(source - a) * (target - b)
    product = complex(np.sum(products if weights is None else weights * products))
    turn = product / abs(product) if product != 0 else 1.0 + 0.0j
    return turn, complex(b - turn * a)
