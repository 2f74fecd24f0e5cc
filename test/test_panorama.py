# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Unwrapping: directions, panoramas as they come, masks."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.typesys import Stores
from test_cameras import CAMERAS

from sfa_localization.bags.decoding import typestore
from sfa_localization.bags.drives import ReadingRecipe, as_live, read_drive
from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.panorama import (
    Unwrapper,
    filled,
    looks_like_panorama,
    panorama_rays,
    repeated_pixels,
)
from sfa_localization.camera.settings import CameraConfig, LensCalibration, PanoramaConfig
from sfa_localization.data.errors import CameraError, ConfigError

SIZE = (400, 400)
SMALL = PanoramaConfig(width=180, height=24)
AZIMUTH = -(np.arange(180) + 0.5 - 90) * 2.0
"""Degrees, of the columns of SMALL."""


def mirror(**settings):
    """The simulator's."""
    return CameraConfig(camera_model='mirror', **settings)


def picture_of(scene, lens=CAMERAS['hyperbolic mirror'], size=SIZE, mount_rpy=(0.0, 0.0, 0.0)):
    """What the camera sees of a scene: a function of rays (N, 3) to BGR (N, 3)."""
    rows, columns = np.mgrid[0 : size[0], 0 : size[1]]
    rays = make_camera(lens, size, mount_rpy=mount_rpy).unproject(
        np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    )
    seen = np.isfinite(rays[:, 0])
    picture = np.zeros((size[0] * size[1], 3))
    picture[seen] = scene(rays[seen])
    return np.rint(picture).astype(np.uint8).reshape(*size, 3)


def smooth(rays):
    """A scene that tells every direction apart, all around and up and down."""
    x, y, z = rays.T
    return np.column_stack([127 + 100 * x, 127 + 100 * y, 127 + 100 * np.sin(3 * z)])


def direct(scene, panorama):
    rays = panorama_rays(panorama)
    return np.rint(scene(rays.reshape(-1, 3))).reshape(rays.shape)


def psnr(a, b):
    error = np.mean((a.astype(float) - b.astype(float)) ** 2)
    return 10 * np.log10(255**2 / error)


def test_panorama_conventions():
    rays = panorama_rays(PanoramaConfig(width=360, height=36, elevation_min=-18, elevation_max=18))
    azimuth = np.degrees(np.arctan2(rays[0, :, 1], rays[0, :, 0]))
    assert_allclose(azimuth[[0, 90, 179, 180]], [179.5, 89.5, 0.5, -0.5])
    elevation = np.degrees(np.arcsin(rays[:, 0, 2]))
    assert_allclose(elevation[[0, 17, 35]], [17.5, 0.5, -17.5])
    with pytest.raises(ConfigError, match='elevation_min'):
        PanoramaConfig(elevation_min=10.0, elevation_max=10.0)
    assert looks_like_panorama(100, 350) and not looks_like_panorama(100, 349)


@pytest.mark.parametrize('name', ['hyperbolic mirror', 'distorted mirror', 'equidistant', 'ocam',
                                  'polar', 'equirectangular', 'dual fisheye'])  # fmt: skip
def test_every_camera_gives_the_same_panorama(name):
    """However it is mounted: its turn is a shift of columns, upright edges and horizon straight."""
    panorama, mount = replace(SMALL, clockwise=name != 'polar'), (-3.0, 2.0, 37.0)
    unwrapper = Unwrapper(CameraConfig(mount_rpy=mount), panorama, CAMERAS[name])
    result = unwrapper(picture_of(smooth, CAMERAS[name], mount_rpy=mount))
    seen = unwrapper.visible(SIZE)
    assert result.shape == (24, 180, 3) and result.dtype == np.uint8
    assert seen.mean() > 0.75
    # The drawn pictures are black right beside their rim, which interpolation mixes in.
    assert psnr(result[seen], direct(smooth, panorama)[seen]) > 32


def test_a_panorama_is_only_resized_turned_and_reversed_to_the_convention():
    """With camera_model: panorama, and with any other camera, of which it is no picture."""
    picture = direct(smooth, PanoramaConfig(width=360, height=48)).astype(np.uint8)
    declared = CameraConfig(camera_model='panorama')
    turned = replace(declared, mount_rpy=(0.0, 0.0, 90.0))
    big = PanoramaConfig(width=720, height=96)
    other = replace(SMALL, clockwise=False)
    for config, panorama in (
        (declared, SMALL), (mirror(mount_rpy=turned.mount_rpy), SMALL), (declared, big),
        (declared, other),
    ):  # fmt: skip
        result = Unwrapper(config, panorama)(picture)
        assert psnr(result[:, 2:-2], direct(smooth, panorama)[:, 2:-2]) > 40
    same = direct(smooth, SMALL).astype(np.uint8)
    for config in (CameraConfig(), declared):
        result = Unwrapper(config, SMALL)(same)
        assert np.array_equal(result, same) and not np.shares_memory(result, same)
    plain = Unwrapper(declared, SMALL)(picture)
    assert_array_equal(Unwrapper(turned, SMALL)(picture), np.roll(plain, -45, axis=1))
    mirrored = LensCalibration(camera_model='panorama', mirrored='yes')
    result = Unwrapper(CameraConfig(), SMALL, mirrored)(picture)
    assert_array_equal(result, plain[:, ::-1])


def test_a_tilted_panorama_is_levelled():
    config = CameraConfig(camera_model='panorama', mount_rpy=(3.0, 0.0, 0.0))
    unwrapper = Unwrapper(config, PanoramaConfig(width=360, height=48))
    picture = picture_of(smooth, unwrapper.calibration, (48, 360), config.mount_rpy)
    seen = unwrapper.visible((48, 360))
    assert 0.8 < seen.mean() < 1.0
    assert psnr(unwrapper(picture)[seen], direct(smooth, unwrapper.panorama)[seen]) > 35


def test_a_blind_sector_hides_what_lies_from_its_start_to_its_end_and_repeats_its_neighbors():
    for sector, hidden in (
        ((350.0, 10.0), np.abs(AZIMUTH) < 10), ((-10.0, 10.0), np.abs(AZIMUTH) < 10),
        ((30.5, 30.5), AZIMUTH > 400), ((100.0, 140.0), np.abs(AZIMUTH - 120) < 20),
    ):  # fmt: skip
        seen = Unwrapper(mirror(blind_sectors=sector), SMALL).visible(SIZE)
        assert_array_equal(~seen.all(axis=0), hidden)
    config = mirror(blind_sectors=(170.0, 190.0))  # behind, so the outer columns
    result, full = (Unwrapper(c, SMALL)(picture_of(smooth)) for c in (config, mirror()))
    columns = np.arange(180).clip(5, 174)
    assert_array_equal(result, full[:, columns])


def test_a_mask_picture_of_any_size_hides_what_is_black_of_images_of_any_size(tmp_path):
    mask = np.full((100, 100), 255, np.uint8)
    mask[:50] = 0  # the upper half of the picture looks forward
    cv2.imwrite(str(tmp_path / 'mask.png'), mask)
    unwrapper = Unwrapper(mirror(mask_file=str(tmp_path / 'mask.png')), SMALL)
    for size in (SIZE, (120, 120), SIZE):
        seen = unwrapper.visible(size)
        assert not seen[:, 46:134].any()
        assert seen[:, :44].all() and seen[:, 136:].all()
        assert_array_equal(unwrapper.seen(size), seen)
        result = unwrapper(picture_of(smooth, size=size))
        assert psnr(result[seen], direct(smooth, SMALL)[seen]) > 35


def test_what_the_camera_does_not_see_is_filled_from_what_it_sees():
    lens = LensCalibration(cx=200.0)
    unwrapper = Unwrapper(CameraConfig(), SMALL, lens)
    result = unwrapper(picture_of(lambda rays: 0 * rays + 200, lens))
    assert unwrapper.seen(SIZE) is None, 'nothing hides the view'
    assert 0.5 < unwrapper.visible(SIZE).mean() < 0.95
    assert (result == 200).all()
    panorama = PanoramaConfig(width=90, height=40, elevation_min=-10.0, elevation_max=60.0)
    unwrapper = Unwrapper(mirror(), panorama)
    result, seen = unwrapper(picture_of(smooth)), unwrapper.visible(SIZE)
    first = int(np.argmax(seen.all(axis=1)))
    assert first > 5 and not seen[: first - 1].any()
    assert_array_equal(result[0], result[int(np.argmax(seen.any(axis=1)))])


def test_wrong_masks_and_pictures_are_refused():
    """And raw images without a description: they would be taken for the simulator's mirror."""
    good, whole = np.zeros((*SIZE, 3), np.uint8), ((0.0, 359.999), (360.0, 0.0), (-10.0, 400.0))
    for config, picture, words in (
        (mirror(blind_sectors=(0.0,)), good, 'a start and an end'),
        (mirror(mask_file='nowhere.png'), good, r'missing or is no image \(nowhere.png'),
        *((mirror(blind_sectors=sector), good, 'sees no part') for sector in whole),
        (CameraConfig(), good, 'no camera is described: set the parameter model'),
        *((mirror(), wrong, '') for wrong in (
            good[..., 0], good.astype(np.float32), good[:0], np.zeros((480, 640, 3), np.uint8)
        )),
    ):  # fmt: skip
        with pytest.raises(CameraError, match=words):
            Unwrapper(config, SMALL)(picture)


@pytest.mark.parametrize('clockwise', [True, False])
@pytest.mark.parametrize('model', ['', 'panorama'])
def test_a_panorama_that_the_camera_gives_is_mounted_and_masked(model, clockwise, tmp_path):
    """In any size. Its columns grow as declared; with camera_model: panorama clockwise."""
    panorama, mount = replace(SMALL, clockwise=clockwise), (4.0, -3.0, 40.0)
    lens = LensCalibration(camera_model='panorama')
    order = slice(None, None, 1 if clockwise or model else -1)
    cv2.imwrite(str(tmp_path / 'mask.png'), np.full((10, 6), [[0, *[255] * 5]], np.uint8)[:, order])
    for size in ((24, 180), (48, 360)):
        config = CameraConfig(camera_model=model, mount_rpy=mount)
        unwrapper = Unwrapper(config, panorama)
        seen = unwrapper.visible(size)
        assert 0.7 < seen.mean() < 1.0 and (unwrapper.seen(size) == seen).all()
        assert unwrapper.lens.mount_rpy == mount
        tilted = picture_of(smooth, lens, size, mount)[:, order]
        assert psnr(unwrapper(tilted)[seen], direct(smooth, panorama)[seen]) > 30
        level = picture_of(smooth, lens, size)[:, order]
        for hiding, hidden in (
            ({'blind_sectors': (100.0, 140.0)}, np.abs(AZIMUTH - 120) < 20),
            ({'mask_file': str(tmp_path / 'mask.png')}, AZIMUTH > 120),
        ):
            unwrapper = Unwrapper(CameraConfig(camera_model=model, **hiding), panorama)
            result = unwrapper(level)
            seen = np.broadcast_to(~hidden[:: 1 if clockwise else -1], (24, 180))
            assert_array_equal(unwrapper.visible(size), seen)
            assert np.abs(result[seen] - direct(smooth, panorama)[seen]).max() < 4
            # A model masks again: nothing changes.
            again = filled(result[None], repeated_pixels(unwrapper.seen(size)))
            assert_array_equal(again[0], result)
    untouched = Unwrapper(CameraConfig(camera_model=model), panorama)
    assert untouched.seen(size) is None
    assert not any(untouched.lens.mount_rpy) if model else untouched.lens is None


def test_recorded_panoramas_are_mounted_and_masked_in_their_size(tmp_path):
    """Those of omnicam_node, beside their geometry, are mounted already; and a mask file that is
    missing is an error at once."""
    panorama = PanoramaConfig(width=360, height=48)
    picture = picture_of(smooth, LensCalibration(camera_model='panorama'), (48, 360))
    camera = CameraConfig(mount_rpy=(0.0, 0.0, 90.0), blind_sectors=(100.0, 140.0))
    for name, expected in (
        ('plain', Unwrapper(camera, panorama)(picture)),
        ('made', Unwrapper(replace(camera, mount_rpy=(0.0,) * 3), panorama)(picture)),
    ):
        with BagWriter(tmp_path / name) as bag:
            for at in (10**18, 10**18 + 10**8):
                bag.image('/front/panorama', at, picture, 'camera')
                bag.odometry('/odom', at, (0, 0, 0), (0, 0), (0, 0))
            info = typestore(Stores.ROS2_JAZZY).types['std_msgs/msg/String'](data='{}')
            if name == 'made':
                bag.message('/front/panorama/info', 10**18, info)
        run = read_drive(tmp_path / name, tmp_path, ReadingRecipe(camera=camera))
        assert_array_equal(run.panoramas.read(0, 1)[0], expected)
        assert 40 <= (~run.seen[0]).sum() <= 41 and (run.seen == run.seen[0]).all()
        missing = ReadingRecipe(camera=CameraConfig(mask_file='nowhere.png'))
        lens = Unwrapper(camera, panorama).lens
        live = as_live(ReadingRecipe(), panorama, lens).unwrapper
        assert live.lens == lens and lens.mount_rpy == camera.mount_rpy
        with pytest.raises(CameraError, match=r'mask_file is missing or is no image \(nowhere.png'):
            read_drive(tmp_path / name, tmp_path, missing)
