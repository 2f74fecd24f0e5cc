# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How the process of a node begins and ends: its executable, --help, exit codes, and signals.

A launch and its terminal both send SIGINT, at any time: also before ROS is there to listen, and
when it has ended. Imports nothing that takes time, and no ROS.
"""

from __future__ import annotations

import importlib
import os
import re
import signal
import sys
import textwrap
from collections.abc import Sequence
from functools import partial
from typing import Any

NODES = {
    'omnicam_node': 'ROS 2 node: camera images to panoramas (--ros-args -p NAME:=VALUE).',
    'sfa_node': 'ROS 2 node: panoramas to slow features and poses.',
    'ekf_node': 'ROS 2 node: poses and odometry to the pose in the map.',
}
CANNOT_START, DIED = 1, 2
"""Exit codes: a launch ends with a node that cannot start, and starts one again that has died."""
_NUMBERS = (signal.SIGINT, signal.SIGTERM)
_left_to_ros = False


def run(name: str, words: Sequence[str] | None = None) -> int:
    """Run a node, with the words of the command line, or print its help; the exit code."""
    words = list(sys.argv if words is None else words)
    if {'-h', '--help'} & set(words[1:]):
        sys.stdout.write(node_help(name))
        return 0
    end_at_once()
    module = importlib.import_module(f'sfa_localization.nodes.{name}')
    lifecycle = importlib.import_module('sfa_localization.nodes.lifecycle')
    return int(lifecycle.run_node(getattr(module, name.title().replace('_', '')), words))


omnicam_node, sfa_node, ekf_node = (partial(run, name) for name in NODES)


def node_help(name: str) -> str:
    """Usage, and each parameter with its default."""
    from sfa_localization.config import render

    head = rf'^/\*\*/{name}:\n  ros__parameters:\n'
    (section,) = re.findall(rf'{head}((?: .*\n)*)', render(), re.MULTILINE)
    shown = textwrap.indent(textwrap.dedent(section), '  ')
    return (
        f'{NODES[name]}\n\nusage: {name} [--ros-args [-p NAME:=VALUE] [-r TOPIC:=OTHER] '
        f'[--params-file FILE]]\n\nIt runs until SIGINT or SIGTERM, and writes no file unless a '
        f'parameter names one.\n\nparameters:\n{shown}'
    )


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
