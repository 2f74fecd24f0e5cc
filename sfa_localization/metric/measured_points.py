# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Measured points bring a map into its owner's coordinates, at the right scale.

At point k, measured at p_k = x + i y with standard deviation s_k, the drive puts the robot at
y_k = o_n + z_n q_k. Both are the same place in two frames, up to one heading, scale and place:

    sum_k |y_k - a p_k - t|^2 / s_k^2

First `settle` finds a, t and the points that are wrong, with the covariance C of y: the largest set
of points that a pair and the wheels' scale explain, then least squares weighted by (C + s^2)^-1.
The odometry is scaled by 1 / |a|, and the map learned once more. Now |a| = 1, its angle turns with
the mean of the segments, and the best t is linear in y: the sum is a quadratic form of the
certified problem, beside that of the loop closures, and bends the map straight.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import linalg, sparse

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
from sfa_localization.data.run import Odometry, Points, Stamps

if TYPE_CHECKING:
    from sfa_localization.metric.stack import SegmentPoses, Stack


WHEELS_STD = 0.02
"""Of the scale of wheels before anything is measured: half-real drives count up to 2 % wrong."""
CONTRADICTION = 0.05
"""A scale that differs more from that of the wheels is worth a warning."""
TURN_STD_MAX = 0.1
"""rad: points that know the map's heading less well are at one place."""
NEAR_M = 1.5
"""A point is placed by the odometry from the nearest image, at most this far."""
# Squared distance of a point from where it should be, over its variance, that 1 of 10,000 exceeds.
_WRONG = -2.0 * math.log(1e-4)
# Where more than one point, or a quarter, seem wrong, the drive errs by more than it claims: in
# variance at most so much.
_MOST_GROWN = 4.0**6


@dataclass(frozen=True, slots=True)
class Settled:
    """What K points say: which are `used`, whether they lie apart, so that the map's heading is
    theirs (`turned`), and by how much the wheels' meters are to be multiplied.
    """

    used: Mask
    turned: bool = False
    scale: float = 1.0
    scale_std: float = WHEELS_STD


@dataclass(frozen=True, slots=True)
class MeasuredPoints:
    """K points beside images: the robot was `offset` (K,) x + i y m, in its own axes, from where
    it took an image when it stood at a measured place.
    """

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
        """Points beside the nearest of the used `images`, which are numbered drive after drive.

        A drive is its odometry and the stamps of its images; a point is of the first that was under
        way then. Points that are near no image stay out. They are places of base_link, images those
        of a camera at a `lever`, ahead + i left, m, of it.
        """
        at, offset = np.full(len(points), -1, np.int64), np.full(len(points), np.inf, complex)
        start, left = 0, np.ones(len(points), bool)
        for odometry, stamps in drives:
            own = images[(images >= start) & (images < start + len(stamps))]
            inside = left & odometry.trajectory.covers(points.stamps_ns)
            left &= ~inside
            for k in np.flatnonzero(inside) if len(own) else ():
                after = int(np.searchsorted(stamps[own - start], points.stamps_ns[k]))
                for image in own[max(after - 1, 0) : after + 1].tolist():
                    pair = np.array([stamps[image - start], points.stamps_ns[k]])
                    moved = relative(*odometry.trajectory.at(pair))
                    if abs(moved[0] + 1j * moved[1]) < abs(offset[k]):
                        at[k], offset[k] = image, moved[0] + 1j * moved[1]
            start += len(stamps)
        near = np.abs(offset) <= NEAR_M
        settled = settled or Settled(np.zeros(len(points), bool))
        return cls(points, np.where(near, at, -1), np.where(near, offset - lever, 0.0), settled)

    @property
    def placed(self) -> Mask:
        """(K,) of the points that are near an image."""
        return self.images >= 0

    def rows(self, stack: Stack) -> Complex:
        """Rows (K, 3N) whose products with [o, z, -b z] are where the drive puts the robot; 0 of
        points that are near no image.
        """
        rows, placed = stack.rows(self.images), self.placed.astype(float)
        beside = stack.facing_rows(rows, placed * self.offset)
        return np.asarray((stack.place_rows(rows, placed) + beside).toarray())

    def ties(self, stack: Stack, before: SegmentPoses | None = None) -> sparse.csr_array:
        """What is squared (K, 3N) of the used points in [o, z, -b z], over its standard deviation.

        The heading of the points turns with the mean of the segments from what it is in the
        solution `before`, without which nothing is tied.
        """
        n, used = stack.segments, self.settled.used & self.settled.turned
        if before is None or not used.any():
            return sparse.csr_array((0, 3 * n), dtype=complex)
        rows, points, std = self.rows(stack)[used], self.points.places[used], self.points.std[used]
        points = points - points.mean()
        turn, _ = align_complex(points, rows @ before.coefficients(stack.period), std**-2)
        rows[:, n : 2 * n] -= np.outer(turn * points, before.z.conj() / n)
        rows = (rows - np.average(rows, axis=0, weights=std**-2)) / std[:, None]
        return sparse.csr_array(rows)

    def frame(self, places: Complex, start: RigidTransform) -> RigidTransform:
        """The transform that lays places (K,) on the points used; `start` where there are none, and
        its heading where these are at one place.
        """
        used = self.settled.used
        if not used.any():
            return start
        weights, points = 1.0 / self.points.std[used] ** 2, self.points.places[used]
        turn, shift = align_complex(places[used], points, weights)
        if not self.settled.turned:
            turn = complex(np.exp(1j * start.yaw_rad))
            shift = complex(np.average(points - turn * places[used], weights=weights))
        return RigidTransform(shift.real, shift.imag, float(np.angle(turn)))

    def quality(self, places: Complex) -> dict[str, Any]:
        """Figures that are stored in the model: by how much a map misses each point that puts the
        robot at places (K,).
        """
        missed, settled = np.abs(places - self.points.places), self.settled
        return {
            'points': [
                {'name': name, 'x_m': at.real, 'y_m': at.imag, 'miss_m': miss, 'used': used}
                for (name, _, at, _), miss, used in zip(
                    self.points.rows(), missed.tolist(), settled.used.tolist(), strict=True
                )
            ],
        }

    def warnings(self, places: Complex) -> Iterator[str]:
        """What is wrong with the points, in words, for a map that puts the robot at places (K,)."""
        missed, settled = np.abs(places - self.points.places), self.settled
        columns = self.points.names, self.placed.tolist(), settled.used.tolist(), missed.tolist()
        for name, placed, used, miss in zip(*columns, strict=True):
            if not placed:
                yield f'{name}: no image within {NEAR_M} m was used: left out'
            elif not used:
                yield f'{name}: {miss:.2f} m from where the others put it: left out, measure again'
        if settled.used.sum() == 2 < self.placed.sum():
            yield 'no third point agrees with the two that are used: measure more points'
        if settled.used.sum() == 2 == self.placed.sum() and settled.turned:
            yield 'two points fit a mirrored drive too: a third shows whether x and y are swapped'
        if settled.used.sum() > 1 and not settled.turned:
            yield (
                'the points are at one place: heading and scale are those of the odometry; measure '
                'another one, some meters away'
            )
        if abs(settled.scale - 1.0) > CONTRADICTION:
            yield (
                f'by the points the wheels count {1 / settled.scale - 1.0:+.1%} of way: check both '
                'and that the points are those of base_link, not of an antenna'
            )


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
    points, std = measured.points.places[placed], measured.points.std[placed]
    points = points - points.mean()  # some coordinates count from the equator
    known = covariance[np.ix_(placed, placed)]
    fit = _Fit(points, places[placed], known + np.diag(std**2))
    if not fit.apart().any():
        return Settled(placed)
    cost, kept = fit.consensus()
    if len(points) > 2 and replace(fit, points=points.conj()).consensus()[0] < cost - _WRONG:
        raise DataError('the points fit the drive mirrored: exchange x and y, or turn one around')
    if not np.isfinite(cost):
        raise DataError(
            f'the measured points contradict the wheels by more than a factor of {LARGEST_SCALE}: '
            'are they in meters, and each at its time?'
        )
    found, grown = fit.settled(kept), 1.0
    while (~found.used).sum() > max(1, len(points) // 4) and grown < _MOST_GROWN:
        grown *= 4.0
        fit = replace(fit, noise=grown * known + np.diag(std**2))
        found = fit.settled(fit.consensus()[1])
    if not found.turned:
        raise DataError(
            'the measured points lie apart, but not as the drive does: is each stop numbered as '
            'inspect numbers it, and each point that of base_link, x_m before y_m?'
        )
    used = placed.copy()
    used[placed] = found.used
    return replace(found, used=used)


@dataclass(frozen=True, slots=True)
class _Fit:
    """Points (K,) and the places (K,) of a drive that should be those, in its own frame; the errors
    of both together have a covariance (K, K) per axis.
    """

    points: Complex
    places: Complex
    noise: Complex

    @property
    def _own(self) -> Array:
        """(K,) m^2, of each point."""
        return np.asarray(np.diag(self.noise).real)

    def apart(self) -> Mask:
        """(K, K): the pairs that show a direction."""
        far = np.maximum(*(np.abs(np.subtract.outer(p, p)) for p in (self.points, self.places)))
        return np.asarray(np.sqrt(np.add.outer(self._own, self._own)) < TURN_STD_MAX * far)

    def consensus(self) -> tuple[float, Mask]:
        """The cost of the likeliest points (K,) that one pair and the wheels explain, and these."""
        best, own = (np.inf, np.ones(len(self.points), bool)), self._own
        for i, j in np.argwhere(np.triu(self.apart())).tolist():
            a = (self.places[j] - self.places[i]) / (self.points[j] - self.points[i] or 1e-9)
            if not 1 / LARGEST_SCALE < abs(a) < LARGEST_SCALE:
                continue
            missed = self.places - self.places[i] - a * (self.points - self.points[i])
            squares = np.abs(missed) ** 2 / own
            wheels = (np.log(abs(a)) / WHEELS_STD) ** 2
            cost = float(np.minimum([*squares, wheels], _WRONG).sum())
            if cost < best[0]:
                best = cost, squares < _WRONG
        return best

    def settled(self, used: Mask) -> Settled:
        """Least squares of the points used (K,), until these are all that fit."""
        for _ in range(len(used)):
            (a, t), spread = self._solved(used)
            frame = np.column_stack([self.points, np.ones(len(used))])
            own = self._own + np.einsum('ki,ij,kj->k', frame, spread, frame.conj()).real
            kept = np.abs(self.places - a * self.points - t) ** 2 < _WRONG * own
            if (kept == used).all() or kept.sum() < 2:
                break
            used = kept
        variance = float(spread[0, 0].real) / abs(a) ** 2  # of log |a|, and of the angle, rad^2
        share = WHEELS_STD**2 / (WHEELS_STD**2 + variance)
        turned = variance < TURN_STD_MAX**2
        return Settled(used, turned, float(abs(a) ** -share), float(np.sqrt(variance * share)))

    def _solved(self, used: Mask) -> tuple[Complex, Complex]:
        """a and t, and their covariance (2, 2) per axis."""
        frame = np.column_stack([self.points, np.ones(len(used))])[used]
        weighted = linalg.solve(self.noise[np.ix_(used, used)], frame, assume_a='pos').conj().T
        spread = np.linalg.pinv(weighted @ frame, hermitian=True)
        return spread @ (weighted @ self.places[used]), spread
