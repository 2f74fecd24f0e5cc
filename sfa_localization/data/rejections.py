# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How often each reason was met: bounded, for some reasons quote what a sender wrote."""

from __future__ import annotations

from collections import Counter

LONGEST = 240
"""Characters of a reason."""
MOST = 32
"""Different reasons that are kept apart."""
OTHER = 'other reasons'


class RejectionCounter(Counter[str]):
    """Counts by reason: shortened to LONGEST characters, those after the first MOST together."""

    def add(self, reason: str, number: int = 1) -> int:
        """Count a reason `number` times; returns how often it, or what it is put to, was met."""
        key = short_line(reason)
        if key not in self and len(self) >= MOST:
            key = OTHER
        self[key] += number
        return self[key]


def short_line(text: str) -> str:
    """One printable line of at most LONGEST characters."""
    # Cut first: what a sender wrote may be very long.
    line = ' '.join(text[: 2 * LONGEST].split())
    line = ''.join(letter if letter.isprintable() else '?' for letter in line)
    return line if len(line) <= LONGEST else line[: LONGEST - 3] + '...'
