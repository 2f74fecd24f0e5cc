# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""An hour of driving through the three nodes at 20 times real time: `soak.py [--seconds 3600]`.

The nodes are processes, with a model of a small simulated world. Odometry at 50 Hz and images at
5 Hz follow a robot on a circle. It fails if a node ends, does not answer, is LOST at the end, or if
memory, handles, threads or latency have grown since the warm-up. Finally each node is restarted
once, and must answer again.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import tempfile
import threading
import time
from collections import deque
from pathlib import Path

import numpy as np
import psutil
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench_chain import Driver, end_process, parameters_of, start_node
from cylinder_worlds import Spheres, place, recipe

from sfa_localization.data.messages import read_stamp
from sfa_localization.data.threads import one_core
from sfa_localization.place_model import PlaceModel

START_NS = 1_700_000_000_000_000_000
ODOMETRY_HZ, EVERY = 50, 10
STEP_NS = 10**9 // ODOMETRY_HZ
SPEED, RADIUS = 0.8, 0.9
VIEWS = 997
"""Images of one lap; each lap shows others of them."""
WARM_UP, LOOKS = 1 / 3, 40
MOST = {'memory_mib': (1.1, 0.0), 'handles': (1.0, 2.0), 'threads': (1.0, 2.0), 'p99_ms': (2.0, 20)}
"""Limits at the end: a factor of the value after the warm-up, and an addition to it. Messages under
way hold handles too, and other programs use the machine."""
AGAIN_S = 60.0
"""A restarted node must answer within this time."""
PATIENCE_S = 1.0
IN_FLIGHT, LATEST_NS = 3, 300_000_000


def lap(steps: np.ndarray) -> np.ndarray:
    """Return poses (N, 3) on a circle about the origin, after so many odometry messages."""
    angle = steps * (SPEED / RADIUS / ODOMETRY_HZ)
    yaw = np.angle(np.exp(1j * (angle + np.pi / 2)))
    return np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), yaw], -1)


class Robot(Driver):
    """Drives on the circle, and hears the poses that come back."""

    def __init__(self) -> None:
        angles = np.arange(VIEWS) * (2 * np.pi / VIEWS)
        poses = lap(angles * RADIUS * ODOMETRY_HZ / SPEED)
        self.views = Spheres.about(1).panoramas(poses, recipe().panorama)
        super().__init__()
        self.errors_m = deque[float](maxlen=500)
        self.step = self.answered = self.unanswered = self.driven_ns = 0
        self.heard = threading.Condition()
        self.node.create_subscription(Odometry, 'ekf/odometry', self.hear_odometry, 1)

    def hear(self, message: PoseWithCovarianceStamped) -> None:
        """Note the latency and the error of a pose."""
        position, stamp_ns = message.pose.pose.position, read_stamp(message.header.stamp)
        true = lap(np.array((stamp_ns - START_NS) / STEP_NS))
        with self.heard:
            super().hear(message)
            self.sent.pop(stamp_ns, None)
            self.errors_m.append(math.hypot(position.x - true[0], position.y - true[1]))
            self.answered += 1
            self.heard.notify()

    def hear_odometry(self, message: Odometry) -> None:
        """Note the stamp of the newest fused odometry."""
        with self.heard:
            self.driven_ns = read_stamp(message.header.stamp)
            self.heard.notify()

    def drive(self) -> None:
        """Send the next odometry, and every tenth time an image."""
        self.step += 1
        stamp_ns, pose = START_NS + self.step * STEP_NS, lap(np.array(float(self.step)))
        self.move(stamp_ns, pose, (SPEED, SPEED / RADIUS))
        if self.step % EVERY == 0:
            turn = self.step * SPEED / RADIUS / ODOMETRY_HZ / (2 * math.pi)
            with self.heard:
                self.show(self.views[round(turn * VIEWS) % VIEWS], stamp_ns)

    def wait(self) -> None:
        """Wait for the nodes; images without an answer for PATIENCE_S count as unanswered."""
        with self.heard:
            if not self.heard.wait_for(self.in_time, PATIENCE_S):
                self.unanswered += len(self.sent)
                self.sent.clear()

    def in_time(self) -> bool:
        """Whether few images are under way, and the newest odometry is fused."""
        late_ns = START_NS + self.step * STEP_NS - self.driven_ns
        return len(self.sent) < IN_FLIGHT and late_ns < LATEST_NS

    def until_answered(self, processes: Nodes) -> None:
        """Drive in real time until all nodes answer."""
        end, self.answered = time.monotonic() + AGAIN_S, 0
        self.sent.clear()
        while self.answered < 3:
            if time.monotonic() > end:
                raise RuntimeError('the nodes do not answer')
            processes.held()
            self.drive()
            time.sleep(1 / ODOMETRY_HZ)
        self.sent.clear()


class Nodes:
    """The three nodes as processes, by name."""

    def __init__(self, model: PlaceModel, folder: Path) -> None:
        model.save(folder / 'model.npz')
        self.parameters = parameters_of(folder / 'model.npz')
        self.running = {name: start_node(name, *p) for name, p in self.parameters.items()}

    def restart(self, name: str) -> None:
        """End a node, and start it again."""
        end_process(self.running[name])
        self.running[name] = start_node(name, *self.parameters[name])

    def held(self) -> dict[str, dict[str, float]]:
        """Return what each process holds; raises RuntimeError for one that has ended."""
        held = {}
        for name, process in self.running.items():
            if process.poll() is not None:
                raise RuntimeError(f'{name} ended with exit code {process.returncode}')
            status = psutil.Process(process.pid)
            memory_mib = status.memory_info().rss / 2**20
            handles, threads = status.num_fds(), status.num_threads()
            held[name] = {'memory_mib': memory_mib, 'handles': handles, 'threads': threads}
        return held


def drive(robot: Robot, processes: Nodes, seconds: float, pace: float) -> list[dict]:
    """Drive for some simulated seconds; return what the nodes hold at LOOKS times on the way."""
    robot.until_answered(processes)
    steps, course, start = round(seconds * ODOMETRY_HZ), [], time.perf_counter()
    robot.answered = robot.unanswered = 0
    robot.latencies_s.clear()
    for step in range(1, steps + 1):
        ahead = step / (ODOMETRY_HZ * pace) - (time.perf_counter() - start)
        if ahead > 0.002:
            time.sleep(ahead)
        robot.drive()
        if step % EVERY == 0:
            robot.wait()
        if step % max(steps // LOOKS, 1) == 0:
            course.append(processes.held())
            sys.stderr.write(f'{step / ODOMETRY_HZ:6.0f} s  {json.dumps(course[-1])}\n')
    time.sleep(1.0)
    return course


def early_and_late(course: list[float], percent: float) -> list[float]:
    """Return this percentile of the tenth after the warm-up, and of the last tenth."""
    tenth, begin = max(len(course) // 10, 1), round(len(course) * WARM_UP)
    parts = course[begin : begin + tenth], course[-tenth:]
    return [round(float(np.percentile(part, percent)), 1) for part in parts]


def soak(seconds: float, pace: float) -> tuple[dict[str, object], list[str]]:
    """Drive and restart the nodes; return figures, and which of them are above their limits."""
    with one_core():
        model = place().model
    with tempfile.TemporaryDirectory() as folder:
        processes, robot = Nodes(model, Path(folder)), Robot()
        try:
            start = time.perf_counter()
            held = drive(robot, processes, seconds, pace)
            wall_s, state, answered = time.perf_counter() - start, robot.state, robot.answered
            share = answered / (answered + robot.unanswered)
            error_m, latencies_ms = (
                statistics.median(robot.errors_m), [1e3 * s for s in robot.latencies_s]
            )  # fmt: skip
            back_s = {}
            for name in processes.parameters:
                began = time.monotonic()
                processes.restart(name)
                robot.until_answered(processes)
                back_s[name] = round(time.monotonic() - began, 1)
        finally:
            robot.close()
            for process in processes.running.values():
                end_process(process)
    courses = {
        f'{name} {what}': early_and_late([each[name][what] for each in held], 50)
        for name in back_s
        for what in held[0][name]
    }
    courses['all p99_ms'] = early_and_late(latencies_ms, 99)
    wrong = []
    for label, (early, late) in courses.items():
        factor, more = MOST[label.split()[1]]
        if late > max(factor * early, early + more):
            wrong.append(f'{label}: {late}, after {early}')
    if not state.startswith(('LOCALISED', 'DEGRADED')):
        wrong.append(f'the filter ended {state!r}')
    if share < 0.5:
        wrong.append(f'only {share:.0%} of the images were answered')
    figures = {'simulated_s': seconds, 'pace': round(seconds / wall_s, 1), 'answered': share,
               'state': state, 'median_error_m': round(error_m, 3), 'early_and_late': courses,
               'back_after_s': back_s}  # fmt: skip
    return figures, wrong


def main() -> int:
    """Print the figures; return 1 where one is above its limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=3600.0, help='simulated time')
    parser.add_argument('--pace', type=float, default=20.0, help='times real time, at most')
    options = parser.parse_args()
    figures, wrong = soak(options.seconds, options.pace)
    sys.stdout.write(json.dumps(figures, indent=2) + '\n')
    sys.stderr.writelines(f'soak: {reason}\n' for reason in wrong)
    return 1 if wrong else 0


if __name__ == '__main__':
    sys.exit(main())
