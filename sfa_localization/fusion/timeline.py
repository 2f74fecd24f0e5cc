# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a message can be placed in time: stamps may be damaged, late, or of another clock."""

from __future__ import annotations

from typing import NamedTuple

from sfa_localization.data.errors import DataError
from sfa_localization.fusion.belief import Belief, Event
from sfa_localization.fusion.history import History

ODOMETRY, POSE, MEASUREMENT = range(3)
"""Kinds of events, in the order in which those of one stamp follow each other."""
HISTORY_NS = 5_000_000_000
"""How late a measurement may come: many times what any camera, network and model take."""
JUMP_NS = 60_000_000_000
"""A stamp this far ahead needs FEW_AHEAD like it: one alone is a damaged message."""
FEW_AHEAD, FEW_BEHIND = 3, 5
"""So many messages in a row that lie ahead, or are too late, are no accident: the clock is another
one, or has gone back."""
_AGAIN_NS = 300_000_000
"""Time that odometry has to cover once more until the clock is taken to have gone back."""


class ClockWentBack(Exception):
    """The clock went back: whoever knows the time starts anew."""


class _Again(NamedTuple):
    """Odometry in a row that is no newer than what came before it: how many of its messages lie
    among those, and the first and last stamp.
    """

    among: int = 0
    first_ns: int = 0
    last_ns: int = 0


class Timeline:
    """Feed it the stamps of all messages; it says which can be used."""

    def __init__(self) -> None:
        self._behind, self._beyond = 0, 0
        self._ahead = self._apart = (0, 0)
        self._again = _Again()

    def require_place(self, stamp_ns: int, kind: int, history: History[Event, Belief]) -> None:
        """Raises DataError for a stamp that cannot be used, and ClockWentBack."""
        if stamp_ns <= 0:
            raise DataError('zero or negative stamp')
        newest_ns, odometry_ns = history.newest_ns, history.newest.odometry_ns
        if newest_ns is None:
            return
        ahead_ns, keeps_time = stamp_ns - newest_ns, kind == ODOMETRY or odometry_ns is None
        if kind == MEASUREMENT:
            beyond = abs(ahead_ns) > HISTORY_NS
            self._apart = (self._apart[0] + 1, ahead_ns) if beyond else (0, 0)
        self._require_near(stamp_ns, ahead_ns, keeps_time)
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
            self._beyond = 0
            self._notice_again(stamp_ns, odometry_ns, history)

    @property
    def problems(self) -> list[str]:
        """How images and odometry are apart in time, in words."""
        if self._again.among > 1:
            return ['odometry is stamped with times that it had passed: did the clock go back?']
        count, apart_ns = self._apart
        if count < FEW_AHEAD:
            return []
        where = f'{abs(apart_ns) * 1e-9:.0f} s {"ahead of" if apart_ns > 0 else "behind"}'
        return [f'images are stamped {where} the odometry: are the clocks synchronized?']

    def _require_near(self, stamp_ns: int, ahead_ns: int, keeps_time: bool) -> None:
        """One stamp far ahead is an error; several in a row that agree are a pause. An image of
        another clock would make all odometry that follows too old, so that some in a row are used
        where no odometry comes between them, which then has ended.
        """
        if ahead_ns > JUMP_NS:
            last_ns, count = self._ahead
            self._ahead = (stamp_ns, count + 1 if abs(stamp_ns - last_ns) <= JUMP_NS else 1)
            if self._ahead[1] < FEW_AHEAD:
                raise DataError('stamp far ahead')
        if keeps_time or ahead_ns > JUMP_NS:
            self._ahead = (0, 0)
        if not keeps_time and ahead_ns > HISTORY_NS:
            self._beyond += 1
            if self._beyond < FEW_AHEAD:
                raise DataError('stamp ahead of the odometry')

    def _notice_again(
        self, stamp_ns: int, newest_ns: int | None, history: History[Event, Belief]
    ) -> None:
        """Odometry that covers once more, in order, what other odometry covered before it, means
        that the clock went back; what fills a hole, or comes out of order, was held up.
        """
        again = self._again
        if newest_ns is None or stamp_ns > newest_ns:
            self._again = _Again()
        elif stamp_ns < again.last_ns or again.last_ns == 0:
            self._again = _Again(0, stamp_ns, stamp_ns)
        else:
            passed = (history.before(stamp_ns).odometry_ns or 0) > again.last_ns
            self._again = _Again(again.among + passed, again.first_ns, stamp_ns)
            if self._again.among >= FEW_BEHIND and stamp_ns - again.first_ns >= _AGAIN_NS:
                raise ClockWentBack
