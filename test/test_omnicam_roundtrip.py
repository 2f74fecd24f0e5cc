# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The simulator's raw picture through the real node equals its directly rendered panorama."""

import dataclasses

import numpy as np
import pytest

from sfa_localization.camera.settings import CameraConfig, PanoramaConfig

rclpy = pytest.importorskip('rclpy')
pytest.importorskip('trimesh')
pytestmark = pytest.mark.ros

from omnicam_bench import Bench, image_message, new_context, pixels, send_until  # noqa: E402

from sfa_localization.simulation.garden import Garden  # noqa: E402

OPEN = {'radius_min': 0.0, 'radius_max': 0.0}
CAMERAS = {
    'mirror': CameraConfig(),
    'mirror, tilted': CameraConfig(mount_yaw=40.0, mount_roll=2.0, mount_pitch=-3.0),
    'fisheye': CameraConfig(
        camera_model='fisheye',
        image_width=800,
        image_height=700,
        cx=400.0,
        cy=350.0,
        fx=195.0,
        fy=195.0,
        distortion=(0.01, -0.003, 0.0004, 0.0),
        **OPEN,
    ),
    'ocam': CameraConfig(
        camera_model='ocam',
        image_width=800,
        image_height=800,
        cx=401.0,
        cy=399.0,
        polynomial=(-150.0, 0.0, 1.8e-3, -1e-7),
        affine=(1.001, 0.001, -0.001),
        **OPEN,
    ),
    'equirectangular': CameraConfig(
        camera_model='equirectangular', image_width=1200, image_height=600
    ),
}
POSE = np.array([0.5, -1.0, 0.7])


@pytest.fixture(scope='module')
def garden():
    return Garden(1)


def psnr(a, b):
    return 10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2))


@pytest.mark.parametrize('name', CAMERAS)
def test_the_node_undoes_the_camera(garden, name, monkeypatch, tmp_path):
    monkeypatch.setenv('ROS_PYTHON_CHECK_FIELDS', '1')
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    camera, panorama = CAMERAS[name], PanoramaConfig()
    context = new_context(64)
    fields = dataclasses.asdict(camera) | dataclasses.asdict(panorama)
    parameters = {
        key: list(value) if isinstance(value, tuple) else value for key, value in fields.items()
    }
    bench = Bench(context, **parameters).start()
    try:
        bench.hear('panorama')
        raw = garden.render_raw(POSE, camera)
        result = pixels(send_until(bench, bench.speak(), image_message(raw)))
    finally:
        bench.close()
        rclpy.try_shutdown(context=context)
    direct = garden.render_panorama(POSE, panorama)
    assert psnr(result, direct) >= 30.0
