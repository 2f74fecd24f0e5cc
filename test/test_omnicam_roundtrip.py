# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The simulator's raw image through the real node equals its directly rendered panorama."""

import numpy as np
import pytest

from sfa_localization.camera.calibration_files import calibration_text
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.settings import LensCalibration, PanoramaConfig

pytest.importorskip('rclpy')
pytest.importorskip('trimesh')

from sensor_msgs.msg import Image

from sfa_localization.nodes.conversions import read_image, to_image
from sfa_localization.nodes.omnicam_node import OmnicamNode
from sfa_localization.simulation.garden import Garden

pytestmark = pytest.mark.ros
LEVEL, OPEN = (0.0, 0.0, 0.0), {'radius_min': 0.0, 'radius_max': 0.0}
CAMERAS = {
    'mirror, tilted': ((640, 640), (2.0, -3.0, 40.0), LensCalibration()),
    'fisheye': ((700, 800), LEVEL, LensCalibration(
        camera_model='fisheye', image_width=800, image_height=700, cx=400.0, cy=350.0, fx=195.0,
        fy=195.0, distortion=(0.01, -0.003, 0.0004, 0.0), **OPEN,
    )),
    'ocam': ((800, 800), LEVEL, LensCalibration(
        camera_model='ocam', image_width=800, image_height=800, cx=401.0, cy=399.0,
        polynomial=(-150.0, 0.0, 1.8e-3, -1e-7), affine=(1.001, 0.001, -0.001), **OPEN,
    )),
    'equirectangular': ((600, 1200), LEVEL, LensCalibration(camera_model='equirectangular')),
}  # fmt: skip
POSE = np.array([0.5, -1.0, 0.7])


@pytest.fixture(scope='module')
def garden():
    return Garden(1)


@pytest.mark.parametrize('name', CAMERAS)
def test_the_node_undoes_the_camera(bench, garden, name, tmp_path):
    (size, mount_rpy, lens), panorama = CAMERAS[name], PanoramaConfig()
    path = tmp_path / 'camera.yaml'
    path.write_text(calibration_text(lens, mount_rpy))
    given = {'width': panorama.width, 'height': panorama.height, 'mount_rpy': list(mount_rpy)}
    bench.run(OmnicamNode, calibration_file=str(path), **given)
    heard = bench.listen(Image, 'panorama')
    raw = garden.render_raw(POSE, make_camera(lens, size, mount_rpy=mount_rpy))
    assert bench.publish_until('image_raw', to_image(raw, 12, 'camera'), lambda: heard)
    direct = garden.render_panorama(POSE, panorama).astype(float)
    assert 10 * np.log10(255**2 / np.mean((direct - read_image(heard[0])[1]) ** 2)) >= 30.0
