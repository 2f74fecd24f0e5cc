# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The error to expect of one image on a path between the trained ones; needs no ground truth.

A stretch of the drive that is left out is usually farther from all other images than a path of
later use: legs end at the border, and a lane is alone in its strip. So the forecast draws points
evenly over the covered ground, and for each finds the distances to the nearest image, and to the
nearest on the opposite side. Around the image nearest to the point, all images up to these two
distances on the two sides are left out, and the map predicts it from the rest: it is then as far
from its neighbors as the point is.

It does not contain what no left-out image can show: other light than that of the trained drives,
or a wheel radius that is wrong everywhere.

Leaving out images needs no new fit: with residuals r and the hat matrix H of the least squares, the
errors of a group G that is not used are (I - H_GG)^-1 r_G.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

from sfa_localization.data.geometry import Array, RigidTransform
from sfa_localization.metric.map_fit import MapFit
from sfa_localization.metric.quadratic_form import Stack

Indices = NDArray[np.int64]

REACH_M = 1.0
"""Ground further than this from every image is not covered by the drive."""
_NARROW_M = 0.1
# Enough for the mean and the map of the expected error; each is a small linear system.
_POINTS = 1000
# Of distances, in which left-out images are weighted.
_BINS = 12
# Images before and after one whose direction is the robot's.
_AROUND = 2


@dataclass(frozen=True, slots=True)
class Forecast:
    """Expected errors of single images at K points, drawn evenly over the covered ground."""

    points: Array
    """(K, 2) m, in the map frame."""
    distances: Array
    """(K,) m to the nearest image of the drive."""
    left_out: Array
    """(K,) m: errors of the map without the images as near as that."""
    drive_std: Array
    """(K,) m: of the drive's own positions there, which a map repeats."""

    @property
    def errors(self) -> Array:
        """(K,) m: of left-out images and of the drive together."""
        return np.hypot(self.left_out, self.drive_std)

    @property
    def expected_m(self) -> float:
        """Mean error to expect of one image on a path between the trained ones."""
        return float(self.errors.mean())

    @property
    def local(self) -> Array:
        """(K,) m: mean of the errors within `REACH_M` of each point."""
        near = cKDTree(self.points).query_ball_point(self.points, REACH_M)
        return np.array([self.errors[rows].mean() for rows in near])

    @property
    def worst(self) -> tuple[float, float, float]:
        """x, y (m, map frame) where the expected error is largest, and this error (m)."""
        local = self.local
        at = int(local.argmax())
        return float(self.points[at, 0]), float(self.points[at, 1]), float(local[at])

    def importance(self, distances: Array) -> Array:
        """Weights (M,), of sum 1, of left-out images so far (m) from the nearest used one.

        As many, by weight, are then at each distance as points of the covered ground are.
        """
        edges = np.quantile(self.distances, np.linspace(0.0, 1.0, _BINS + 1))
        edges[0] = 0.0
        bins = np.searchsorted(edges, distances, 'right') - 1
        inside = (bins >= 0) & (bins < _BINS)
        if not inside.any():
            return np.full(len(distances), 1.0 / max(len(distances), 1))
        bins = np.clip(bins, 0, _BINS - 1)
        counts = np.bincount(bins[inside], minlength=_BINS)
        weights = np.where(inside, 1.0 / np.maximum(counts[bins], 1), 0.0)
        return np.asarray(weights / weights.sum())

    def widened(self, factor: float) -> Forecast:
        """With the variances of the drive's own positions larger by a factor."""
        return replace(self, drive_std=np.sqrt(factor) * self.drive_std)

    def improved(self, share: float) -> Forecast:
        """With this share of the left-out errors; nothing learned from a drive improves its own."""
        return replace(self, left_out=share * self.left_out)

    def moved(self, frame: RigidTransform) -> Forecast:
        """The same forecast in another frame."""
        return replace(self, points=frame.apply(self.points))


def forecast(fit: MapFit, sway_variance: Array, rng: np.random.Generator) -> Forecast:
    """The forecast of a fit, in its own frame.

    `sway_variance` (M,) m^2 is how uncertain the drive's own positions are where each image was
    taken: the map repeats their errors, which leaving out images cannot show.
    """
    complex_places = fit.places
    places = np.column_stack([complex_places.real, complex_places.imag])
    points = _covered(places, rng)
    near, nearest = cKDTree(places).query(points)
    far = _beyond(places, points, nearest)
    white, weights = fit.elimination.whitened(fit.expanded).T, fit.weights
    errors = np.empty(len(points))
    for k, image in enumerate(nearest):
        gap = _gap(complex_places, fit.stack, int(image), near[k], far[k], rng)
        left_out = _left_out_errors(white[gap], weights[gap], fit.residuals[gap])
        errors[k] = abs(complex(left_out[gap == image][0]))
    return Forecast(points, near, errors, np.sqrt(sway_variance[nearest]))


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


def _beyond(places: Array, points: Array, nearest: Indices) -> Array:
    """Distance (K,) to the nearest place on the side away from the nearest one of all."""
    distances = np.empty(len(points))
    for k, point in enumerate(points):
        away = places - point
        opposite = away @ away[nearest[k]] < 0.0
        distances[k] = np.hypot(*away[opposite].T).min() if opposite.any() else np.inf
    return distances


def _gap(
    places: NDArray[np.complex128],
    stack: Stack,
    image: int,
    near: float,
    far: float,
    rng: np.random.Generator,
) -> Indices:
    """Rows around an image: within `near`, and on one side, fore or aft, nearer than `far`."""
    first = stack.first[stack.owner[image]]
    last = np.append(stack.first[1:], len(places))[stack.owner[image]] - 1
    along = places[min(image + _AROUND, last)] - places[max(image - _AROUND, first)]
    # A robot that turned on the spot has no direction of driving.
    if along == 0.0:
        along = np.exp(2j * np.pi * rng.random())
    side = along * rng.choice([-1.0, 1.0])
    away = places - places[image]
    distance = np.abs(away)
    inside = (distance <= near) | ((np.real(away * np.conj(side)) > 0.0) & (distance < far))
    inside[image] = True
    return np.flatnonzero(inside)


def _left_out_errors(
    white: Array, weights: Array, residuals: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Errors (G,) of a group of images by a map learned without them.

    From their whitened features (G, m), weights and residuals (G,) in the map of all images.
    """
    remaining = np.eye(len(white)) - (white @ white.T) * weights
    # Where nothing but the group determines the map, the matrix is singular.
    remaining[np.diag_indices_from(remaining)] += 1e-9
    return np.asarray(np.linalg.solve(remaining, residuals))
