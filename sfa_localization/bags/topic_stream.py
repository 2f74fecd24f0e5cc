# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A topic as a stream of stamped values in order of stamp; every rejected message is counted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from sfa_localization.data.errors import BagError
from sfa_localization.data.messages import NO_STAMP
from sfa_localization.data.rejections import RejectionCounter
from sfa_localization.data.run import Count

CLOCK_JUMP_NS = 10_000_000_000
"""A stamp that moved this much (10 s) more or less than the time of reception is a jump of the
sender's clock: queues and networks delay a message by less."""


class Tally:
    """Counts used messages, and rejected ones by reason; in strict reading these are errors."""

    def __init__(self, where: str, strict: bool) -> None:
        self._where, self._strict = where, strict
        self._used = 0
        self._skipped = RejectionCounter()

    def use(self, number: int = 1) -> None:
        self._used += number

    def skip(self, reason: str, number: int = 1) -> None:
        """Count messages that are faulty."""
        if self._strict:
            raise BagError(f'{self._where}: {reason}; read without --strict to skip such messages')
        self._skipped.add(reason, number)

    def leave_out(self, reason: str, number: int = 1) -> None:
        """Count messages that are left out although nothing is wrong with them."""
        if number:
            self._skipped.add(reason, number)

    def withdraw(self, reason: str, number: int) -> None:
        """Count messages, used so far, as left out."""
        self._used -= number
        self.leave_out(reason, number)

    @property
    def count(self) -> Count:
        return Count(self._used, dict(self._skipped))


class Item(NamedTuple):
    """A message on its way: its stamp, its reception, and the value read from it."""

    stamp_ns: int
    receive_ns: int
    value: Any

    def continues(self, before: Item | None) -> bool:
        """Whether stamps and receptions differ by about the same time from one before."""
        if before is None:
            return False
        moved, received = self.stamp_ns - before.stamp_ns, self.receive_ns - before.receive_ns
        return -CLOCK_JUMP_NS <= moved - received <= CLOCK_JUMP_NS


class StampFilter:
    """Passes messages in strictly increasing order of stamp, and detects a clock that was set.

    A stamp that moved by CLOCK_JUMP_NS more or less than the time of reception is a jump. It is
    accepted only when the next message continues from it: a single one is skipped, a lasting one
    is a clock that was set; after a clock was set back, messages are skipped until it has caught
    up. One message may be held back, so call `flush` at the end.
    """

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._last: Item | None = None
        self._suspect: Item | None = None
        self._behind: Item | None = None

    def push(self, item: Item) -> list[Item]:
        """Messages that can be used now."""
        if item.stamp_ns <= 0:
            self._tally.skip(NO_STAMP)
            return []
        suspect, self._suspect = self._suspect, None
        if item.continues(self._last):
            self._drop(suspect)
            return self._in_order(item)
        if item.continues(self._behind) and not self._ahead(item):
            self._behind = item
            self._tally.skip('clock was set back')
            return []
        if suspect is not None and item.continues(suspect):
            if self._ahead(suspect):
                return [*self._in_order(suspect), *self._in_order(item)]
            self._behind = item
            self._tally.skip('clock was set back', 2)
            return []
        self._drop(suspect)
        self._suspect = item
        return []

    def flush(self) -> list[Item]:
        """The message held back; it is used only when nothing came before it."""
        suspect, self._suspect = self._suspect, None
        if suspect is not None and self._last is None:
            return self._in_order(suspect)
        self._drop(suspect)
        return []

    def _ahead(self, item: Item) -> bool:
        return self._last is None or item.stamp_ns > self._last.stamp_ns

    def _drop(self, suspect: Item | None) -> None:
        if suspect is not None:
            self._tally.skip('stamp jumps')

    def _in_order(self, item: Item) -> list[Item]:
        if self._ahead(item):
            self._last = item
            return [item]
        same = self._last is not None and item.stamp_ns == self._last.stamp_ns
        self._tally.skip('duplicate stamp' if same else 'stamp out of order')
        return []


@dataclass(eq=False)
class Stream:
    """One topic being read.

    `select` picks the part of a message that matters, or None, and `convert` turns that part into
    a value. Messages of an opaque stream are not decoded: their value is None. Without a usable
    message a `required` one is an error.
    """

    topic: str
    select: Callable[[Any], Any]
    convert: Callable[[Any], Any]
    tally: Tally
    received: int = 0
    required: bool = True
    opaque: bool = False

    def __post_init__(self) -> None:
        self.stamps = StampFilter(self.tally)
