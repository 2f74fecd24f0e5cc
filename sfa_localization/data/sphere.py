# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The viewing directions of the pixels of a panorama."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sfa_localization.data.geometry import Array


def rotation(roll: float, pitch: float, yaw: float = 0.0) -> Array:
    """The rotation (3, 3) from the axes of a body at roll, pitch and yaw, rad, to level axes."""
    a, b, c = np.cos([roll, pitch, yaw])
    i, j, k = np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, a, -i], [0, i, a]])
    about_y = np.array([[b, 0, j], [0, 1, 0], [-j, 0, b]])
    about_z = np.array([[c, -k, 0], [k, c, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def directions(azimuth: Array | float, elevation: Array | float) -> Array:
    """Unit rays (..., 3), x forward, y left, z up, of azimuths and elevations (...) rad."""
    level = np.cos(elevation)
    parts = level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


@dataclass(frozen=True, slots=True)
class Sphere:
    """The directions of a panorama: all azimuths, forward in the center column.

    Elevations `low` and `high`, rad, of the lower and upper edge; columns grow `clockwise` seen
    from above, or counterclockwise.
    """

    low: float
    high: float
    clockwise: bool = True

    def elevations(self, rows: int) -> Array:
        """Elevations (rows,) rad of the rows."""
        return self.high - (np.arange(rows) + 0.5) * (self.high - self.low) / rows

    def azimuths(self, columns: int) -> Array:
        """Azimuths (columns,) rad of the columns, counterclockwise from forward."""
        clockwise = (np.arange(columns) + 0.5 - columns / 2) * 2 * np.pi / columns
        return -clockwise if self.clockwise else clockwise

    def pixels(self, rays: Array, rows: int, columns: int) -> Array:
        """Column and row (..., 2) of rays (..., 3) in a panorama of this size."""
        x, y, z = np.moveaxis(rays, -1, 0)
        azimuth = np.arctan2(y, x) * (-1 if self.clockwise else 1)
        elevation = np.arctan2(z, np.hypot(x, y))
        column = (azimuth / (2 * np.pi) + 0.5) * columns - 0.5
        row = (self.high - elevation) / (self.high - self.low) * rows - 0.5
        return np.stack([column, row], axis=-1)

    def directions(self, pixels: Array, rows: int, columns: int) -> Array:
        """Unit rays (..., 3) of pixels (..., 2); the inverse of `pixels`."""
        column, row = np.moveaxis(pixels, -1, 0)
        azimuth = ((column + 0.5) / columns - 0.5) * 2 * np.pi * (-1 if self.clockwise else 1)
        elevation = self.high - (row + 0.5) / rows * (self.high - self.low)
        return directions(azimuth, elevation)

    def rays(self, rows: int, columns: int) -> Array:
        """Unit rays (rows, columns, 3) of the pixels, x forward, y left, z up; read-only."""
        return _rays(self, rows, columns)


@lru_cache(maxsize=4)
def _rays(sphere: Sphere, rows: int, columns: int) -> Array:
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(float)
    rays = sphere.directions(pixels, rows, columns)
    rays.setflags(write=False)
    return rays
