# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The pace of a replay: a clock with a rate, pauses and steps, and the keys that control it."""

from __future__ import annotations

import math
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sfa_localization.data.settings import Settings, setting

PAUSE, STEP, FASTER, SLOWER = 'pause', 'step', 'faster', 'slower'
KEYS = {b' ': PAUSE, b's': STEP, b'\x1b[C': STEP, b'\x1b[A': FASTER, b'\x1b[B': SLOWER}


@dataclass(frozen=True, slots=True)
class PlayConfig(Settings):
    """How a bag is replayed."""

    rate: float = setting(1.0, 'speed of the replay', unit='x', low=1e-3, high=1e6)
    start_offset: float = setting(0.0, 'begin this far into the bag', unit='s', low=0.0, high=1e9)
    wait: float = setting(
        20.0,
        'longest wait for subscribers of images and odometry before the start',
        unit='s',
        low=0.0,
        high=3600.0,
    )


class Pace:
    """The time of the bag (ns) as a function of a steady clock (seconds)."""

    def __init__(
        self, start_ns: int, rate: float, now: Callable[[], float] = time.monotonic
    ) -> None:
        self.rate, self.paused = rate, False
        self._now = now
        self._bag_ns, self._since = start_ns, now()

    @property
    def time_ns(self) -> int:
        """Time of the bag now."""
        if self.paused:
            return self._bag_ns
        return self._bag_ns + int((self._now() - self._since) * self.rate * 1e9)

    def delay(self, stamp_ns: int) -> float:
        """Seconds until the bag's time is `stamp_ns`; infinite while paused."""
        if self.paused:
            return math.inf
        return (stamp_ns - self._bag_ns) * 1e-9 / self.rate - (self._now() - self._since)

    def jump(self, stamp_ns: int) -> None:
        """Set the bag's time."""
        self._bag_ns, self._since = stamp_ns, self._now()

    def toggle_pause(self) -> None:
        """Pause, or continue from there."""
        self.jump(self.time_ns)
        self.paused = not self.paused

    def scale(self, factor: float) -> None:
        """Multiply the rate."""
        self.jump(self.time_ns)
        self.rate *= factor


class Keyboard:
    """Context manager that reads single keys if standard input is a foreground terminal."""

    def __init__(self, descriptor: int | None = None) -> None:
        self._descriptor = descriptor
        self._saved: list[Any] | None = None

    def __enter__(self) -> Keyboard:
        if self._descriptor is None:
            self._descriptor = _foreground_terminal()
        if self._descriptor is not None:
            self._saved = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor)
        return self

    def __exit__(self, *_error: object) -> None:
        if self._descriptor is not None and self._saved is not None:
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._saved)

    @property
    def attached(self) -> bool:
        """Whether keys can be read."""
        return self._descriptor is not None

    def read(self, timeout: float) -> str:
        """The action of a key pressed within `timeout` seconds, or ''."""
        if self._descriptor is None:
            time.sleep(timeout)
            return ''
        ready, _, _ = select.select([self._descriptor], [], [], timeout)
        if not ready:
            return ''
        data = os.read(self._descriptor, 8)
        if not data:  # the terminal was closed
            self._descriptor = None
        return KEYS.get(data, '')


def _foreground_terminal() -> int | None:
    """Descriptor of standard input if it is a terminal and this process is in its foreground."""
    try:
        descriptor = sys.stdin.fileno()
        if os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp():
            return descriptor
    except (OSError, ValueError, AttributeError):  # there is no standard input
        pass
    return None
