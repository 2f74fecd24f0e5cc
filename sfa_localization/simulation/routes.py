# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where a simulated robot drives: routes over a lawn, clear of its trees.

A route is a list of motions; each starts and ends at rest where the last one ended.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, wrap_angle

CLEARANCE_M = 0.8
"""From the robot's center to any obstacle."""
TIGHTEST_M = 0.8
"""Smallest radius of a curve."""
CELL_M = 0.5  # side of the cells in which coverage is counted
STEP_M = 0.05  # between points of a curve


@dataclass(frozen=True, slots=True)
class Motion:
    """Driven from rest to rest: `steps` (M, 2) of distance in m and turn in rad, images or not."""

    steps: Array
    images: bool = True


Route = list[Motion]


class Lawn:
    """Free ground: a rectangle of half sizes `half` (2,) about the origin, without some discs."""

    def __init__(self, half: Array, obstacles: Array) -> None:
        """`obstacles` (N, 3) are discs x, y, radius in meters."""
        self.half = np.asarray(half, float)
        self._obstacles = np.asarray(obstacles, float).reshape(-1, 3)

    @property
    def size_m2(self) -> float:
        return float(4 * self.half.prod())

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
    """Which cells of a lawn a route has passed."""

    def __init__(self, lawn: Lawn) -> None:
        self._half = lawn.half
        self._passed = np.zeros(np.ceil(2 * lawn.half / CELL_M).astype(int) + 1, bool)

    def gain(self, points: Array) -> int:
        """How many new cells points (N, 2) would pass."""
        x, y = self._cells(points)
        cells = np.unique(x[~self._passed[x, y]] * self._passed.shape[1] + y[~self._passed[x, y]])
        return len(cells)

    def add(self, points: Array) -> None:
        """Mark the cells of points (N, 2) as passed; start anew when nearly all are."""
        self._passed[self._cells(points)] = True
        if self._passed.mean() > 0.9:
            self._passed[:] = False

    def _cells(self, points: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        cells = np.rint((points + self._half) / CELL_M).astype(int)
        x, y = np.clip(cells, 0, np.array(self._passed.shape) - 1).T
        return x, y


class Plan:
    """A route under construction, from a start pose on."""

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
        self.position, self.length_m = np.asarray(target, float), self.length_m + distance

    def reach(self, target: Array, rng: np.random.Generator, images: bool = False) -> None:
        """Drive to a point (2,), around the obstacles."""
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
        self.position, self.heading = points[-1], float(at[-1])
        self.length_m += float(steps[:, 0].sum())


def coverage(lawn: Lawn, start: Array, rng: np.random.Generator, length_m: float = 0.0) -> Route:
    """Straight legs criss-crossing the lawn until `length_m` is driven (0: by the lawn's size)."""
    plan, cells = Plan(lawn, start), Coverage(lawn)
    driven = np.zeros(6)
    shortest = 0.8 * lawn.half.min()
    while plan.length_m < (length_m or 1.15 * lawn.size_m2):
        ends = lawn.random_points(rng, 250)
        ends = ends[lawn.clear(plan.position, ends)]
        far = np.linalg.norm(ends - plan.position, axis=1)
        ends = ends[far > min(shortest, far.max(initial=0.0) / 2)]
        target = _most_new(cells, driven, plan.position, ends)
        cells.add(_between(plan.position, target))
        driven[_sector(target - plan.position)] += np.hypot(*(target - plan.position))
        plan.straight_to(target)
    return plan.route


def _between(start: Array, end: Array) -> Array:
    count = int(np.hypot(*(end - start)) / CELL_M * 2) + 2
    return np.asarray(start + np.linspace(0, 1, count)[:, None] * (end - start))


def _sector(offsets: Array) -> NDArray[np.int64]:
    """Which sixth of the directions offsets (..., 2) have; forth and back are the same."""
    angle = np.arctan2(offsets[..., 1], offsets[..., 0]) % np.pi
    return np.asarray(angle / np.pi * 6, int) % 6


def _most_new(cells: Coverage, driven: Array, start: Array, ends: Array) -> Array:
    """The end (2,) of the leg over most new ground, in directions not much `driven` (6,)."""
    lengths = np.linalg.norm(ends - start, axis=1)
    share = driven[_sector(ends - start)] / (driven.sum() + 1.0)
    gains = np.array([cells.gain(_between(start, end)) for end in ends])
    return np.asarray(ends[(gains - (0.5 + 4 * share) * lengths).argmax()])


def lines(lawn: Lawn, start: Array, rng: np.random.Generator, length_m: float = 0.0) -> Route:
    """Ten straight lines of 8 m or more in well spread directions; no images between them.

    On small lawns the lines are at least 0.6 of its shorter side. `length_m` is not used.
    """
    plan, cells = Plan(lawn, start), Coverage(lawn)
    directions = rng.permutation(10) * np.pi / 10 + rng.uniform(0, np.pi)
    for direction in directions:
        one, other = _line(lawn, cells, direction, rng)
        if np.hypot(*(other - plan.position)) < np.hypot(*(one - plan.position)):
            one, other = other, one
        plan.reach(one, rng)
        plan.turn_to(float(np.arctan2(*(other - one)[::-1])), images=False)
        plan.straight_to(other)
    return plan.route


def _line(
    lawn: Lawn, cells: Coverage, direction: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Both ends of a free line in about this direction over ground not yet passed."""
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
            one, other = middles[best] - half[best], middles[best] + half[best]
            cells.add(_between(one, other))
            return one, other
    raise DataError('the simulated lawn has no room for straight lines; name a larger area')


def mower(lawn: Lawn, start: Array, rng: np.random.Generator, length_m: float = 0.0) -> Route:
    """Nine lanes along each axis, with turns of 90 degrees between; `length_m` is not used."""
    plan = Plan(lawn, start)
    for axis in rng.permutation(2):
        ahead = -1.0 if plan.position[axis] > 0 else 1.0
        offsets = np.linspace(-1, 1, 9) * lawn.half[1 - axis] * 0.97
        if plan.position[1 - axis] > 0:
            offsets = offsets[::-1]
        for offset in offsets:
            ahead = _lane(plan, int(axis), float(offset), ahead, rng)
    return plan.route


def _lane(plan: Plan, axis: int, offset: float, ahead: float, rng: np.random.Generator) -> float:
    """Drive one lane, shifted to be free, or none; return the direction of the next."""
    for shift in rng.permuted(np.arange(-9, 10) * 0.1)[np.argsort(np.abs(np.arange(-9, 10)))]:
        ends = np.zeros((2, 2))
        ends[:, axis] = np.array([-ahead, ahead]) * plan.lawn.half[axis]
        ends[:, 1 - axis] = offset + shift
        if plan.lawn.clear(ends[0], ends[1:])[0]:
            plan.reach(ends[0], rng, images=bool(plan.route))
            plan.straight_to(ends[1])
            return -ahead
    return ahead


def closed_curve(
    lawn: Lawn, start: Array, rng: np.random.Generator, length_m: float = 0.0
) -> Route:
    """A smooth closed curve through the start, of about `length_m` (0: by the lawn's size)."""
    target = length_m or 3.8 * lawn.half.sum()
    best: Array | None = None
    for _ in range(4000):
        curve = _spline_around(lawn, start, rng)
        if not _drivable(lawn, curve):
            continue
        if best is None or _misses(curve, target) < _misses(best, target):
            best = curve
        if _misses(best, target) < 0.05:
            break
    if best is None:
        raise DataError('the simulated lawn is too crowded for a smooth curve; name a larger area')
    plan = Plan(lawn, start)
    plan.follow(best)
    return plan.route


def _misses(curve: Array, length_m: float) -> float:
    return abs(_length(curve) / length_m - 1)


def _length(curve: Array) -> float:
    return float(np.hypot(*np.diff(curve, axis=0).T).sum())


def _spline_around(lawn: Lawn, start: Array, rng: np.random.Generator) -> Array:
    """Points every STEP_M of a random closed spline, twice around the lawn's center."""
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


def curves(lawn: Lawn, start: Array, rng: np.random.Generator, length_m: float = 0.0) -> Route:
    """Arcs of changing curvature, never straight, until `length_m` is driven (0: by the lawn)."""
    cells = Coverage(lawn)
    pieces = int(np.ceil((length_m or 1.15 * lawn.size_m2) / ARC_M))
    state = (np.asarray(start[:2], float), float(start[2]))
    trail = [_arcs_from(lawn, cells, state, rng)]
    chosen: list[Array] = []
    budget = 60 * pieces
    while len(chosen) < pieces and budget:
        budget -= 1
        if trail[-1]:
            arc = trail[-1].pop()
            cells.add(arc[:, :2])
            chosen.append(arc)
            trail.append(_arcs_from(lawn, cells, (arc[-1, :2], float(arc[-1, 2])), rng))
        elif chosen:
            trail.pop()
            chosen.pop()
        else:
            break
    if len(chosen) < pieces:
        raise DataError('the simulated lawn has no room for curves; name a larger area')
    plan = Plan(lawn, start)
    plan.route.append(Motion(np.concatenate([_arc_steps(arc) for arc in chosen])))
    return plan.route


ARC_M = 2.5


def _arcs_from(
    lawn: Lawn, cells: Coverage, state: tuple[Array, float], rng: np.random.Generator
) -> list[Array]:
    """Free arcs (M, 3) of points and headings that go on from a state, the best one last."""
    steepest = 1 / TIGHTEST_M
    bends = rng.uniform(0.08, steepest, 12) * rng.choice([-1, 1], 12)
    bends = np.concatenate([bends, [-steepest, steepest]])
    arcs = [_arc(state, bend) for bend in bends]
    arcs = [arc for arc in arcs if lawn.free(arc[:, :2]).all()]
    return sorted(arcs, key=lambda arc: cells.gain(arc[:, :2]) + rng.uniform(0, 1.5))


def _arc(state: tuple[Array, float], bend: float) -> Array:
    distance = np.linspace(0, ARC_M, int(ARC_M / STEP_M) + 1)
    heading = state[1] + bend * distance
    x = state[0][0] + (np.sin(heading) - np.sin(state[1])) / bend
    y = state[0][1] - (np.cos(heading) - np.cos(state[1])) / bend
    return np.stack([x, y, heading], -1)


def _arc_steps(arc: Array) -> Array:
    turns = np.diff(arc[:, 2])
    return np.stack([np.full(len(turns), ARC_M / len(turns)), turns], -1)


Planner = Callable[[Lawn, Array, np.random.Generator, float], Route]

ROUTES: dict[str, Planner] = {
    'coverage': coverage,
    'lines': lines,
    'mower': mower,
    'test': closed_curve,
    'curves': curves,
}
