# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How the process of a node ends; SIGINT and SIGTERM while ROS does not listen.

That is before it is initialized, and when it has ended. A launch and its terminal both send SIGINT,
at any time. Imports nothing that takes time.
"""

from __future__ import annotations

import os
import signal
from typing import Any

CANNOT_START, DIED = 1, 2
"""Exit codes: a launch ends with a node that cannot start, and starts one again that has died."""
_NUMBERS = (signal.SIGINT, signal.SIGTERM)
_left_to_ros = False


def end_at_once() -> None:
    """End the process with exit code 0 at a signal: nothing has begun that needs an end."""
    for number in _NUMBERS:
        signal.signal(number, _obey)


def leave_to_ros() -> None:
    """Do nothing at a signal from now on: rclpy has its own handlers, which end its context."""
    global _left_to_ros
    _left_to_ros = True


def ignore() -> None:
    """Ignore signals for the rest of the process; Python leaves this so while it ends."""
    for number in _NUMBERS:
        signal.signal(number, signal.SIG_IGN)


def _obey(number: int, frame: Any) -> None:
    if not _left_to_ros:
        os._exit(0)
