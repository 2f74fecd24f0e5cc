# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three nodes as real processes in a ROS domain of their own, with a bag player as input.

A recorder subscribes to their outputs, and detects when a node ends or stays silent.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image
from std_msgs.msg import String

from sfa_localization.commands.processes import Processes
from sfa_localization.data.errors import LocalizationError, NodeError
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import read_stamp
from sfa_localization.data.run import Trajectory
from sfa_localization.nodes.conversions import read_odometry, read_pose

NODES = ('omnicam_node', 'sfa_node', 'ekf_node')
PLAYER = 'play'
# The output by which each node is monitored.
OUTPUTS = {
    'omnicam_node': 'panorama',
    'sfa_node': 'sfa/pose_with_covariance',
    'ekf_node': 'ekf/odometry',
}
INPUTS = ('/odom', 'sfa/pose_with_covariance', 'panorama')
LARGEST_DOMAIN = 101  # ROS domains above it may collide with ephemeral ports
# An unknown heading has the variance of the uniform distribution, pi^2 / 3 rad^2.
KNOWN_YAW_VARIANCE = np.pi**2 / 3 - 0.1
QUEUE = 1000  # messages: the recorder must not lose any


@dataclass(frozen=True)
class Timeouts:
    """How long the processes may take (s)."""

    start_s: float = 60.0  # until all nodes are connected, on a busy machine
    silence_s: float = 15.0  # of a node during the replay: longer than any pause of its inputs
    settle_s: float = 2.0  # without an output after the replay, which ends the recording
    stop_s: float = 10.0  # until a process has ended after a signal


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
        self._poses: dict[str, list[tuple[int, Array]]] = {name: [] for name in NODES}
        self._received_s = dict.fromkeys(NODES, -np.inf)
        self.state = ''
        self._node.create_subscription(String, 'ekf/state', self._keep_state, QoSProfile(depth=10))
        self._subscribe('omnicam_node', Image, self._keep_panorama)
        self._subscribe('sfa_node', PoseWithCovarianceStamped, self._keep_pose)
        self._subscribe('ekf_node', Odometry, self._keep_odometry)

    def close(self) -> None:
        """Leave the ROS graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _subscribe(self, name: str, kind: Any, keep: Any) -> None:
        def receive(message: Any) -> None:
            try:
                self._poses[name].append(keep(message))
            except LocalizationError as error:
                raise NodeError(f'{name}: invalid message on {OUTPUTS[name]}: {error}') from None
            self._received_s[name] = time.monotonic()

        self._node.create_subscription(kind, OUTPUTS[name], receive, QoSProfile(depth=QUEUE))

    def _keep_state(self, message: String) -> None:
        self.state = message.data

    @staticmethod
    def _keep_panorama(message: Image) -> tuple[int, Array]:
        return read_stamp(message.header.stamp), np.empty(0)

    @staticmethod
    def _keep_pose(message: PoseWithCovarianceStamped) -> tuple[int, Array]:
        stamp_ns, pose, covariance = read_pose(message)
        known = covariance[2, 2] < KNOWN_YAW_VARIANCE
        return stamp_ns, np.where([True, True, known], pose, np.nan)

    @staticmethod
    def _keep_odometry(message: Odometry) -> tuple[int, Array]:
        motion = read_odometry(message)
        return motion.stamp_ns, motion.pose

    def spin(self, seconds: float) -> None:
        """Receive messages for some time; raises NodeError for an invalid one."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def connected(self) -> bool:
        """True when every node of the chain has its publisher and its subscriptions."""
        own = set(OUTPUTS.values())
        return all(self._node.count_publishers(topic) for topic in own) and all(
            self._node.count_subscribers(topic) > (topic in own) for topic in INPUTS
        )

    def silence_s(self, name: str) -> float:
        """Time (s) since a node's last output."""
        return time.monotonic() - self._received_s[name]

    def count(self, name: str) -> int:
        """Number of a node's outputs so far."""
        return len(self._poses[name])

    def trajectory(self, name: str) -> Trajectory:
        """The poses that a node published, in order of their stamps."""
        poses = sorted(self._poses[name], key=lambda item: item[0])
        stamps = np.array([stamp for stamp, _ in poses], np.int64)
        return Trajectory(stamps, np.array([pose for _, pose in poses]).reshape(-1, 3))


def commands(model: Path, bag: Path, rate: float) -> dict[str, list[str]]:
    """The command lines of the three nodes and of the player of `bag`, by name."""
    program = [sys.executable, '-m', 'sfa_localization']
    nodes = {name: [*program, name, '--ros-args'] for name in NODES}
    nodes['omnicam_node'] += ['-p', 'image_transport:=compressed', '-p', 'camera_model:=mirror']
    nodes['sfa_node'] += ['-p', f'model:={model}']
    return {**nodes, PLAYER: [*program, PLAYER, str(bag), '--rate', str(rate)]}


def run_live(
    programs: Mapping[str, Sequence[str]],
    folder: Path,
    timeouts: Timeouts | None = None,
    on_end: Callable[[str], None] | None = None,
) -> dict[str, Trajectory]:
    """Run the nodes, then the player; return the published poses, as 'sfa' and 'ekf'.

    `on_end` is called with the last state on ekf/state when the replay ends.

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
        _replay(recorder, processes, timeouts)
        if on_end is not None:
            on_end(recorder.state)
        _settle(recorder, processes, timeouts)
        return {name: recorder.trajectory(f'{name}_node') for name in ('sfa', 'ekf')}


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


def _replay(recorder: Recorder, processes: Processes, timeouts: Timeouts) -> None:
    """Receive until the replay has ended. Raises NodeError for a silent node."""
    start = time.monotonic()
    while not processes.ended(PLAYER):
        recorder.spin(0.2)
        processes.require_alive(NODES)
        if time.monotonic() - start > timeouts.silence_s:
            _require_output(recorder, processes, timeouts.silence_s)


def _settle(recorder: Recorder, processes: Processes, timeouts: Timeouts) -> None:
    """Receive until the outputs have ended. Raises NodeError where there was none."""
    while min(recorder.silence_s(name) for name in NODES) < timeouts.settle_s:
        recorder.spin(0.1)
        processes.require_alive(NODES)
    _require_output(recorder, processes, np.inf)


def _require_output(recorder: Recorder, processes: Processes, longest_s: float) -> None:
    """Raise NodeError for the first node of the chain that is silent."""
    for name in NODES:
        if recorder.count(name) == 0 or recorder.silence_s(name) > longest_s:
            since = f' in the last {longest_s:g} s' if np.isfinite(longest_s) else ''
            raise NodeError(
                f'{name} is silent: {recorder.count(name)} messages on {OUTPUTS[name]}, '
                f'none{since}; see {processes.log(name)}'
            )
