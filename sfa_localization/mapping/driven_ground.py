# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The ground on which a robot drove in training, and the error to expect there: a map to look at,
and to plan on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Indices, Mask
from sfa_localization.mapping.settings import GroundConfig

# Images farther from the one before are drawn apart: the drive between them is not in the map.
_JOINED_M = 1.0
RED_M = 0.3
"""Expected error from which paths are drawn red."""
LINE_M = 0.05
"""Width of the drawn paths."""


@dataclass(frozen=True, slots=True)
class Cells:
    """Which square cells (H, W), row 0 at the lowest y, the robot drove on; `corner` (2,) m is the
    lower left corner of the first cell in the map.
    """

    driven: Mask
    corner: Array
    size_m: float

    @property
    def area_m2(self) -> float:
        """Area of the cells on which the robot drove."""
        return float(self.driven.sum() * self.size_m**2)

    def enclosed(self, places: Array) -> Mask:
        """The cells (H, W) inside the convex hull of places (P, 2) m."""
        from scipy.spatial import Delaunay, QhullError  # for drives that are taught alone

        row, column = np.indices(self.driven.shape)
        centers = self.corner + self.size_m * (np.stack([column, row], axis=-1) + 0.5)
        try:
            return np.asarray(Delaunay(places).find_simplex(centers) >= 0)
        except (QhullError, ValueError):  # too few places, or all on a line
            return np.zeros(self.driven.shape, bool)


@dataclass(frozen=True, slots=True)
class DrivenGround:
    """Places (P, 2) m of base_link in the map, in the order of driving. `joined` (P,) tells whether
    the robot drove there from the place before; `expected_m` (P,) is the error of one image.
    """

    places: Array
    joined: Mask
    expected_m: Array

    @classmethod
    def of(cls, places: Array, drive: Indices, expected_m: Array) -> DrivenGround:
        """Of images at places (P, 2), each of a drive (P,)."""
        near = np.hypot(*np.diff(places, axis=0).T) <= _JOINED_M
        return cls(places, np.append(False, near & (np.diff(drive) == 0)), expected_m)

    @property
    def lines(self) -> Indices:
        """Rows (L, 2) of the places at the ends of each stretch that was driven."""
        ends = np.flatnonzero(self.joined)
        return np.column_stack([ends - 1, ends])

    @property
    def red(self) -> Array:
        """How red the ends (2 L,) of the lines are drawn: 0, green, where one image hardly errs, to
        1 from RED_M on.
        """
        return np.minimum(self.expected_m[self.lines.ravel()] / RED_M, 1.0)

    def cells(self, config: GroundConfig) -> Cells:
        """The cells that a robot of some width covered."""
        size_m = config.cell
        reach_m = config.width / 2
        ends = self.places[self.lines]
        part = np.linspace(0.0, 1.0, int(np.ceil(_JOINED_M / size_m)) + 1)[:, None]
        between = ends[:, :1] + part * (ends[:, 1:] - ends[:, :1])
        points = np.concatenate([self.places, between.reshape(-1, 2)])
        margin = int(np.ceil(reach_m / size_m)) + 1
        corner = (np.floor(points.min(0) / size_m) - margin) * size_m
        column, row = np.unique(np.floor((points - corner) / size_m).astype(int), axis=0).T
        driven = np.zeros((row.max() + margin + 1, column.max() + margin + 1), bool)
        offsets = np.indices((2 * margin + 1,) * 2).reshape(2, -1).T - margin
        disc = offsets[np.hypot(*offsets.T) * size_m <= reach_m]
        for up, right in disc.tolist():
            driven[row + up, column + right] = True
        return Cells(driven, corner, size_m)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays to save."""
        return {'places': self.places, 'joined': self.joined, 'expected_m': self.expected_m}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> DrivenGround:
        """Read the arrays of `to_arrays`."""
        return cls(arrays['places'].astype(float), arrays['joined'].astype(bool),
                   arrays['expected_m'].astype(float))  # fmt: skip
