# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The directions that the pixels of a panorama look in."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sfa_localization.data.geometry import Array


def rotation(roll: float, pitch: float, yaw: float = 0.0) -> Array:
    """The rotation (3, 3) from the axes of what has roll, pitch and yaw, rad, to level ones."""
    a, b, c = np.exp(1j * np.array([roll, pitch, yaw]))
    about_x = [[1, 0, 0], [0, a.real, -a.imag], [0, a.imag, a.real]]
    about_y = [[b.real, 0, b.imag], [0, 1, 0], [-b.imag, 0, b.real]]
    about_z = [[c.real, -c.imag, 0], [c.imag, c.real, 0], [0, 0, 1]]
    return np.asarray(np.array(about_z) @ about_y @ about_x)


@dataclass(frozen=True, slots=True)
class Sphere:
    """The part of the sphere of directions that a panorama shows: all azimuths, with forward in
    the middle, between the elevations `low` and `high`, rad, of its lower and upper edge; whether
    columns grow `clockwise` seen from above.
    """

    low: float
    high: float
    clockwise: bool = True

    def elevations(self, rows: int) -> Array:
        """Of the rows of a panorama, (rows,) rad."""
        return self.high - (np.arange(rows) + 0.5) * (self.high - self.low) / rows

    def azimuths(self, columns: int) -> Array:
        """Of the columns of a panorama, (columns,) rad, counterclockwise from forward."""
        clockwise = (np.arange(columns) + 0.5 - columns / 2) * 2 * np.pi / columns
        return -clockwise if self.clockwise else clockwise

    def rays(self, rows: int, columns: int) -> Array:
        """Unit rays (rows, columns, 3) of the pixels in the robot's axes (x forward, y left, z up),
        read-only.
        """
        return _rays(self, rows, columns)


@lru_cache(maxsize=4)
def _rays(sphere: Sphere, rows: int, columns: int) -> Array:
    elevation, azimuth = sphere.elevations(rows)[:, None], sphere.azimuths(columns)
    flat, up = np.cos(elevation), np.sin(elevation)
    parts = flat * np.cos(azimuth), flat * np.sin(azimuth), np.broadcast_to(up, (rows, columns))
    rays = np.stack(parts, axis=-1)
    rays.setflags(write=False)
    return rays
