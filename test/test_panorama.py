# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Unwrapping: directions, straight lines, rotation as a column shift, masks, normalization."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.panorama import (
    Unwrapper,
    _in_sectors,
    looks_like_panorama,
    nearest_visible,
    normalized,
    panorama_rays,
)
from sfa_localization.camera.settings import CameraConfig, LensCalibration, PanoramaConfig
from sfa_localization.data.errors import CameraError, ConfigError

SIZE = (400, 400)
SMALL = PanoramaConfig(width=180, height=24)


def mirror(**settings):
    """The simulator's."""
    return CameraConfig(camera_model='mirror', **settings)


LENSES = {
    'mirror': LensCalibration(),
    'fisheye': LensCalibration(camera_model='fisheye', fx=150.0, fy=150.0, radius_min=0.0),
    'polar': LensCalibration(camera_model='polar', radius_min=100.0, radius_max=310.0),
    'ocam': LensCalibration(camera_model='ocam', polynomial=(-150.0, 0.0, 1.9e-3), radius_min=0.0),
    'equirectangular': LensCalibration(camera_model='equirectangular'),
    'dual': LensCalibration(
        camera_model='dual_fisheye', fx=95.0, fy=95.0, cx=160.0, second_cx=480.0, second_cy=319.5
    ),
}


def picture_of(scene, lens=LENSES['mirror'], size=SIZE, mount_rpy=(0.0, 0.0, 0.0)):
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
    np.testing.assert_allclose(azimuth[[0, 90, 179, 180]], [179.5, 89.5, 0.5, -0.5])
    elevation = np.degrees(np.arcsin(rays[:, 0, 2]))
    np.testing.assert_allclose(elevation[[0, 17, 35]], [17.5, 0.5, -17.5])
    turned = panorama_rays(PanoramaConfig(width=360, clockwise=False))
    np.testing.assert_allclose(turned[0, 0, 1], -panorama_rays(PanoramaConfig(width=360))[0, 0, 1])


@pytest.mark.parametrize('name', LENSES)
@pytest.mark.parametrize('clockwise', [True, False])
def test_every_camera_gives_the_same_panorama(name, clockwise):
    panorama = dataclasses.replace(SMALL, clockwise=clockwise)
    mount = (-3.0, 2.0, 37.0)
    unwrapper = Unwrapper(CameraConfig(mount_rpy=mount), panorama, LENSES[name])
    result = unwrapper(picture_of(smooth, LENSES[name], mount_rpy=mount))
    seen = unwrapper.visible(SIZE)
    assert result.shape == (24, 180, 3)
    assert result.dtype == np.uint8
    assert seen.mean() > 0.85
    # The drawn pictures are black right beside their rim, which interpolation mixes in.
    assert psnr(result[seen], direct(smooth, panorama)[seen]) > 34


@pytest.mark.parametrize('name', LENSES)
def test_a_turn_of_the_camera_is_a_shift_of_columns(name):
    """The same picture, from a camera turned by 10 columns, moves to the left in azimuth."""
    picture = picture_of(smooth, LENSES[name])
    straight, shifted = (
        Unwrapper(CameraConfig(mount_rpy=(0.0, 0.0, yaw)), SMALL, LENSES[name])(picture)
        for yaw in (0.0, 10 * 360.0 / SMALL.width)
    )
    np.testing.assert_allclose(shifted, np.roll(straight, -10, axis=1), atol=2)


@pytest.mark.parametrize('name', LENSES)
def test_vertical_edges_become_straight_columns(name):
    def poles(rays):
        angle = np.degrees(np.arctan2(rays[:, 1], rays[:, 0]))
        return np.repeat(np.where(angle[:, None] % 60 < 30, 220, 30), 3, axis=1)

    unwrapper = Unwrapper(CameraConfig(), SMALL, LENSES[name])
    bright = unwrapper(picture_of(poles, LENSES[name]))[..., 0] > 125
    seen = unwrapper.visible(SIZE)
    columns = np.arange(SMALL.width)
    azimuth = -(columns + 0.5 - SMALL.width / 2) * 360 / SMALL.width
    away_from_edges = np.abs((azimuth % 30) - 15) < 12
    expected = np.broadcast_to(azimuth % 60 < 30, bright.shape)
    checked = seen & away_from_edges
    assert checked.sum() > 0.5 * bright.size
    np.testing.assert_array_equal(bright[checked], expected[checked])


@pytest.mark.parametrize('name', LENSES)
def test_the_horizon_becomes_a_straight_row(name):
    panorama = PanoramaConfig(width=180, height=20, elevation_min=-10, elevation_max=10)

    def sky(rays):
        return np.repeat(np.where(rays[:, 2:] > 0, 220, 30), 3, axis=1)

    unwrapper = Unwrapper(CameraConfig(), panorama, LENSES[name])
    bright = unwrapper(picture_of(sky, LENSES[name]))[..., 0] > 125
    seen = unwrapper.visible(SIZE)
    assert bright[:9][seen[:9]].all()
    assert not bright[11:][seen[11:]].any()


def test_a_synthetic_ring_in_polar_becomes_a_row():
    picture = np.zeros((400, 400, 3), np.uint8)
    cv2.circle(picture, (190, 210), 100, (255, 255, 255), 4)
    lens = LensCalibration(
        camera_model='polar',
        cx=190.0,
        cy=210.0,
        radius_min=50.0,
        radius_max=150.0,
        angle_min=80.0,
        angle_max=110.0,
        image_width=0,
        image_height=0,
    )
    panorama = PanoramaConfig(width=300, height=50, elevation_min=-10.0, elevation_max=20.0)
    result = Unwrapper(CameraConfig(), panorama, lens)(picture)[..., 0].astype(float)
    rows = (result * np.arange(50)[:, None]).sum(0) / result.sum(0)
    np.testing.assert_allclose(rows, 24.5, atol=0.4)  # radius 100 is half way: 5 degrees


class TestPanoramaInput:
    def picture(self):
        return direct(smooth, PanoramaConfig(width=360, height=48)).astype(np.uint8)

    def test_is_resized(self):
        result = Unwrapper(CameraConfig(camera_model='panorama'), SMALL)(self.picture())
        assert result.shape == (24, 180, 3)
        assert psnr(result, direct(smooth, SMALL)) > 40

    def test_is_enlarged(self):
        big = PanoramaConfig(width=720, height=96)
        result = Unwrapper(CameraConfig(camera_model='panorama'), big)(self.picture())
        assert psnr(result[:, 2:-2], direct(smooth, big)[:, 2:-2]) > 40

    def test_is_turned_and_reversed_to_the_convention(self):
        config = CameraConfig(camera_model='panorama', mount_rpy=(0.0, 0.0, 90.0))
        turned = Unwrapper(config, SMALL)(self.picture())
        plain = Unwrapper(CameraConfig(camera_model='panorama'), SMALL)(self.picture())
        np.testing.assert_array_equal(turned, np.roll(plain, -45, axis=1))
        mirrored = LensCalibration(camera_model='panorama', mirrored='yes')
        result = Unwrapper(CameraConfig(), SMALL, mirrored)(self.picture())
        np.testing.assert_array_equal(result, plain[:, ::-1])
        other = dataclasses.replace(SMALL, clockwise=False)
        result = Unwrapper(CameraConfig(camera_model='panorama'), other)(self.picture())
        assert psnr(result, direct(smooth, other)) > 40

    def test_a_tilted_one_is_levelled(self):
        config = CameraConfig(camera_model='panorama', mount_rpy=(3.0, 0.0, 0.0))
        unwrapper = Unwrapper(config, PanoramaConfig(width=360, height=48))
        picture = picture_of(smooth, unwrapper.calibration, (48, 360), config.mount_rpy)
        seen = unwrapper.visible((48, 360))
        expected = direct(smooth, unwrapper.panorama)
        assert 0.8 < seen.mean() < 1.0
        assert psnr(unwrapper(picture)[seen], expected[seen]) > 35

    def test_any_other_camera_only_resizes_it(self):
        turned = CameraConfig(mount_rpy=(0.0, 0.0, 90.0))
        result = Unwrapper(turned, SMALL)(self.picture())
        assert psnr(result, direct(smooth, SMALL)) > 40

    def test_the_result_is_never_the_input_itself(self):
        picture = direct(smooth, SMALL).astype(np.uint8)
        for config in (CameraConfig(), CameraConfig(camera_model='panorama')):
            result = Unwrapper(config, SMALL)(picture)
            np.testing.assert_array_equal(result, picture)
            assert not np.shares_memory(result, picture)


def test_raw_images_need_a_description():
    """And are told of it: another camera's would be taken for the simulator's mirror."""
    unwrapper = Unwrapper(CameraConfig(), SMALL)
    assert unwrapper(np.zeros((24, 180, 3), np.uint8)).shape == (24, 180, 3)
    for size in ((640, 640), (988, 988), (100, 200)):
        with pytest.raises(CameraError, match='no camera is described: in the parameter file set'):
            unwrapper(np.zeros((*size, 3), np.uint8))


def test_shapes_of_panoramas():
    assert looks_like_panorama(60, 600)
    assert looks_like_panorama(100, 350)
    assert not looks_like_panorama(640, 640)
    assert not looks_like_panorama(100, 349)


class TestMasks:
    @pytest.mark.parametrize(
        ('sector', 'hidden'),
        [
            ((-180.0, 180.0), 360),
            ((0.0, 360.0), 360),
            ((360.0, 0.0), 360),
            ((-10.0, 400.0), 360),
            ((350.0, 10.0), 20),
            ((-10.0, 10.0), 20),
            ((30.5, 30.5), 0),
        ],
    )
    def test_a_blind_sector_hides_what_lies_from_its_start_to_its_end(self, sector, hidden):
        azimuth = np.radians(np.arange(360) + 0.25)
        rays = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], -1)[None]
        assert np.count_nonzero(_in_sectors(rays, sector)) == hidden

    def test_a_blind_sector_repeats_its_neighbors(self):
        config = mirror(blind_sectors=(170.0, 190.0))  # behind, so the outer columns
        unwrapper, plain = Unwrapper(config, SMALL), Unwrapper(mirror(), SMALL)
        picture = picture_of(smooth)
        seen = unwrapper.visible(SIZE)
        np.testing.assert_array_equal(
            seen.all(axis=0), ~np.isin(np.arange(180), [*range(5), *range(175, 180)])
        )
        result, full = unwrapper(picture), plain(picture)
        np.testing.assert_array_equal(result[:, 5:175], full[:, 5:175])
        np.testing.assert_array_equal(result[:, :5], np.repeat(full[:, 5:6], 5, axis=1))
        np.testing.assert_array_equal(result[:, 175:], np.repeat(full[:, 174:175], 5, axis=1))

    def test_a_mask_picture_hides_what_is_black(self, tmp_path):
        mask = np.full(SIZE, 255, np.uint8)
        mask[: SIZE[0] // 2] = 0  # the upper half of the picture looks forward
        path = tmp_path / 'mask.png'
        cv2.imwrite(str(path), mask)
        seen = Unwrapper(mirror(mask_file=str(path)), SMALL).visible(SIZE)
        assert not seen[:, 46:134].any()
        assert seen[:, :44].all()
        assert seen[:, 136:].all()

    def test_a_mask_follows_the_size_of_the_picture(self, tmp_path):
        path = tmp_path / 'mask.png'
        cv2.imwrite(str(path), np.vstack([np.zeros((50, 100)), np.full((50, 100), 255)]))
        seen = Unwrapper(mirror(mask_file=str(path)), SMALL).visible(SIZE)
        assert 0.48 < seen.mean() < 0.52

    def test_what_is_outside_the_picture_is_filled(self):
        lens = LensCalibration(cx=200.0)
        unwrapper = Unwrapper(CameraConfig(), SMALL, lens)
        result = unwrapper(picture_of(lambda rays: 0 * rays + 200, lens))
        assert 0.5 < unwrapper.visible(SIZE).mean() < 0.95
        assert (result == 200).all()

    def test_rows_beyond_the_camera_repeat_the_last_seen(self):
        panorama = PanoramaConfig(width=90, height=40, elevation_min=-10.0, elevation_max=60.0)
        unwrapper = Unwrapper(mirror(), panorama)
        result = unwrapper(picture_of(smooth))
        seen = unwrapper.visible(SIZE)
        first = int(np.argmax(seen.all(axis=1)))
        assert first > 5
        assert not seen[: first - 1].any()
        np.testing.assert_array_equal(result[0], result[int(np.argmax(seen.any(axis=1)))])

    @pytest.mark.parametrize(
        ('config', 'words'),
        [
            (mirror(blind_sectors=(0.0,)), 'a start and an end'),
            (mirror(mask_file='nowhere.png'), 'nowhere.png'),
            (mirror(blind_sectors=(0.0, 359.999)), 'sees no part'),
            (mirror(blind_sectors=(-180.0, 180.0)), 'sees no part'),
        ],
    )
    def test_impossible_masks_say_what_is_wrong(self, config, words):
        panorama = dataclasses.replace(SMALL, elevation_min=15.0)
        with pytest.raises(CameraError, match=words):
            Unwrapper(config, panorama)(np.zeros((*SIZE, 3), np.uint8))


def test_the_nearest_visible_pixel_goes_around_the_back():
    visible = np.array([[0, 1, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0]], bool)
    rows, columns = nearest_visible(visible)
    assert rows.tolist() == [[0] * 6, [0] * 6]
    assert columns[0].tolist()[:2] == [1, 1] or columns[0, 0] == 5
    assert columns[0, [1, 2, 4, 5]].tolist() == [1, 1, 5, 5]


@pytest.mark.parametrize(
    'picture',
    [
        np.zeros((400, 400), np.uint8),
        np.zeros((400, 400, 4), np.uint8),
        np.zeros((400, 400, 3), np.float32),
        np.zeros((0, 640, 3), np.uint8),
        np.zeros((480, 640, 3), np.uint8),
        [[1, 2, 3]],
        None,
    ],
)
def test_wrong_pictures_are_refused(picture):
    with pytest.raises(CameraError):
        Unwrapper(mirror(), SMALL)(picture)


@pytest.mark.parametrize('shape', [(20, 40_000, 3), (40_000, 20, 3)])
@pytest.mark.parametrize('model', ['equirectangular', 'panorama'])
def test_a_picture_that_no_table_can_map_is_refused_by_name(model, shape):
    with pytest.raises(CameraError, match=f'{shape[1]} x {shape[0]} pixels is longer than'):
        Unwrapper(CameraConfig(camera_model=model), SMALL)(np.zeros(shape, np.uint8))


def test_an_empty_range_of_elevations_is_refused():
    with pytest.raises(ConfigError, match='elevation_min'):
        PanoramaConfig(elevation_min=10.0, elevation_max=10.0)


def test_images_of_several_sizes():
    unwrapper = Unwrapper(mirror(), SMALL)
    expected = direct(smooth, SMALL)
    for size in ((400, 400), (320, 320), (400, 400), (200, 200), (100, 100), (120, 120)):
        result = unwrapper(picture_of(smooth, size=size))
        assert psnr(result, expected) > 35
        assert unwrapper.visible(size).shape == (24, 180)


class TestNormalization:
    def picture(self):
        return np.clip(direct(smooth, SMALL), 0, 255).astype(np.uint8)

    def test_is_off_by_default(self):
        assert CameraConfig().normalization == 'off'

    @pytest.mark.parametrize('method', ['exposure', 'local'])
    def test_cancels_a_change_of_exposure(self, method):
        bright = self.picture()
        dark = (bright * 0.6).astype(np.uint8)
        before = np.abs(bright.astype(float) - dark).mean()
        after = np.abs(normalized(bright, method).astype(float) - normalized(dark, method)).mean()
        assert after < 0.06 * before

    def test_local_cancels_light_from_one_side(self):
        picture = np.full((24, 180, 3), 100, np.uint8)
        shaded = (picture * (1 + 0.5 * np.cos(np.arange(180) * 2 * np.pi / 180))[:, None]).astype(
            np.uint8
        )
        result = normalized(shaded, 'local')
        assert result.std() < 0.2 * shaded.std()
        assert np.abs(np.diff(result[:, [0, -1]].astype(int), axis=1)).max() <= 2

    @pytest.mark.parametrize('method', ['exposure', 'local'])
    def test_survives_black_and_white(self, method):
        for level in (0, 255):
            result = normalized(np.full((24, 180, 3), level, np.uint8), method)
            assert result.dtype == np.uint8
            assert result.std() == 0

    def test_works_in_the_unwrapper(self):
        config = mirror(normalization='exposure')
        result = Unwrapper(config, SMALL)(picture_of(smooth) // 3)
        grey = cv2.cvtColor(result, cv2.COLOR_BGR2GRAY)
        assert 105 < grey.mean() < 115
