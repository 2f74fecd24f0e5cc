# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three nodes as real processes in a ROS domain of their own, with a bag player as input.

A recorder subscribes to their outputs; a node that ends or stays silent is an error.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from subprocess import DEVNULL, STDOUT, Popen, TimeoutExpired
from typing import Any, NamedTuple

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from sfa_localization.data.errors import NodeError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Trajectory
from sfa_localization.nodes.conversions import read_odometry, read_pose

NODES = ('omnicam_node', 'sfa_node', 'ekf_node')
PLAYER = 'play'
POSES = {'sfa_node': 'sfa/pose_with_covariance', 'ekf_node': 'ekf/odometry'}
"""What is recorded."""
START_S = 60.0  # until all nodes are connected, on a busy machine
SETTLE_S = 2.0  # without an output after the replay, which ends the recording
STOP_S = 10.0  # until outputs, or a process after a signal, have ended
LARGEST_DOMAIN = 101  # ROS domains above it may collide with ephemeral ports
# An unknown heading has the variance of the uniform distribution, pi^2 / 3 rad^2.
KNOWN_YAW_VARIANCE = np.pi**2 / 3 - 0.1
QUEUE = 1000  # messages: the recorder must not lose any
LAST_LINES = 5  # of a failed program's output, in the error message


class Live(NamedTuple):
    """What the nodes published: poses of single images and of the filter, and the last state."""

    sfa: Trajectory
    ekf: Trajectory
    state: str


class Recorder:
    """A ROS node that records the outputs of the nodes, in a context of its own."""

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
        self.last_s, self.state = time.monotonic(), ''
        for kind, read, (name, topic) in zip(
            (PoseWithCovarianceStamped, Odometry), (_pose, _odometry), POSES.items(), strict=True
        ):
            keep = partial(self._keep, self.poses[name], read)
            self._node.create_subscription(kind, topic, keep, QUEUE)
        self._node.create_subscription(String, 'ekf/state', self._keep_state, QUEUE)

    def close(self) -> None:
        """Leave the ROS graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _keep(self, poses: list[tuple[int, Array]], read: Any, message: Any) -> None:
        poses.append(read(message))
        self.last_s = time.monotonic()

    def _keep_state(self, message: String) -> None:
        self.state = message.data

    def spin(self, seconds: float) -> None:
        """Receive messages for some time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def connected(self) -> bool:
        """True when every node of the chain has its publisher and its subscriptions."""
        inputs = {'/odom': 0, 'panorama': 0, POSES['sfa_node']: 1}  # the recorder is another one
        return all(self._node.count_publishers(topic) for topic in POSES.values()) and all(
            self._node.count_subscribers(topic) > own for topic, own in inputs.items()
        )

    def trajectory(self, name: str) -> Trajectory:
        """The poses that a node published, in order of their stamps."""
        poses = sorted(self.poses[name], key=lambda item: item[0])
        stamps = np.array([stamp for stamp, _ in poses], np.int64)
        return Trajectory(stamps, np.array([pose for _, pose in poses]).reshape(-1, 3))


def _pose(message: PoseWithCovarianceStamped) -> tuple[int, Array]:
    stamp_ns, pose, covariance = read_pose(message)
    known = covariance[2, 2] < KNOWN_YAW_VARIANCE
    return stamp_ns, np.where([True, True, known], pose, np.nan)


def _odometry(message: Odometry) -> tuple[int, Array]:
    stamp_ns, _, pose = read_odometry(message)
    return stamp_ns, np.array(pose)


class Processes:
    """Context manager of programs that write to log files; all have ended after its exit."""

    def __init__(self, folder: Path, stop_timeout_s: float) -> None:
        self._folder, self._stop_timeout_s = folder, stop_timeout_s
        self._running: dict[str, Popen[bytes]] = {}

    def __enter__(self) -> Processes:
        self._folder.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *_error: object) -> None:
        """Interrupt all, then terminate and finally kill those that do not end in time."""
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C leaves no program
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            self._stop(number)
        signal.signal(signal.SIGINT, before)

    def start(self, name: str, command: Sequence[str]) -> None:
        """Start a program under a unique name."""
        with open(self.log(name), 'wb') as output:
            self._running[name] = Popen(command, stdin=DEVNULL, stdout=output, stderr=STDOUT)

    def log(self, name: str) -> Path:
        """File with the output of a program."""
        return self._folder / f'{name}.log'

    def ended(self, name: str) -> bool:
        """True after a program has ended with exit code 0. Raises NodeError for another."""
        code = self._running[name].poll()
        if code:
            how = f'exit code {code}' if code >= 0 else signal.Signals(-code).name
            raise NodeError(f'{name} ended ({how}); {self._last_output(name)}')
        return code is not None

    def require_alive(self, names: Sequence[str]) -> None:
        """Raise NodeError, with the last lines of its output, for a program that has ended."""
        for name in names:
            if self.ended(name):
                raise NodeError(f'{name} ended; {self._last_output(name)}')

    def _last_output(self, name: str) -> str:
        lines = self.log(name).read_text(encoding='utf-8', errors='replace').strip().splitlines()
        last = '\n  '.join(lines[-LAST_LINES:])
        return f'its last output, from {self.log(name)}:\n  {last}'

    def _stop(self, number: signal.Signals) -> None:
        alive = [process for process in self._running.values() if process.poll() is None]
        for process in alive:
            process.send_signal(number)
        for process in alive:
            with suppress(TimeoutExpired):
                process.wait(self._stop_timeout_s)


def commands(model: Path, bag: Path) -> dict[str, list[str]]:
    """The command lines of the three nodes and of the player of `bag`, by name."""
    program = [sys.executable, '-m', 'sfa_localization']
    nodes = {name: [*program, name, '--ros-args'] for name in NODES}
    nodes['omnicam_node'] += ['-p', 'image_transport:=compressed', '-p', 'camera_model:=mirror']
    nodes['sfa_node'] += ['-p', f'model:={model}']
    return {**nodes, PLAYER: [*program, PLAYER, str(bag)]}


def run_live(programs: Mapping[str, Sequence[str]], folder: Path) -> Live:
    """Run the nodes, then the player; return what the nodes published.

    `programs` are command lines, see `commands`; logs go to `folder`. Raises NodeError when one
    ends too early, does not start, or stays silent. All processes have ended on return.
    """
    domain_id = 1 + os.getpid() % LARGEST_DOMAIN
    os.environ.update(
        ROS_DOMAIN_ID=str(domain_id),
        ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST',
        ROS_LOG_DIR=str(folder.resolve() / 'ros'),
        PYTHONUNBUFFERED='1',
    )
    with closing(Recorder(domain_id)) as recorder, Processes(folder, STOP_S) as processes:
        for name in NODES:
            processes.start(name, programs[name])
        _await_nodes(recorder, processes)
        processes.start(PLAYER, programs[PLAYER])
        while not processes.ended(PLAYER):
            recorder.spin(0.2)
            processes.require_alive(NODES)
        ended_s, state = time.monotonic(), recorder.state
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
