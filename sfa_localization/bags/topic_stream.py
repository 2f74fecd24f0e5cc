# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A topic as a stream of values in order of stamp, with a count of all that was left out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from sfa_localization.data.errors import BagError, LocalizationError
from sfa_localization.data.messages import NO_STAMP
from sfa_localization.data.rejections import RejectionCounter
from sfa_localization.data.run import Count


class Tally:
    """Counts used messages, and skipped ones by reason; in strict reading a skip is an error."""

    def __init__(self, where: str, strict: bool) -> None:
        self._where, self._strict = where, strict
        self._used = 0
        self._skipped = RejectionCounter()

    def use(self, number: int = 1) -> None:
        self._used += number

    def skip(self, reason: str, number: int = 1) -> None:
        """Count messages left out because they are faulty."""
        if self._strict:
            raise BagError(f'{self._where}: {reason}; read without --strict to skip such messages')
        self._skipped.add(reason, number)

    def leave(self, reason: str, number: int = 1) -> None:
        """Count messages left out though nothing is wrong with them."""
        if number:
            self._skipped.add(reason, number)

    def unuse(self, reason: str, number: int) -> None:
        """Count messages, used so far, as left out."""
        self._used -= number
        self.leave(reason, number)

    @property
    def count(self) -> Count:
        return Count(self._used, dict(self._skipped))


class Item(NamedTuple):
    """A message on its way: the stamp it is filed under, its reception, what it tells."""

    stamp_ns: int
    receive_ns: int
    value: Any


class StampFilter:
    """Lets messages through in strictly increasing order of stamp, and a clock that was set.

    A stamp that moved by `jump_ns` more or less than the time of reception is a jump. It is
    believed only when the next message goes on from it: a lone one is skipped, a lasting one
    was a clock being set; what comes after a clock was set back is skipped until it has caught
    up. One message may be held back, so ask `flush` for it at the end.
    """

    def __init__(self, jump_ns: int, tally: Tally) -> None:
        self._jump_ns, self._tally = jump_ns, tally
        self._last: Item | None = None
        self._suspect: Item | None = None
        self._behind: Item | None = None

    def push(self, item: Item) -> list[Item]:
        """Messages that can be used now."""
        last = self._last
        if last is not None and self._suspect is None and item.stamp_ns > last.stamp_ns:
            moved, received = item.stamp_ns - last.stamp_ns, item.receive_ns - last.receive_ns
            if -self._jump_ns <= moved - received <= self._jump_ns:
                self._last = item  # the usual case, without detours
                return [item]
        return self._judge(item)

    def _judge(self, item: Item) -> list[Item]:
        if item.stamp_ns <= 0:
            self._tally.skip(NO_STAMP)
            return []
        suspect, self._suspect = self._suspect, None
        if self._follows(self._last, item):
            self._drop(suspect)
            return self._in_order(item)
        if self._follows(self._behind, item) and not self._ahead(item):
            self._behind = item
            self._tally.skip('clock was set back')
            return []
        if self._follows(suspect, item):
            return self._after_clock_was_set(suspect, item)
        self._drop(suspect)
        self._suspect = item
        return []

    def flush(self) -> list[Item]:
        """What was held back; of use only when nothing came before it."""
        suspect, self._suspect = self._suspect, None
        if suspect is not None and self._last is None:
            return self._in_order(suspect)
        self._drop(suspect)
        return []

    def _follows(self, before: Item | None, after: Item) -> bool:
        """Whether both clocks tell about the same time between two messages."""
        if before is None:
            return False
        moved, received = after.stamp_ns - before.stamp_ns, after.receive_ns - before.receive_ns
        return abs(moved - received) <= self._jump_ns

    def _ahead(self, item: Item) -> bool:
        return self._last is None or item.stamp_ns > self._last.stamp_ns

    def _drop(self, suspect: Item | None) -> None:
        if suspect is not None:
            self._tally.skip('stamp jumps')

    def _after_clock_was_set(self, suspect: Item | None, item: Item) -> list[Item]:
        first = [] if suspect is None else [suspect]
        if all(self._ahead(entry) for entry in first):
            return [passed for entry in (*first, item) for passed in self._in_order(entry)]
        self._behind = item
        self._tally.skip('clock was set back', len(first) + 1)
        return []

    def _in_order(self, item: Item) -> list[Item]:
        if self._ahead(item):
            self._last = item
            return [item]
        same = self._last is not None and item.stamp_ns == self._last.stamp_ns
        self._tally.skip('duplicate stamp' if same else 'stamp out of order')
        return []


class Stream:
    """One topic being read.

    `select` picks the part of a message that matters, or None, and `convert` turns that into a
    value. Of an opaque one messages are not decoded: they are None.
    """

    def __init__(
        self,
        topic: str,
        select: Callable[[Any], Any],
        convert: Callable[[Any], Any],
        stamps: StampFilter,
        tally: Tally,
    ) -> None:
        self.topic, self.select, self.tally = topic, select, tally
        self.received, self.required, self.opaque = 0, True, False
        self._convert, self._stamps = convert, stamps

    def push(self, stamp_ns: int, receive_ns: int, part: Any) -> list[tuple[int, Any]]:
        """Stamps and values that the message, with one held back, gives."""
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
