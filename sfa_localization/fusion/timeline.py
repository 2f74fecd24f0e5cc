# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a message can be placed in time: stamps may be damaged, late, or of another clock."""

from __future__ import annotations

import math
from collections.abc import Callable

from sfa_localization.data.errors import DataError
from sfa_localization.data.events import clock_difference
from sfa_localization.fusion.belief import Belief, Event
from sfa_localization.fusion.history import History

ODOMETRY, POSE, MEASUREMENT = range(3)
"""Kinds of events, in the order in which those of one stamp follow each other."""
HISTORY_NS = 5_000_000_000
"""How late a measurement may come: many times what any camera, network and model take."""
LEAP_NS = 500_000_000
PERIODS = 2.5
"""A stamp leaps ahead where it lies farther than this, and than so many periods of the odometry,
after all before it: its clock is wrong, or there was a pause."""
FEW_AHEAD = 3
FEW_BEHIND = 5
"""So many messages in a row that leap ahead, or are too late, are no accident: there was a pause,
or the clock has gone back."""
AHEAD = 'stamp ahead of those before'
_AGAIN_NS = 300_000_000
"""Duration of repeated odometry stamps after which the clock is considered set back."""


class ClockWentBack(Exception):
    """The clock went back: the filter has to start anew."""


def odometry_ns(history: History[Event, Belief]) -> int | None:
    """The stamp of the newest odometry; None without any. Where some is remembered it needs no
    belief: while odometry comes late, each would be made anew from there on.
    """
    last_ns = history.last_ns(ODOMETRY)
    return history.newest.odometry.stamp_ns if last_ns is None else last_ns


class Timeline:
    """Decides by the stamps of all messages, in the order of arrival, which can be used."""

    def __init__(self) -> None:
        self._behind = 0
        # Messages in a row that leap ahead: kind, stamp, and what takes each once more.
        self._leaps: list[tuple[int, int, Callable[[], object]]] = []
        self._retaking = False
        self._other_clock = (0, 0)
        self._period_ns = 0
        # Consecutive odometry with old stamps: how many messages lie among earlier ones, and the
        # first and last stamp.
        self._again = 0, 0, 0

    def require_order(
        self, stamp_ns: int, kind: int, history: History[Event, Belief], again: Callable[[], object]
    ) -> None:
        """Raises DataError for a stamp ahead of those before, which would make what follows too
        old, until FEW_AHEAD messages in a row are ahead: then calls `again` of those that waited.
        Odometry in order ends the row.
        """
        newest_ns = history.newest_ns
        if newest_ns is None or odometry_ns(history) is None or self._retaking:
            return
        ahead_ns = stamp_ns - newest_ns
        if kind == MEASUREMENT:
            other = abs(ahead_ns) > HISTORY_NS
            self._other_clock = (self._other_clock[0] + 1, ahead_ns) if other else (0, 0)
        if ahead_ns <= max(LEAP_NS, PERIODS * self._period_ns):
            if kind == ODOMETRY and ahead_ns > 0:
                self._period_ns = ahead_ns
            far_ns = HISTORY_NS if kind == ODOMETRY else math.inf
            self._leaps = [
                leap for leap in self._leaps if leap[0] != kind and leap[1] - stamp_ns <= far_ns
            ]
            return
        if len(self._leaps) + 1 < FEW_AHEAD:
            self._leaps.append((kind, stamp_ns, again))
            raise DataError(AHEAD)
        waiting = self._leaps
        self._leaps = []
        self._retaking = True
        for *_, take in waiting:
            take()
        self._retaking = False
        self._period_ns = stamp_ns - (history.newest_ns or stamp_ns)

    def require_place(self, stamp_ns: int, kind: int, history: History[Event, Belief]) -> None:
        """Raises DataError for a stamp that cannot be used, and ClockWentBack."""
        if stamp_ns <= 0:
            raise DataError('zero or negative stamp')
        newest_ns = history.newest_ns
        counted_ns = odometry_ns(history)
        if newest_ns is None:
            return
        reason = ''
        if stamp_ns <= newest_ns and not history.reaches(stamp_ns):
            reason = 'too old'
        elif history.holds((stamp_ns, kind)):
            reason = 'duplicate stamp'
        if kind == ODOMETRY or counted_ns is None:  # the odometry keeps the time
            self._behind = self._behind + 1 if reason else 0
        if reason and self._behind >= FEW_BEHIND:
            raise ClockWentBack
        if reason:
            raise DataError(reason)
        if kind == ODOMETRY:
            self._notice_again(stamp_ns, counted_ns, history)

    @property
    def problems(self) -> list[str]:
        """How the stamps of images and odometry disagree, in words."""
        if self._again[0] > 1:
            return ['odometry is stamped with times that it had passed: did the clock go back?']
        if self._leaps:
            return [AHEAD]
        count, ahead_ns = self._other_clock
        if count < FEW_AHEAD:
            return []
        return [f'images are {clock_difference(ahead_ns)}: synchronize the clocks']

    def _notice_again(
        self, stamp_ns: int, newest_ns: int | None, history: History[Event, Belief]
    ) -> None:
        """Raises ClockWentBack for odometry that covers once more, in order, what other odometry
        covered before it; odometry that fills a gap, or is out of order, was only delayed.
        """
        # Needed by the fault "all clocks step -1.71 s".
        among, first_ns, last_ns = self._again
        if newest_ns is None or stamp_ns > newest_ns:
            self._again = 0, 0, 0
        elif stamp_ns < last_ns or last_ns == 0:
            self._again = 0, stamp_ns, stamp_ns
        else:
            among += (history.before(stamp_ns).odometry.stamp_ns or 0) > last_ns
            self._again = among, first_ns, stamp_ns
            if among >= FEW_BEHIND and stamp_ns - first_ns >= _AGAIN_NS:
                raise ClockWentBack
