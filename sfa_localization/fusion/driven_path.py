# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The odometry's path of the last seconds: where the robot was at each delay before a stamp."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle

LATEST_S = 10.0
"""Delays that are distinguished; images that are later look like images of elsewhere."""
STEP_S = 0.1
DELAYS: Array = STEP_S * np.arange(LATEST_S / STEP_S + 0.5)
COUNT = len(DELAYS)
KNOT_NS = 50_000_000
"""The path is remembered at this distance in time: no robot turns far meanwhile."""
_TRAIL_NS = round(LATEST_S * 1e9) + KNOT_NS
AS_BEFORE = 10
"""Knots of the path whose motion is taken for that of before the odometry began."""
_STRAIGHT_RAD = 1e-6
_EVEN, _EVEN_RADPS = 0.2, 0.05
"""Standard deviations of speed and turn rate on a line or a circle, as a part of the means, and of
the turn rate at most, where it is small."""

Knot = tuple[int, float, float, float]
"""Stamp ns, x m, y m, yaw rad by odometry."""
Complex = NDArray[np.complex128]


class Path(NamedTuple):
    """Odometry's positions (K,), x + iy, and headings (K,) at each delay before a stamp.

    `known` (K,): whether the odometry had begun.
    """

    places: Complex
    yaws: Array
    known: NDArray[np.bool_]

    @property
    def rates(self) -> Array:
        """Speed m/s and turn rate rad/s (2, K - 1) between one delay and the next."""
        return np.array([np.abs(np.diff(self.places)), np.diff(self.yaws)]) / STEP_S

    def steady(self, seconds: float = LATEST_S) -> bool:
        """Whether it is a line or a circle at one speed lately, on which all delays look alike."""
        count = round(seconds / STEP_S)
        v, omega = self.rates[:, :count]
        same_speed = v.std() < _EVEN * v.mean()
        same_rate = omega.std() < max(_EVEN * abs(float(omega.mean())), _EVEN_RADPS)
        return bool(self.known[: count + 1].all() and same_speed and same_rate)

    @property
    def circling(self) -> bool:
        """Whether it is steady and no line."""
        return self.steady() and abs(float(self.rates[1].mean())) > _EVEN_RADPS


def extended(trail: tuple[Knot, ...], knot: Knot) -> tuple[Knot, ...]:
    """The odometry's path with another knot, without what is older than is remembered."""
    if trail and 0 <= knot[0] - trail[-1][0] < KNOT_NS:
        return trail
    first = 0
    while first + 1 < len(trail) and trail[first + 1][0] <= knot[0] - _TRAIL_NS:
        first += 1
    return (*trail[first:], knot)


def path_to(now: Knot, trail: tuple[Knot, ...]) -> Path:
    """The path that led to a pose."""
    knots = (*trail, now)
    seconds = np.array([(knot[0] - now[0]) * 1e-9 for knot in knots])
    x, y, yaw = np.array([knot[1:] for knot in knots]).T
    places = np.interp(-DELAYS, seconds, x) + 1j * np.interp(-DELAYS, seconds, y)
    known = seconds[0] - 1e-9 <= -DELAYS
    return Path(places, np.interp(-DELAYS, seconds, np.unwrap(yaw)), known)


def continued(path: Path, trail: tuple[Knot, ...], now: Knot) -> Path:
    """The path of a robot that moved before the odometry began as it does where it begins."""
    knots = (*trail, now)
    before_s = np.minimum((now[0] - knots[0][0]) * 1e-9 - DELAYS, 0.0)
    way, turned = _steadily(knots[0], knots[min(AS_BEFORE - 1, len(trail))], before_s)
    return Path(path.places + way, path.yaws + turned, np.ones(COUNT, bool))


def _steadily(first: Knot, later: Knot, seconds: Array) -> tuple[Complex, Array]:
    """Way and turn (K,) of as many seconds from the first of two knots, as between both."""
    between_s = (later[0] - first[0]) * 1e-9
    if between_s <= 0:
        return np.zeros(COUNT, complex), np.zeros(COUNT)
    part, turn = seconds / between_s, float(wrap_angle(later[3] - first[3]))
    chord = complex(later[1] - first[1], later[2] - first[2])
    straight = abs(turn) < _STRAIGHT_RAD
    arc = part if straight else np.expm1(1j * turn * part) / np.expm1(1j * turn)
    return np.asarray(chord * arc, complex), turn * part
