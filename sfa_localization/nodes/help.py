# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What a node prints for --help, instead of starting: no ROS is needed for that."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

NODES = {
    'omnicam_node': 'ROS 2 node: camera images to panoramas (--ros-args -p NAME:=VALUE).',
    'sfa_node': 'ROS 2 node: panoramas to slow features and poses.',
    'ekf_node': 'ROS 2 node: poses and odometry to the pose in the map.',
}


def asks_for_help(words: Sequence[str]) -> bool:
    """Whether arguments of a node ask for help: before those of ROS, or in their place."""
    return bool({'-h', '--help'} & set(words))


def node_help(name: str, summary: str) -> str:
    """Usage, and each parameter with its default."""
    from sfa_localization.config import render

    lines, wanted = [], False
    for line in render().splitlines():
        if line and not line.startswith((' ', '#')):
            wanted = line.startswith(f'/**/{name}:')
        elif wanted and line.strip() != 'ros__parameters:':
            lines.append(line)
    shown = textwrap.indent(textwrap.dedent('\n'.join(lines)), '  ')
    return (
        f'{summary}\n\nusage: {name} [--ros-args [-p NAME:=VALUE] [-r TOPIC:=OTHER] '
        f'[--params-file FILE]]\n\nIt runs until SIGINT or SIGTERM, and writes no file unless a '
        f'parameter names one.\n\nparameters:\n{shown}\n'
    )
