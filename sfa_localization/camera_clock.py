# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A camera's clock that is late or early: what an image shows is not the pose at its stamp.

The delay is a part of the state. An image stamped late shows where the robot has been, which dead
reckoning remembers; one stamped early, where it is about to be at the speed of now.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sfa_localization.geometry import Array
from sfa_localization.motion import DELAY, OMEGA, V, arc, wrap

DELAY_LIMIT = 0.5
"""Delay s, either way, beyond which none is believed."""
_SPACING_NS = 15_000_000
_KEPT = 36
Reckoned = tuple[float, float, float]
"""A pose, or a change of one, in the frame of dead reckoning: x m, y m, yaw rad."""
Trail = tuple[tuple[int, Reckoned], ...]
"""Dead-reckoned poses with their stamps ns, the newest last."""


class Sight(NamedTuple):
    """Where the robot was when an image was taken, and how it moved: in the map's frame.

    `pose` x m, y m, yaw rad; `offset` what leads to it from the pose at the stamp; `velocity` m/s,
    m/s, rad/s; `reckoned` the pose in the frame of dead reckoning.
    """

    pose: Reckoned
    offset: Reckoned
    velocity: Reckoned
    reckoned: Reckoned


def left_behind(trail: Trail, stamp_ns: int, reckoned: Reckoned) -> Trail:
    """The trail with a pose more, unless the last is near; it covers DELAY_LIMIT."""
    if trail and stamp_ns - trail[-1][0] < _SPACING_NS:
        return trail
    return (*trail[1 - _KEPT :], (stamp_ns, reckoned))


def look_back(stamp_ns: int, mean: Array, reckoned: Reckoned, trail: Trail) -> Sight:
    """What an image of this stamp shows, by the state's `mean` (11,) and the way behind."""
    delay, v, omega = float(mean[DELAY]), float(mean[V]), float(mean[OMEGA])
    if delay > 0 and trail:
        then, v, omega = _recalled(
            stamp_ns - round(delay * 1e9), stamp_ns, reckoned, trail, v, omega
        )
    else:
        path = arc(reckoned[2], v, omega, -delay)
        then = (reckoned[0] + path.dx, reckoned[1] + path.dy, wrap(reckoned[2] + path.dyaw))
    x, y, yaw = mean[:3].tolist()
    turned = yaw - reckoned[2]
    c, s = math.cos(turned), math.sin(turned)
    dx, dy = then[0] - reckoned[0], then[1] - reckoned[1]
    offset = (c * dx - s * dy, s * dx + c * dy, wrap(then[2] - reckoned[2]))
    heading = then[2] + turned
    velocity = (v * math.cos(heading), v * math.sin(heading), omega)
    return Sight((x + offset[0], y + offset[1], wrap(heading)), offset, velocity, then)


def _recalled(
    taken_ns: int, stamp_ns: int, reckoned: Reckoned, trail: Trail, v: float, omega: float
) -> tuple[Reckoned, float, float]:
    """Dead-reckoned pose and twist at `taken_ns`; v and omega are those of now."""
    later_ns, later = stamp_ns, reckoned
    for earlier_ns, earlier in reversed(trail):
        if earlier_ns <= taken_ns:
            break
        later_ns, later = earlier_ns, earlier
    span = max(later_ns - earlier_ns, 1)
    part = min((later_ns - taken_ns) / span, 1.0)
    dx, dy, dyaw = later[0] - earlier[0], later[1] - earlier[1], wrap(later[2] - earlier[2])
    then = (later[0] - part * dx, later[1] - part * dy, wrap(later[2] - part * dyaw))
    if later_ns != stamp_ns:
        # The newest piece of way may be too short to say how fast it was driven.
        along = dx * math.cos(then[2]) + dy * math.sin(then[2])
        v, omega = along * 1e9 / span, dyaw * 1e9 / span
    return then, v, omega
