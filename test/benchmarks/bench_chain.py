# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three nodes as processes against three relays that only pass messages on: `bench_chain.py`
MODEL.npz. Latency from a picture to its pose, and CPU; then those of one, two and four robots.

The two chains take turns at 30 pictures and 50 odometry messages a second; the pictures are
panoramas already, so that both carry the same. All nodes run on this machine, in one domain.
"""

from __future__ import annotations

import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

sys.path.insert(0, str(Path(__file__).parents[1]))

from ros_bench import DOMAIN, Spinner, end_process, start_node, start_process

from sfa_localization.data.messages import read_stamp
from sfa_localization.nodes.conversions import to_image, to_odometry, to_pose_with_covariance
from sfa_localization.place_model import PlaceModel

ODOMETRY_HZ, PICTURES_HZ = 50.0, 30.0
NODES = ('omnicam_node', 'sfa_node', 'ekf_node')
STAGES = [
    (Image, 'image_raw'),
    (Image, 'panorama'),
    (PoseWithCovarianceStamped, 'sfa/pose_with_covariance'),
    (PoseWithCovarianceStamped, 'ekf/pose'),
]
"""What each of three nodes takes, and what it gives."""
DEADLINE_S, LAST_S = 60.0, 1.0
ROBOTS, RATES_HZ = (1, 2, 4), (10.0, 30.0)


class Relay(Node):
    """Passes a message on, and does the least that its neighbor in the chain must: nothing."""

    def __init__(self, stage: int) -> None:
        super().__init__(f'relay_{stage}')
        (self.kind, topic), (self.made, output) = STAGES[stage : stage + 2]
        self.out = self.create_publisher(self.made, output, 10)
        self.create_subscription(self.kind, topic, self.pass_on, qos_profile_sensor_data)
        self.create_subscription(Odometry, 'odom', lambda _: None, qos_profile_sensor_data)
        self.answer = to_pose_with_covariance([0, 0, 0], np.eye(3), 1, 'map')

    def pass_on(self, message: Any) -> None:
        """The picture as it is, then a pose of the same stamp."""
        if self.made is not self.kind:
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
    """Sends pictures and odometry to robots in namespaces, and notes when the poses come."""

    def __init__(self, model: PlaceModel, names: list[str]) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('bench', context=self.context)
        self.executor = Spinner(self.context)
        self.executor.add_node(self.node)
        size = (model.panorama.height, model.panorama.width, 3)
        self.panorama = np.random.default_rng(1).integers(40, 215, size, np.uint8)
        self.sent: dict[int, float] = {}
        self.latencies: dict[str, list[float]] = {name: [] for name in names}
        make = self.node.create_publisher
        self.images = {name: make(Image, f'/{name}/image_raw', 10) for name in names}
        self.odometry = {name: make(Odometry, f'/{name}/odom', 10) for name in names}
        for name in names:
            kind, topic = STAGES[-1]
            listen = partial(self.hear, name)
            self.node.create_subscription(kind, f'/{name}/{topic}', listen, 10)

    def hear(self, name: str, message: PoseWithCovarianceStamped) -> None:
        """Note when a pose of this robot comes."""
        sent_s = self.sent.get(read_stamp(message.header.stamp))
        if sent_s is not None:
            self.latencies[name].append(time.perf_counter() - sent_s)

    def run(self, names: list[str], rate_hz: float, seconds: float) -> int:
        """Send for some seconds; how many pictures each of the robots got."""
        self.sent.clear()
        start, pictures, moves = time.perf_counter(), 0, 0
        while (now := time.perf_counter() - start) < seconds:
            if now >= moves / ODOMETRY_HZ:
                self.move(names, time.time_ns(), np.zeros(3), (0.0, 0.0))
                moves += 1
            elif now >= pictures / rate_hz:
                self.panorama[3::6, ::3, 0] ^= 1  # never the same twice
                self.panorama[0, 0] = time.time_ns() % 251
                self.show(names, self.panorama, time.time_ns())
                pictures += 1
            else:
                time.sleep(0.0005)
        time.sleep(LAST_S)
        return pictures

    def move(self, names: list[str], stamp_ns: int, pose: Any, twist: Any) -> None:
        """One odometry message."""
        frames, one = ('odom', 'base_link'), np.eye(3)
        message = to_odometry(pose, one, twist, one[:2, :2] * 1e-6, stamp_ns, frames)
        for name in names:
            self.odometry[name].publish(message)

    def show(self, names: list[str], image: np.ndarray, stamp_ns: int) -> None:
        """One image."""
        message = to_image(image, stamp_ns, 'omnicam')
        self.sent[stamp_ns] = time.perf_counter()
        for name in names:
            self.images[name].publish(message)

    def wait(self) -> None:
        """Until each robot has answered."""
        end = time.monotonic() + DEADLINE_S
        while silent := [name for name, heard in self.latencies.items() if not heard]:
            if time.monotonic() > end:
                raise RuntimeError(f'nothing comes back from {", ".join(silent)}')
            self.run(silent, 10.0, 0.5)

    def close(self) -> None:
        """End the node and its thread."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def parameters_of(model: PlaceModel, path: Path) -> dict[str, list[str]]:
    """Parameters of the nodes, by their names, for images that are the model's panoramas."""
    size = model.panorama
    return {
        'omnicam_node': ['camera_model:=panorama', f'width:={size.width}',
                         f'height:={size.height}', f'elevation_min:={size.elevation_min}',
                         f'elevation_max:={size.elevation_max}'],
        'sfa_node': [f'model:={path.resolve()}'],
        'ekf_node': [],
    }  # fmt: skip


class Processes:
    """Three processes for each robot; `kinds` are chain or relay, by namespace."""

    def __init__(self, model_path: Path, model: PlaceModel, kinds: dict[str, str]) -> None:
        parameters = parameters_of(model, model_path)
        parameters['ekf_node'] = ['initial_pose:=[0.0, 0.0, 0.0]']
        self.driver = Driver(model, [*kinds])
        self.running = {
            name: [
                start_node(node, *parameters[node], namespace=f'/{name}')
                if kind == 'chain'
                else start_process(__file__, stage, '--ros-args', '-r', f'__ns:=/{name}')
                for stage, node in enumerate(NODES)
            ]
            for name, kind in kinds.items()
        }

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        self.driver.close()
        for each in self.running.values():
            for process in each:
                end_process(process)

    def measure(self, names: list[str], rate_hz: float, seconds: float) -> tuple[int, np.ndarray]:
        """Pictures that each robot got, and CPU seconds (robots, 3) that its nodes used."""
        before = self._cpu_s(names)
        return self.driver.run(names, rate_hz, seconds), self._cpu_s(names) - before

    def _cpu_s(self, names: list[str]) -> np.ndarray:
        used = [[psutil.Process(p.pid).cpu_times() for p in self.running[name]] for name in names]
        return np.array([[times.user + times.system for times in each] for each in used])


def bench_chain(model_path: Path | str, rounds: int = 3, seconds: float = 8.0) -> dict[str, float]:
    """Median latency over the relay's, the chain's p99 in ms, and its CPU share (1: one core)."""
    model, sides = PlaceModel.load(model_path), ('chain', 'relay')
    with Processes(Path(model_path), model, {side: side for side in sides}) as processes:
        processes.driver.wait()
        taken = processes.driver.latencies
        cpu, sent = {side: np.zeros(3) for side in sides}, dict.fromkeys(sides, 0)
        for heard in taken.values():
            heard.clear()
        for _ in range(rounds):
            for side in sides:
                pictures, used = processes.measure([side], PICTURES_HZ, seconds)
                sent[side] += pictures
                cpu[side] += used[0]
    found: dict[str, float] = {}
    for side in sides:
        found[f'{side}_latency_p50_ms'], found[f'{side}_latency_p99_ms'] = (
            float(np.percentile(taken[side], percent) * 1e3) for percent in (50, 99)
        )
        shares = cpu[side] / (rounds * (seconds + LAST_S))
        found[f'{side}_cpu_share'] = float(shares.sum())
        found[f'{side}_answered'] = len(taken[side]) / sent[side]
        if side == 'chain':
            found |= {f'chain_cpu_share_{n}': float(s) for n, s in zip(NODES, shares, strict=True)}
    ratio = found['chain_latency_p50_ms'] / found['relay_latency_p50_ms']
    return {'chain_latency_over_relay': ratio, **found}


def bench_robots(model_path: Path | str, seconds: float = 8.0) -> dict[str, float]:
    """CPU shares of each node (1: one core), the mean of the robots, by robots and camera rate."""
    model, found = PlaceModel.load(model_path), {}
    for count in ROBOTS:
        names = [f'robot{k + 1}' for k in range(count)]
        with Processes(Path(model_path), model, dict.fromkeys(names, 'chain')) as processes:
            processes.driver.wait()
            for rate_hz in RATES_HZ:
                answers = processes.driver.latencies
                before = sum(map(len, answers.values()))
                pictures, used = processes.measure(names, rate_hz, seconds)
                prefix = f'robots_{count}_at_{rate_hz:.0f}_hz'
                for node, cpu_s in zip(NODES, used.mean(axis=0), strict=True):
                    found[f'{prefix}_cpu_{node}'] = float(cpu_s / (seconds + LAST_S))
                answered = sum(map(len, answers.values())) - before
                found[f'{prefix}_answered'] = answered / (pictures * count)
    return found


if __name__ == '__main__':
    if sys.argv[1].isdigit():
        relay(int(sys.argv[1]))
    else:
        measured = {**bench_chain(sys.argv[1]), **bench_robots(sys.argv[1])}
        sys.stdout.write(json.dumps(measured, indent=2) + '\n')
