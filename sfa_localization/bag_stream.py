# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A topic as a stream of values in order of stamp, with a count of all that was left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

from sfa_localization.errors import BagError, LocalizationError
from sfa_localization.run import Count


class Tally:
    """Counts used messages, and skipped ones by reason; in strict reading a skip is an error."""

    def __init__(self, where: str, strict: bool) -> None:
        self._where, self._strict = where, strict
        self._used = 0
        self._skipped: Counter[str] = Counter()

    def use(self, number: int = 1) -> None:
        self._used += number

    def skip(self, reason: str, number: int = 1) -> None:
        """Count messages left out because they are faulty."""
        if self._strict:
            raise BagError(f'{self._where}: {reason}; read without --strict to skip such messages')
        self._skipped[reason] += number

    def leave(self, reason: str, number: int = 1) -> None:
        """Count messages left out though nothing is wrong with them."""
        if number:
            self._skipped[reason] += number

    def unuse(self, reason: str, number: int) -> None:
        """Count messages, used so far, as left out."""
        self._used -= number
        self.leave(reason, number)

    @property
    def count(self) -> Count:
        return Count(self._used, dict(self._skipped))


class Item(NamedTuple):
    """A message on its way: the stamp it is filed under, its reception, itself."""

    stamp_ns: int
    receive_ns: int
    message: Any


class StampFilter:
    """Lets messages through in strictly increasing order of stamp, and a clock that was set.

    A stamp that moved by `jump_ns` more or less than the time of reception is a jump. It is
    believed only when the next message goes on from it: a lone one is skipped, a lasting one
    was a clock being set. One message may be held back, so ask `flush` for it at the end.
    """

    def __init__(self, jump_ns: int, tally: Tally) -> None:
        self._jump_ns, self._tally = jump_ns, tally
        self._last: Item | None = None
        self._suspect: Item | None = None

    def push(self, item: Item) -> list[Item]:
        """Messages that can be used now."""
        if item.stamp_ns <= 0:
            self._tally.skip('zero stamp')
            return []
        suspect, self._suspect = self._suspect, None
        if self._last is not None and self._follows(self._last, item):
            if suspect is not None:
                self._tally.skip('stamp jumps')
            return self._in_order([item])
        if suspect is not None and self._follows(suspect, item):
            return self._in_order([suspect, item])
        if suspect is not None:
            self._tally.skip('stamp jumps')
        self._suspect = item
        return []

    def flush(self) -> list[Item]:
        """What was held back; of use only when nothing came before it."""
        suspect, self._suspect = self._suspect, None
        if suspect is None:
            return []
        if self._last is None:
            return self._in_order([suspect])
        self._tally.skip('stamp jumps')
        return []

    def _follows(self, before: Item, after: Item) -> bool:
        moved = after.stamp_ns - before.stamp_ns
        return abs(moved - (after.receive_ns - before.receive_ns)) <= self._jump_ns

    def _in_order(self, items: list[Item]) -> list[Item]:
        passed = []
        for item in items:
            last = self._last
            if last is not None and item.stamp_ns == last.stamp_ns:
                self._tally.skip('duplicate stamp')
            elif last is not None and item.stamp_ns < last.stamp_ns:
                self._tally.skip('stamp out of order')
            else:
                self._last = item
                passed.append(item)
        return passed


class Stream:
    """One topic being read: `select` picks the part of a message that matters, or None, and
    `convert` turns that into a value. Of an opaque one messages are not decoded: they are None.
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

    def push(self, item: Item) -> list[tuple[int, Any]]:
        """Stamps and values that the message, with one held back, gives."""
        return self._converted(self._stamps.push(item))

    def flush(self) -> list[tuple[int, Any]]:
        """The rest, when the topic has ended."""
        return self._converted(self._stamps.flush())

    def _converted(self, items: list[Item]) -> list[tuple[int, Any]]:
        values = []
        for item in items:
            try:
                values.append((item.stamp_ns, self._convert(item.message)))
                self.tally.use()
            except LocalizationError as error:
                self.tally.skip(str(error))
        return values
