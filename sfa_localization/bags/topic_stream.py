# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A topic as a stream of stamped values in order of stamp; every rejected message is counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from sfa_localization.data.errors import BagError, LocalizationError
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
        last = self._last
        if last is not None and self._suspect is None and item.stamp_ns > last.stamp_ns:
            moved, received = item.stamp_ns - last.stamp_ns, item.receive_ns - last.receive_ns
            if -CLOCK_JUMP_NS <= moved - received <= CLOCK_JUMP_NS:
                self._last = item  # the usual case, kept short because it runs per message
                return [item]
        return self._judge(item)

    def _judge(self, item: Item) -> list[Item]:
        if item.stamp_ns <= 0:
            self._tally.skip(NO_STAMP)
            return []
        suspect, self._suspect = self._suspect, None
        if _continues(self._last, item):
            self._drop(suspect)
            return self._in_order(item)
        if _continues(self._behind, item) and not self._ahead(item):
            self._behind = item
            self._tally.skip('clock was set back')
            return []
        if suspect is not None and _continues(suspect, item):
            return self._after_clock_was_set(suspect, item)
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

    def _after_clock_was_set(self, suspect: Item, item: Item) -> list[Item]:
        if self._ahead(suspect):
            return [*self._in_order(suspect), *self._in_order(item)]
        self._behind = item
        self._tally.skip('clock was set back', 2)
        return []

    def _in_order(self, item: Item) -> list[Item]:
        if self._ahead(item):
            self._last = item
            return [item]
        same = self._last is not None and item.stamp_ns == self._last.stamp_ns
        self._tally.skip('duplicate stamp' if same else 'stamp out of order')
        return []


def _continues(before: Item | None, after: Item) -> bool:
    """Whether stamps and receptions differ by about the same time between two messages."""
    if before is None:
        return False
    moved, received = after.stamp_ns - before.stamp_ns, after.receive_ns - before.receive_ns
    return abs(moved - received) <= CLOCK_JUMP_NS


class Stream:
    """One topic being read.

    `select` picks the part of a message that matters, or None, and `convert` turns that part into
    a value. Messages of an opaque stream are not decoded: their value is None.
    """

    def __init__(
        self,
        topic: str,
        select: Callable[[Any], Any],
        convert: Callable[[Any], Any],
        tally: Tally,
    ) -> None:
        self.topic, self.select, self.tally = topic, select, tally
        self.received, self.required, self.opaque = 0, True, False
        self._convert, self._stamps = convert, StampFilter(tally)

    def push(self, stamp_ns: int, receive_ns: int, part: Any) -> list[tuple[int, Any]]:
        """Stamps and values from this message and from one that was held back."""
        try:
            item = Item(stamp_ns, receive_ns, self._convert(part))
        except LocalizationError as error:
            self.tally.skip(str(error))
            return []
        return self._used(self._stamps.push(item))

    def flush(self) -> list[tuple[int, Any]]:
        """The rest, when the topic has ended."""
        return self._used(self._stamps.flush())

    def _used(self, items: list[Item]) -> list[tuple[int, Any]]:
        self.tally.use(len(items))
        return [(item.stamp_ns, item.value) for item in items]
