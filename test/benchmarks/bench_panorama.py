# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Unwrapping against bare cv2.remap, and the omnicam node against a bare relay.

Each ratio compares two things measured in turns, in one run: `python bench_panorama.py`.
"""

from __future__ import annotations

import array
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from sfa_localization.camera.calibration_files import calibration_text
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.panorama import Unwrapper, build_tables
from sfa_localization.camera.settings import CameraConfig, LensCalibration, PanoramaConfig

CAMERA = CameraConfig(camera_model='mirror')
SIZE = {'image_width': 1280, 'image_height': 960, 'cx': 640.0, 'cy': 480.0}
LENS = LensCalibration(fx=225.0, fy=225.0, radius_min=60.0, radius_max=476.0, **SIZE)
PANORAMAS = {'600x60': PanoramaConfig(), '1200x120': PanoramaConfig(width=1200, height=120)}


def picture() -> np.ndarray:
    """A textured raw picture (960, 1280, 3)."""
    noise = np.random.default_rng(1).integers(0, 256, (60, 80, 3), np.uint8)
    return np.asarray(cv2.resize(noise, (1280, 960), interpolation=cv2.INTER_CUBIC))


def interleaved(functions: list[Callable[[], object]], rounds: int) -> np.ndarray:
    """Seconds (rounds, functions), each round calling every function once, in turns."""
    times = np.empty((rounds, len(functions)))
    for row in range(rounds):
        for column in np.roll(np.arange(len(functions)), row):
            start = time.perf_counter()
            functions[column]()
            times[row, column] = time.perf_counter() - start
    return times


def bench_unwrap(rounds: int = 400) -> dict[str, float]:
    """Median time of a whole unwrapping over that of cv2.remap with the same tables, at worst."""
    raw, ratios, result = picture(), [], {}
    for name, panorama in PANORAMAS.items():
        unwrap = Unwrapper(CAMERA, panorama, LENS)
        tables = build_tables(CAMERA, LENS, panorama, raw.shape[:2])
        maps = tables.pixels, tables.fractions

        def remap(maps=maps, border=tables.border):
            return cv2.remap(raw, *maps, cv2.INTER_LINEAR, borderMode=border)

        def rebuild(panorama=panorama):
            return Unwrapper(CAMERA, panorama, LENS)(raw)

        unwrap(raw)
        times = interleaved([remap, lambda unwrap=unwrap: unwrap(raw)], rounds)
        middle = np.median(times[rounds // 10 :], axis=0)
        building = np.median(interleaved([rebuild], 5))
        ratios.append(middle[1] / middle[0])
        result[f'unwrap_{name}_ms'] = middle[1] * 1e3
        result[f'remap_{name}_ms'] = middle[0] * 1e3
        result[f'tables_each_time_{name}_over_unwrap'] = building / middle[1]
    return {'unwrap_over_remap': float(max(ratios)), **{k: float(v) for k, v in result.items()}}


def bench_roundtrip() -> dict[str, float]:
    """PSNR in dB of unwrapped simulated pictures against the directly rendered panorama."""
    from sfa_localization.simulation.garden import Garden

    limits = {'radius_min': 0.0, 'radius_max': 0.0, 'image_width': 800, 'image_height': 800}
    center = {'cx': 399.5, 'cy': 399.5}
    lenses = {
        'mirror': LensCalibration(),
        'fisheye': LensCalibration(camera_model='fisheye', fx=195.0, fy=195.0, **limits, **center),
        'ocam': LensCalibration(
            camera_model='ocam', polynomial=(-150.0, 0.0, 1.8e-3, -1e-7), **limits, **center
        ),
    }
    garden, pose, panorama = Garden(1), np.array([0.5, -1.0, 0.7]), PanoramaConfig()
    direct = garden.render_panorama(pose, panorama).astype(float)
    result = {}
    for name, lens in lenses.items():
        camera = make_camera(lens, (lens.image_height, lens.image_width))
        error = Unwrapper(CAMERA, panorama, lens)(garden.render_raw(pose, camera)) - direct
        result[f'psnr_{name}_db'] = float(10 * np.log10(255**2 / np.mean(error**2)))
    return result


class _Loop:
    """Sends pictures to the omnicam node and to a relay in turns, and times each answer."""

    def __init__(self, domain_id: int, calibration: Path) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.parameter import Parameter
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import Image

        from sfa_localization.nodes.omnicam_node import OmnicamNode

        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain_id)
        # Reliable throughout: a lost picture would otherwise be timed as a slow one.
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
        overrides = {
            'qos_overrides./raw_a.subscription.reliability': 'reliable',
            'calibration_file': str(calibration),
        }
        self.node = OmnicamNode(
            context=self.context,
            cli_args=['--ros-args', '-r', 'image_raw:=/raw_a', '-r', 'panorama:=/out_a'],
            parameter_overrides=[Parameter(n, value=value) for n, value in overrides.items()],
        )
        self.relay = rclpy.create_node('relay', context=self.context)
        self.peer = rclpy.create_node('peer', context=self.context)
        relayed = self.relay.create_publisher(Image, '/out_b', qos)
        self.relay.create_subscription(Image, '/raw_b', relayed.publish, qos)
        self.answered = 0.0
        for name in 'ab':
            self.peer.create_subscription(Image, f'/out_{name}', self._answer, qos)
        self.senders = [self.peer.create_publisher(Image, f'/raw_{n}', qos) for n in 'ab']
        self.executor = SingleThreadedExecutor(context=self.context)
        for node in (self.node, self.relay, self.peer):
            self.executor.add_node(node)
        self.node.start()
        deadline = time.monotonic() + 20
        while not all(sender.get_subscription_count() for sender in self.senders):
            if time.monotonic() > deadline:
                raise TimeoutError('the nodes did not find each other')
            self.executor.spin_once(timeout_sec=0.05)

    def _answer(self, message: object) -> None:
        self.answered = time.perf_counter()

    def time_one(self, which: int, message: object) -> float:
        """Seconds from publishing a picture to the arrival of its answer; NaN when it is lost."""
        self.answered = 0.0
        deadline = time.monotonic() + 2
        start = time.perf_counter()
        self.senders[which].publish(message)
        while not self.answered and time.monotonic() < deadline:
            self.executor.spin_once(timeout_sec=0.5)
        return self.answered - start if self.answered else float('nan')

    def close(self) -> None:
        import rclpy

        self.executor.shutdown()
        for node in (self.node, self.relay, self.peer):
            node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def bench_omnicam(rounds: int = 150, domain_id: int = 65) -> dict[str, float]:
    """The node's latency in to out less that of a bare rclpy relay, over the time of unwrapping.

    Pictures of 1280 x 960 to 600 x 60; the relay sends the same pictures on as they are.
    """
    from sensor_msgs.msg import Image

    raw = picture()
    message = Image(encoding='bgr8', height=960, width=1280, step=3840)
    message.header.stamp.sec = 1
    message.data = array.array('B', raw.tobytes())
    unwrap = Unwrapper(CAMERA, PANORAMAS['600x60'], LENS)
    unwrap(raw)
    with tempfile.TemporaryDirectory() as folder:
        calibration = Path(folder, 'camera.yaml')
        calibration.write_text(calibration_text(LENS, CAMERA.mount_rpy))
        loop = _Loop(domain_id, calibration)
    try:
        times = np.array([[loop.time_one(n, message) for n in range(2)] for _ in range(rounds)])
        remap = np.median(interleaved([lambda: unwrap(raw)], rounds))
    finally:
        loop.close()
    # Large messages take one of several times at random: compare the undisturbed ones.
    node, relay = np.nanquantile(times[rounds // 10 :], 0.2, axis=0)
    return {
        'omnicam_latency_over_relay': float((node - relay) / remap),
        'omnicam_latency_ms': float(node * 1e3),
        'relay_latency_ms': float(relay * 1e3),
        'pictures_lost': float(np.isnan(times).mean()),
    }


if __name__ == '__main__':
    json.dump({**bench_unwrap(), **bench_roundtrip(), **bench_omnicam()}, sys.stdout, indent=2)
