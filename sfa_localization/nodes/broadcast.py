# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""When the transform map -> odom holds: at each odometry message's stamp, and for a while after.

Those who look up the present need a transform from the future, and this holds what is right now.
Once that time has come it is out of date, and tf2 neither forgets nor replaces a transform. So the
time right before and right after it is then given what was right: tf2 interpolates between
neighbors, and the outdated transform counts for two nanoseconds only.
"""

from __future__ import annotations

from collections import deque

from sfa_localization.fusion.belief import Pose
from sfa_localization.fusion.timeline import HISTORY_NS

Dated = tuple[int, Pose]
"""A stamp in ns, and map -> odom at it."""
_OFF_GRID_NS = 500
"""Added to the future: stamps of odometry are often whole multiples of its period apart."""


class Broadcast:
    """What to publish on /tf, so that a lookup at an odometry's stamp gives what it was then."""

    def __init__(self) -> None:
        self._newest: Dated | None = None
        self._future_ns: deque[int] = deque()

    def add(self, stamp_ns: int, map_to_odom: Pose, ahead_ns: int) -> list[Dated]:
        """Return the transforms to publish with odometry of this stamp, `ahead_ns` into the future.

        A stamp before others is late; beyond the filter's history the clock has gone back.
        """
        if self._newest is not None and stamp_ns < self._newest[0]:
            if stamp_ns >= self._newest[0] - HISTORY_NS:
                return [(stamp_ns, map_to_odom)]
            self.reset()
        sent = [*self._corrections(stamp_ns), (stamp_ns, map_to_odom)]
        self._newest = stamp_ns, map_to_odom
        future_ns = stamp_ns + ahead_ns + _OFF_GRID_NS
        if ahead_ns and (not self._future_ns or future_ns > self._future_ns[-1]):
            self._future_ns.append(future_ns)
            sent.append((future_ns, map_to_odom))
        return sent

    def reset(self) -> None:
        """Forget: the clock has gone back."""
        self._newest = None
        self._future_ns.clear()

    def _corrections(self, until_ns: int) -> list[Dated]:
        """Around each future that has become the past: what was newest before it came."""
        made: list[Dated] = []
        while self._newest is not None and self._future_ns and self._future_ns[0] <= until_ns:
            passed_ns = self._future_ns.popleft()
            made += [
                (beside_ns, self._newest[1])
                for beside_ns in (passed_ns - 1, passed_ns + 1)
                if self._newest[0] < beside_ns < until_ns
            ]
        return made
