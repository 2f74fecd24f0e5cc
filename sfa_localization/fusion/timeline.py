# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a message can be placed in time: stamps may be damaged, late, or of another clock."""

from __future__ import annotations

from collections import Counter

from sfa_localization.data.errors import DataError
from sfa_localization.fusion.belief import Belief, Event
from sfa_localization.fusion.history import History, Key

ODOMETRY, POSE, MEASUREMENT = range(3)
"""Kinds of events, in the order in which those of one stamp follow each other."""
HISTORY_NS = 5_000_000_000
"""How late a measurement may come: many times what any camera, network and model take."""
LEAP_NS = 500_000_000
"""A stamp that is ahead of all before it by more leaves the order of reception, or follows a pause:
as much as a gap of the odometry."""
FEW_AHEAD, FEW_BEHIND = 3, 5
"""So many messages of a kind in a row that leap ahead, and messages in a row that are too late, are
no accident: there was a pause, and the clock has gone back."""
_AGAIN_NS = 300_000_000
"""Time that odometry has to cover once more until the clock is taken to have gone back."""


class ClockWentBack(Exception):
    """The clock went back: whoever knows the time starts anew."""


class Timeline:
    """Feed it the stamps of all messages; it says which can be used."""

    def __init__(self) -> None:
        self._behind = 0
        # By the kind of messages: how many in a row leap ahead, and those that wait for the next.
        self._leaps = Counter[int]()
        self._held: dict[int, list[tuple[Key, Event]]] = {ODOMETRY: [], MEASUREMENT: []}
        self._apart = 0, 0
        # Odometry in a row that is no newer than what came before it: how many of its messages lie
        # among those, and the first and last stamp.
        self._again = 0, 0, 0

    def require_place(self, event: Event, kind: int, history: History[Event, Belief]) -> None:
        """Raises DataError for a stamp that cannot be used, and ClockWentBack.

        A stamp ahead of those before would make what follows too old, or wait: its message is held
        until the next of its kind are no earlier, and left out where one is.
        """
        stamp_ns = event.stamp_ns
        if stamp_ns <= 0:
            raise DataError('zero or negative stamp')
        newest_ns, odometry_ns = history.newest_ns, history.newest.odometry.stamp_ns
        if newest_ns is None:
            return
        ahead_ns, keeps_time = stamp_ns - newest_ns, kind == ODOMETRY or odometry_ns is None
        if kind == MEASUREMENT:
            apart = abs(ahead_ns) > HISTORY_NS
            self._apart = (self._apart[0] + 1, ahead_ns) if apart else (0, 0)
        held = self._held[kind]
        if held and stamp_ns < held[-1][0][0]:
            held.clear()
        leaps = ahead_ns > LEAP_NS and odometry_ns is not None
        self._leaps[kind] = self._leaps[kind] + 1 if leaps else 0
        if kind == ODOMETRY:  # it keeps the time: while it goes on, images ahead are wrong
            self._leaps[MEASUREMENT] = 0
        if 0 < self._leaps[kind] < FEW_AHEAD:
            del held[: -FEW_AHEAD + 2]
            held.append(((stamp_ns, kind), event))
            raise DataError('stamp ahead of those before')
        while held:
            history.add(*held.pop(0))
        reason = ''
        if ahead_ns <= 0 and not history.reaches(stamp_ns):
            reason = 'too old'
        elif ahead_ns <= 0 and history.holds((stamp_ns, kind)):
            reason = 'duplicate stamp'
        if keeps_time:
            self._behind = self._behind + 1 if reason else 0
        if reason and self._behind >= FEW_BEHIND:
            raise ClockWentBack
        if reason:
            raise DataError(reason)
        if kind == ODOMETRY:
            self._notice_again(stamp_ns, odometry_ns, history)

    @property
    def problems(self) -> list[str]:
        """How images and odometry are apart in time, in words."""
        if self._again[0] > 1:
            return ['odometry is stamped with times that it had passed: did the clock go back?']
        count, apart_ns = self._apart
        if count < FEW_AHEAD:
            return []
        where = f'{abs(apart_ns) * 1e-9:.0f} s {"ahead of" if apart_ns > 0 else "behind"}'
        return [f'images are stamped {where} the odometry: are the clocks synchronized?']

    def _notice_again(
        self, stamp_ns: int, newest_ns: int | None, history: History[Event, Belief]
    ) -> None:
        """Odometry that covers once more, in order, what other odometry covered before it, means
        that the clock went back; what fills a hole, or comes out of order, was held up.
        """
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
