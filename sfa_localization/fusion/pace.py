# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which delays of images are small: a matter of how fast the robot drives and turns."""

from __future__ import annotations

import math

TOLERATED_S = 0.45
"""At walking speed, and as long as nothing is known about the robot."""
_TOLERATED_M, _TOLERATED_RAD = 0.45, 0.3
"""In a small delay a robot drives and turns no more than this..."""
_LEAST_S, _MOST_S = 0.35, 1.25
"""...but a delay is small below, and large above these limits."""
STANDING = 0.01
"""Speed m/s and turn rate rad/s of a robot that stands."""
_USUAL_S = 10.0
"""Over how long a robot's usual speed and turn rate are taken."""


def tolerated_s(v: float, omega: float) -> float:
    """The largest small delay of a robot's usual speed m/s and turn rate rad/s; 0 where unknown."""
    pairs = (_TOLERATED_M, v), (_TOLERATED_RAD, omega)
    limits = [most / abs(rate) for most, rate in pairs if rate]
    return min(max(min(limits, default=TOLERATED_S), _LEAST_S), _MOST_S)


class Pace:
    """How fast a robot usually is while it moves: a stop changes nothing."""

    def __init__(self) -> None:
        self._moved_s, self._v_square, self._omega_square, self._v = 0.0, 0.0, 0.0, 0.0

    def add(self, v: float, omega: float, seconds: float) -> None:
        """Take a speed m/s and a turn rate rad/s that lasted."""
        if abs(v) < STANDING and abs(omega) < STANDING:
            return
        self._moved_s = min(self._moved_s + seconds, _USUAL_S)
        share = min(seconds / self._moved_s, 1.0)
        self._v_square += share * (v * v - self._v_square)
        self._omega_square += share * (omega * omega - self._omega_square)
        self._v = v

    @property
    def v(self) -> float:
        """The larger of usual and present speed, m/s; 0 before any."""
        return max(math.sqrt(self._v_square), abs(self._v))

    @property
    def tolerated_s(self) -> float:
        """The largest small delay of this robot."""
        return tolerated_s(self.v, math.sqrt(self._omega_square))
