# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A bounded, sorted history of events, replayed from where a late one belongs.

Beliefs are a pure function of the sorted events: an event that comes late has exactly the effect
that it would have had in time. The beliefs after it are made anew when they are asked for, so that
events far ahead are not replayed for each one that comes.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from typing import Generic, TypeVar

E = TypeVar('E')
B = TypeVar('B')
Key = tuple[int, int]


class History(Generic[E, B]):
    """Events by (stamp_ns, rank), each with the belief after it; `step` makes the next belief.

    `start` is the belief at `start_ns`, before which no event can be placed. Events older than
    `span_ns` can no longer be placed, and are forgotten unless all are to be kept (`keep`).
    """

    def __init__(
        self,
        span_ns: int,
        start: B,
        step: Callable[[B, E], B],
        start_ns: int | None = None,
        keep: bool = False,
    ) -> None:
        self._span_ns = span_ns
        self._step = step
        self._keep = keep
        self._base = start
        self._horizon_ns = start_ns
        self._keys: list[Key] = []
        self.events: list[E] = []
        self._beliefs: list[B] = []

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def newest(self) -> B:
        return self._belief(len(self._keys))

    @property
    def newest_ns(self) -> int | None:
        return self._keys[-1][0] if self._keys else self._horizon_ns

    def last_ns(self, rank: int) -> int | None:
        """The stamp of the newest event of a rank, without making its belief; None without any."""
        return next((stamp_ns for stamp_ns, kind in reversed(self._keys) if kind == rank), None)

    def holds(self, key: Key) -> bool:
        """Whether there is an event of this stamp and rank."""
        at = bisect_left(self._keys, key)
        return self._keys[at : at + 1] == [key]

    def reaches(self, stamp_ns: int) -> bool:
        """Whether an event of this stamp can still be placed."""
        if self._keys and stamp_ns < self._keys[-1][0] - self._span_ns:
            return False
        return self._horizon_ns is None or stamp_ns > self._horizon_ns

    def add(self, key: Key, event: E) -> B:
        """Place an event, after those of the same key. Returns the belief right after it."""
        at = bisect_right(self._keys, key)
        self._keys.insert(at, key)
        self.events.insert(at, event)
        del self._beliefs[at:]
        belief = self._belief(at + 1)
        cut = bisect_left(self._keys, (self._keys[-1][0] - self._span_ns, 0))
        if cut and not self._keep:
            self._base = self._belief(cut)
            self._horizon_ns = self._keys[cut - 1][0]
            del self._keys[:cut], self.events[:cut], self._beliefs[:cut]
        return belief

    def before(self, stamp_ns: int) -> B:
        """The belief after the last event up to the stamp."""
        return self._belief(bisect_right(self._keys, (stamp_ns, 1 << 30)))

    def _belief(self, count: int) -> B:
        """The belief after the first events, as many as `count`; those before it are made too."""
        belief = self._beliefs[-1] if self._beliefs else self._base
        for event in self.events[len(self._beliefs) : count]:
            belief = self._step(belief, event)
            self._beliefs.append(belief)
        return self._beliefs[count - 1] if count else self._base
