# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The error to expect of one image on a path between the trained ones, without ground truth.

A stretch of the drive that is held out is usually farther from all other images than later paths
are: legs end at the border, and a lane is alone in its strip. So held-out images are weighted,
until their distances to the nearest image that their map was learned from are distributed as those
of points drawn evenly over the covered ground.

The forecast contains no error that a held-out image cannot show: that of another light than in the
trained drives, or of a wheel radius that is wrong everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from sfa_localization.data.geometry import Array, Indices, RigidTransform

REACH_M = 1.0
"""Ground farther than this from every image is not covered by the drive."""
# Points on the ground, and bins of their distances.
_POINTS = 1000
_BINS = 12


@dataclass(frozen=True, slots=True)
class Forecast:
    """Expected errors of single images where M images were taken."""

    places: Array
    """(M, 2) m, in the map frame."""
    held_out: Array
    """(M,) m: errors of a map learned without that stretch of the drive."""
    drive_std: Array
    """(M,) m: of the positions of the drive there, which a map repeats."""
    weight: Array
    """(M,) of sum 1: by which `held_out` represents paths between the trained ones."""
    distances: Array
    """(K,) m to the nearest image, of points drawn evenly over the covered ground."""
    nearest: Array
    """(M,) m from each image to the nearest one of the map that was learned without it."""

    @property
    def errors(self) -> Array:
        """(M,) m: of held-out images and of the drive together."""
        return np.hypot(self.held_out, self.drive_std)

    @property
    def expected_m(self) -> float:
        """Mean error to expect of one image on a path between the trained ones."""
        return float(self.weight @ self.errors)

    @property
    def local(self) -> Array:
        """(M,) m: error to expect of one image within `REACH_M` of each place.

        Held-out images there err more or less than others that were held out as far from the rest:
        by this factor the expected error is larger or smaller. A corner that was driven once errs
        by 1.6 m when it is held out, 3 m from the rest, but by 0.13 m when it is not (rendered).
        """
        rank = np.argsort(np.argsort(self.nearest, kind='stable'), kind='stable')
        alike = rank * _BINS // len(rank)
        usual = np.bincount(alike, self.errors, _BINS) / np.maximum(np.bincount(alike), 1)
        factor = self.errors / np.maximum(usual[alike], 1e-12)
        near = cKDTree(self.places).query_ball_point(self.places, REACH_M)
        return np.array([self.expected_m * factor[rows].mean() for rows in near])

    @property
    def worst(self) -> tuple[float, float, float]:
        """x, y (m, map frame) where the expected error is largest, and this error (m)."""
        local = self.local
        at = int(local.argmax())
        return float(self.places[at, 0]), float(self.places[at, 1]), float(local[at])

    def improved(self, share: float) -> Forecast:
        """With this share of the held-out errors; those of the drive stay."""
        return replace(self, held_out=share * self.held_out)

    def moved(self, frame: RigidTransform) -> Forecast:
        """The same forecast in another frame."""
        return replace(self, places=frame.apply(self.places))


def ground_distances(places: Array, rng: np.random.Generator) -> Array:
    """Distances (K,) m to the nearest of the places (M, 2), of points drawn evenly over the ground
    that they cover: inside their hull, and within REACH_M."""
    centered = places - places.mean(0)
    local = centered @ np.linalg.svd(centered, full_matrices=False)[2].T
    hull = ConvexHull(local, qhull_options='QJ').equations  # also of a straight line
    tree = cKDTree(local)
    distances = np.zeros(0)
    while len(distances) < _POINTS:
        points = rng.uniform(local.min(0), local.max(0), (4 * _POINTS, 2))
        inside = np.all(points @ hull[:, :2].T + hull[:, 2] <= 1e-6, axis=1)
        nearest = tree.query(points[inside])[0]
        distances = np.append(distances, nearest[nearest <= REACH_M])
    return distances[:_POINTS]


def importance(near: Array, distances: Array) -> Array:
    """Weights (M,), of sum 1, of held-out images at distances `near` (M,), m, from the nearest used
    one, so that their distribution is that of `distances` (K,) of points of the ground."""
    edges = np.quantile(distances, np.linspace(0.0, 1.0, _BINS + 1))
    edges[0] = 0.0
    bins = np.searchsorted(edges, near, 'right') - 1
    inside = (bins >= 0) & (bins < _BINS)
    if not inside.any():
        return np.full(len(near), 1.0 / max(len(near), 1))
    bins = np.clip(bins, 0, _BINS - 1)
    counts = np.bincount(bins[inside], minlength=_BINS)
    weights = np.where(inside, 1.0 / np.maximum(counts[bins], 1), 0.0)
    return np.asarray(weights / weights.sum())


def nearest_used(places: Array, part: Indices) -> Array:
    """Distance (M,) m from each place (M, 2) to the nearest one of another part (M,); infinite
    where there is none."""
    distances = np.full(len(places), np.inf)
    for number in np.unique(part):
        inside = part == number
        if not inside.all():
            distances[inside] = cKDTree(places[~inside]).query(places[inside])[0]
    return distances
