# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Camera models: ray -> pixel -> ray, agreement with other implementations, mounting."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from places import distances

from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.settings import CameraConfig, LensCalibration, PanoramaConfig
from sfa_localization.data.errors import CameraError, ConfigError

FORWARD, LEFTWARD, UP = np.eye(3)
OPEN = {'radius_min': 0.0, 'radius_max': 0.0}
PINHOLE = {'xi': 0.0, 'axis': 'forward', 'mirrored': 'no', **OPEN}
OCAM = (-157.9, 0.0, 1.83e-3, -1.1e-6, 3.2e-9)
SIZE = (640, 640)
CAMERAS = {
    'hyperbolic mirror': LensCalibration(),
    'parabolic mirror': LensCalibration(xi=1.0, fx=170.0, fy=168.0),
    'distorted mirror': LensCalibration(distortion=(-0.03, 0.002, 0.001, -0.002), cx=310.0),
    'beyond one': LensCalibration(xi=1.6, fx=350.0, fy=350.0),
    'pinhole': LensCalibration(fx=400.0, fy=400.0, **PINHOLE),
    'equidistant': LensCalibration(camera_model='fisheye', fx=190.0, fy=190.0),
    'kannala-brandt': LensCalibration(
        camera_model='fisheye', fx=190.0, fy=191.0, distortion=(-0.01, 0.005, -0.003, 0.0004)
    ),
    'ocam': LensCalibration(
        camera_model='ocam', polynomial=OCAM, affine=(1.01, 0.002, -0.003), cx=322.3, cy=318.0
    ),
    'polar': LensCalibration(camera_model='polar', radius_min=60.0, radius_max=300.0),
    'equirectangular': LensCalibration(camera_model='equirectangular'),
    'dual fisheye': LensCalibration(
        camera_model='dual_fisheye', fx=90.0, fy=90.0, cx=160.0, second_cx=480.0, second_cy=319.5
    ),
    'panorama': LensCalibration(camera_model='panorama'),
}


def rays(n=4000, seed=3):
    vectors = np.random.default_rng(seed).normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def unit(*angles):
    """Rays (N, 3) at angles from z toward x."""
    return np.column_stack([np.sin(angles), np.zeros(len(angles)), np.cos(angles)])


def lens_of(**settings):
    """The lens alone, centered at 0."""
    return make_camera(LensCalibration(cx=0.0, cy=0.0, **settings), SIZE).lens


@pytest.mark.parametrize('name', CAMERAS)
def test_rays_and_pixels_are_each_others_inverse_where_the_camera_sees(name):
    config = CAMERAS[name]
    rows, columns = np.mgrid[0:640:7, 0:640:7]
    grid = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    camera = make_camera(config, SIZE, mount_rpy=(7.0, -11.0, 130.0))
    pixels = camera.project(rays())
    seen = np.isfinite(pixels).all(axis=1)
    assert seen.sum() > 100
    assert_allclose(camera.unproject(pixels[seen]), rays()[seen], atol=1e-9)
    assert np.all((pixels[seen] >= -0.5) & (pixels[seen] <= 639.5))
    if camera.lens.center is not None:
        radius = distances(pixels[seen], [config.cx, config.cy])
        assert config.radius_min <= radius.min()
        assert radius.max() <= (config.radius_max or np.inf)
    back = camera.unproject(grid)
    seen = np.isfinite(back).all(axis=1)
    assert seen.sum() > 1000
    assert_allclose(np.linalg.norm(back[seen], axis=1), 1.0, atol=1e-12)
    assert_allclose(camera.project(back[seen]), grid[seen], atol=1e-6)


def test_the_mirror_model_by_hand():
    """xi = 0.9, horizontal ray: z = 0, so the radius is f / xi; straight down: the center."""
    camera = make_camera(LensCalibration(radius_min=0.0), SIZE)
    slanted = np.array([np.cos(0.3), 0.0, np.sin(0.3)])
    radius = 150 * np.cos(0.3) / (0.9 - np.sin(0.3))
    expected = [[319.5, 319.5 - 150 / 0.9], [319.5 + 150 / 0.9, 319.5], [319.5, 319.5],
                [319.5, 319.5 - radius]]  # fmt: skip
    seen = camera.project(np.array([FORWARD, LEFTWARD, -UP, slanted]))
    assert_allclose(seen, expected)
    assert np.isnan(camera.project(np.array([UP, [np.nan, 0, 0], [0, 0, 0]]))).all()
    angle = np.array([0.2, 0.9, 1.5, 2.0])  # a paraboloid maps it to the radius tan(angle / 2)
    pixels = lens_of(xi=1.0, fx=100.0, fy=100.0).project(unit(*angle))
    assert_allclose(pixels[:, 0], 100 * np.tan(angle / 2))


def test_pinhole_and_fisheye_agree_with_opencv():
    coefficients, none = (-0.2, 0.05, 0.001, -0.002), np.zeros(3)
    lens = {'fx': 400.0, 'fy': 410.0, 'cx': 300.0, 'cy': 330.0, 'distortion': coefficients}
    forward = rays()[rays()[:, 0] > 0.85]
    optical = np.column_stack([-forward[:, 1], -forward[:, 2], forward[:, 0]])
    matrix = np.array([[400.0, 0, 300.0], [0, 410.0, 330.0], [0, 0, 1]])
    theirs = cv2.projectPoints(optical, none, none, matrix, np.array(coefficients))[0]
    ours = make_camera(LensCalibration(**lens, **PINHOLE), SIZE)
    assert_allclose(ours.project(forward), theirs.reshape(-1, 2), atol=1e-6)
    config = CAMERAS['kannala-brandt']
    ours = make_camera(config, SIZE)
    above = rays()[(rays()[:, 2] > 0.2) & np.isfinite(ours.project(rays())[:, 0])]
    optical = np.column_stack([above[:, 1], -above[:, 0], above[:, 2]])[:, None]
    matrix = np.array([[190.0, 0, 319.5], [0, 191.0, 319.5], [0, 0, 1]])
    theirs, _ = cv2.fisheye.projectPoints(optical, none, none, matrix, np.array(config.distortion))
    assert_allclose(ours.project(above), theirs.reshape(-1, 2), atol=1e-6)


def test_a_polar_picture_by_hand():
    """For ocam see test_calibration_files.py."""
    pixels = np.array([[319.5, 319.5 - 60.0], [319.5, 319.5 - 300.0]])
    forward = make_camera(CAMERAS['polar'], SIZE).unproject(pixels)
    assert_allclose(np.degrees(np.arcsin(forward[:, 2])), [78 - 90, 114 - 90])


def test_where_the_picture_looks():
    quarter = 100 * np.pi / 2
    pixels = np.array([[319.5 + quarter, 319.5], [319.5, 319.5 - quarter], [319.5, 319.5]])
    for axis, mirrored, looks in (
        ('down', 'no', [-LEFTWARD, FORWARD, -UP]), ('down', 'yes', [LEFTWARD, FORWARD, -UP]),
        ('up', 'no', [LEFTWARD, FORWARD, UP]), ('forward', 'no', [-LEFTWARD, UP, FORWARD]),
    ):  # fmt: skip
        settings = {'axis': axis, 'mirrored': mirrored, 'fx': 100.0, 'fy': 100.0}
        camera = make_camera(LensCalibration(camera_model='fisheye', **settings, **OPEN), SIZE)
        assert_allclose(camera.unproject(pixels), looks, atol=1e-12)


def test_roll_comes_first_then_pitch_then_yaw():
    """Quarter turns: yaw to the left, pitch downwards, roll about the axis itself (REP-103)."""
    lens = LensCalibration(camera_model='equirectangular')
    center, right = (199.5, 99.5), (299.5, 99.5)
    for mount, pixel, ray in (
        ((0.0, 0.0, 90.0), center, LEFTWARD), ((0.0, 90.0, 0.0), center, -UP),
        ((90.0, 0.0, 0.0), right, -UP), ((90.0, 90.0, 90.0), right, -LEFTWARD),
    ):  # fmt: skip
        camera = make_camera(lens, (200, 400), mount_rpy=mount)
        assert_allclose(camera.unproject(np.array([pixel])), [ray], atol=1e-12)
    with pytest.raises(ConfigError, match='roll, pitch and yaw'):
        CameraConfig(mount_rpy=(1.0, 2.0))


def test_intrinsics_follow_the_size_of_the_picture():
    large, small = (make_camera(LensCalibration(), size).project(rays())
                    for size in (SIZE, (320, 320)))  # fmt: skip
    both = np.isfinite(large[:, 0]) & np.isfinite(small[:, 0])
    assert_allclose((small[both] + 0.5) * 2 - 0.5, large[both], atol=1e-9)


def test_distortion_beyond_its_increasing_part_is_not_used():
    """1 + 3 k r^2 = 0 at r = 1 for k = -1/3: a ray at 60 degrees (r = 1.7) must not fold back."""
    pixels = lens_of(fx=100.0, fy=100.0, distortion=(-1 / 3, 0.0, 0.0, 0.0), **PINHOLE).project(
        unit(*np.radians([30.0, 60.0]))
    )
    assert np.isfinite(pixels[0]).all() and np.isnan(pixels[1]).all()


def test_impossible_cameras_say_what_is_wrong():
    ocam = {'camera_model': 'ocam'}
    for change, size, words in (
        ({}, (480, 640), '640 x 480'), ({}, (0, 640), 'empty'),
        ({'distortion': (0.1,)}, SIZE, 'coefficients'), (ocam, SIZE, 'polynomial'),
        ({**ocam, 'polynomial': OCAM, 'affine': (0.5, 0.5, 1.0)}, SIZE, 'singular'),
        ({**ocam, 'polynomial': (100.0, 0.0)}, SIZE, 'negative'),
        ({**ocam, 'polynomial': (-1.0, 0.0, -100.0)}, SIZE, 'does not increase'),
        ({'camera_model': 'polar', 'radius_max': 10.0}, SIZE, 'radius_min'),
        ({'camera_model': 'polar', 'angle_min': 120.0}, SIZE, 'angle_min'),
    ):  # fmt: skip
        with pytest.raises(CameraError, match=words):
            make_camera(LensCalibration(**change), size)


def test_the_panorama_model_uses_the_elevations_of_the_panorama():
    panorama = PanoramaConfig(elevation_min=-10.0, elevation_max=30.0)
    camera = make_camera(LensCalibration(camera_model='panorama'), (40, 360), panorama)
    looks = camera.unproject(np.array([[179.5, -0.5], [179.5, 39.5]]))
    assert_allclose(np.degrees(np.arcsin(looks[:, 2])), [30.0, -10.0])
