# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""An hour of driving through the three nodes at 20 times its pace: `soak.py [--seconds 3600]`.

The nodes are processes of their own, with a place learnt from a small simulated world. Odometry
at 50 Hz and pictures at 5 Hz follow a robot that goes round in that place. Fails when a node ends,
does not answer, is lost at the end, holds more memory, handles or threads than after the warm-up,
or answers later; in the end each node is restarted once, and has to answer again.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image
from std_msgs.msg import String

sys.path.insert(0, str(Path(__file__).parents[1]))

from cylinder_worlds import PLACE_SIZE, Spheres, place, recipe
from ros_bench import Spinner
from ros_domains import free_domain

from sfa_localization.data.messages import read_stamp
from sfa_localization.data.threads import one_core
from sfa_localization.nodes.conversions import to_image, to_odometry
from sfa_localization.nodes.lifecycle import latched_qos

DOMAIN = free_domain()
START_NS = 1_700_000_000_000_000_000
ODOMETRY_HZ, EVERY = 50, 10
STEP_NS = 10**9 // ODOMETRY_HZ
SPEED, RADIUS = 0.8, 0.9
VIEWS = 997
"""Pictures of one lap; the robot passes others of them in each lap."""
WARM_UP = 1 / 3
GROWTH = 0.1
MORE = 2
"""Handles and threads that a node may have more at the end: those of messages on their way."""
SLOWER, SLOWER_S = 2.0, 0.02
"""The slowest of 100 answers may take longer at the end by this factor and by so many seconds:
the machine has other things to do."""
AGAIN_S = 30.0
"""A restarted node answers by then: it loads ROS, and sfa_node its model."""
PATIENCE_S = 1.0
IN_FLIGHT, LATEST_NS = 3, 300_000_000
SPREAD = np.diag([1e-6, 1e-6])


def lap(steps: np.ndarray) -> np.ndarray:
    """Poses (N, 3) of a circle about the place's origin, after so many odometry messages."""
    angle = steps * (SPEED / RADIUS / ODOMETRY_HZ)
    yaw = np.angle(np.exp(1j * (angle + np.pi / 2)))
    return np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), yaw], -1)


class Robot:
    """Sends odometry and pictures, and hears the poses that come back."""

    def __init__(self) -> None:
        angles = np.arange(VIEWS) * (2 * np.pi / VIEWS)
        poses = lap(angles * RADIUS * ODOMETRY_HZ / SPEED)
        self.views = Spheres.about(1).panoramas(poses, recipe().panorama)
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('robot', context=self.context)
        self.executor = Spinner(self.context)
        self.executor.add_node(self.node)
        self.pictures = self.node.create_publisher(Image, 'image_raw', 10)
        self.odometry = self.node.create_publisher(Odometry, 'odom', 1000)
        self.state, self.errors_m = '', deque[float](maxlen=500)
        self.last_state, self.used, self.share = '', 0, 0.0
        self.sent_ns = self.driven_ns = 0
        self.waiting: dict[int, float] = {}
        self.latencies_s: list[float] = []
        self.answered = self.unanswered = 0
        self.heard = threading.Condition()
        listen = self.node.create_subscription
        listen(PoseWithCovarianceStamped, 'ekf/pose', self.hear, 100)
        listen(Odometry, 'ekf/odometry', self.hear_odometry, 1)
        listen(String, 'ekf/state', self.hear_state, latched_qos())
        listen(DiagnosticArray, '/diagnostics', self.hear_health, 10)

    def hear(self, message: PoseWithCovarianceStamped) -> None:
        """Note the answer to a picture."""
        position, stamp_ns = message.pose.pose.position, read_stamp(message.header.stamp)
        true = lap(np.array((stamp_ns - START_NS) / STEP_NS))
        with self.heard:
            self.errors_m.append(math.hypot(position.x - true[0], position.y - true[1]))
            sent_s = self.waiting.pop(stamp_ns, None)
            if sent_s is not None:
                self.latencies_s.append(time.monotonic() - sent_s)
            self.answered += 1
            self.heard.notify()

    def hear_odometry(self, message: Odometry) -> None:
        """Note how far the filter has come."""
        with self.heard:
            self.driven_ns = read_stamp(message.header.stamp)
            self.heard.notify()

    def hear_state(self, message: String) -> None:
        """Note what the filter says of itself."""
        self.state = message.data

    def hear_health(self, message: DiagnosticArray) -> None:
        """Note how much odometry the filter has used."""
        for status in message.status:
            if status.name.startswith('ekf_node'):
                told = {item.key: item.value for item in status.values}
                self.used = int(told.get('odometry: used', 0))

    def step(self, number: int) -> None:
        """The odometry of one moment, and its picture where there is one."""
        stamp_ns = START_NS + number * STEP_NS
        pose = lap(np.array(float(number)))
        twist = np.array([SPEED, SPEED / RADIUS])
        frames = ('odom', 'base_link')
        self.sent_ns = stamp_ns
        self.odometry.publish(to_odometry(pose, np.eye(3), twist, SPREAD, stamp_ns, frames))
        if number % EVERY == 0:
            turn = number * SPEED / RADIUS / ODOMETRY_HZ / (2 * math.pi)
            view = self.views[round(turn * VIEWS) % VIEWS]
            with self.heard:
                self.waiting[stamp_ns] = time.monotonic()
            self.pictures.publish(to_image(view, stamp_ns, 'omnicam'))

    def wait(self) -> None:
        """Until little is unanswered: to drive faster than the nodes says nothing of them."""
        with self.heard:
            if not self.heard.wait_for(self.followed, PATIENCE_S):
                self.unanswered += len(self.waiting)
                self.waiting.clear()

    def followed(self) -> bool:
        """Whether the nodes are not far behind."""
        late_ns = self.sent_ns - self.driven_ns
        return len(self.waiting) < IN_FLIGHT and late_ns < LATEST_NS

    def close(self) -> None:
        """End the node and its thread."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


class Nodes:
    """The three nodes as processes, by name."""

    def __init__(self, folder: Path) -> None:
        with one_core():
            place().model.save(folder / 'model.npz')
        size = [f'height:={PLACE_SIZE[0]}', f'width:={PLACE_SIZE[1]}']
        self.parameters = {
            'omnicam_node': ['camera_model:=panorama', *size],
            'sfa_node': [f'model:={folder / "model.npz"}'],
            'ekf_node': [],
        }
        self.environment = {
            **os.environ,
            'ROS_DOMAIN_ID': str(DOMAIN),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'ROS_LOG_DIR': str(folder),
            'OMP_NUM_THREADS': '1',
        }
        self.running: dict[str, subprocess.Popen] = {}

    def __enter__(self) -> Nodes:
        for name in self.parameters:
            self.start(name)
        return self

    def __exit__(self, *_: object) -> None:
        for name in list(self.running):
            self.end(name)

    def start(self, name: str) -> None:
        """Start a node."""
        code = f'import sys; from sfa_localization.nodes.{name} import main; sys.exit(main())'
        words = [word for value in self.parameters[name] for word in ('-p', value)]
        command = [sys.executable, '-c', code, '--ros-args', *words]
        self.running[name] = subprocess.Popen(command, env=self.environment)

    def end(self, name: str) -> None:
        """End a node, by force where it does not end itself."""
        process = self.running.pop(name)
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def held(self) -> dict[str, Held]:
        """What each process holds; RuntimeError for one that has ended."""
        for name, process in self.running.items():
            if process.poll() is not None:
                raise RuntimeError(f'{name} ended with exit code {process.returncode}')
        return {name: Held.of(process.pid) for name, process in self.running.items()}


@dataclass(frozen=True, slots=True)
class Held:
    """What a process holds: resident memory, handles of files and sockets, threads."""

    memory_mib: float
    handles: int
    threads: int

    @classmethod
    def of(cls, pid: int) -> Held:
        """Ask the system."""
        process = psutil.Process(pid)
        memory_mib = process.memory_info().rss / 2**20
        return cls(memory_mib, process.num_fds(), process.num_threads())


def awake(robot: Robot, processes: Nodes, number: int = 0) -> int:
    """Drive at a robot's own pace from a step on, until all three answer; the step after it."""
    end, robot.answered = time.monotonic() + AGAIN_S, 0
    robot.waiting.clear()
    while robot.answered < 3:
        if time.monotonic() > end:
            raise RuntimeError('the nodes do not answer')
        processes.held()
        robot.step(number)
        number += 1
        time.sleep(1 / ODOMETRY_HZ)
    robot.waiting.clear()
    return number


def restarted(robot: Robot, processes: Nodes, number: int) -> dict[str, float]:
    """Seconds after which a node that ended and came back is part of answers again, by name."""
    found = {}
    for name in processes.parameters:
        processes.end(name)
        began = time.monotonic()
        processes.start(name)
        number = awake(robot, processes, number)
        found[name] = time.monotonic() - began
    return found


def drive(robot: Robot, processes: Nodes, seconds: float, pace: float):
    """Drive so many simulated seconds; (time s, held by node) forty times on the way."""
    first = awake(robot, processes)
    steps = round(seconds * ODOMETRY_HZ)
    often = max(steps // 40, 1)
    found, start = [], time.perf_counter()
    robot.answered = robot.unanswered = 0
    robot.latencies_s.clear()
    for step in range(1, steps + 1):
        ahead = step / (ODOMETRY_HZ * pace) - (time.perf_counter() - start)
        if ahead > 0.002:
            time.sleep(ahead)
        robot.step(first + step)
        if step % EVERY == 0:
            robot.wait()
        if step % often == 0:
            found.append((step / ODOMETRY_HZ, processes.held()))
            tell(*found[-1])
    wall_s = time.perf_counter() - start
    time.sleep(0.5)
    robot.last_state = robot.state
    time.sleep(2.0)  # the nodes tell their health every second
    robot.share = robot.used / (first + steps)
    return found, wall_s, first + steps + 1


def tell(seconds: float, held: dict[str, Held]) -> None:
    """One line of progress."""
    shown = '  '.join(
        f'{name} {one.memory_mib:.1f} MiB, {one.handles} handles, {one.threads} threads'
        for name, one in held.items()
    )
    sys.stderr.write(f'{seconds:6.0f} s  {shown}\n')


Course = list[tuple[float, dict[str, Held]]]


def parts(count: int) -> tuple[slice, slice]:
    """Of so many figures in order: the tenth after the warm-up, and the last."""
    tenth, begin = max(count // 10, 1), round(count * WARM_UP)
    return slice(begin, begin + tenth), slice(-tenth, None)


def growth(found: Course) -> dict[str, float]:
    """Share by which the last tenth of the drive holds more memory than what follows the
    warm-up."""
    early, late = (found[part] for part in parts(len(found)))
    means = [
        {name: np.mean([held[name].memory_mib for _, held in part]) for name in part[0][1]}
        for part in (early, late)
    ]
    return {name: float(means[1][name] / means[0][name] - 1) for name in means[0]}


def holdings(found: Course, what: str) -> dict[str, list[int]]:
    """Most handles or threads after the warm-up and at the end, by node."""
    return {
        name: [max(getattr(held[name], what) for _, held in found[p]) for p in parts(len(found))]
        for name in found[0][1]
    }


def latencies_ms(robot: Robot) -> list[float]:
    """99th percentile from a picture to its pose, after the warm-up and at the end."""
    taken = robot.latencies_s
    return [round(1e3 * float(np.percentile(taken[p], 99)), 1) for p in parts(len(taken))]


def worse(found: Course, slowest_ms: list[float]) -> list[str]:
    """What the nodes hold more at the end, and whether they answer later."""
    wrong = [f'{name} grew by {g:.0%}' for name, g in growth(found).items() if g > GROWTH]
    for what in ('handles', 'threads'):
        wrong += [
            f'{name} has {end} {what}, after {begin}'
            for name, (begin, end) in holdings(found, what).items()
            if end > begin + MORE
        ]
    begin, end = slowest_ms
    if end > SLOWER * begin and end > begin + 1e3 * SLOWER_S:
        wrong.append(f'the slowest answers take {end:.0f} ms, after {begin:.0f} ms')
    return wrong


def soak(seconds: float, pace: float) -> tuple[dict[str, object], list[str]]:
    """Figures of the drive, and what is wrong with them."""
    with tempfile.TemporaryDirectory() as folder, Nodes(Path(folder)) as processes:
        robot = Robot()
        try:
            found, wall_s, number = drive(robot, processes, seconds, pace)
            total, slowest_ms = robot.answered + robot.unanswered, latencies_ms(robot)
            answered, errors_m = robot.answered, statistics.median(robot.errors_m)
            back_s = restarted(robot, processes, number)
        finally:
            robot.close()
    wrong = worse(found, slowest_ms)
    if not robot.last_state.startswith(('LOCALISED', 'DEGRADED')):
        wrong.append(f'the filter ended {robot.last_state!r}')
    if answered < 0.5 * total:
        wrong.append(f'{total - answered} of {total} pictures were not answered')
    if robot.share < 0.5:
        wrong.append(f'only {robot.share:.0%} of the odometry was used')
    figures = {
        'soak_simulated_s': seconds,
        'soak_pace': round(seconds / wall_s, 1),
        'soak_answered': round(answered / total, 4),
        'soak_odometry_used': round(robot.share, 4),
        'soak_state': robot.last_state,
        'soak_median_error_m': round(errors_m, 3),
        'soak_memory_mib': {n: round(one.memory_mib, 1) for n, one in found[-1][1].items()},
        'soak_growth': {name: round(value, 4) for name, value in growth(found).items()},
        'soak_handles': holdings(found, 'handles'),
        'soak_threads': holdings(found, 'threads'),
        'soak_p99_latency_ms': slowest_ms,
        'soak_back_after_s': {name: round(value, 1) for name, value in back_s.items()},
    }
    return figures, wrong


def main() -> int:
    """Print the figures; 1 where something is wrong with them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=3600.0, help='simulated time')
    parser.add_argument('--pace', type=float, default=20.0, help='at most so many times real time')
    options = parser.parse_args()
    figures, wrong = soak(options.seconds, options.pace)
    sys.stdout.write(json.dumps(figures, indent=2) + '\n')
    for reason in wrong:
        sys.stderr.write(f'soak: {reason}\n')
    return 1 if wrong else 0


if __name__ == '__main__':
    sys.exit(main())
