# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three nodes as real processes in a ROS domain of their own, with a bag player as input.

A recorder subscribes to their outputs; a node that ends or stays silent is an error.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image
from std_msgs.msg import String

from sfa_localization.commands.processes import Processes
from sfa_localization.data.errors import NodeError
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import read_stamp
from sfa_localization.data.run import Trajectory
from sfa_localization.nodes.conversions import read_odometry, read_pose

NODES = ('omnicam_node', 'sfa_node', 'ekf_node')
PLAYER = 'play'
OUTPUTS = {
    'omnicam_node': 'panorama',
    'sfa_node': 'sfa/pose_with_covariance',
    'ekf_node': 'ekf/odometry',
}
"""What is recorded of each node."""
INPUTS = ('/odom', 'sfa/pose_with_covariance', 'panorama')
LARGEST_DOMAIN = 101  # ROS domains above it may collide with ephemeral ports
# An unknown heading has the variance of the uniform distribution, pi^2 / 3 rad^2.
KNOWN_YAW_VARIANCE = np.pi**2 / 3 - 0.1
QUEUE = 1000  # messages: the recorder must not lose any


@dataclass(frozen=True)
class Timeouts:
    """How long the processes may take (s)."""

    start_s: float = 60.0  # until all nodes are connected, on a busy machine
    settle_s: float = 2.0  # without an output after the replay, which ends the recording
    stop_s: float = 10.0  # until outputs, or a process after a signal, have ended


@dataclass(frozen=True)
class Live:
    """What the nodes published: poses of single images and of the filter, and the last state."""

    sfa: Trajectory
    ekf: Trajectory
    state: str


class Recorder:
    """A ROS node that records the outputs of the three nodes, in a context of its own."""

    def __init__(self, domain_id: int) -> None:
        self._context = Context()
        rclpy.init(
            context=self._context,
            domain_id=domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self._node = rclpy.create_node(
            'demo_recorder', context=self._context, use_global_arguments=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.received: dict[str, list[tuple[int, Array]]] = {name: [] for name in NODES}
        self.last_s = time.monotonic()
        self.state = ''
        self._subscribe('omnicam_node', Image, _panorama)
        self._subscribe('sfa_node', PoseWithCovarianceStamped, _pose)
        self._subscribe('ekf_node', Odometry, _odometry)
        self._node.create_subscription(String, 'ekf/state', self._keep_state, QUEUE)

    def close(self) -> None:
        """Leave the ROS graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _subscribe(self, name: str, kind: Any, read: Any) -> None:
        def receive(message: Any) -> None:
            self.received[name].append(read(message))
            self.last_s = time.monotonic()

        self._node.create_subscription(kind, OUTPUTS[name], receive, QUEUE)

    def _keep_state(self, message: String) -> None:
        self.state = message.data

    def spin(self, seconds: float) -> None:
        """Receive messages for some time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def connected(self) -> bool:
        """True when every node of the chain has its publisher and its subscriptions."""
        own = set(OUTPUTS.values())
        return all(self._node.count_publishers(topic) for topic in own) and all(
            self._node.count_subscribers(topic) > (topic in own) for topic in INPUTS
        )

    def trajectory(self, name: str) -> Trajectory:
        """The poses that a node published, in order of their stamps."""
        poses = sorted(self.received[name], key=lambda item: item[0])
        stamps = np.array([stamp for stamp, _ in poses], np.int64)
        return Trajectory(stamps, np.array([pose for _, pose in poses]).reshape(-1, 3))


def _panorama(message: Image) -> tuple[int, Array]:
    return read_stamp(message.header.stamp), np.empty(0)


def _pose(message: PoseWithCovarianceStamped) -> tuple[int, Array]:
    stamp_ns, pose, covariance = read_pose(message)
    known = covariance[2, 2] < KNOWN_YAW_VARIANCE
    return stamp_ns, np.where([True, True, known], pose, np.nan)


def _odometry(message: Odometry) -> tuple[int, Array]:
    motion = read_odometry(message)
    return motion.stamp_ns, motion.pose


def commands(model: Path, bag: Path, rate: float) -> dict[str, list[str]]:
    """The command lines of the three nodes and of the player of `bag`, by name."""
    program = [sys.executable, '-m', 'sfa_localization']
    nodes = {name: [*program, name, '--ros-args'] for name in NODES}
    nodes['omnicam_node'] += ['-p', 'image_transport:=compressed', '-p', 'camera_model:=mirror']
    nodes['sfa_node'] += ['-p', f'model:={model}']
    return {**nodes, PLAYER: [*program, PLAYER, str(bag), '--rate', str(rate)]}


def run_live(
    programs: Mapping[str, Sequence[str]], folder: Path, timeouts: Timeouts | None = None
) -> Live:
    """Run the nodes, then the player; return what the nodes published.

    `programs` are command lines, see `commands`; logs go to `folder`. Raises NodeError when one
    ends too early, does not start, or stays silent. All processes have ended on return.
    """
    timeouts = timeouts or Timeouts()
    domain_id = 1 + os.getpid() % LARGEST_DOMAIN
    with (
        _ros_environment(domain_id, folder) as environment,
        closing(Recorder(domain_id)) as recorder,
        Processes(folder, environment, timeouts.stop_s) as processes,
    ):
        for name in NODES:
            processes.start(name, programs[name])
        _await_nodes(recorder, processes, timeouts.start_s)
        processes.start(PLAYER, programs[PLAYER])
        while not processes.ended(PLAYER):
            recorder.spin(0.2)
            processes.require_alive(NODES)
        ended_s, state = time.monotonic(), recorder.state
        while (now_s := time.monotonic()) < ended_s + timeouts.stop_s:
            if now_s - max(recorder.last_s, ended_s) > timeouts.settle_s:
                break
            recorder.spin(0.1)
        processes.require_alive(NODES)
        for name in NODES:
            if not recorder.received[name]:
                log = processes.log(name)
                raise NodeError(f'{name} is silent: nothing on {OUTPUTS[name]}; see {log}')
        return Live(recorder.trajectory('sfa_node'), recorder.trajectory('ekf_node'), state)


@contextmanager
def _ros_environment(domain_id: int, folder: Path) -> Iterator[Mapping[str, str]]:
    """Environment of the processes, also set in this one while the recorder is used."""
    changes = {
        'ROS_DOMAIN_ID': str(domain_id),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_LOG_DIR': str(folder.resolve() / 'ros'),
        'PYTHONUNBUFFERED': '1',
    }
    before = dict(os.environ)
    os.environ.update(changes)
    try:
        yield dict(os.environ)
    finally:
        os.environ.clear()
        os.environ.update(before)


def _await_nodes(recorder: Recorder, processes: Processes, timeout_s: float) -> None:
    """Return when all nodes are connected. Raises NodeError after the timeout."""
    end = time.monotonic() + timeout_s
    while not recorder.connected():
        processes.require_alive(NODES)
        if time.monotonic() > end:
            logs = ', '.join(str(processes.log(name)) for name in NODES)
            raise NodeError(f'the nodes did not start in {timeout_s:g} s; see {logs}')
        recorder.spin(0.1)
