# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The error to expect of one image on a path between the trained ones; needs no ground truth.

A stretch of the drive that is left out is usually farther from all other images than a path of
later use: legs end at the border, and a lane is alone in its strip. So left-out images are weighted
until as many of them are at each distance from the nearest image that their map was learned from
as points drawn evenly over the covered ground are from any.

It does not contain what no left-out image can show: other light than that of the trained drives,
or a wheel radius that is wrong everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from sfa_localization.data.geometry import Array, Indices, RigidTransform

REACH_M = 1.0
"""Ground further than this from every image is not covered by the drive."""
_NARROW_M = 0.1
# Points on the ground: enough for the shares of distances.
_POINTS = 1000
# Of distances, in which left-out images are weighted.
_BINS = 12


@dataclass(frozen=True, slots=True)
class Forecast:
    """Expected errors of single images where M images were taken."""

    places: Array
    """(M, 2) m, in the map frame."""
    left_out: Array
    """(M,) m: errors of a map without that stretch of the drive."""
    drive_std: Array
    """(M,) m: of the drive's own positions there, which a map repeats."""
    weight: Array
    """(M,) of sum 1: how well each of `left_out` represents paths between the trained ones."""
    distances: Array
    """(K,) m to the nearest image, of points drawn evenly over the covered ground."""

    @property
    def errors(self) -> Array:
        """(M,) m: of left-out images and of the drive together."""
        return np.hypot(self.left_out, self.drive_std)

    @property
    def expected_m(self) -> float:
        """Mean error to expect of one image on a path between the trained ones."""
        return float(self.weight @ self.errors)

    @property
    def local(self) -> Array:
        """(M,) m: mean of the errors within `REACH_M` of each place, by weight."""
        near = cKDTree(self.places).query_ball_point(self.places, REACH_M)
        weight = self.weight + 1e-2 / len(self.weight)  # where none has any, all count
        return np.array([np.average(self.errors[n], weights=weight[n]) for n in near])

    @property
    def worst(self) -> tuple[float, float, float]:
        """x, y (m, map frame) where the expected error is largest, and this error (m)."""
        local = self.local
        at = int(local.argmax())
        return float(self.places[at, 0]), float(self.places[at, 1]), float(local[at])

    def improved(self, share: float) -> Forecast:
        """With this share of the left-out errors; nothing learned from a drive improves its own."""
        return replace(self, left_out=share * self.left_out)

    def moved(self, frame: RigidTransform) -> Forecast:
        """The same forecast in another frame."""
        return replace(self, places=frame.apply(self.places))


def ground_distances(places: Array, rng: np.random.Generator) -> Array:
    """Distance (K,) m to the nearest of the places (M, 2), of points drawn evenly over the ground
    that they cover.
    """
    return np.asarray(cKDTree(places).query(_covered(places, rng))[0])


def importance(near: Array, distances: Array) -> Array:
    """Weights (M,), of sum 1, of left-out images so `near` (M,), m, to the nearest used one.

    As many, by weight, are then at each distance as `distances` (K,) of points of the ground are.
    """
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
    """Distance (M,) m from each place (M, 2) to the nearest one of another part (M,).

    Infinite where there is no other part.
    """
    distances = np.full(len(places), np.inf)
    for name in np.unique(part):
        own = part == name
        if not own.all():
            distances[own] = cKDTree(places[~own]).query(places[own])[0]
    return distances


def _covered(places: Array, rng: np.random.Generator) -> Array:
    """Points (K, 2) drawn evenly inside the hull of the places (M, 2), and near one of them."""
    center = places.mean(0)
    axes = np.linalg.svd(places - center, full_matrices=False)[2]
    along, across = (places - center) @ axes.T[:, 0], (places - center) @ axes.T[:, 1]
    if np.ptp(across) < _NARROW_M:
        # One straight route has hardly a hull: the ground that it covers is its line.
        spots = rng.uniform(along.min(), along.max(), (4 * _POINTS, 1))
        line = center + spots * axes[0]
        near = cKDTree(places).query(line)[0] <= REACH_M
        return np.asarray(line[near][:_POINTS])
    hull = ConvexHull(places)
    normals, offsets = hull.equations[:, :2], hull.equations[:, 2]
    tree = cKDTree(places)
    low, high = places.min(0), places.max(0)
    found: list[Array] = []
    while sum(len(points) for points in found) < _POINTS:
        points = rng.uniform(low, high, (4 * _POINTS, 2))
        points = points[np.all(points @ normals.T + offsets <= 0.0, axis=1)]
        found.append(points[tree.query(points)[0] <= REACH_M])
    return np.concatenate(found)[:_POINTS]
