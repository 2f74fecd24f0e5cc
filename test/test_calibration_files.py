# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files of other tools, each as that tool writes it."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose

from sfa_localization.camera.calibration_files import (
    calibration_of,
    calibration_of_info,
    calibration_text,
    read_calibration,
)
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.settings import CameraConfig, LensCalibration
from sfa_localization.data.errors import CameraError, ConfigError

OCAM = """#polynomial coefficients of the direct mapping\n
4 -2.0e+02 0.0e+00 1.5e-03 -2.0e-06\n
#polynomial coefficients of the inverse mapping\n
3 300.0 150.0 -10.0\n
#center: "row" and "column", starting from 0\n
241.5 318.5\n
#affine parameters "c", "d", "e"\n
0.999 0.001 -0.002\n
#image size: "height" and "width"\n
480 640
"""
MATRIX = [285.5, 0.0, 424.0, 0.0, 286.5, 400.0, 0.0, 0.0, 1.0]
FOUR = [0.1, 0.2, 0.3, 0.4, 0.0]
K = {'k1': 0.1, 'k2': 0.2, 'k3': 0.3, 'k4': 0.4}
LENS = {'fx': 285.5, 'fy': 286.5, 'cx': 424.0, 'cy': 400.0}
SIZE = {'image_width': 848, 'image_height': 800}


def info(model, name='distortion_model', coefficients=FOUR, matrix=MATRIX):
    """camera_info, or ost.yaml of one of the releases of camera_calibration."""
    parts = {
        'camera_matrix': {'rows': 3, 'cols': 3, 'data': matrix},
        'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': coefficients},
    }
    return yaml.safe_dump({**SIZE, 'camera_name': 'front', **parts, name: model})


def echoed():
    """What `ros2 topic echo` prints."""
    message = {
        'header': {'frame_id': 'camera'}, 'height': 800, 'width': 848, 'k': MATRIX, 'd': FOUR,
        'distortion_model': 'equidistant', 'roi': {'height': 0, 'width': 0},
    }  # fmt: skip
    return yaml.safe_dump(message, sort_keys=False) + '---\nheader:\n  frame_id: camera\n'


def kalibr(model, intrinsics, distortion, resolution=(848, 800)):
    camera = {
        'camera_model': model, 'intrinsics': intrinsics, 'distortion_model': distortion,
        'distortion_coeffs': FOUR[:4], 'resolution': [*resolution], 'rostopic': '/cam0/image_raw',
    }  # fmt: skip
    return yaml.safe_dump({'cam0': camera, 'cam1': {'camera_model': 'ds'}})


STORAGE = '%YAML:1.0\n---\n'
"""The head of camodocal's, and ORB-SLAM3's."""
MEI = STORAGE + yaml.safe_dump({
    'model_type': 'MEI', **SIZE, 'mirror_parameters': {'xi': 1.5},
    'distortion_parameters': {'k1': 0.1, 'k2': 0.2, 'p1': 0.3, 'p2': 0.4},
    'projection_parameters': {'gamma1': 285.5, 'gamma2': 286.5, 'u0': 424.0, 'v0': 400.0},
})  # fmt: skip
BRANDT = STORAGE + yaml.safe_dump({
    'model_type': 'KANNALA_BRANDT', **SIZE,
    'projection_parameters': {'k2': 0.1, 'k3': 0.2, 'k4': 0.3, 'k5': 0.4,
                              'mu': 285.5, 'mv': 286.5, 'u0': 424.0, 'v0': 400.0},
})  # fmt: skip


def stella(model):
    camera = {'name': 'a camera', 'model': model, **LENS, **K, 'fps': 30.0, 'cols': 848}
    return yaml.safe_dump({'Camera': {**camera, 'rows': 800}, 'Feature': {'scale_factor': 1.2}})


def orb(model, head, coefficients=K):
    numbers = {f'{head}.{name}': value for name, value in {**LENS, **coefficients}.items()}
    size = {'Camera.width': 848, 'Camera.height': 800, 'Camera2.k1': 0.9}
    return STORAGE + yaml.safe_dump(
        {'File.version': '1.0', 'Camera.type': model, **numbers, **size}
    )


def opencv(suffix, tmp_path, **more):
    path = tmp_path / f'storage{suffix}'
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    lens = {
        'camera_matrix': np.reshape(MATRIX, (3, 3)),
        'distortion_coefficients': np.array([FOUR]),
    }
    for name, value in {**SIZE, **lens, **more}.items():
        file.write(name, value)
    file.release()
    return path.read_text()


def read(tmp_path, text, name='camera.yaml'):
    path = tmp_path / name
    path.write_text(text)
    return read_calibration(path)


def test_files_of_every_program_give_the_same_camera(tmp_path):
    """Focal lengths, center, size and four coefficients are the same in all."""
    xi, four = np.array([[1.25]]), [*LENS.values()]
    for text, model, mirror in (
        (info('plumb_bob'), 'mirror', 0.0), (info('fisheye', 'camera_model'), 'fisheye', None),
        (echoed(), 'fisheye', None), (MEI, 'mirror', 1.5), (BRANDT, 'fisheye', None),
        (kalibr('omni', [0.8, *four], 'radtan'), 'mirror', 0.8),
        (kalibr('pinhole', four, 'radtan'), 'mirror', 0.0),
        (kalibr('pinhole', four, 'equidistant'), 'fisheye', None),
        (stella('fisheye'), 'fisheye', None), (orb('KannalaBrandt8', 'Camera1'), 'fisheye', None),
        (orb('KannalaBrandt8', 'Camera'), 'fisheye', None),
        (orb('PinHole', 'Camera1', {'k1': 0.1, 'k2': 0.2, 'p1': 0.3, 'p2': 0.4}), 'mirror', 0.0),
        (opencv('.yml', tmp_path, xi=xi), 'mirror', 1.25),
        (opencv('.xml', tmp_path, fisheye_model=1), 'fisheye', None),
        (opencv('.xml', tmp_path, fisheye_model=0), 'mirror', 0.0),
    ):  # fmt: skip
        lens = read(tmp_path, text)
        assert lens.camera_model == model, text
        assert (lens.fx, lens.fy, lens.cx, lens.cy) == (285.5, 286.5, 424.0, 400.0), text
        assert (lens.image_width, lens.image_height) == (848, 800), text
        assert lens.distortion == (0.1, 0.2, 0.3, 0.4), text
        assert (lens.radius_min, lens.radius_max) == (0.0, 0.0), text
        if mirror is not None:
            assert lens.xi == mirror, text
            assert (lens.mirrored, lens.axis) == (('auto',) * 2 if mirror else ('no', 'forward'))
    assert read(tmp_path, stella('equirectangular')).camera_model == 'equirectangular'


def test_ocam(tmp_path):
    """100 rows below the center: row = c x + cy, column = e x + cx; depth 200 - 15 + 2. A file
    replaces the camera model.
    """
    lens = read(tmp_path, OCAM, 'calib_results.txt')
    assert lens == LensCalibration(
        camera_model='ocam', polynomial=(-200.0, 0.0, 0.0015, -2e-06), cx=318.5, cy=241.5,
        affine=(0.999, 0.001, -0.002), image_width=640, image_height=480,
        radius_min=0.0, radius_max=0.0,
    )  # fmt: skip
    ray = make_camera(lens, (480, 640)).unproject(np.array([[318.5 - 0.2, 241.5 + 99.9]]))
    expected = np.array([[-100.0, 0.0, 187.0]]) / np.hypot(100, 187)
    assert_allclose(ray, expected, atol=1e-12)
    path = str(tmp_path / 'calib_results.txt')
    assert calibration_of(CameraConfig(calibration_file=path, camera_model='panorama')) == lens


def test_what_is_written_is_read_again(tmp_path):
    for model, values in {
        'mirror': {'distortion': (0.1, 1e-5, 0.0, -2e-6), 'xi': 1.25, 'mirrored': 'no'},
        'fisheye': {'fx': 190.5, 'fy': 191.0, 'image_width': 1280, 'image_height': 960},
        'ocam': {'polynomial': (-150.0, 0.0, 1.8e-3, -1e-7), 'affine': (1.001, 0.001, -0.001)},
        'polar': {'angle_min': 70.0, 'angle_max': 120.0, 'radius_min': 42.0},
        'dual_fisheye': {
            'second_cx': 480.0, 'second_cy': 319.5, 'second_roll': 5.0, 'second_focal': 140.0,
            'second_tilt': (1.0, -2.0), 'second_distortion': (0.1, 0.0, 0.0, 0.0),
        },
        'equirectangular': {'elevation_min': -20.0, 'elevation_max': 50.0},
    }.items():  # fmt: skip
        lens = LensCalibration(camera_model=model, mount_rpy=(1.0, 0.0, 90.0), **values)
        assert read(tmp_path, calibration_text(lens)) == lens


def test_unusable_files_are_named_with_the_reason(tmp_path):
    for text, words in (
        ('', 'no camera calibration'),
        ('a: 1', 'no number fx or gamma1 or mu is given; supported are'),
        (info('plumb_bob', coefficients=[1, 2, 3, 4, 5]), 'only 4'),
        (info('strange'), "'strange' is not supported; use another"),
        (info('', coefficients=[], matrix=[0.0] * 9), 'not calib'),
        (kalibr('ds', [1, 2, 3, 4, 5, 6], 'none'), "'ds'"),
        (kalibr('omni', [1, 2], 'none'), '2 numbers of'),
        (kalibr('omni', [1] * 5, 'equidistant'), "'equidistant'"),
        (MEI.replace('MEI', 'SCARAMUZZA'), 'scaramuzza'), (MEI.replace('xi', 'psi'), 'number xi'),
        ('camera_model: fisheye\ncx: 1.0\nfx: 2.0', 'cy, fy missing'),
        ('camera_model: panorama\nmirored: yes', "did you mean 'mirrored'"),
        (stella('radial_division'), 'radial_division'), ('<opencv_storage><a>', 'is not XML'),
    ):  # fmt: skip
        with pytest.raises(CameraError, match=rf'camera\.yaml.*{words}'):
            read(tmp_path, text)
    for text in ('hello', OCAM.replace('4 -2.0e+02', '9 -2.0e+02')):
        with pytest.raises(CameraError, match=r'calib\.txt'):
            read(tmp_path, text, 'calib.txt')
    with pytest.raises(CameraError, match=r'missing\.yaml'):
        read_calibration(tmp_path / 'missing.yaml')
    with pytest.raises(ConfigError, match=r'distortion: 1e.300 is outside'):
        LensCalibration(distortion=(1e300, 1.0, 1.0))


def test_a_camera_info_of_a_part_of_the_image_is_that_of_the_part():
    roi = SimpleNamespace(x_offset=100, y_offset=40, width=640, height=640)
    fields = {'width': 848, 'height': 800, 'k': MATRIX, 'd': [0.0] * 5, 'roi': roi}
    lens = calibration_of_info(SimpleNamespace(distortion_model='plumb_bob', **fields))
    assert (lens.camera_model, lens.xi, lens.axis) == ('mirror', 0.0, 'forward'), 'a pinhole'
    assert (lens.cx, lens.cy, lens.image_width, lens.image_height) == (324.0, 360.0, 640, 640)


def test_coefficients_with_powers_of_ten_are_numbers_as_programs_write_them(tmp_path):
    """YAML 1.1 reads 4e-09 as a text."""
    path = tmp_path / 'camera.yaml'
    text = info('equidistant', coefficients=[0.0, 4e-9, 0.0, 0.0])
    path.write_text(text.replace('4.0e-09', '4e-09'))
    assert '4e-09' in path.read_text()
    assert read_calibration(path).distortion == (0.0, 4e-9, 0.0, 0.0)
