# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A node's record of its inputs: rates, latencies, rejections. Bounded memory."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

from sfa_localization.data.rejections import RejectionCounter

_WINDOW = 500


def steady_s() -> float:
    """Seconds of a clock that never steps: wall time and simulated time may."""
    return time.monotonic()


class Monitor:
    """Counts of messages received, used, and rejected by reason; latency of the last messages."""

    def __init__(self) -> None:
        self.received = 0
        self.used = 0
        self.refused = RejectionCounter()
        self.last_received_s: float | None = None
        self._arrivals: deque[float] = deque(maxlen=_WINDOW)
        self._latencies: deque[float] = deque(maxlen=_WINDOW)

    def receive(self) -> float:
        """Note an arrival; returns its steady time in seconds, for `use`."""
        now = steady_s()
        self.received += 1
        self.last_received_s = now
        self._arrivals.append(now)
        return now

    def use(self, received_s: float | None = None) -> None:
        """Note that the message that arrived at `received_s` has been processed by now."""
        self.used += 1
        if received_s is not None:
            self._latencies.append(steady_s() - received_s)

    def refuse(self, reason: str) -> int:
        """Count a rejection; returns how many of this reason there have been."""
        return self.refused.add(reason)

    def silent_for_s(self) -> float:
        """Seconds since the last arrival; infinite before the first."""
        if self.last_received_s is None:
            return float('inf')
        return steady_s() - self.last_received_s

    def rate_hz(self) -> float:
        """Arrivals per second over the window; 0 with fewer than two."""
        if len(self._arrivals) < 2:
            return 0.0
        span = max(steady_s(), self._arrivals[-1]) - self._arrivals[0]
        return (len(self._arrivals) - 1) / max(span, 1e-9)

    def latency_ms(self, percent: float) -> float:
        """Percentile of the time from arrival to completion; 0 where there was none."""
        if not self._latencies:
            return 0.0
        return float(np.percentile(self._latencies, percent) * 1e3)

    def values(self, prefix: str = '') -> dict[str, str]:
        """Names and texts for a diagnostic status."""
        texts = {
            f'{prefix}received': str(self.received),
            f'{prefix}used': str(self.used),
            f'{prefix}rate [Hz]': f'{self.rate_hz():.1f}',
            f'{prefix}latency p50 [ms]': f'{self.latency_ms(50):.2f}',
            f'{prefix}latency p99 [ms]': f'{self.latency_ms(99):.2f}',
        }
        # Copied, because the thread of a feed may add to it meanwhile.
        refused = sorted(dict(self.refused).items())
        texts.update({f'{prefix}refused: {why}': str(n) for why, n in refused})
        return texts
