# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A node's record of its inputs: rates, latencies, rejections. Bounded memory."""

from __future__ import annotations

import math
import time
from collections import deque

from sfa_localization.data.rejections import RejectionCounter

_WINDOW = 500


def steady_s() -> float:
    """Seconds of a clock that never steps: wall time and simulated time may."""
    return time.monotonic()


class Monitor:
    """Counts of messages received, used, and rejected by reason; latency of the last messages, and
    how long, `waited_s`, the last one had waited to be taken.
    """

    def __init__(self) -> None:
        self.received = self.used = 0
        self.waited_s = 0.0
        self.refused = RejectionCounter()
        self._arrivals_s: deque[float] = deque(maxlen=_WINDOW)
        self._latencies_s: deque[float] = deque(maxlen=_WINDOW)

    def receive(self) -> None:
        """Count a message that has arrived."""
        self.received += 1
        self._arrivals_s.append(steady_s())

    def use(self) -> None:
        """Count the last message as used, and note the time since it arrived."""
        self.used += 1
        self._latencies_s.append(steady_s() - self._arrivals_s[-1])

    def silent_for_s(self) -> float:
        """Seconds since the last arrival; infinite before the first."""
        return steady_s() - self._arrivals_s[-1] if self._arrivals_s else math.inf

    def values(self, prefix: str = '') -> dict[str, str]:
        """Names and texts for a diagnostic status: counts, arrivals per second over the window, and
        percentiles of the time from arrival to completion.
        """
        span_s = steady_s() - self._arrivals_s[0] if self._arrivals_s else 0.0
        rate_hz = max(len(self._arrivals_s) - 1, 0) / max(span_s, 1e-9)
        taken_ms = sorted(1e3 * latency_s for latency_s in self._latencies_s) or [0.0]
        p50, p99 = (taken_ms[round(part * (len(taken_ms) - 1))] for part in (0.5, 0.99))
        texts = {
            f'{prefix}received': str(self.received),
            f'{prefix}used': str(self.used),
            f'{prefix}rate [Hz]': f'{rate_hz:.1f}',
            f'{prefix}latency p50 [ms]': f'{p50:.2f}',
            f'{prefix}latency p99 [ms]': f'{p99:.2f}',
        }
        # Copied, because the thread of a feed may add to it meanwhile.
        refused = sorted(dict(self.refused).items())
        texts.update({f'{prefix}refused: {why}': str(n) for why, n in refused})
        return texts
