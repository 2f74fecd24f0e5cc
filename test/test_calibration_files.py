# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files of other tools, each as that tool writes it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sfa_localization.camera.calibration_files import (
    calibration_of,
    calibration_text,
    read_calibration,
)
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.settings import CameraConfig, LensCalibration
from sfa_localization.data.errors import CameraError, ConfigError

OCAM = """#polynomial coefficients of the direct mapping

4 -2.0e+02 0.0e+00 1.5e-03 -2.0e-06

#polynomial coefficients of the inverse mapping

3 300.0 150.0 -10.0

#center: "row" and "column", starting from 0

241.5 318.5

#affine parameters "c", "d", "e"

0.999 0.001 -0.002

#image size: "height" and "width"

480 640
"""
CAMERA_INFO = """image_width: 640
image_height: 480
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [400.5, 0.0, 320.0, 0.0, 401.5, 240.0, 0.0, 0.0, 1.0]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {n}
  data: {coefficients}
"""
ECHOED = """header:
  frame_id: camera
height: 480
width: 640
distortion_model: equidistant
d:
- 0.1
- 0.01
- 0.001
- 0.0001
k:
- 200.0
- 0.0
- 320.0
- 0.0
- 201.0
- 240.0
- 0.0
- 0.0
- 1.0
---
"""
KALIBR = """cam0:
  camera_model: {model}
  intrinsics: {intrinsics}
  distortion_model: {distortion}
  distortion_coeffs: [0.1, 0.01, 0.001, -8.0e-05]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""
MEI = """%YAML:1.0
---
model_type: MEI
camera_name: camera
image_width: 752
image_height: 480
mirror_parameters:
   xi: 1.5
distortion_parameters:
   k1: 0.1
   k2: 0.2
   p1: 1e-3
   p2: 0.004
projection_parameters:
   gamma1: 700.0
   gamma2: 701.0
   u0: 370.0
   v0: 240.0
"""
BRANDT = """%YAML:1.0
---
model_type: KANNALA_BRANDT
image_width: 640
image_height: 480
projection_parameters:
   k2: 0.1
   k3: 0.2
   k4: 0.3
   k5: 0.4
   mu: 200.0
   mv: 201.0
   u0: 320.0
   v0: 240.0
"""


def read(tmp_path, text, name='camera.yaml'):
    path = tmp_path / name
    path.write_text(text)
    return read_calibration(path)


def test_ocam(tmp_path):
    assert read(tmp_path, OCAM, 'calib_results.txt') == LensCalibration(
        camera_model='ocam',
        polynomial=(-200.0, 0.0, 0.0015, -2e-06),
        affine=(0.999, 0.001, -0.002),
        cx=318.5,
        cy=241.5,
        image_width=640,
        image_height=480,
        radius_min=0.0,
        radius_max=0.0,
    )


def test_ocam_camera_by_hand(tmp_path):
    """100 rows below the center: row = c x + cy, column = e x + cx; depth 200 - 15 + 2."""
    camera = make_camera(read(tmp_path, OCAM, 'calib_results.txt'), (480, 640))
    pixel = np.array([[318.5 - 0.2, 241.5 + 99.9]])
    expected = np.array([[-100.0, 0.0, 187.0]]) / np.hypot(100, 187)
    np.testing.assert_allclose(camera.unproject(pixel), expected, atol=1e-12)


@pytest.mark.parametrize('affine', ['0.0 0.0 0.0', '0.5 0.5 1.0'])
def test_an_ocam_lens_that_maps_all_pixels_to_a_line_is_rejected(tmp_path, affine):
    text = OCAM.replace('0.999 0.001 -0.002', affine)
    assert text != OCAM
    with pytest.raises(CameraError, match='singular'):
        make_camera(read(tmp_path, text, 'calib_results.txt'), (480, 640))


@pytest.mark.parametrize('name', ['distortion', 'polynomial', 'affine'])
def test_coefficients_beyond_all_lenses_are_rejected(name):
    with pytest.raises(ConfigError, match=f'{name}: 1e.300 is outside'):
        LensCalibration(**{name: (1e300, 1.0, 1.0)})


def test_camera_info_of_a_pinhole(tmp_path):
    text = CAMERA_INFO.format(model='plumb_bob', n=5, coefficients=[0.1, 0.2, 0.3, 0.4, 0.0])
    lens = read(tmp_path, text)
    assert lens.camera_model == 'mirror'
    assert lens.xi == 0.0
    assert lens.mirrored == 'no'
    assert [getattr(lens, name) for name in ('fx', 'fy', 'cx', 'cy')] == [
        400.5,
        401.5,
        320.0,
        240.0,
    ]
    assert lens.distortion == (0.1, 0.2, 0.3, 0.4)
    assert (lens.image_width, lens.image_height) == (640, 480)


@pytest.mark.parametrize('model', ['equidistant', 'fisheye'])
def test_camera_info_of_a_fisheye(tmp_path, model):
    text = CAMERA_INFO.format(model=model, n=4, coefficients=[0.1, 0.2, 0.3, 0.4])
    lens = read(tmp_path, text)
    assert lens.camera_model == 'fisheye'
    assert lens.distortion == (0.1, 0.2, 0.3, 0.4)


def test_camera_info_as_echoed(tmp_path):
    lens = read(tmp_path, ECHOED)
    assert lens.camera_model == 'fisheye'
    assert (lens.fx, lens.cy, lens.image_height) == (200.0, 240.0, 480)


def test_kalibr(tmp_path):
    omni = KALIBR.format(model='omni', intrinsics=[0.8, 833, 830, 373, 253], distortion='radtan')
    lens = read(tmp_path, omni)
    assert lens.camera_model == 'mirror'
    assert [getattr(lens, name) for name in ('xi', 'fx', 'fy', 'cx', 'cy')] == [
        0.8,
        833,
        830,
        373,
        253,
    ]
    assert lens.distortion == (0.1, 0.01, 0.001, -8e-05)
    assert (lens.image_width, lens.image_height) == (752, 480)
    equi = KALIBR.format(model='pinhole', intrinsics=[190, 191, 254, 256], distortion='equidistant')
    lens = read(tmp_path, equi)
    assert lens.camera_model == 'fisheye'
    assert lens.fy == 191


def test_camodocal(tmp_path):
    lens = read(tmp_path, MEI)
    assert lens.camera_model == 'mirror'
    assert lens.xi == 1.5
    assert lens.distortion == (0.1, 0.2, 0.001, 0.004)
    assert (lens.fx, lens.cx, lens.image_width) == (700.0, 370.0, 752)
    lens = read(tmp_path, BRANDT)
    assert lens.camera_model == 'fisheye'
    assert lens.distortion == (0.1, 0.2, 0.3, 0.4)
    assert (lens.fx, lens.fy) == (200.0, 201.0)


@pytest.mark.parametrize('name', ['distortion_model', 'camera_model'])
@pytest.mark.parametrize(
    ('model', 'read_as'),
    [('plumb_bob', 'mirror'), ('equidistant', 'fisheye'), ('fisheye', 'fisheye')],
)
def test_ost_yaml_of_camera_calibration(tmp_path, name, model, read_as):
    """Its releases name the distortion in two ways."""
    text = CAMERA_INFO.format(model=model, n=4, coefficients=[0.1, 0.2, 0.3, 0.4])
    lens = read(tmp_path, text.replace('distortion_model', name), 'ost.yaml')
    assert (lens.camera_model, lens.fx, lens.image_width) == (read_as, 400.5, 640)
    assert lens.distortion == (0.1, 0.2, 0.3, 0.4)


STELLA = """Camera:
  name: "a fisheye"
  setup: "monocular"
  model: "{model}"
  fx: 285.5
  fy: 286.5
  cx: 424.0
  cy: 400.0
  k1: 0.1
  k2: 0.2
  k3: 0.3
  k4: 0.4
  fps: 30.0
  cols: 848
  rows: 800
  color_order: "RGB"
Feature:
  scale_factor: 1.2
"""
ORB = """%YAML:1.0

#--------------------------------------------------------------------------------------------
# Camera Parameters. Adjust them!
#--------------------------------------------------------------------------------------------
File.version: "1.0"
Camera.type: "{model}"
Camera1.fx: 285.5
Camera1.fy: 286.5
Camera1.cx: 424.0
Camera1.cy: 400.0
Camera1.k1: 0.1
Camera1.k2: 0.2
Camera1.k3: 0.3
Camera1.k4: 0.4
Camera.width: 848
Camera.height: 800
"""


@pytest.mark.parametrize(
    'text', [
        STELLA.format(model='fisheye'),
        ORB.format(model='KannalaBrandt8'),
        ORB.format(model='KannalaBrandt8').replace('Camera1.', 'Camera.'),
    ],
)  # fmt: skip
def test_fisheyes_of_slam_programs(tmp_path, text):
    lens = read(tmp_path, text)
    assert (lens.camera_model, lens.distortion) == ('fisheye', (0.1, 0.2, 0.3, 0.4))
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (285.5, 286.5, 424.0, 400.0)
    assert (lens.image_width, lens.image_height) == (848, 800)


def test_other_cameras_of_slam_programs(tmp_path):
    pinhole = ORB.format(model='PinHole').replace('k3: 0.3', 'p1: 0.3').replace('k4', 'p2')
    assert read(tmp_path, pinhole).distortion == (0.1, 0.2, 0.3, 0.4)
    assert read(tmp_path, STELLA.format(model='equirectangular')).camera_model == 'equirectangular'


def test_opencv_xml(tmp_path):
    path = tmp_path / 'out_camera_data.xml'
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write('image_width', 640)
    storage.write('image_height', 480)
    storage.write('camera_matrix', np.array([[300.0, 0, 320], [0, 301.0, 240], [0, 0, 1]]))
    storage.write('distortion_coefficients', np.array([[0.1, 1e-5, 0.0, 0.001]]))
    storage.write('xi', np.array([[1.25]]))
    storage.release()
    lens = read_calibration(path)
    assert (lens.camera_model, lens.xi, lens.fx, lens.image_height) == ('mirror', 1.25, 300.0, 480)
    assert lens.distortion == (0.1, 1e-5, 0.0, 0.001)


def test_opencv_file_storage(tmp_path):
    path = tmp_path / 'opencv.yml'
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write('image_width', 640)
    storage.write('image_height', 480)
    storage.write('camera_matrix', np.array([[300.0, 0, 320], [0, 301.0, 240], [0, 0, 1]]))
    storage.write('distortion_coefficients', np.array([[0.1, 1e-5, 0.0, 0.001]]))
    storage.write('xi', np.array([[1.25]]))
    storage.release()
    lens = read_calibration(path)
    assert lens.camera_model == 'mirror'
    assert (lens.xi, lens.fx, lens.fy) == (1.25, 300.0, 301.0)
    assert lens.distortion == (0.1, 1e-5, 0.0, 0.001)


def test_a_calibration_file_replaces_the_camera_model(tmp_path):
    path = tmp_path / 'calib_results.txt'
    path.write_text(OCAM)
    config = CameraConfig(calibration_file=str(path), camera_model='panorama')
    assert calibration_of(config) == read_calibration(path)
    assert (read_calibration(path).radius_min, read_calibration(path).radius_max) == (0.0, 0.0)


@pytest.mark.parametrize('model', ['mirror', 'equirectangular', 'panorama'])
def test_without_a_calibration_file_the_camera_model_counts(model):
    assert calibration_of(CameraConfig(camera_model=model)) == LensCalibration(camera_model=model)


LENSES = {
    'mirror': {'distortion': (0.1, 1e-5, 0.0, -2e-6), 'xi': 1.25, 'axis': 'up', 'mirrored': 'no'},
    'fisheye': {'fx': 190.5, 'fy': 191.0, 'image_width': 1280, 'image_height': 960},
    'ocam': {'polynomial': (-150.0, 0.0, 1.8e-3, -1e-7), 'affine': (1.001, 0.001, -0.001)},
    'polar': {'angle_min': 70.0, 'angle_max': 120.0, 'radius_min': 42.0},
    'dual_fisheye': {'second_cx': 480.0, 'second_cy': 319.5, 'second_roll': 5.0},
    'panorama': {'mirrored': 'yes'},
}


@pytest.mark.parametrize('model', LENSES)
def test_what_is_written_is_read_again(tmp_path, model):
    lens = LensCalibration(camera_model=model, **LENSES[model])
    path = tmp_path / 'camera.yaml'
    path.write_text(calibration_text(lens, (0.0, 0.0, 90.0)))
    assert read_calibration(path) == lens
    assert 'mount_rpy: [0.0, 0.0, 90.0]' in path.read_text()


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('', 'no camera calibration'),
        ('just words', 'no camera calibration'),
        ('a: [1, 2', 'is not YAML'),
        ('a: 1', 'camera_matrix'),
        (CAMERA_INFO.format(model='plumb_bob', n=5, coefficients=[1, 2, 3, 4, 5]), 'only 4'),
        (CAMERA_INFO.format(model='strange', n=4, coefficients=[0, 0, 0, 0]), 'strange'),
        (CAMERA_INFO.replace('400.5', '0.0').format(model='', n=0, coefficients=[]), 'not calib'),
        (KALIBR.format(model='ds', intrinsics=[1, 2, 3, 4, 5, 6], distortion='none'), "'ds'"),
        (KALIBR.format(model='omni', intrinsics=[1, 2], distortion='none'), '1 numbers of'),
        (KALIBR.replace('752', 'x').format(model='omni', intrinsics=[1] * 5, distortion=''), 'x'),
        (MEI.replace('MEI', 'SCARAMUZZA'), 'SCARAMUZZA'),
        ('camera_model: fisheye\ncx: 1.0\nfx: 2.0', 'cy, fy, distortion missing'),
        ('camera_model: panorama\nmirored: yes', "did you mean 'mirrored'"),
        ('camera_model: strange', 'strange'),
        ('camera_model: panorama\nimage_width: -1', 'image_width'),
        (MEI.replace('gamma1', 'gamma'), "'gamma1' is missing"),
        ('model_type: SCARAMUZZA', "'projection_parameters' is missing"),
        (STELLA.format(model='radial_division'), "'radial_division' of a SLAM program"),
        (STELLA.format(model='fisheye').replace('fx', 'f'), "'fx' is missing"),
        ('Camera: 3', 'no camera calibration'),
        ('Camera.3: 3', 'of a SLAM program'),
        ('<opencv_storage><a>', 'is not XML'),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', 'definitions of its own'),
        ('<opencv_storage><camera_matrix/></opencv_storage>', 'has 0 numbers'),
    ],
)
def test_unusable_files_are_named_with_the_reason(tmp_path, text, words):
    with pytest.raises(CameraError, match=words) as caught:
        read(tmp_path, text)
    assert 'camera.yaml' in str(caught.value)


def test_unusable_text_files_are_named_with_the_reason(tmp_path):
    for text in ('', 'hello', OCAM.replace('4 -2.0e+02', '9 -2.0e+02')):
        with pytest.raises(CameraError, match=r'calib\.txt'):
            read(tmp_path, text, 'calib.txt')
    with pytest.raises(CameraError, match=r'missing\.yaml'):
        read_calibration(tmp_path / 'missing.yaml')
