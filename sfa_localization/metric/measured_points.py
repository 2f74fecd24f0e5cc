# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Measured points give a map the coordinates of its owner, and the right scale.

At point k, measured at p_k = x + i y with standard deviation s_k, the drive puts the robot at
y_k = o_n + z_n q_k. Both are the same place in two frames, up to one heading, scale and place:

    sum_k |y_k - a p_k - t|^2 / s_k^2

First `settle` finds a, t and the wrong points, with the covariance C of y: the largest set that a
pair of points and the wheels' scale explain, then least squares weighted by (C + s^2)^-1. The
odometry is scaled by 1 / |a|, and the map learned once more. Now |a| = 1, its angle turns with the
mean of the segments, and the best t is linear in y: the sum is one more residual of the pose graph.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import linalg

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import (
    Array,
    Complex,
    Indices,
    Mask,
    RigidTransform,
    align_complex,
    relative,
)
from sfa_localization.data.messages import LARGEST_SCALE
from sfa_localization.data.run import Odometry, Points, Stamps, Trajectory

WHEELS_STD = 0.02
"""Prior of the scale of wheels: in drives of real robots they count up to 2 % wrong."""
CONTRADICTION = 0.05
"""A scale that differs more from that of the wheels is worth a warning."""
TURN_STD_MAX = 0.1
"""rad: points that give the map's heading less well are at one place."""
NEAR_M = 1.5
"""A point is placed by the odometry from the nearest image, at most this far."""
# Gate: the squared error of a point over its variance, which 1 of 10,000 exceeds.
_GATE = -2.0 * math.log(1e-4)
# Where more than one point, or a quarter, are outliers, the covariance of the drive grows by up to:
_GROWTH_MAX = 4.0**6


@dataclass(frozen=True, slots=True)
class Settled:
    """Which of K points are `used`, whether these give the map's heading (`turned`), and the scale:
    multiply the wheels' meters by it."""

    used: Mask
    turned: bool = False
    scale: float = 1.0
    scale_std: float = WHEELS_STD


@dataclass(frozen=True, slots=True)
class MeasuredPoints:
    """K points, and images near them: the robot stood at a point `offset` (K,) x + i y m, in its
    own axes, from where it took the image; `images` are -1 where none is near."""

    points: Points
    images: Indices
    offset: Complex
    settled: Settled

    @classmethod
    def of(
        cls,
        points: Points,
        drives: Sequence[tuple[Odometry, Stamps]],
        images: Indices,
        settled: Settled | None = None,
        lever: complex = 0j,
    ) -> MeasuredPoints:
        """Points with the nearest of the used `images`, which are numbered drive after drive.

        A drive is its odometry and the stamps of its images. A point is of the first drive that
        covers its stamp. Points are places of base_link, or of an antenna at its lever arm, images
        those of a camera at a `lever` arm, ahead + i left, m.
        """
        nearest = np.full(len(points), -1)
        offset = np.full(len(points), np.inf, complex)
        turned = np.ones(len(points), complex)
        pending = np.ones(len(points), bool)
        start = 0
        for odometry, stamps in drives:
            used = images[(images >= start) & (images < start + len(stamps))] - start
            covered = pending & odometry.trajectory.covers(points.stamps_ns)
            pending &= ~covered
            if len(used):
                at_ns = points.stamps_ns[covered]
                image, moved = _from_nearest(at_ns, odometry.trajectory, stamps, used)
                nearest[covered] = image + start
                offset[covered] = moved[:, 0] + 1j * moved[:, 1]
                turned[covered] = np.exp(1j * moved[:, 2])
            start += len(stamps)
        near = np.abs(offset) <= NEAR_M
        offset = offset + turned * points.lever
        settled = settled or Settled(np.zeros(len(points), bool))
        return cls(points, np.where(near, nearest, -1), np.where(near, offset - lever, 0), settled)

    @property
    def placed(self) -> Mask:
        """(K,) of the points near an image."""
        return self.images >= 0

    def frame(self, places: Complex, start: RigidTransform) -> RigidTransform:
        """The transform from places (K,) to the used points; `start` without any, and with its
        heading where they are at one place."""
        used = self.settled.used
        if not used.any():
            return start
        weights = 1.0 / self.points.std[used] ** 2
        points = self.points.places[used]
        turn, shift = align_complex(places[used], points, weights)
        if not self.settled.turned:
            turn = complex(np.exp(1j * start.yaw_rad))
            shift = complex(np.average(points - turn * places[used], weights=weights))
        return RigidTransform(shift.real, shift.imag, float(np.angle(turn)))

    def quality(self, places: Complex) -> dict[str, Any]:
        """Figures that are stored in the model, of a map that puts the robot at places (K,)."""
        missed = np.abs(places - self.points.places).tolist()
        columns = self.points.rows(), missed, self.settled.used.tolist()
        return {
            'points': [
                {'name': name, 'x_m': place.real, 'y_m': place.imag, 'miss_m': miss, 'used': used}
                for (name, _, place, *_), miss, used in zip(*columns, strict=True)
            ],
        }

    def warnings(self, places: Complex) -> Iterator[str]:
        """What is wrong with the points, for a map that puts the robot at places (K,)."""
        settled = self.settled
        count = int(self.settled.used.sum())
        for point, placed in zip(self.quality(places)['points'], self.placed, strict=True):
            name = point['name']
            miss = point['miss_m']
            if not placed:
                yield f'{name}: no image within {NEAR_M} m was used: left out'
            elif not point['used']:
                yield f'{name}: {miss:.2f} m from where the others put it: left out, measure again'
        if count == 2 < self.placed.sum():
            yield 'no third point agrees with the two that are used: measure more points'
        if count == 2 == self.placed.sum() and settled.turned:
            yield 'two points fit a mirrored drive too: a third shows whether x and y are swapped'
        if count > 1 and not settled.turned:
            yield (
                'the points are at one place, or too inaccurate for their distances: heading and '
                'scale are those of the odometry; measure another point some meters away'
            )
        if abs(settled.scale - 1.0) > CONTRADICTION:
            yield (
                f'by the points, the wheels count {1 / settled.scale - 1.0:+.1%} of way: check '
                'both, and that the points are those of base_link, not of an antenna'
            )


def _from_nearest(
    at_ns: Stamps, path: Trajectory, stamps: Stamps, images: Indices
) -> tuple[Indices, Array]:
    """Of the `images` right before and after each time (K,), the nearest (K,), and the motion
    (K, 3) from it along a path; `stamps` (N,) are those of all images.
    """
    after = np.searchsorted(stamps[images], at_ns)
    around = images[np.clip([after - 1, after], 0, len(images) - 1)]
    moved = np.stack([relative(path.at(stamps[image]), path.at(at_ns)) for image in around])
    nearer = np.hypot(moved[:, :, 0], moved[:, :, 1]).argmin(axis=0)
    rows = np.arange(len(at_ns))
    return around[nearer, rows], moved[nearer, rows]


def settle(measured: MeasuredPoints, places: Complex, covariance: Complex) -> Settled:
    """What points say of a map that puts them at places (K,) with a covariance (K, K) per axis.

    Raises DataError where they cannot be those of this drive.
    """
    placed = measured.placed
    if not placed.any():
        raise DataError(
            f'none of {len(placed)} measured points is within {NEAR_M} m of an image that was '
            'used: are their stamps those of the bags?'
        )
    points = measured.points.places[placed]
    std = measured.points.std[placed]
    points = points - points.mean()  # some coordinates count from the equator
    by_drive = covariance[np.ix_(placed, placed)]
    fit = _Similarity(points, places[placed], by_drive + np.diag(std**2))
    if not fit.pairs().any():
        return Settled(placed)
    cost, inliers = fit.consensus()
    if len(points) > 2 and replace(fit, points=points.conj()).consensus()[0] < cost - _GATE:
        raise DataError('the points fit the drive mirrored: exchange x and y, or turn one around')
    if not np.isfinite(cost):
        raise DataError(
            f'the measured points contradict the wheels by more than a factor of {LARGEST_SCALE}: '
            'are they in meters, and each at its time?'
        )
    settled = fit.settled(inliers)
    growth = 1.0
    while (~settled.used).sum() > max(1, len(points) // 4) and growth < _GROWTH_MAX:
        growth *= 4.0
        fit = replace(fit, noise=growth * by_drive + np.diag(std**2))
        settled = fit.settled(fit.consensus()[1])
    if not settled.turned:
        raise DataError(
            'the measured points have not the shape of the drive: is each stop numbered as inspect '
            'numbers it, and each point that of base_link, x_m before y_m?'
        )
    used = placed.copy()
    used[placed] = settled.used
    return replace(settled, used=used)


@dataclass(frozen=True, slots=True)
class _Similarity:
    """Points (K,) and the places (K,) of a drive that should be a p + t; the errors of both
    together have the covariance `noise` (K, K) per axis."""

    points: Complex
    places: Complex
    noise: Complex

    @property
    def _variance(self) -> Array:
        """(K,) m^2, of each point."""
        return np.asarray(np.diag(self.noise).real)

    def pairs(self) -> Mask:
        """(K, K): the pairs far enough from each other to give a heading."""
        far = np.maximum(*(np.abs(np.subtract.outer(p, p)) for p in (self.points, self.places)))
        std = np.sqrt(np.add.outer(self._variance, self._variance))
        return np.asarray(std < TURN_STD_MAX * far)

    def consensus(self) -> tuple[float, Mask]:
        """The least cost of a pair of points, and its inliers (K,): outliers cost the gate."""
        least = np.inf
        inliers = np.ones(len(self.points), bool)
        for i, j in np.argwhere(np.triu(self.pairs())).tolist():
            a = (self.places[j] - self.places[i]) / (self.points[j] - self.points[i] or 1e-9)
            if not 1 / LARGEST_SCALE < abs(a) < LARGEST_SCALE:
                continue
            residuals = self.places - self.places[i] - a * (self.points - self.points[i])
            squares = np.abs(residuals) ** 2 / self._variance
            wheels = (np.log(abs(a)) / WHEELS_STD) ** 2
            cost = float(np.minimum([*squares, wheels], _GATE).sum())
            if cost < least:
                least = cost
                inliers = squares < _GATE
        return least, inliers

    def settled(self, used: Mask) -> Settled:
        """Least squares of the points used (K,), until these are the inliers."""
        frame = np.column_stack([self.points, np.ones(len(used))])
        for _ in range(len(used)):
            noise = self.noise[np.ix_(used, used)]
            weighted = linalg.solve(noise, frame[used], assume_a='pos').conj().T
            covariance = np.linalg.pinv(weighted @ frame[used], hermitian=True)  # of a and t
            a, t = covariance @ (weighted @ self.places[used])
            by_frame = np.einsum('ki,ij,kj->k', frame, covariance, frame.conj()).real
            squares = np.abs(self.places - a * self.points - t) ** 2
            inliers = squares < _GATE * (self._variance + by_frame)
            if (inliers == used).all() or inliers.sum() < 2:
                break
            used = inliers
        variance = float(covariance[0, 0].real) / abs(a) ** 2  # of log |a|, and of the angle, rad^2
        share = WHEELS_STD**2 / (WHEELS_STD**2 + variance)
        turned = variance < TURN_STD_MAX**2
        return Settled(used, turned, float(abs(a) ** -share), float(np.sqrt(variance * share)))
