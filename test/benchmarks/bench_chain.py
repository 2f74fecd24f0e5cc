# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The chain of three nodes against a bare relay of the same messages: `bench_chain.py MODEL`.

Both run as three processes each, with pictures at 30 Hz and odometry at 50 Hz, in turns, in one
run. A latency is the time from sending a picture to receiving what the third process makes of it.

Then the CPU of each node at camera rates of 10 and 30 Hz, for one, two and four robots that share
the machine and the domain, each in its namespace.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

sys.path.insert(0, str(Path(__file__).parents[1]))

from ros_bench import Spinner
from ros_domains import free_domain

from sfa_localization.data.messages import read_stamp
from sfa_localization.nodes.conversions import (
    to_image,
    to_odometry,
    to_pose_with_covariance,
    to_stamp,
)
from sfa_localization.place_model import PlaceModel

DOMAIN = free_domain()
PICTURES_HZ, ODOMETRY_HZ = 30.0, 50.0
NODES = ('omnicam_node', 'sfa_node', 'ekf_node')
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
DEADLINE_S = 20.0
ROBOTS, RATES_HZ = (1, 2, 4), (10.0, 30.0)


class Relay(Node):
    """Passes a message on, and does the least that its neighbour in the chain must: nothing."""

    def __init__(self, stage: int) -> None:
        super().__init__(f'relay_{stage}')
        kinds = [Image, Image, PoseWithCovarianceStamped, PoseWithCovarianceStamped]
        self.out = self.create_publisher(kinds[stage + 1], f'relay/stage_{stage + 1}', 10)
        source = f'relay/stage_{stage}'
        self.create_subscription(kinds[stage], source, self.pass_on, BEST_EFFORT)
        self.create_subscription(Odometry, 'relay/odom', lambda _: None, BEST_EFFORT)
        self.answer = to_pose_with_covariance([0, 0, 0], np.eye(3), 1, 'map')

    def pass_on(self, message: Any) -> None:
        """The picture as it is, then a pose of the same stamp."""
        if isinstance(message, Image) and self.out.msg_type is not Image:
            self.answer.header.stamp = message.header.stamp
            message = self.answer
        self.out.publish(message)


def relay(stage: int) -> None:
    """The process of one relay."""
    rclpy.init()
    try:
        rclpy.spin(Relay(stage))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


class Driver:
    """Sends pictures and odometry, and notes when the answers come."""

    def __init__(self, panorama: np.ndarray) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('bench', context=self.context)
        self.executor = Spinner(self.context)
        self.executor.add_node(self.node)
        self.sent: dict[int, float] = {}
        self.latencies: list[float] = []
        self.panorama = panorama
        make, listen = self.node.create_publisher, self.node.create_subscription
        self.images = {name: make(Image, f'{name}', 10) for name in ('image_raw', 'relay/stage_0')}
        self.odometry = {name: make(Odometry, name, 10) for name in ('odom', 'relay/odom')}
        for topic in ('ekf/pose', 'relay/stage_3'):
            listen(PoseWithCovarianceStamped, topic, self.hear, 10)

    def hear(self, message: PoseWithCovarianceStamped) -> None:
        """Note the time from sending to receiving."""
        sent = self.sent.pop(read_stamp(message.header.stamp), None)
        if sent is not None:
            self.latencies.append(time.perf_counter() - sent)

    def run(self, image_topic: str, odometry_topic: str, seconds: float) -> tuple[list[float], int]:
        """Send for some seconds; latencies of the answers, and how many pictures were sent."""
        self.sent.clear()
        self.latencies.clear()
        start, pictures, moves = time.perf_counter(), 0, 0
        while (now := time.perf_counter() - start) < seconds:
            if now >= moves / ODOMETRY_HZ:
                self.move(odometry_topic)
                moves += 1
            elif now >= pictures / PICTURES_HZ:
                self.picture(image_topic)
                pictures += 1
            else:
                time.sleep(0.0005)
        time.sleep(1.0)
        return list(self.latencies), pictures

    def move(self, topic: str) -> None:
        """One odometry message of a robot that stands."""
        spread = np.eye(2) * 1e-4
        frames = ('odom', 'base_link')
        zero = np.zeros(3)
        self.odometry[topic].publish(
            to_odometry(zero, np.eye(3), zero[:2], spread, time.time_ns(), frames)
        )

    def picture(self, topic: str) -> None:
        """One picture, never the same twice."""
        stamp_ns = time.time_ns()
        self.panorama[0, 0] = stamp_ns % 251
        self.panorama[3::6, ::3, 0] ^= 1
        message = to_image(self.panorama, stamp_ns, 'omnicam')
        message.header.stamp = to_stamp(stamp_ns)
        self.sent[stamp_ns] = time.perf_counter()
        self.images[topic].publish(message)

    def wait(self, topic: str, odometry_topic: str) -> None:
        """Until a picture comes back."""
        end = time.monotonic() + DEADLINE_S
        while time.monotonic() < end:
            if self.run(topic, odometry_topic, 0.5)[0]:
                return
        raise RuntimeError(f'nothing comes back from {topic}')

    def close(self) -> None:
        """End the node and its thread."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def start(command: list[str], folder: Path) -> subprocess.Popen[bytes]:
    """A process of one node, alone on its domain."""
    environment = {
        **os.environ,
        'ROS_DOMAIN_ID': str(DOMAIN),
        'ROS_LOG_DIR': str(folder),
        'OMP_NUM_THREADS': '1',
        'PYTHONPATH': os.pathsep.join(sys.path),
    }
    return subprocess.Popen([sys.executable, *command], env=environment)


def chain(
    model_path: Path, model: PlaceModel, folder: Path, namespace: str = '/'
) -> list[subprocess.Popen[bytes]]:
    """The three nodes; the pictures are panoramas already, so that both sides carry the same."""
    size = model.panorama
    parameters = {
        'omnicam_node': ['camera_model:=panorama', f'width:={size.width}',
                         f'height:={size.height}', f'elevation_min:={size.elevation_min}',
                         f'elevation_max:={size.elevation_max}'],
        'sfa_node': [f'model:={model_path}'],
        'ekf_node': ['initial_pose:=[0.0, 0.0, 0.0]'],
    }  # fmt: skip
    code = 'import sys; from sfa_localization.nodes.{} import main; sys.exit(main())'
    return [
        start(
            [
                '-c',
                code.format(node),
                '--ros-args',
                '-r',
                f'__ns:={namespace}',
                *(p for v in parameters[node] for p in ('-p', v)),
            ],
            folder,
        )
        for node in NODES
    ]


class Fleet:
    """Robots that stand: sends pictures and odometry to each, and counts the poses of each."""

    def __init__(self, panorama: np.ndarray, names: list[str]) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('fleet', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.panorama = panorama
        self.answers = dict.fromkeys(names, 0)
        make = self.node.create_publisher
        self.images = [make(Image, f'/{name}/image_raw', 10) for name in names]
        self.odometry = [make(Odometry, f'/{name}/odom', 10) for name in names]
        for name in names:
            self.node.create_subscription(
                PoseWithCovarianceStamped, f'/{name}/ekf/pose', self.counter(name), 10
            )

    def counter(self, name: str) -> Any:
        """What to do with a pose of this robot."""

        def count(_: PoseWithCovarianceStamped) -> None:
            self.answers[name] += 1

        return count

    def send(self) -> None:
        """Send one picture to each robot, never the same twice."""
        self.panorama[3::6, ::3, 0] ^= 1
        stamp_ns = time.time_ns()
        self.panorama[0, 0] = stamp_ns % 251
        message = to_image(self.panorama, stamp_ns, 'omnicam')
        for publisher in self.images:
            publisher.publish(message)

    def move(self) -> None:
        """Send one odometry message to each robot."""
        zero, frames = np.zeros(3), ('odom', 'base_link')
        message = to_odometry(zero, np.eye(3), zero[:2], np.eye(2) * 1e-4, time.time_ns(), frames)
        for publisher in self.odometry:
            publisher.publish(message)

    def run(self, seconds: float, rate_hz: float) -> int:
        """Send for some seconds; how many pictures each robot got."""
        start, pictures, moves = time.perf_counter(), 0, 0
        while (now := time.perf_counter() - start) < seconds:
            if now >= moves / ODOMETRY_HZ:
                self.move()
                moves += 1
            elif now >= pictures / rate_hz:
                self.send()
                pictures += 1
            else:
                self.executor.spin_once(timeout_sec=0.0005)
        return pictures

    def wait(self) -> None:
        """Until each robot has answered."""
        end = time.monotonic() + 3 * DEADLINE_S
        while not all(self.answers.values()):
            self.run(0.5, 10.0)
            if time.monotonic() > end:
                raise RuntimeError(f'robots do not answer: {self.answers}')

    def close(self) -> None:
        """End the node."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def bench_robots(model_path: Path | str, seconds: float = 8.0) -> dict[str, float]:
    """CPU shares of each node (1: one core), the mean of the robots, by robots and camera rate."""
    model = PlaceModel.load(model_path)
    figures: dict[str, float] = {}
    for count in ROBOTS:
        figures |= _bench_fleet(Path(model_path).resolve(), model, count, seconds)
    return figures


def _bench_fleet(
    model_path: Path, model: PlaceModel, count: int, seconds: float
) -> dict[str, float]:
    names = [f'robot{k + 1}' for k in range(count)]
    processes: list[subprocess.Popen[bytes]] = []
    fleet = Fleet(some_panorama(model), names)
    with tempfile.TemporaryDirectory() as folder:
        try:
            for name in names:
                processes += chain(model_path, model, Path(folder), f'/{name}')
            fleet.wait()
            figures: dict[str, float] = {}
            for rate_hz in RATES_HZ:
                figures |= _fleet_figures(fleet, processes, rate_hz, seconds)
            return figures
        finally:
            fleet.close()
            _end(processes)


def _fleet_figures(
    fleet: Fleet, processes: list[subprocess.Popen[bytes]], rate_hz: float, seconds: float
) -> dict[str, float]:
    before, answered = cpu_seconds(processes), sum(fleet.answers.values())
    pictures = fleet.run(seconds, rate_hz)
    shares = ((cpu_seconds(processes) - before) / seconds).reshape(-1, len(NODES)).mean(axis=0)
    robots = len(fleet.answers)
    prefix = f'robots_{robots}_at_{rate_hz:.0f}_hz'
    named = {f'{prefix}_cpu_{n}': float(s) for n, s in zip(NODES, shares, strict=True)}
    share = (sum(fleet.answers.values()) - answered) / (pictures * robots)
    return {**named, f'{prefix}_answered': share}


def some_panorama(model: PlaceModel) -> np.ndarray:
    """A picture of the model's size, of random dots."""
    size = (model.panorama.height, model.panorama.width, 3)
    return np.random.default_rng(1).integers(40, 215, size, np.uint8)


def cpu_seconds(processes: list[subprocess.Popen[bytes]]) -> np.ndarray:
    """CPU time that each process has used, s."""
    times = [psutil.Process(process.pid).cpu_times() for process in processes]
    return np.array([spent.user + spent.system for spent in times])


def bench_chain(model_path: Path | str, rounds: int = 3, seconds: float = 8.0) -> dict[str, float]:
    """Median latency over the relay's, the chain's p99 in ms, and its CPU share (1: one core)."""
    model = PlaceModel.load(model_path)
    sides: dict[str, list[subprocess.Popen[bytes]]] = {'chain': [], 'relay': []}
    driver = Driver(some_panorama(model))
    with tempfile.TemporaryDirectory() as folder:
        try:
            sides['chain'] = chain(Path(model_path).resolve(), model, Path(folder))
            sides['relay'] = [start([__file__, '--relay', str(k)], Path(folder)) for k in range(3)]
            return _measure(driver, sides, rounds, seconds)
        finally:
            driver.close()
            _end([*sides['chain'], *sides['relay']])


def _end(processes: list[subprocess.Popen[bytes]]) -> None:
    """Ask all to end, then make those that do not."""
    for process in processes:
        process.terminate()
    for process in processes:
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _measure(
    driver: Driver, sides: dict[str, list[subprocess.Popen[bytes]]], rounds: int, seconds: float
) -> dict[str, float]:
    topics = {'chain': ('image_raw', 'odom'), 'relay': ('relay/stage_0', 'relay/odom')}
    for name in sides:
        driver.wait(*topics[name])
    taken: dict[str, list[float]] = {name: [] for name in sides}
    cpu = {name: np.zeros(3) for name in sides}
    sent = dict.fromkeys(sides, 0)
    for _ in range(rounds):
        for name, processes in sides.items():
            before = cpu_seconds(processes)
            latencies, pictures = driver.run(*topics[name], seconds)
            cpu[name] += cpu_seconds(processes) - before
            taken[name] += latencies
            sent[name] += pictures
    wall = rounds * (seconds + 1.0)
    median = {name: statistics.median(values) for name, values in taken.items()}
    shares = {
        f'chain_cpu_share_{n}': float(c / wall) for n, c in zip(NODES, cpu['chain'], strict=True)
    }
    return {
        'chain_latency_over_relay': median['chain'] / median['relay'],
        'chain_latency_p50_ms': median['chain'] * 1e3,
        'chain_latency_p99_ms': float(np.percentile(taken['chain'], 99) * 1e3),
        'chain_cpu_share': float(cpu['chain'].sum() / wall),
        **shares,
        'chain_answered': len(taken['chain']) / sent['chain'],
        'relay_latency_p50_ms': median['relay'] * 1e3,
        'relay_latency_p99_ms': float(np.percentile(taken['relay'], 99) * 1e3),
        'relay_cpu_share': float(cpu['relay'].sum() / wall),
        'relay_answered': len(taken['relay']) / sent['relay'],
    }


if __name__ == '__main__':
    if sys.argv[1] == '--relay':
        relay(int(sys.argv[2]))
    else:
        measured = {**bench_chain(sys.argv[1]), **bench_robots(sys.argv[1])}
        sys.stdout.write(json.dumps(measured, indent=2) + '\n')
