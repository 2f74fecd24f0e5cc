# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A topic as a stream of stamped values in order of stamp; every rejected message is counted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from sfa_localization.data.errors import BagError
from sfa_localization.data.messages import NO_STAMP
from sfa_localization.data.rejections import RejectionCounter
from sfa_localization.data.run import Count

CLOCK_JUMP_NS = 10_000_000_000
"""A stamp that moved this much (10 s) more or less than the time of reception is a jump of the
sender's clock: queues and networks delay a message by less."""


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
        return abs(moved - received) <= CLOCK_JUMP_NS


@dataclass(eq=False)
class Stream:
    """One topic being read: the `bag` and its name, the used messages, the others by reason.

    `convert` makes a value of a message, or of its transform to the `frame`, where that is not
    None. Messages of an opaque stream are not decoded: their value is None. In `strict` reading a
    faulty message is an error, and without a usable one a `required` stream always is.

    Messages pass in strictly increasing order of stamp. A jump ahead is accepted only when the next
    message continues from it: a single one is skipped, a lasting one is a clock that was set. After
    a clock was set back, messages are skipped until it has caught up.
    """

    bag: Path
    topic: str
    convert: Callable[[Any], Any]
    strict: bool
    frame: str | None = None
    required: bool = True
    opaque: bool = False
    received: int = 0
    used: int = 0
    skipped: RejectionCounter = field(default_factory=RejectionCounter)
    _last: Item | None = None
    _suspect: Item | None = None

    @property
    def count(self) -> Count:
        return Count(self.used, dict(self.skipped))

    def skip(self, reason: str) -> None:
        """Count a message that is faulty. Raises BagError in strict reading."""
        if self.strict:
            raise BagError(f'{self.bag}: {self.topic}: {reason}; '
                           'read without --strict to skip such messages')  # fmt: skip
        self.skipped.add(reason)

    def push(self, item: Item) -> list[Item]:
        """Messages that can be used now; one may be held back, so call `flush` at the end."""
        if item.stamp_ns <= 0:
            self.skip(NO_STAMP)
            return []
        suspect, self._suspect = self._suspect, None
        sound, last = item.continues(self._last), self._last
        if suspect is not None and not sound and item.continues(suspect):
            self._last = suspect
            return [suspect, *self._in_order(item)]
        if suspect is not None:
            self.skip('stamp jumps')
        if sound or (last is not None and item.stamp_ns <= last.stamp_ns):
            return self._in_order(item)
        self._suspect = item
        return []

    def flush(self) -> list[Item]:
        """The message held back; it is used only when nothing came before it."""
        if self._suspect is None:
            return []
        if self._last is None:
            return self._in_order(self._suspect)
        self.skip('stamp jumps')
        return []

    def _in_order(self, item: Item) -> list[Item]:
        if self._last is None or item.stamp_ns > self._last.stamp_ns:
            self._last = item
            return [item]
        same, sound = item.stamp_ns == self._last.stamp_ns, item.continues(self._last)
        other = 'stamp out of order' if sound else 'clock was set back'
        self.skip('duplicate stamp' if same else other)
        return []
