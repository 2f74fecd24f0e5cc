# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three nodes as processes in a separate ROS domain, with a bag player as input.

A recorder subscribes to their outputs; a node that ends or publishes nothing is an error.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from operator import itemgetter
from pathlib import Path
from subprocess import DEVNULL, STDOUT, Popen, TimeoutExpired
from typing import NamedTuple

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from sfa_localization.bags.motion_arrays import to_trajectory
from sfa_localization.data.errors import NodeError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Trajectory
from sfa_localization.nodes.conversions import read_odometry, read_pose

NODES = ('omnicam_node', 'sfa_node', 'ekf_node')
PLAYER = 'play'
POSES = {'sfa_node': 'sfa/pose_with_covariance', 'ekf_node': 'ekf/odometry'}
"""Recorded topics."""
START_S = 60.0  # limit for the start of all nodes on a busy machine
SETTLE_S = 2.0  # the recording ends so long after the last output
STOP_S = 10.0  # limit for outputs after the replay, and for the end of a process after a signal
LARGEST_DOMAIN = 101  # larger ROS domains may collide with ephemeral ports
UNKNOWN_YAW_VARIANCE = np.pi**2 / 3 - 0.1  # rad^2; that of a uniform distribution is pi^2 / 3
QUEUE = 1000  # messages, so that the recorder loses none
LAST_LINES = 5  # of the output of a failed program, for the error message


class Live(NamedTuple):
    """The published poses of single images and of the filter, and the last state."""

    sfa: Trajectory
    ekf: Trajectory
    state: str


class Recorder:
    """Records the outputs of the nodes, in a separate ROS context."""

    def __init__(self, domain_id: int) -> None:
        self._context = Context()
        off = SignalHandlerOptions.NO
        rclpy.init(context=self._context, domain_id=domain_id, signal_handler_options=off)
        self._node = rclpy.create_node(
            'demo_recorder', context=self._context, use_global_arguments=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.poses: dict[str, list[tuple[int, Array]]] = {name: [] for name in POSES}
        self.last_s = time.monotonic()
        self.state = ''
        for topic, kind, keep in (
            (POSES['sfa_node'], PoseWithCovarianceStamped, self._keep_pose),
            (POSES['ekf_node'], Odometry, self._keep_odometry),
            ('ekf/state', String, self._keep_state),
        ):
            self._node.create_subscription(kind, topic, keep, QUEUE)

    def close(self) -> None:
        """Leave the ROS graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _keep_pose(self, message: PoseWithCovarianceStamped) -> None:
        stamp_ns, pose, covariance = read_pose(message)
        has_yaw = covariance[2, 2] < UNKNOWN_YAW_VARIANCE
        self.poses['sfa_node'].append((stamp_ns, np.where([True, True, has_yaw], pose, np.nan)))
        self.last_s = time.monotonic()

    def _keep_odometry(self, message: Odometry) -> None:
        stamp_ns, _, pose = read_odometry(message)
        self.poses['ekf_node'].append((stamp_ns, np.array(pose)))
        self.last_s = time.monotonic()

    def _keep_state(self, message: String) -> None:
        self.state = message.data

    def spin(self, seconds: float) -> None:
        """Receive messages for some time."""
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=remaining)

    def connected(self) -> bool:
        """Whether every node has its publisher and its subscriptions."""
        inputs = {'/odom': 1, 'panorama': 1, POSES['sfa_node']: 2}  # one of two is the recorder
        return all(self._node.count_publishers(topic) for topic in POSES.values()) and all(
            self._node.count_subscribers(topic) >= count for topic, count in inputs.items()
        )

    def trajectory(self, name: str) -> Trajectory:
        """The poses that a node published, in order of their stamps."""
        return to_trajectory(sorted(self.poses[name], key=itemgetter(0)))


class Processes:
    """Context manager of programs with log files; on its exit all have ended."""

    def __init__(self, folder: Path, stop_timeout_s: float = STOP_S) -> None:
        self._folder = folder
        self._stop_timeout_s = stop_timeout_s
        self._running: dict[str, Popen[bytes]] = {}
        folder.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_error: object) -> None:
        """Interrupt all, then terminate and finally kill those that do not end in time."""
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # also after a second Ctrl-C
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            alive = [process for process in self._running.values() if process.poll() is None]
            for process in alive:
                process.send_signal(number)
            for process in alive:
                with suppress(TimeoutExpired):
                    process.wait(self._stop_timeout_s)
        signal.signal(signal.SIGINT, before)

    def start(self, name: str, command: Sequence[str]) -> None:
        """Start a program under a unique name."""
        with open(self.log(name), 'wb') as output:
            self._running[name] = Popen(command, stdin=DEVNULL, stdout=output, stderr=STDOUT)

    def log(self, name: str) -> Path:
        """The file with the output of a program."""
        return self._folder / f'{name}.log'

    def ended(self, name: str) -> bool:
        """Whether a program has ended, with exit code 0. Raises NodeError for another exit code."""
        code = self._running[name].poll()
        if code:
            how = f'exit code {code}' if code >= 0 else signal.Signals(-code).name
            raise NodeError(f'{name} ended ({how}); {self._last_output(name)}')
        return code is not None

    def require_alive(self, names: Sequence[str]) -> None:
        """Raise NodeError with the last output of a program that has ended."""
        for name in names:
            if self.ended(name):
                raise NodeError(f'{name} ended; {self._last_output(name)}')

    def _last_output(self, name: str) -> str:
        lines = self.log(name).read_text(encoding='utf-8', errors='replace').strip().splitlines()
        last = '\n  '.join(lines[-LAST_LINES:])
        return f'its last output, from {self.log(name)}:\n  {last}'


def commands(model: Path, bag: Path) -> dict[str, list[str]]:
    """The command lines of the three nodes and of the player of `bag`, by name."""
    program = [sys.executable, '-m', 'sfa_localization']
    nodes = {name: [*program, name, '--ros-args'] for name in NODES}
    nodes['omnicam_node'] += ['-p', 'image_transport:=compressed']
    for name in ('omnicam_node', 'sfa_node'):
        nodes[name] += ['-p', f'model:={model}']
    return {**nodes, PLAYER: [*program, PLAYER, str(bag)]}


def run_live(programs: Mapping[str, Sequence[str]], folder: Path) -> Live:
    """Run the nodes, then the player, and record the outputs of the nodes.

    `programs` are command lines, see `commands`; logs go to `folder`. Raises NodeError if a node
    does not start, ends early or publishes nothing. On return all processes have ended.
    """
    domain_id = 1 + os.getpid() % LARGEST_DOMAIN
    os.environ.update(
        ROS_DOMAIN_ID=str(domain_id),
        ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST',
        ROS_LOG_DIR=str(folder.resolve() / 'ros'),
        PYTHONUNBUFFERED='1',
    )
    with closing(Recorder(domain_id)) as recorder, Processes(folder) as processes:
        for name in NODES:
            processes.start(name, programs[name])
        _await_nodes(recorder, processes)
        processes.start(PLAYER, programs[PLAYER])
        while not processes.ended(PLAYER):
            recorder.spin(0.2)
            processes.require_alive(NODES)
        ended_s = time.monotonic()
        state = recorder.state
        while (now_s := time.monotonic()) < ended_s + STOP_S:
            if now_s - max(recorder.last_s, ended_s) > SETTLE_S:
                break
            recorder.spin(0.1)
        processes.require_alive(NODES)
        for name, topic in POSES.items():
            if not recorder.poses[name]:
                raise NodeError(f'{name} is silent: nothing on {topic}; see {processes.log(name)}')
        return Live(recorder.trajectory('sfa_node'), recorder.trajectory('ekf_node'), state)


def _await_nodes(recorder: Recorder, processes: Processes) -> None:
    """Return when all nodes are connected. Raises NodeError after START_S."""
    end = time.monotonic() + START_S
    while not recorder.connected():
        processes.require_alive(NODES)
        if time.monotonic() > end:
            logs = ', '.join(str(processes.log(name)) for name in NODES)
            raise NodeError(f'the nodes did not start in {START_S:g} s; see {logs}')
        recorder.spin(0.1)
