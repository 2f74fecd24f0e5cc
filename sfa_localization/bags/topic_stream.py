# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A topic as a stream of stamped values in order of stamp; every rejected message is counted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sfa_localization.bags.motion_arrays import StampedValues
from sfa_localization.camera.video import ImageReader
from sfa_localization.data.errors import BagError, LocalizationError
from sfa_localization.data.events import CLOCK_JUMP_NS, CLOCK_RANGE_S, clock_difference, whole_leap
from sfa_localization.data.messages import NO_STAMP
from sfa_localization.data.rejections import RejectionCounter
from sfa_localization.data.run import Count


class Item(NamedTuple):
    """A message: its stamp, its reception, and its value."""

    stamp_ns: int
    receive_ns: int
    value: Any

    def late_ns(self, before: Item) -> int:
        """Step of the stamp minus the step of the reception since a message before."""
        return self.stamp_ns - before.stamp_ns - (self.receive_ns - before.receive_ns)

    def continues(self, before: Item) -> bool:
        """Whether stamp and reception have moved alike since a message before."""
        return abs(self.late_ns(before)) <= CLOCK_JUMP_NS

    def corrects(self, ahead: Item, before: Item | None) -> bool:
        """Whether this stamp is more plausible than the later one of the previous message."""
        if before is None or self.stamp_ns == ahead.stamp_ns:
            return self.stamp_ns < ahead.stamp_ns
        later = self.stamp_ns > before.stamp_ns
        return later and abs(self.late_ns(before)) < abs(ahead.late_ns(before))


@dataclass(eq=False)
class Stream:
    """One topic being read, with the number of used messages, and of skipped ones by reason.

    `convert` makes a value of a message, of its transform to `frame`, or of an image of a `wanted`
    stamp that `images` reads. Messages of an opaque stream are not decoded: their value is None.
    `strict` raises for a faulty message; a `required` stream must have a usable message. A stream
    that is collected has `values`, of used messages by stamp: what `keep` returns of them. A used
    message becomes what `passes` returns, by default itself; the end of the topic what `ends` does.

    Messages pass in increasing order of stamp, each when the next one has come. A single stamp that
    is ahead of the next is skipped, as is a jump that the next does not continue; a lasting jump is
    a clock that was set. After a clock was set back, messages are skipped until it has caught up.
    """

    bag: Path
    topic: str
    convert: Callable[[Any], Any]
    strict: bool
    frame: str | None = None
    images: ImageReader | None = None
    wanted: Callable[[int], bool] = lambda stamp_ns: True
    keep: Callable[[Any], Any] = lambda value: value
    passes: Callable[[Item], Iterable[Used]] | None = None
    ends: Callable[[], Iterable[Used]] = list
    required: bool = True
    opaque: bool = False
    received: int = 0
    used: int = 0
    skipped: RejectionCounter = field(default_factory=RejectionCounter)
    values: StampedValues = field(default_factory=list)
    _last: Item | None = None
    _waiting: Item | None = None
    _ahead_ns: list[int] = field(default_factory=list)

    @property
    def count(self) -> Count:
        return Count(self.used, dict(self.skipped))

    @property
    def ahead_ns(self) -> tuple[float, float]:
        """Median of how far stamps are ahead of the reception, and range of the middle 80 %."""
        low, middle, high = np.percentile(self._ahead_ns or [0], (10, 50, 90))
        return float(middle), float(high - low)

    def skip(self, reason: str) -> None:
        """Count a message that is faulty. Raises BagError in strict reading."""
        if self.strict:
            raise BagError(f'{self.bag}: {self.topic}: {reason}; '
                           'read without --strict to skip such messages')  # fmt: skip
        self.skipped.add(reason)

    def take(self, parts: Iterable[tuple[int, Any]], receive_ns: int) -> Iterator[Used]:
        """Use the values of messages or images with their stamps; faulty ones are counted."""
        for stamp_ns, part in parts:
            try:
                if isinstance(part, LocalizationError):
                    raise part
                item = Item(stamp_ns, receive_ns, part if self.opaque else self.convert(part))
            except LocalizationError as error:
                self.skip(str(error))
            else:
                yield from self.push(item)

    def push(self, item: Item) -> list[Used]:
        """The message to be used now, if any; the latest is held back until `flush`."""
        waiting = self._waiting
        last = self._last
        before = waiting or last
        if item.stamp_ns <= 0:
            self.skip(NO_STAMP)
        elif before is None or item.stamp_ns > before.stamp_ns:
            self._waiting = item
            return self._settled(waiting, item)
        elif waiting and item.corrects(waiting, last):
            self._waiting = item
            self.skip('stamp jumps')
        else:
            same = item.stamp_ns == before.stamp_ns
            sound = item.continues(before)
            other = 'stamp out of order' if sound else 'clock was set back'
            self.skip('duplicate stamp' if same else other)
        return []

    def flush(self) -> list[Used]:
        """The message held back."""
        waiting = self._waiting
        self._waiting = None
        return self._settled(waiting, None)

    def _settled(self, waiting: Item | None, following: Item | None) -> list[Used]:
        """The message held back, if it continues the last one or is continued by the following."""
        if waiting is None:
            return []
        continuing = waiting.continues(self._last) if self._last else True
        if not continuing and not (following and following.continues(waiting)):
            self.skip('stamp jumps')
            return []
        self._last = waiting
        self._ahead_ns.append(waiting.stamp_ns - waiting.receive_ns)
        self.used += 1
        if self.passes is not None:
            return list(self.passes(waiting))
        return [(self, waiting.stamp_ns, waiting.value)]


Used = tuple[Stream, int, Any]
"""A stream, with the stamp, ns, and the value of a message."""
# Uses of topics whose messages are sent when measured, in words.
_STAMPED_AT_ONCE = {'images': 'images', 'imu': 'gyroscope', 'orientation': 'orientation',
                    'ground_truth': 'ground truth'}  # fmt: skip


def by_one_clock(streams: Mapping[str, Stream]) -> list[str]:
    """Stamp the values of streams, by their use, by the clock of the odometry; return sentences
    about what was corrected.
    """
    texts = []
    for use, name in _STAMPED_AT_ONCE.items():
        if stream := streams.get(use):
            ahead_ns, text = clock_offset(name, stream, streams['odometry'])
            stream.values = [(stamp_ns - ahead_ns, value) for stamp_ns, value in stream.values]
            texts.append(text)
    return [text for text in texts if text]


def clock_offset(name: str, stream: Stream, odometry: Stream) -> tuple[int, str]:
    """By how much, ns, a stream's stamps are ahead of those of the odometry by the reception of
    both, and a sentence; 0 and '' for less than turns show, and for bags that do not hold the times
    of reception; 0 also for what queues may have delayed.
    """
    ahead, spread = stream.ahead_ns
    other, other_spread = odometry.ahead_ns
    offset_ns = whole_leap(ahead - other)
    range_ns = CLOCK_RANGE_S * 1e9
    # If a bag holds no times of reception, stamps are ahead by the length of the drive.
    if abs(offset_ns) <= max(range_ns, spread, other_spread):
        return 0, ''
    difference = clock_difference(offset_ns, stream.topic, odometry.topic)
    text = f'{name}: {difference}, by their reception'
    if min(ahead, other) > -CLOCK_JUMP_NS and max(ahead, other) < range_ns:
        return 0, f'{text}: delayed, or by another clock? not corrected'
    return offset_ns, f'{text}: taken into account'
