# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Rejections counted by reason, in bounded memory, because some reasons quote the sender."""

from __future__ import annotations

from collections import Counter

LONGEST = 240
"""Characters of a reason: two lines of a terminal."""
MOST = 32
"""Different reasons that are counted one by one."""
OTHER = 'other reasons'


class RejectionCounter(Counter[str]):
    """Counts by reason, cut to LONGEST characters; reasons after the first MOST share one count."""

    def add(self, reason: str, number: int = 1) -> int:
        """Count a reason `number` times; returns its count, or that of OTHER where it is summed."""
        key = short_line(reason)
        if key not in self and len(self) >= MOST:
            key = OTHER
        self[key] += number
        return self[key]


def short_line(text: str) -> str:
    """One printable line of at most LONGEST characters."""
    line = ' '.join(text[: 2 * LONGEST].split())  # the text may be very long
    line = ''.join(letter if letter.isprintable() else '?' for letter in line)
    return line if len(line) <= LONGEST else line[: LONGEST - 3] + '...'


def encodable(text: str) -> str:
    """The text in UTF-8; bytes of file names that are not UTF-8 become \\udcff."""
    return text.encode(errors='backslashreplace').decode()


def quoted(value: object) -> str:
    """The repr of any value, in one line of bounded length."""
    return short_line(repr(value))


def listed(names: list[str], most: int = 8) -> str:
    """Names for an error message."""
    return ', '.join(names[:most] + ['...'] * (len(names) > most))
