# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Routes of a simulated robot over a lawn, clear of its trees.

A route is a list of motions; each starts where the last one ended, and starts and ends at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, wrap_angle

CLEARANCE_M = 0.8
"""Smallest distance of the robot's center from an obstacle."""
TIGHTEST_M = 0.8
"""Smallest radius of a curve."""
CELL_M = 0.5  # side of the cells in which coverage is counted
STEP_M = 0.05  # between points of a curve


@dataclass(frozen=True, slots=True)
class Motion:
    """A motion from rest to rest: `steps` (M, 2) of distance m and turn rad; with images or not."""

    steps: Array
    images: bool = True


Route = list[Motion]


class Lawn:
    """A rectangle of half sizes `half` (2,) about the origin, without obstacles."""

    def __init__(self, half: Array, obstacles: Array) -> None:
        """`obstacles` (N, 3) are discs x, y, radius in meters."""
        self.half = np.asarray(half, float)
        self._obstacles = np.asarray(obstacles, float).reshape(-1, 3)

    def free(self, points: Array) -> NDArray[np.bool_]:
        """Mask (...) of the points (..., 2) that the robot's center may reach."""
        inside = (np.abs(points) <= self.half + 1e-9).all(-1)
        gaps = np.linalg.norm(points[..., None, :] - self._obstacles[:, :2], axis=-1)
        return np.asarray(inside & (gaps >= self._obstacles[:, 2] + CLEARANCE_M).all(-1))

    def clear(self, start: Array, ends: Array) -> NDArray[np.bool_]:
        """Mask (N,) of the free straight lines from `start` (2,) or (N, 2) to `ends` (N, 2)."""
        t = np.linspace(0, 1, 200)[:, None, None]
        return np.asarray(self.free(start + t * (ends - start)).all(0))

    def random_points(self, rng: np.random.Generator, count: int) -> Array:
        """Free points (<= count, 2), denser toward the edge so that its corners are reached."""
        points = rng.uniform(-1, 1, (count, 2))
        points = np.sign(points) * np.abs(points) ** 0.6 * self.half
        return np.asarray(points[self.free(points)])


class Coverage:
    """The cells of a lawn that a route has passed."""

    def __init__(self, lawn: Lawn) -> None:
        self._half = lawn.half
        self._passed = np.zeros(np.ceil(2 * lawn.half / CELL_M).astype(int) + 1, bool)

    def gain(self, points: Array) -> int:
        """Number of new cells that points (N, 2) would pass."""
        passed = np.zeros_like(self._passed)
        passed[self._cells(points)] = True
        return int((passed & ~self._passed).sum())

    def add(self, points: Array) -> None:
        """Mark the cells of points (N, 2) as passed; forget all when nearly all are."""
        self._passed[self._cells(points)] = True
        if self._passed.mean() > 0.9:
            self._passed[:] = False

    def _cells(self, points: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        cells = np.rint((points + self._half) / CELL_M).astype(int)
        x, y = np.clip(cells, 0, np.array(self._passed.shape) - 1).T
        return x, y


class RouteBuilder:
    """Builds a route from a start pose on."""

    def __init__(self, lawn: Lawn, start: Array) -> None:
        self.lawn = lawn
        self.route: Route = []
        self.position = np.asarray(start[:2], float)
        self.heading = float(start[2])
        self.length_m = 0.0

    def turn_to(self, heading_rad: float, images: bool = True) -> None:
        """Turn on the spot, in the shorter direction."""
        turn = float(wrap_angle(heading_rad - self.heading))
        if abs(turn) > 1e-6:
            self.route.append(Motion(np.array([[0.0, turn]]), images))
        self.heading = heading_rad

    def straight_to(self, target: Array, images: bool = True) -> None:
        """Turn toward a point (2,) and drive there."""
        offset = target - self.position
        distance = float(np.hypot(*offset))
        if distance < 1e-3:
            return
        self.turn_to(float(np.arctan2(offset[1], offset[0])), images)
        self.route.append(Motion(np.array([[distance, 0.0]]), images))
        self.position = np.asarray(target, float)
        self.length_m = self.length_m + distance

    def reach(self, target: Array, rng: np.random.Generator, images: bool = False) -> None:
        """Drive to a point (2,) around the obstacles."""
        if not self.lawn.clear(self.position, target[None])[0]:
            self.straight_to(self._detour(target, rng), images)
        self.straight_to(target, images)

    def _detour(self, target: Array, rng: np.random.Generator) -> Array:
        points = self.lawn.random_points(rng, 500)
        points = points[self.lawn.clear(self.position, points) & self.lawn.clear(target, points)]
        if not len(points):
            raise DataError('the simulated lawn is too crowded to drive on; name a larger area')
        there = np.linalg.norm(points - self.position, axis=1)
        onward = np.linalg.norm(points - target, axis=1)
        return np.asarray(points[(there + onward).argmin()])

    def follow(self, points: Array) -> None:
        """Drive along a smooth line (N, 2) that starts here, after turning to its direction."""
        chords = np.diff(points, axis=0)
        headings = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
        # The heading at each point is the mean of the chords on both sides.
        inner = (headings[1:] + headings[:-1]) / 2
        at = np.concatenate([1.5 * headings[:1] - 0.5 * headings[1:2], inner, headings[-1:]])
        self.turn_to(float(at[0]))
        steps = np.stack([np.hypot(*chords.T), np.diff(at)], -1)
        self.route.append(Motion(steps))
        self.position = points[-1]
        self.heading = float(at[-1])
        self.length_m += float(steps[:, 0].sum())


def coverage(lawn: Lawn, start: Array, rng: np.random.Generator, length_m: float = 0.0) -> Route:
    """Straight legs, `length_m` in all (0: by the lawn's size), over ground not yet passed and in
    directions not yet driven.
    """
    builder = RouteBuilder(lawn, start)
    cells = Coverage(lawn)
    driven = np.zeros(6)
    shortest = 0.8 * lawn.half.min()
    while builder.length_m < (length_m or 4.6 * lawn.half.prod()):
        ends = lawn.random_points(rng, 250)
        ends = ends[lawn.clear(builder.position, ends)]
        far = np.linalg.norm(ends - builder.position, axis=1)
        ends = ends[far > min(shortest, far.max(initial=0.0) / 2)]
        lengths = np.linalg.norm(ends - builder.position, axis=1)
        share = driven[_sector(ends - builder.position)] / (driven.sum() + 1.0)
        gains = np.array([cells.gain(_between(builder.position, end)) for end in ends])
        target = ends[(gains - (0.5 + 4 * share) * lengths).argmax()]
        cells.add(_between(builder.position, target))
        driven[_sector(target - builder.position)] += np.hypot(*(target - builder.position))
        builder.straight_to(target)
    return builder.route


def _between(start: Array, end: Array) -> Array:
    count = int(np.hypot(*(end - start)) / CELL_M * 2) + 2
    return np.asarray(start + np.linspace(0, 1, count)[:, None] * (end - start))


def _sector(offsets: Array) -> NDArray[np.int64]:
    """The sector, of 30 degrees, of offsets (..., 2); forth and back are the same."""
    angle = np.arctan2(offsets[..., 1], offsets[..., 0]) % np.pi
    return np.asarray(angle / np.pi * 6, int) % 6


def lines(lawn: Lawn, start: Array, rng: np.random.Generator, length_m: float = 0.0) -> Route:
    """Ten straight lines in evenly spread directions; no images between them.

    They are at least 8 m long, or 0.6 of the shorter side of a small lawn. `length_m` is unused.
    """
    builder = RouteBuilder(lawn, start)
    cells = Coverage(lawn)
    directions = rng.permutation(10) * np.pi / 10 + rng.uniform(0, np.pi)
    for direction in directions:
        start, end = _line(lawn, cells, direction, rng)
        if np.hypot(*(end - builder.position)) < np.hypot(*(start - builder.position)):
            start, end = end, start
        builder.reach(start, rng)
        builder.turn_to(float(np.arctan2(*(end - start)[::-1])), images=False)
        builder.straight_to(end)
    return builder.route


def _line(
    lawn: Lawn, cells: Coverage, direction: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Both ends of a free line in about this direction that passes most new cells."""
    shortest = min(8.0, 1.2 * lawn.half.min())
    for _ in range(20):
        middles = lawn.random_points(rng, 300)
        angles = direction + rng.uniform(-0.1, 0.1, len(middles))
        reach = rng.uniform(shortest, 2 * lawn.half.max(), (len(middles), 1)) / 2
        half = reach * np.stack([np.cos(angles), np.sin(angles)], -1)
        keep = np.flatnonzero(lawn.clear(middles - half, middles + half))
        if len(keep):
            gains = [cells.gain(_between(middles[i] - half[i], middles[i] + half[i])) for i in keep]
            best = keep[int(np.argmax(gains))]
            ends = middles[best] - half[best], middles[best] + half[best]
            cells.add(_between(*ends))
            return ends
    raise DataError('the simulated lawn has no room for straight lines; name a larger area')


def mower(lawn: Lawn, start: Array, rng: np.random.Generator, length_m: float = 0.0) -> Route:
    """Nine lanes along each axis, with turns of 90 degrees between; `length_m` is unused."""
    builder = RouteBuilder(lawn, start)
    for axis in rng.permutation(2):
        ahead = -1.0 if builder.position[axis] > 0 else 1.0
        offsets = np.linspace(-1, 1, 9) * lawn.half[1 - axis] * 0.97
        if builder.position[1 - axis] > 0:
            offsets = offsets[::-1]
        for offset in offsets:
            ahead = _lane(builder, int(axis), float(offset), ahead, rng)
    return builder.route


def _lane(
    builder: RouteBuilder, axis: int, offset: float, ahead: float, rng: np.random.Generator
) -> float:
    """Drive a lane, shifted aside if a tree is in the way; return the direction of the next."""
    for shift in rng.permuted(np.arange(-9, 10) * 0.1)[np.argsort(np.abs(np.arange(-9, 10)))]:
        ends = np.zeros((2, 2))
        ends[:, axis] = np.array([-ahead, ahead]) * builder.lawn.half[axis]
        ends[:, 1 - axis] = offset + shift
        if builder.lawn.clear(ends[0], ends[1:])[0]:
            builder.reach(ends[0], rng, images=bool(builder.route))
            builder.straight_to(ends[1])
            return -ahead
    return ahead


def closed_curve(
    lawn: Lawn, start: Array, rng: np.random.Generator, length_m: float = 0.0
) -> Route:
    """A smooth closed curve through the start, of about `length_m` (0: by the lawn's size)."""
    target = length_m or 3.8 * lawn.half.sum()
    best: Array | None = None
    least = np.inf
    for _ in range(4000):
        curve = _spline_around(lawn, start, rng)
        if not _drivable(lawn, curve):
            continue
        error = abs(np.hypot(*np.diff(curve, axis=0).T).sum() / target - 1)
        if error < least:
            best = curve
            least = error
        if least < 0.05:
            break
    if best is None:
        raise DataError('the simulated lawn is too crowded for a smooth curve; name a larger area')
    builder = RouteBuilder(lawn, start)
    builder.follow(best)
    return builder.route


def _spline_around(lawn: Lawn, start: Array, rng: np.random.Generator) -> Array:
    """Points, STEP_M apart, of a random closed spline twice around the lawn's center."""
    count = int(rng.integers(9, 14))
    first = np.arctan2(start[1] / lawn.half[1], start[0] / lawn.half[0])
    turns = (np.arange(1, count) + rng.uniform(-0.3, 0.3, count - 1)) / count * 4 * np.pi
    angles = first + rng.choice([-1, 1]) * turns
    reach = rng.uniform(0.25, 0.95, (count - 1, 1))
    corners = np.stack([np.cos(angles), np.sin(angles)], -1) * reach * lawn.half
    if not lawn.free(corners).all():
        return np.asarray(corners)
    corners = np.concatenate([start[None, :2], corners, start[None, :2]])
    chords = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    spline = CubicSpline(chords, corners, bc_type='periodic')
    return np.asarray(spline(np.linspace(0, chords[-1], int(chords[-1] / STEP_M))))


def _drivable(lawn: Lawn, curve: Array) -> bool:
    chords = np.diff(curve, axis=0)
    bends = np.abs(wrap_angle(np.diff(np.arctan2(chords[:, 1], chords[:, 0]))))
    gentle = bends < np.hypot(*chords[1:].T) / TIGHTEST_M
    return bool(lawn.free(curve).all() and gentle.all())


ROUTES = {'coverage': coverage, 'lines': lines, 'mower': mower, 'test': closed_curve}
