# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes as processes: `python bench_chain.py FOLDER MODEL.npz BAG [SECONDS]`.

Runs the package that lies in the folder, of any version. Measures the latency from an image to its
pose, the share of a core at 10 and at 30 images a second beside 50 odometry messages, the same in
one process, and with several cameras beside one, and time and memory until nodes are active.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from subprocess import PIPE, STDOUT, TimeoutExpired
from typing import Any

import cv2
import numpy as np
import psutil
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench_core import images_and_poses
from ros_bench import DEADLINE_S, DOMAIN, FRAMES, Spinner, start_process, until

from sfa_localization.camera.encodings import JPEG_QUALITY
from sfa_localization.camera.settings import LensCalibration
from sfa_localization.data.messages import read_stamp
from sfa_localization.nodes.conversions import to_compressed, to_image, to_odometry, to_stamp
from sfa_localization.nodes.lifecycle import latched_qos
from sfa_localization.place_model import PlaceModel

ODOMETRY_HZ, RIG_HZ, IDLE_S = 50.0, 10.0, 1.0
NAMESPACE = '/bench'


def start_node(name, *parameters, **options):
    """The process of a node; `cwd` is the folder of the package, if it is another version."""
    words = ['--ros-args', '-r', f'__ns:={NAMESPACE}', *(w for p in parameters for w in ('-p', p))]
    return start_process('-m', 'sfa_localization', name, *words, **options)


def end_process(process):
    """Ask it to end, and make it where it does not."""
    process.terminate()
    with suppress(TimeoutExpired):
        process.wait(DEADLINE_S)
    process.kill()
    process.wait()


class Driver:
    """Sends images and odometry to the nodes, and notes when the poses come."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('bench', context=self.context, namespace=NAMESPACE)
        self.executor = Spinner(self.context)
        self.executor.add_node(self.node)
        self.state, self.sent = '', dict[int, float]()
        self.latencies_s: list[float] = []
        self.images = self.node.create_publisher(Image, 'image_raw', 10)
        self.odometry = self.node.create_publisher(Odometry, 'odom', 1000)
        listen = self.node.create_subscription
        listen(PoseWithCovarianceStamped, 'ekf/pose', self.hear, 100)
        listen(String, 'ekf/state', self.hear_state, latched_qos())

    def hear(self, message: PoseWithCovarianceStamped) -> None:
        """Note when the pose of an image comes."""
        sent_s = self.sent.get(read_stamp(message.header.stamp))
        if sent_s is not None:
            self.latencies_s.append(time.perf_counter() - sent_s)

    def hear_state(self, message: String) -> None:
        """Note the state of the filter."""
        self.state = message.data

    def move(self, stamp_ns: int, pose: Any, twist: Any) -> None:
        """Send one odometry message."""
        moved = pose, np.eye(3), twist, np.eye(2) * 1e-6
        self.odometry.publish(to_odometry(*moved, stamp_ns, FRAMES))

    def show(self, image: np.ndarray, stamp_ns: int) -> None:
        """Send one image."""
        self.sent[stamp_ns] = time.perf_counter()
        self.images.publish(to_image(image, stamp_ns, 'omnicam'))

    def close(self) -> None:
        """End the node and its thread."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


class Shuttle(Driver):
    """Drives to and fro along the path of a bag."""

    def __init__(self, bag: Path) -> None:
        super().__init__()
        images, poses = images_and_poses(bag)
        poses[:, 2] = np.unwrap(poses[:, 2])
        order = [*range(len(images)), *range(len(images) - 2, 0, -1)]
        self.views, self.poses, self.passed = images[order], poses[order], 0

    def drive(self, rate_hz: float, seconds: float) -> None:
        """Drive in real time, so fast that images come at this rate."""
        self.sent.clear()
        self.latencies_s.clear()
        start, images, moves = time.perf_counter(), 0, 0
        while (now := time.perf_counter() - start) < seconds:
            if now >= moves / ODOMETRY_HZ:
                place = self.passed + now * rate_hz
                pose, move = self.pose(place), self.pose(place + 0.5) - self.pose(place - 0.5)
                speed = np.cos(pose[2]) * move[0] + np.sin(pose[2]) * move[1]
                self.move(time.time_ns(), pose, rate_hz * np.array([speed, move[2]]))
                moves += 1
            elif now >= images / rate_hz:
                self.show(self.views[(self.passed + images) % len(self.views)], time.time_ns())
                images += 1
            else:
                time.sleep(0.0005)
        self.passed += images
        time.sleep(IDLE_S)

    def pose(self, place: float) -> np.ndarray:
        """Return the pose of the odometry there, in images from the start."""
        turns = {'xp': np.arange(len(self.poses)), 'period': len(self.poses)}
        return np.array([np.interp(place, fp=column, **turns) for column in self.poses.T])


def parameters_of(path: Path | str) -> dict[str, list[str]]:
    """Return the parameters of each node, for images that are the panoramas of any model."""
    with np.load(path) as arrays:
        size = json.loads(str(arrays['header']))['panorama']
    names = 'width', 'height', 'elevation_min', 'elevation_max'
    return {
        'omnicam_node': ['camera_model:=panorama', *(f'{name}:={size[name]}' for name in names)],
        'sfa_node': [f'model:={Path(path).resolve()}'],
        'ekf_node': [],
    }


def composed(parameters: dict[str, list[str]]) -> dict[str, list[str]]:
    """Return the same for all nodes in one process."""
    return {'localization': [word for words in parameters.values() for word in words]}


@contextmanager
def running(parameters: dict[str, list[str]], **options: Any) -> Iterator[list[Any]]:
    """Start the nodes, and end them; yields their processes."""
    processes = [start_node(name, *p, **options) for name, p in parameters.items()]
    try:
        yield processes
    finally:
        for process in processes:
            end_process(process)


def cpu_s(processes: list[Any]) -> float:
    """Return the CPU time that processes have used, in s."""
    times = [psutil.Process(process.pid).cpu_times() for process in processes]
    return float(sum(spent.user + spent.system for spent in times))


def bench_nodes(
    package: Path, parameters: dict[str, list[str]], bag: Path, seconds: float
) -> dict[str, float]:
    """Share of a core at 10 and 30 images a second, the latency at 30, in ms, and the memory."""
    driver, figures = Shuttle(bag), {}
    try:
        with running(parameters, cwd=package) as processes:
            if not until(lambda: driver.drive(10.0, 3.0) or driver.state.startswith('LOCALISED')):
                raise RuntimeError('the nodes do not find the robot')
            for rate_hz in (10, 30):
                before = cpu_s(processes)
                driver.drive(rate_hz, seconds)
                figures[f'cpu_{rate_hz}_hz'] = (cpu_s(processes) - before) / (seconds + IDLE_S)
            median, late = np.percentile(driver.latencies_s, [50, 99]) * 1e3
            figures['all_mib'] = sum(map(rss_mib, processes))
            return {**figures, 'latency_p50_ms': float(median), 'latency_p99_ms': float(late)}
    finally:
        driver.close()


class Rig(Driver):
    """A robot that stands, whose cameras take JPEG images of `size` (columns, rows) at 10 Hz."""

    def __init__(self, topics: list[str], size: tuple[int, int]) -> None:
        super().__init__()
        make = self.node.create_publisher
        self.cameras = [make(CompressedImage, f'{topic}/compressed', 10) for topic in topics]
        self.taken = []
        for seed in range(10):
            noise = np.random.default_rng(seed).integers(0, 256, (30, 40, 3), np.uint8)
            image = cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC)
            self.taken.append(to_compressed(image, 1, 'camera', JPEG_QUALITY))

    def stand(self, seconds: float) -> None:
        """Send in real time."""
        self.sent.clear()
        self.latencies_s.clear()
        start, images, moves = time.perf_counter(), 0, 0
        while (now := time.perf_counter() - start) < seconds:
            if now >= moves / ODOMETRY_HZ:
                self.move(time.time_ns(), np.zeros(3), np.zeros(2))
                moves += 1
            elif now >= images / RIG_HZ:
                message, stamp_ns = self.taken[images % len(self.taken)], time.time_ns()
                message.header.stamp = to_stamp(stamp_ns)
                self.sent[stamp_ns] = time.perf_counter()
                for camera in self.cameras:
                    camera.publish(message)
                images += 1
            else:
                time.sleep(0.0005)
        time.sleep(IDLE_S)


def bench_rig(
    path: Path, seconds: float, topics: list[str], size: tuple[int, int]
) -> tuple[float, float]:
    """Share of a core, and the 99th percentile of the latency, ms, with the camera of a model."""
    given = [f'model:={path}']
    jpeg = [*given, 'image_transport:=compressed']
    placed = ['initial_pose:=[0.0, 0.0, 0.0]']  # the images are noise, which tells no place
    rig = Rig(topics, size)
    try:
        with running({'omnicam_node': jpeg, 'sfa_node': given, 'ekf_node': placed}) as processes:
            if not until(lambda: rig.stand(2.0) or rig.latencies_s):
                raise RuntimeError('the nodes give no pose')
            before = cpu_s(processes)
            rig.stand(seconds)
            share = (cpu_s(processes) - before) / (seconds + IDLE_S)
            if len(rig.latencies_s) < 0.9 * RIG_HZ * seconds:
                raise RuntimeError('images are lost: this computer is too busy')
            return share, float(np.percentile(rig.latencies_s, 99)) * 1e3
    finally:
        rig.close()


def bench_cameras(path: Path, seconds: float = 8.0) -> dict[str, float]:
    """Four cameras of 640 x 480 around a robot, over one mirror of 640 x 640."""
    from sfa_localization.camera.sectors import MountedCamera, optical_pose

    focal = 320 / math.tan(math.radians(50))
    lens = LensCalibration(image_height=480, fx=focal, fy=focal, cy=239.5, xi=0.0, radius_min=0.0,
                           radius_max=0.0, mirrored='no')  # fmt: skip
    names = ['front', 'left', 'rear', 'right']
    cameras = tuple(
        MountedCamera.at(name, lens, optical_pose((0.0, 0.0, 0.5), (0.0, 0.0, 90.0 * number)))
        for number, name in enumerate(names)
    )
    model = PlaceModel.load(path)
    with tempfile.TemporaryDirectory() as folder:
        one, four = Path(folder) / 'one.npz', Path(folder) / 'four.npz'
        replace(model, lens=LensCalibration()).save(one)
        replace(model, lens=None, surround=cameras).save(four)
        alone, _ = bench_rig(one, seconds, ['image_raw'], (640, 640))
        topics = [f'{name}/image_raw' for name in names]
        together, latency_ms = bench_rig(four, seconds, topics, (640, 480))
    return {'cameras_over_mirror': together / alone, 'cameras_latency_p99_ms': latency_ms}


def rss_mib(process: Any) -> float:
    """Return the resident memory of a process, in MiB."""
    return float(psutil.Process(process.pid).memory_info().rss / 2**20)


def bench_start(package: Path, parameters: dict[str, list[str]]) -> dict[str, float]:
    """Until all nodes, started at once, are active: time, in s, and of the node with the most of
    each, CPU time, in s, and memory, in MiB.
    """
    begun = time.perf_counter()
    with running(parameters, cwd=package, stdout=PIPE, stderr=STDOUT, text=True) as processes:
        for process in processes:
            next(line for line in process.stdout if line.rstrip().endswith(': active'))
        return {
            'launch_s': time.perf_counter() - begun,
            'active_s': max(cpu_s([process]) for process in processes),
            'memory_mib': max(map(rss_mib, processes)),
        }


if __name__ == '__main__':
    package, model_path, bag_path = map(Path, sys.argv[1:4])
    seconds = float(sys.argv[4]) if sys.argv[4:] else 8.0
    nodes = parameters_of(model_path)
    figures = bench_nodes(package, nodes, bag_path, seconds) | bench_start(package, nodes)
    if package.resolve() == Path(__file__).parents[2]:  # the last release lacks both
        alone = bench_nodes(package, composed(nodes), bag_path, seconds)
        figures |= {f'composed_{name}': value for name, value in alone.items()}
        with suppress(RuntimeError):  # too busy for the images of four cameras
            figures |= bench_cameras(model_path, seconds)
    print(json.dumps(figures))
