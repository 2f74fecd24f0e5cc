# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three nodes as processes over three relays that only pass messages on: `bench_chain.py`
MODEL.npz BAG. Latency from an image to its pose, CPU, and what a node takes until it is active.

Images come 30 times a second, odometry 50 times. The images are panoramas already.
"""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import Image

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench_busy import drive_of, images_of
from ros_bench import DEADLINE_S, DOMAIN, Spinner, end_process, start_node, start_process

from sfa_localization.data.messages import read_stamp
from sfa_localization.nodes.conversions import to_image, to_odometry
from sfa_localization.nodes.lifecycle import sensor_qos
from sfa_localization.place_model import PlaceModel

ODOMETRY_HZ, IMAGES_HZ, LAST_S = 50.0, 30.0, 1.0
_SEEN = 'sfa/pose_with_covariance'
_POSE = PoseWithCovarianceStamped
RELAYS = {
    'omnicam_node': [(Image, 'image_raw', Image, 'panorama')],
    'sfa_node': [(Image, 'panorama', _POSE, _SEEN)],
    'ekf_node': [(_POSE, _SEEN, _POSE, 'ekf/pose'), (Odometry, 'odom', Odometry, 'ekf/odometry')],
}
"""What each node receives and publishes."""


class Driver:
    """Sends images and odometry to robots in namespaces, and notes when the poses come."""

    def __init__(
        self, model: PlaceModel, names: list[str], pictures: np.ndarray | None = None
    ) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('bench', context=self.context)
        self.executor = Spinner(self.context)
        self.executor.add_node(self.node)
        size = (1, model.panorama.height, model.panorama.width, 3)
        noise = np.random.default_rng(1).integers(40, 215, size, np.uint8)
        self.panoramas = itertools.cycle(noise if pictures is None else pictures.copy())
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
                panorama = next(self.panoramas)
                panorama[3::6, ::3, 0] ^= 1  # never the same twice
                panorama[0, 0] = time.time_ns() % 251
                self.show(panorama, time.time_ns())
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


def relay(node: str, namespace: str) -> None:
    """In the place of a node: pass on each message, or an empty one with its header."""
    rclpy.init()
    here = rclpy.create_node(f'relay_{node}', namespace=namespace)

    def passing(given: type, topic: str, made: type, onward: str) -> None:
        publisher = here.create_publisher(made, onward, 10)

        def take(message: Any) -> None:
            publisher.publish(message if given is made else made(header=message.header))

        here.create_subscription(given, topic, take, sensor_qos(20))

    for topics in RELAYS[node]:
        passing(*topics)
    with suppress(ExternalShutdownException):
        rclpy.spin(here)


def nodes_of(model: PlaceModel, path: Path | str, names: list[str]) -> dict[str, list[Any]]:
    """The processes of the nodes of robots of these names."""
    parameters = parameters_of(model, path)
    parameters['ekf_node'] = ['initial_pose:=[0.0, 0.0, 0.0]']  # no image is of the place
    return {
        node: [start_node(node, *given, namespace=f'/{name}') for name in names]
        for node, given in parameters.items()
    }


def relays_of(name: str) -> dict[str, list[Any]]:
    """The processes of relays in the place of the nodes."""
    return {node: [start_process(__file__, '--relay', node, f'/{name}')] for node in RELAYS}


@contextmanager
def driven(
    model: PlaceModel,
    names: list[str],
    running: dict[str, list[Any]],
    pictures: np.ndarray | None = None,
) -> Iterator[Driver]:
    """A driver of robots whose processes are running, once each has answered; it ends them."""
    driver = Driver(model, names, pictures)
    try:
        end = time.monotonic() + DEADLINE_S
        while not all(driver.latencies.values()):
            if time.monotonic() > end:
                raise RuntimeError(f'robots do not answer: {driver.latencies}')
            driver.run(10.0, 0.5)
        yield driver
    finally:
        driver.close()
        for processes in running.values():
            for process in processes:
                end_process(process)


def cpu_s(processes: list[Any]) -> float:
    """The mean CPU time that processes have used, s."""
    times = [psutil.Process(process.pid).cpu_times() for process in processes]
    return float(np.mean([spent.user + spent.system for spent in times]))


def measured(
    driver: Driver, running: dict[str, list[Any]], rate_hz: float, seconds: float
) -> dict[str, float]:
    """CPU shares of each node (1: one core), the mean of the robots, percentiles of latency in ms,
    and the share of images that were answered.
    """
    for each in driver.latencies.values():
        each.clear()
    before = {node: cpu_s(processes) for node, processes in running.items()}
    images = driver.run(rate_hz, seconds)
    spent = {node: cpu_s(processes) - before[node] for node, processes in running.items()}
    found = {f'cpu_{node}': used / (seconds + LAST_S) for node, used in spent.items()}
    found['cpu'] = sum(found.values())
    taken = [latency for each in driver.latencies.values() for latency in each]
    found['answered'] = len(taken) / (images * len(driver.latencies))
    for percent in (50, 99):
        found[f'latency_p{percent}_ms'] = float(np.percentile(taken or [np.nan], percent) * 1e3)
    return found


def bench_chain(path: Path | str, drive: Path | str, seconds: float = 8.0) -> dict[str, float]:
    """Nodes over relays at the higher rate, in turns, with images of a drive in the place."""
    model = PlaceModel.load(path)
    pictures = images_of(drive_of(model, Path(drive)))
    nodes, relays = nodes_of(model, path, ['robot']), relays_of('relays')
    rounds: list[list[dict[str, float]]] = []
    with (
        driven(model, ['robot'], nodes, pictures) as robot,
        driven(model, ['relays'], relays, pictures) as passing,
    ):
        for _ in range(2):
            sides = (robot, nodes), (passing, relays)
            rounds.append([measured(*side, IMAGES_HZ, seconds) for side in sides])
    ours, bare = (
        {name: min(one[k][name] for one in rounds) for name in rounds[0][k]} for k in (0, 1)
    )
    found = {f'chain_{name}': value for name, value in ours.items()}
    for name in ('latency_p50_ms', 'latency_p99_ms', 'cpu'):
        found[f'chain_{name.removesuffix("_ms")}_over_relays'] = ours[name] / bare[name]
    return {**found, **bench_start(model, path)}


def bench_start(model: PlaceModel, path: Path | str) -> dict[str, float]:
    """CPU s from exec to active, and resident MiB then, of each node."""
    found: dict[str, float] = {}
    for node, given in parameters_of(model, path).items():
        pipe = {'stdout': subprocess.PIPE, 'stderr': subprocess.STDOUT, 'text': True}
        process = start_node(node, *given, **pipe)
        try:
            next(line for line in process.stdout if line.rstrip().endswith(': active'))
            found[f'start_{node}_cpu_s'] = cpu_s([process])
            found[f'start_{node}_mib'] = psutil.Process(process.pid).memory_info().rss / 2**20
        finally:
            end_process(process)
    return found


if __name__ == '__main__':
    if '--relay' in sys.argv:
        relay(*sys.argv[2:])
    else:
        sys.stdout.write(json.dumps(bench_chain(*sys.argv[1:]), indent=2) + '\n')
