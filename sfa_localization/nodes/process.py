# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes as processes: their names, the signals that end them, and their exit codes."""

from __future__ import annotations

import signal

NODES = {
    'omnicam_node': 'ROS 2 node: camera images to panoramas (--ros-args -p NAME:=VALUE).',
    'sfa_node': 'ROS 2 node: panoramas to slow features and poses.',
    'ekf_node': 'ROS 2 node: poses and odometry to the pose in the map.',
}
COMPOSED = 'localization'
"""The executable that runs all of them in one process."""
TEACH = 'teach_node'
EXECUTABLES = {
    **NODES,
    COMPOSED: 'All three nodes in one process, with their parameters.',
    TEACH: 'ROS 2 node: records a drive, says where to drive still, and trains on it.',
}
CANNOT_START = 1
DIED = 2
"""Exit codes: a launch ends if a node cannot start, and restarts a node that died."""


def is_true(argument: str, text: str) -> bool:
    """An argument of a launch as ROS and Python write booleans. Raises ValueError otherwise."""
    values = {'true': True, '1': True, 'false': False, '0': False}
    if text.lower() not in values:
        raise ValueError(f'{argument}:={text}: give true or false')
    return values[text.lower()]


SIGNALS = (signal.SIGINT, signal.SIGTERM)
