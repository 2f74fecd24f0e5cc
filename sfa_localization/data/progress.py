# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Progress of long work, on standard error: a bar on a terminal, a line now and then in a log."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from tqdm import tqdm

LOG_PERIOD_S = 10.0
"""Time between two lines in a log: hours of work leave some hundred lines."""
T = TypeVar('T')


class _Log:
    """Standard error as tqdm writes to it, but a line for each state of the bar."""

    def write(self, text: str) -> None:
        if line := text.strip():
            sys.stderr.write(f'{line}\n')

    def flush(self) -> None:
        sys.stderr.flush()


def _bar(items: Iterable[T] | None, desc: str, total: int | None, unit: str, **options: Any) -> Any:
    if not options.get('disable') and not sys.stderr.isatty():
        done = (
            '{percentage:.0f}% of {total_fmt}{unit}, {remaining_s:.0f} s left'
            if total
            else '{n_fmt}{unit}'
        )
        options |= {'file': _Log(), 'bar_format': f'{{desc}}: {done}', 'leave': False}
        options |= {'mininterval': LOG_PERIOD_S, 'delay': LOG_PERIOD_S, 'miniters': 1}
    return tqdm(items, desc, total, unit=f' {unit}', **options)


def progress_bar(
    desc: str, total: int | None = None, unit: str = 'images', initial: int = 0, *, visible: bool
) -> Any:
    """A context manager with `update(n)`, `n` and `total`; if not `visible`, it counts silently."""
    return _bar(None, desc, total, unit, initial=initial, disable=not visible)


def progress_over(
    items: Iterable[T], desc: str, total: int | None = None, unit: str = 'images', *, visible: bool
) -> Iterator[T]:
    """The items, with the progress through them."""
    return iter(_bar(items, desc, total, unit, disable=not visible))


def announce(text: str, *, visible: bool) -> None:
    """Say what begins, in a line of its own."""
    if visible:
        sys.stderr.write(f'{text}\n')
