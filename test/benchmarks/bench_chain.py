# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three nodes as processes, for one, two and four robots on this machine: `bench_chain.py`
MODEL.npz. Latency from an image to its pose, and CPU of each node.

Images come 10 and 30 times a second, odometry 50 times. The images are panoramas already.
"""

from __future__ import annotations

import json
import sys
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image

sys.path.insert(0, str(Path(__file__).parents[1]))

from ros_bench import DEADLINE_S, DOMAIN, Spinner, end_process, start_node

from sfa_localization.data.messages import read_stamp
from sfa_localization.nodes.conversions import to_image, to_odometry
from sfa_localization.place_model import PlaceModel

ODOMETRY_HZ, LAST_S = 50.0, 1.0
ROBOTS, RATES_HZ = (1, 2, 4), (10.0, 30.0)


class Driver:
    """Sends images and odometry to robots in namespaces, and notes when the poses come."""

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
        self.odometry = {name: make(Odometry, f'/{name}/odom', 1000) for name in names}
        for name in names:
            hear, topic = partial(self.hear, name), f'/{name}/ekf/pose'
            self.node.create_subscription(PoseWithCovarianceStamped, topic, hear, 100)

    def hear(self, name: str, message: PoseWithCovarianceStamped) -> None:
        """Note when a pose of this robot comes."""
        sent_s = self.sent.get(read_stamp(message.header.stamp))
        if sent_s is not None:
            self.latencies[name].append(time.perf_counter() - sent_s)

    def run(self, rate_hz: float, seconds: float) -> int:
        """Send to robots that stand for some seconds; how many images each of them got."""
        self.sent.clear()
        start, images, moves = time.perf_counter(), 0, 0
        while (now := time.perf_counter() - start) < seconds:
            if now >= moves / ODOMETRY_HZ:
                self.move(time.time_ns(), np.zeros(3), (0.0, 0.0))
                moves += 1
            elif now >= images / rate_hz:
                self.panorama[3::6, ::3, 0] ^= 1  # never the same twice
                self.panorama[0, 0] = time.time_ns() % 251
                self.show(self.panorama, time.time_ns())
                images += 1
            else:
                time.sleep(0.0005)
        time.sleep(LAST_S)
        return images

    def move(self, stamp_ns: int, pose: Any, twist: Any) -> None:
        """One odometry message to each robot."""
        frames, one = ('odom', 'base_link'), np.eye(3)
        message = to_odometry(pose, one, twist, one[:2, :2] * 1e-6, stamp_ns, frames)
        for publisher in self.odometry.values():
            publisher.publish(message)

    def show(self, image: np.ndarray, stamp_ns: int) -> None:
        """One image to each robot."""
        message = to_image(image, stamp_ns, 'omnicam')
        self.sent[stamp_ns] = time.perf_counter()
        for publisher in self.images.values():
            publisher.publish(message)

    def close(self) -> None:
        """End the node and its thread."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def parameters_of(model: PlaceModel, path: Path | str) -> dict[str, list[str]]:
    """Parameters of the nodes, by their names, for images that are the model's panoramas."""
    size = model.panorama
    return {
        'omnicam_node': ['camera_model:=panorama', f'width:={size.width}',
                         f'height:={size.height}', f'elevation_min:={size.elevation_min}',
                         f'elevation_max:={size.elevation_max}'],
        'sfa_node': [f'model:={Path(path).resolve()}'],
        'ekf_node': [],
    }  # fmt: skip


@contextmanager
def driven(model_path: Path | str, names: list[str]):
    """The driver, once each robot has answered, and the processes of each node."""
    model = PlaceModel.load(model_path)
    driver, parameters = Driver(model, names), parameters_of(model, model_path)
    parameters['ekf_node'] = ['initial_pose:=[0.0, 0.0, 0.0]']  # no image is of the place
    running = {
        node: [start_node(node, *given, namespace=f'/{name}') for name in names]
        for node, given in parameters.items()
    }
    try:
        end = time.monotonic() + DEADLINE_S
        while not all(driver.latencies.values()):
            if time.monotonic() > end:
                raise RuntimeError(f'robots do not answer: {driver.latencies}')
            driver.run(10.0, 0.5)
        yield driver, running
    finally:
        driver.close()
        for processes in running.values():
            for process in processes:
                end_process(process)


def cpu_s(processes: list[Any]) -> float:
    """The mean CPU time that processes have used, s."""
    times = [psutil.Process(process.pid).cpu_times() for process in processes]
    return float(np.mean([spent.user + spent.system for spent in times]))


def bench_chain(model_path: Path | str, seconds: float = 8.0) -> dict[str, float]:
    """By robots and rate of images: CPU shares of each node (1: one core), the mean of the robots,
    percentiles of latency in ms, and the share of images that were answered.
    """
    found: dict[str, float] = {}
    for count in ROBOTS:
        with driven(model_path, [f'robot{k + 1}' for k in range(count)]) as (driver, running):
            for rate_hz in RATES_HZ:
                for each in driver.latencies.values():
                    each.clear()
                before = {node: cpu_s(processes) for node, processes in running.items()}
                images, prefix = driver.run(rate_hz, seconds), f'robots_{count}_at_{rate_hz:.0f}_hz'
                for node, processes in running.items():
                    share = (cpu_s(processes) - before[node]) / (seconds + LAST_S)
                    found[f'{prefix}_cpu_{node}'] = share
                taken = [latency for each in driver.latencies.values() for latency in each]
                found[f'{prefix}_answered'] = len(taken) / (images * count)
                for percent in (50, 99):
                    latency_ms = float(np.percentile(taken or [np.nan], percent) * 1e3)
                    found[f'{prefix}_latency_p{percent}_ms'] = latency_ms
    alone = f'robots_1_at_{RATES_HZ[-1]:.0f}_hz'
    found['chain_cpu_share'] = sum(v for k, v in found.items() if k.startswith(f'{alone}_cpu'))
    found['chain_latency_p99_ms'] = found[f'{alone}_latency_p99_ms']
    return found


if __name__ == '__main__':
    sys.stdout.write(json.dumps(bench_chain(sys.argv[1]), indent=2) + '\n')
