# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A node's record of its inputs: rates, latencies, rejections. Bounded memory."""

from __future__ import annotations

import math
import time
from collections import deque

import numpy as np

from sfa_localization.data.rejections import RejectionCounter

_WINDOW = 500
RECENT_S = 10.0
"""The images by which the filter judges clocks are about as old."""


def steady_s() -> float:
    """Seconds of a clock that never steps: wall time and simulated time may."""
    return time.monotonic()


class Monitor:
    """Counts of messages received, used, and rejected by reason; latencies of the last messages.

    `waited_s` is how long the last message had waited in the queue of its subscription.
    """

    def __init__(self) -> None:
        self.received = self.used = 0
        self.waited_s = 0.0
        self.refused = RejectionCounter()
        self._arrivals_s: deque[float] = deque(maxlen=_WINDOW)
        self._latencies_s: deque[float] = deque(maxlen=_WINDOW)
        self._waits_s: deque[float] = deque(maxlen=_WINDOW)

    def receive(self, received_ns: int = 0) -> None:
        """Count a message; `received_ns` is when the middleware received it, 0 if unknown."""
        self.received += 1
        self.waited_s = max(time.time_ns() - received_ns, 0) * 1e-9 if received_ns > 0 else 0.0
        self._arrivals_s.append(steady_s())
        self._waits_s.append(self.waited_s)

    def use(self) -> None:
        """Count the last message as used, and note the time since it arrived."""
        self.used += 1
        self._latencies_s.append(steady_s() - self._arrivals_s[-1])

    def longest_wait_s(self) -> float:
        """How long messages that arrived in the last RECENT_S have waited at most, s."""
        since_s = steady_s() - RECENT_S
        waits = zip(list(self._arrivals_s), list(self._waits_s), strict=False)
        return max((wait_s for at_s, wait_s in waits if at_s >= since_s), default=0.0)

    def silent_for_s(self) -> float:
        """Seconds since the last arrival; infinite before the first."""
        return steady_s() - self._arrivals_s[-1] if self._arrivals_s else math.inf

    def values(self, prefix: str = '') -> dict[str, str]:
        """Names and texts for a diagnostic status: counts, arrivals per second over the window, and
        percentiles of the time from arrival to completion.
        """
        span_s = steady_s() - self._arrivals_s[0] if self._arrivals_s else 0.0
        rate_hz = max(len(self._arrivals_s) - 1, 0) / max(span_s, 1e-9)
        p50_s, p99_s = np.percentile(self._latencies_s or [0.0], [50, 99])
        texts = {
            f'{prefix}received': str(self.received),
            f'{prefix}used': str(self.used),
            f'{prefix}rate [Hz]': f'{rate_hz:.1f}',
            f'{prefix}latency p50 [ms]': f'{1e3 * p50_s:.2f}',
            f'{prefix}latency p99 [ms]': f'{1e3 * p99_s:.2f}',
        }
        # Copied, because the thread of a feed may add to it meanwhile.
        refused = sorted(dict(self.refused).items())
        return texts | {f'{prefix}refused: {reason}': str(n) for reason, n in refused}
