# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Progress of long work, on standard error: a bar on a terminal, a line now and then in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from tqdm import tqdm

LOG_PERIOD_S = 10.0
"""Time between two lines in a log: hours of work leave some hundred lines."""
T = TypeVar('T')


class LogLines:
    """Counts work, and writes how much of it is done each LOG_PERIOD_S; short work writes nothing.

    With the few methods of tqdm's bars that are used here.
    """

    def __init__(self, desc: str, total: int | None, unit: str, initial: int = 0) -> None:
        self.desc, self.total, self.unit, self.n = desc, total, unit, initial
        self._first, self._start_s = initial, time.monotonic()
        self._next_s = self._start_s + LOG_PERIOD_S

    def __enter__(self) -> LogLines:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def update(self, n: int = 1) -> None:
        """So much more is done."""
        self.n += n
        now_s = time.monotonic()
        if now_s >= self._next_s:
            self._next_s = now_s + LOG_PERIOD_S
            announce(self.line(now_s - self._start_s), shown=True)

    def over(self, items: Iterable[T]) -> Iterator[T]:
        """The items; each that has been dealt with counts."""
        for item in items:
            yield item
            self.update()

    def line(self, seconds: float) -> str:
        """What is done after so many seconds, and how long the rest takes at this pace."""
        if not self.total:
            return f'{self.desc}: {self.n} {self.unit}'
        left_s = seconds * (self.total - self.n) / max(self.n - self._first, 1)
        share = self.n / self.total
        return f'{self.desc}: {share:.0%} of {self.total} {self.unit}, {left_s:.0f} s left'


def progress_bar(
    desc: str, total: int | None = None, unit: str = 'images', initial: int = 0, *, shown: bool
) -> Any:
    """A context manager with `update(n)`, `n` and `total`; not `shown`, it counts silently."""
    if shown and not sys.stderr.isatty():
        return LogLines(desc, total, unit, initial)
    return tqdm(desc=desc, total=total, unit=f' {unit}', initial=initial, disable=not shown)


def progress_over(
    items: Iterable[T], desc: str, total: int | None = None, unit: str = 'images', *, shown: bool
) -> Iterator[T]:
    """The items, with the progress through them."""
    if shown and not sys.stderr.isatty():
        return LogLines(desc, total, unit).over(items)
    return iter(tqdm(items, desc, total, unit=f' {unit}', disable=not shown))


def announce(text: str, *, shown: bool) -> None:
    """Say what begins, in a line of its own."""
    if shown:
        sys.stderr.write(f'{text}\n')
        sys.stderr.flush()
