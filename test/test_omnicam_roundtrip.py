# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The simulator's raw image through the real node equals its directly rendered panorama."""

import numpy as np
import pytest
from ros_domains import free_domain

from sfa_localization.camera.calibration_files import calibration_text
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.settings import LensCalibration, PanoramaConfig

rclpy = pytest.importorskip('rclpy')
pytest.importorskip('trimesh')
pytestmark = pytest.mark.ros

from omnicam_bench import Bench, image_message, new_context, pixels, send_until  # noqa: E402

from sfa_localization.simulation.garden import Garden  # noqa: E402

DOMAIN = free_domain()

OPEN = {'radius_min': 0.0, 'radius_max': 0.0}
LEVEL = (0.0, 0.0, 0.0)
CAMERAS = {
    'mirror': ((640, 640), LEVEL, LensCalibration()),
    'mirror, tilted': ((640, 640), (2.0, -3.0, 40.0), LensCalibration()),
    'fisheye': (
        (700, 800),
        LEVEL,
        LensCalibration(
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
    ),
    'ocam': (
        (800, 800),
        LEVEL,
        LensCalibration(
            camera_model='ocam',
            image_width=800,
            image_height=800,
            cx=401.0,
            cy=399.0,
            polynomial=(-150.0, 0.0, 1.8e-3, -1e-7),
            affine=(1.001, 0.001, -0.001),
            **OPEN,
        ),
    ),
    'equirectangular': ((600, 1200), LEVEL, LensCalibration(camera_model='equirectangular')),
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
    (size, mount_rpy, lens), panorama = CAMERAS[name], PanoramaConfig()
    (tmp_path / 'camera.yaml').write_text(calibration_text(lens, mount_rpy))
    context = new_context(DOMAIN)
    bench = Bench(
        context,
        calibration_file=str(tmp_path / 'camera.yaml'),
        mount_rpy=list(mount_rpy),
        width=panorama.width,
        height=panorama.height,
    ).start()
    try:
        bench.hear('panorama')
        raw = garden.render_raw(POSE, make_camera(lens, size, mount_rpy=mount_rpy))
        result = pixels(send_until(bench, bench.speak(), image_message(raw)))
    finally:
        bench.close()
        rclpy.try_shutdown(context=context)
    direct = garden.render_panorama(POSE, panorama)
    assert psnr(result, direct) >= 30.0
