# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Several cameras live: what describes them, the panorama of their images, and faulty ones."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sfa_localization.camera import surround
from sfa_localization.camera.lenses import turned_camera
from sfa_localization.camera.panorama import panorama_rays
from sfa_localization.camera.sectors import MountedCamera, optical_pose
from sfa_localization.camera.settings import LensCalibration, PanoramaConfig, SurroundConfig
from sfa_localization.data.errors import ConfigError

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from ros_bench import standing, until
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String

from sfa_localization.data.messages import read_stamp
from sfa_localization.data.transforms import TransformTree
from sfa_localization.nodes import discovery, surround_input
from sfa_localization.nodes.conversions import to_compressed, to_image
from sfa_localization.nodes.ekf_node import EkfNode
from sfa_localization.nodes.lifecycle import latched_qos
from sfa_localization.nodes.omnicam_node import OmnicamNode
from sfa_localization.place_model import PlaceModel

pytestmark = pytest.mark.ros
PANORAMA = PanoramaConfig(width=120, height=12)
SMALL = {'width': 120, 'height': 12}
START_NS, STEP_NS = 12_000_000_000, 100_000_000
WALKS = {'front': 0.0, 'left': 90.0, 'rear': 180.0, 'right': 270.0}


def color(rays, turn=0.0):
    """The color (..., 3) along rays (..., 3): it differs by direction, and by channel."""
    azimuth = np.arctan2(rays[..., 1], rays[..., 0]) + turn
    waves = np.sin(azimuth), np.cos(azimuth), np.sin(2 * azimuth) + 2 * rays[..., 2]
    return 128 + 40 * np.stack(waves, axis=-1)


def pinhole(width=160, height=120, fov_deg=100.0):
    focal = width / 2 / np.tan(np.radians(fov_deg / 2))
    return LensCalibration(
        image_width=width, image_height=height, fx=focal, fy=focal, cx=width / 2 - 0.5,
        cy=height / 2 - 0.5, xi=0.0, radius_min=0.0, radius_max=0.0, axis='forward', mirrored='no',
    )  # fmt: skip


def fisheye(width=160, height=160, fov_deg=190.0):
    focal = width / np.radians(fov_deg)
    lens = pinhole(width, height)
    return replace(lens, camera_model='fisheye', fx=focal, fy=focal)


def picture(lens, yaw_deg, turn=0.0):
    """What a camera sees that looks toward an azimuth of the robot, turned by an angle."""
    size = lens.image_height, lens.image_width
    model = turned_camera(lens, size, optical_pose((0, 0, 0), (0, 0, yaw_deg))[:3, :3])
    columns, rows = np.meshgrid(np.arange(size[1]), np.arange(size[0]))
    rays = model.unproject(np.stack([columns.ravel(), rows.ravel()], -1).astype(float))
    seen = np.nan_to_num(color(rays, turn)).clip(0, 255)
    return np.rint(seen).astype(np.uint8).reshape(*size, 3)


def info_of(lens):
    is_fisheye = lens.camera_model == 'fisheye'
    k = [lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0]
    model = 'equidistant' if is_fisheye else 'plumb_bob'
    size = {'width': lens.image_width, 'height': lens.image_height}
    return CameraInfo(distortion_model=model, k=k, d=[0.0] * (4 if is_fisheye else 5), **size)


def poses(yaws):
    """The parameter camera_poses of cameras in one place."""
    return [number for yaw in yaws for number in (0.0, 0.0, 0.5, 0.0, 0.0, yaw)]


class Rig:
    """Cameras that look around, their node, and what it publishes."""

    def __init__(self, bench, yaws=None, lens=None, topic='{}/image_raw', **parameters):
        self.bench, self.yaws = bench, yaws or WALKS
        self.lens, self.topic = lens or pinhole(), topic
        self.number, self.skew_ns = 0, dict.fromkeys(self.yaws, 0)
        given = {'cameras': [*self.yaws], 'camera_poses': poses(self.yaws.values())}
        given = {name: value for name, value in (SMALL | given | parameters).items() if value}
        self.node = bench.run(OmnicamNode, **given)
        self.heard = bench.listen(Image, 'panorama')
        self.troubles = bench.listen(String, 'panorama/troubles', latched_qos())

    def describe(self, *names):
        """Publish camera_info until all of these are taken."""
        for name in names or self.yaws:
            info, topic = info_of(self.lens), f'{name}/camera_info'
            used = self.node.monitors[topic]
            assert self.bench.publish_until(topic, info, lambda u=used: u.used)

    def send(self, without=(), make=None):
        """The images of the next time, of all cameras but some; waits until each is taken."""
        self.number += 1
        stamp_ns = START_NS + self.number * STEP_NS
        for name, yaw in self.yaws.items():
            if name in without:
                continue
            image = picture(self.lens, yaw, 0.01 * self.number)
            image = make(name, image) if make else image
            sent = to_image(image, stamp_ns + self.skew_ns[name], f'{name}_optical_frame')
            monitor = self.node.monitors[f'{name}/image_raw']
            before = monitor.received
            self.bench.publish(self.topic.format(name), sent)
            assert until(lambda m=monitor, b=before: m.received > b)
        return stamp_ns

    def connect(self):
        """Wait until the node receives images of all cameras."""
        topics = [self.topic.format(name) for name in self.yaws]
        assert until(lambda: all(self.node.count_subscribers(topic) for topic in topics))
        for name, topic in zip(self.yaws, topics, strict=True):
            sent = to_image(picture(self.lens, 0.0), 1, 'x')
            monitor = self.node.monitors[f'{name}/image_raw']
            assert self.bench.publish_until(topic, sent, lambda m=monitor: m.received)

    def next(self, **options):
        """Send until another panorama is heard; the last one, (H, W, 3), and its stamp."""
        count = len(self.heard)
        for _ in range(20):
            stamp_ns = self.send(**options)
            if until(lambda: len(self.heard) > count, 0.3):
                break
        last = self.heard[-1]
        data = np.frombuffer(last.data, np.uint8).reshape(last.height, last.width, 3)
        return data, read_stamp(last.header.stamp), stamp_ns


def expected(turn):
    return color(panorama_rays(PANORAMA), turn)
