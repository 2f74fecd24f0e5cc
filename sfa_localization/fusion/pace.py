# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which delays of images are small: a matter of how fast the robot drives and turns."""

from __future__ import annotations

TOLERATED_S = 0.45
"""At walking speed, and as long as nothing is known about the robot."""
_TOLERATED_M, _TOLERATED_RAD = 0.45, 0.3
"""In a small delay a robot drives and turns no more than this..."""
_LEAST_S, _MOST_S = 0.35, 1.25
"""...but a delay is small below, and large above these limits."""
STANDING = 0.01
"""Speed m/s and turn rate rad/s of a robot that stands."""


def tolerated_s(v: float, omega: float) -> float:
    """The largest small delay of a robot's usual speed m/s and turn rate rad/s; 0 where unknown."""
    limits = [
        much / abs(rate) for much, rate in ((_TOLERATED_M, v), (_TOLERATED_RAD, omega)) if rate
    ]
    return min(max(min(limits, default=TOLERATED_S), _LEAST_S), _MOST_S)
