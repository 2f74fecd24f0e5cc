# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The lens of a camera, learned from a drive: from tracks of points that a known lens projects."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from places import as_complex, lengths

from sfa_localization.camera import lens_report
from sfa_localization.camera.kinds import DUAL_FISHEYE, FISHEYE, MIRROR
from sfa_localization.camera.learned_lens import learn_lens, triangulated
from sfa_localization.camera.lens_guess import LensGuess
from sfa_localization.camera.lens_models import LensCircle
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.point_tracks import PointTracker, Tracks, changing, chosen_images
from sfa_localization.camera.settings import LensCalibration, PanoramaConfig
from sfa_localization.data.errors import CameraError
from sfa_localization.data.run import Trajectory, integrate

SIZE = (600, 800)
MIRROR_LENS = LensCalibration(
    image_width=800, image_height=600, fx=105.0, fy=105.0, cx=408.0, cy=296.0, xi=0.75,
    radius_min=30.0, radius_max=285.0, mount_rpy=(0.0, 0.0, -40.0),
)  # fmt: skip
EQUIANGULAR = replace(
    MIRROR_LENS, camera_model='polar', angle_min=40.0, angle_max=116.0, mount_rpy=(0.0, 0.0, 90.0)
)
LEANING = LensCalibration(
    camera_model='fisheye', image_width=800, image_height=600, fx=160.0, fy=160.0, cx=395.0,
    cy=305.0, distortion=(0.02, -0.004, 0.0, 0.0), radius_min=0.0, radius_max=285.0,
    mount_rpy=(8.0, -2.0, 30.0),
)  # fmt: skip
TWO = LensCalibration(
    camera_model='dual_fisheye', image_width=800, image_height=400, fx=118.0, fy=118.0, cx=201.0,
    cy=198.0, second_cx=598.0, second_cy=201.0, second_focal=108.0, second_roll=3.0,
    radius_min=0.0, radius_max=0.0, mount_rpy=(0.0, 0.0, 20.0),
)  # fmt: skip
LENSES = {'mirror': MIRROR_LENS, 'equiangular mirror': EQUIANGULAR, 'leaning': LEANING, 'two': TWO}
PLACE = complex(-0.35, 0.1)
TURNS, DELAY_S = 0.96, 0.05  # true over counted turns; how late images are stamped


def drive(seconds=70.0, turn=0.5):
    """Stamps, true poses and odometry of a robot that drives legs and arcs, and turns on spots."""
    rng = np.random.default_rng(0)
    stamps_ns = (np.arange(0.0, seconds, 0.04) * 1e9).astype(np.int64) + 10**9
    phase = (stamps_ns * 1e-9 // 2.0).astype(int)
    rates = rng.choice([0.0, 0.0, turn, -turn], phase.max() + 1)[phase]
    speeds = np.where(phase % 7 == 3, 0.0, 0.8)
    true = np.column_stack([speeds, np.where(phase % 7 == 3, 2 * turn, rates)])
    counted = true / [1.0, TURNS]
    return stamps_ns, integrate(stamps_ns, true), integrate(stamps_ns, counted)


def samples_of(camera, lens):
    """Images with a bright sky, and noise where the camera sees anything."""
    rows, columns = np.mgrid[: lens.image_height, : lens.image_width]
    rays = camera.unproject(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    gray = np.where(rays[:, 2] > 0, 200.0, 80.0) * np.isfinite(rays[:, 0])
    gray = np.nan_to_num(gray).reshape(rows.shape)[..., None]
    rng = np.random.default_rng(1)
    images = [gray + rng.normal(0, 20, (*rows.shape, 3)) * (gray > 0) for _ in range(6)]
    return [np.clip(image, 0, 255).astype(np.uint8) for image in images]


def tracks_of(lens, count=900, noise_px=0.3, **driven):
    """Tracks of points around a drive, with noise and a few that slide; and its odometry."""
    stamps_ns, true, counted = drive(**driven)
    rng, size = np.random.default_rng(2), (lens.image_height, lens.image_width)
    camera = make_camera(lens, size, mount_rpy=lens.mount_rpy)
    rows = np.arange(5, len(stamps_ns), 6)
    image_ns, poses = stamps_ns[rows], true[rows]
    lever = PLACE * np.exp(1j * poses[:, 2])
    places = poses[:, :2] + np.column_stack([lever.real, lever.imag])
    found = []
    for _ in range(count):
        first = rng.integers(0, len(rows) - 10)
        seen = np.arange(first, min(first + rng.integers(4, 30), len(rows)))
        far, azimuth = rng.uniform(1.0, 12.0), rng.uniform(0, 2 * np.pi)
        at = places[seen[len(seen) // 2]] + far * np.array([np.cos(azimuth), np.sin(azimuth)])
        height = rng.choice([-0.5, rng.uniform(-0.4, 0.6) * far])
        away = np.column_stack([at - places[seen], np.full(len(seen), height)])
        turn = np.exp(-1j * poses[seen, 2])
        level = as_complex(away) * turn
        pixels = camera.project(np.column_stack([level.real, level.imag, away[:, 2]]))
        slides = rng.uniform(-1, 1, 2) * (rng.random() < 0.1)
        pixels += rng.normal(0, noise_px, pixels.shape) + slides * np.arange(len(seen))[:, None]
        visible = np.isfinite(pixels[:, 0])
        if visible.sum() > 3:
            found.append((seen[visible], pixels[visible]))
    point = np.repeat(np.arange(len(found)), [len(seen) for seen, _ in found])
    image, pixels = (np.concatenate(part) for part in zip(*found, strict=True))
    stamped_ns = image_ns + int(DELAY_S * 1e9)
    tracks = Tracks(point, image, pixels, stamped_ns, size, (9, 0))
    return tracks, Trajectory(stamps_ns, counted)


def guess_of(lens):
    """What images tell of these lenses: the rim, three pixels off."""
    base = LensCalibration(
        image_width=lens.image_width, image_height=lens.image_height,
        radius_min=lens.radius_min, radius_max=lens.radius_max,
    )  # fmt: skip
    if lens is TWO:
        circles = LensCircle(201.0, 199.0, 186.0, 1.4), LensCircle(597.0, 201.0, 171.0, 1.4)
        return LensGuess(DUAL_FISHEYE, circles, base)
    circle = LensCircle(lens.cx + 1.0, lens.cy - 1.0, lens.radius_max, 2.0, lens.radius_min)
    return LensGuess(FISHEYE if lens is LEANING else MIRROR, (circle,), base)


def learned(lens, **options):
    camera = make_camera(lens, (lens.image_height, lens.image_width), mount_rpy=lens.mount_rpy)
    tracks, odometry = tracks_of(lens, **options)
    return learn_lens(tracks, odometry, guess_of(lens), samples_of(camera, lens))


@pytest.fixture(scope='module')
def of_mirror():
    return learned(MIRROR_LENS)


@pytest.mark.slow
@pytest.mark.parametrize('name', LENSES)
def test_a_drive_shows_the_lens_and_where_the_camera_sits(name, of_mirror):
    """The horizon is right to a degree, whatever wheels count and stamps say; elevations are, up to
    the stretch that level driving does not show, of which the models have a prior.
    """
    lens = LENSES[name]
    result = of_mirror if lens is MIRROR_LENS else learned(lens)
    size = lens.image_height, lens.image_width
    true, found = (make_camera(k, size, mount_rpy=k.mount_rpy) for k in (lens, result.calibration))
    azimuth, elevation = np.radians(np.meshgrid(np.arange(0, 360, 30.0), [-8.0, 0.0, 10.0]))
    level = np.cos(elevation)
    parts = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    rays = np.stack(parts, axis=-1).reshape(-1, 3)
    seen = found.unproject(true.project(rays))
    level = rays[:, 2] == 0.0
    off = np.degrees(np.arccos(np.clip(np.sum(seen * rays, axis=1), -1, 1)))
    assert np.nanmax(off[level]) < 1.0 and np.isfinite(off).mean() > 0.8
    stretch = (seen[:, 2] / lengths(seen))[~level] / np.tan(elevation).ravel()[~level]
    assert np.nanmax(stretch) < 1.25 * np.nanmin(stretch)
    if name != 'equiangular mirror':
        assert 0.8 < np.nanmedian(stretch) < 1.25
    assert abs(result.place - PLACE) < 0.04
    low, high = result.sees
    assert low < 0 < high
    if lens is not TWO:
        assert_allclose(result.horizon.value, horizon_px(lens), atol=3.0)
        assert (result.calibration.axis == 'up') == (lens is LEANING)
    assert 'sees' in lens_report.sentence(result)


def horizon_px(lens):
    camera = make_camera(lens, (lens.image_height, lens.image_width))
    (pixel,) = camera.lens.project(np.array([[1.0, 0.0, 0.0]]) @ camera.rotation)
    return np.hypot(*(pixel - [lens.cx, lens.cy]))


@pytest.mark.slow
def test_a_wrong_description_is_named_with_its_size_and_a_right_one_is_not(of_mirror):
    result, far = of_mirror, replace(MIRROR_LENS, cx=MIRROR_LENS.cx + 15.0)
    turned = replace(MIRROR_LENS, mount_rpy=(0.0,) * 3)
    polar = replace(EQUIANGULAR, angle_min=78.0, angle_max=114.0, mount_rpy=(0.0, 0.0, -40.0))
    said = {
        name: ' '.join(lens_report.contradictions(result, lens, 'camera.yaml'))
        for name, lens in (
            ('right', MIRROR_LENS),
            ('far', far),
            ('turned', turned),
            ('polar', polar),
        )
    }
    assert said['right'] == ''
    assert '423, 296, the drive shows 408, 296 (+- ' in said['far']
    assert '40 degrees off' in said['turned'] and 'yaw of -40 degrees' in said['turned']
    shown = re.search(r'puts the horizon at 115 px, the drive shows (\d+) \(', said['polar'])[1]
    assert int(shown) == pytest.approx(horizon_px(MIRROR_LENS), abs=3.0)


@pytest.mark.slow
def test_the_panorama_shows_what_the_lens_sees_unless_others_are_asked(of_mirror):
    usual = PanoramaConfig()
    for sees, expected in (
        ((-60.0, 40.0), (-12.0, 24.0)), ((-3.0, 80.0), (-2.0, 34.0)),
        ((-30.0, 11.0), (-26.0, 10.0)), ((-5.0, 15.0), (-4.0, 14.0)),
    ):  # fmt: skip
        chosen = lens_report.fitting_panorama(usual, sees)
        assert (chosen.elevation_min, chosen.elevation_max) == expected
    asked = replace(usual, elevation_min=-20.0)
    assert lens_report.fitting_panorama(asked, of_mirror.sees) == asked
    assert lens_report.advice(of_mirror) == []
    (text,) = lens_report.advice(replace(of_mirror, sees=(1.0, 80.0)))
    assert 'sees nothing below 1 degrees' in text


def test_a_drive_that_does_not_show_the_lens_says_what_is_missing():
    for options, words in (
        ({'seconds': 4.0}, 'drive 5 m, not'), ({'turn': 0.0}, 'turn by 360 degrees in all, not 0'),
        ({'seconds': 20.0, 'turn': 0.1}, 'turn by 360 degrees in all, not 75'),
        ({'count': 60}, 'points that can be followed'),
    ):  # fmt: skip
        with pytest.raises(CameraError, match=words):
            learned(MIRROR_LENS, **options)
    with pytest.raises(CameraError, match='stamped by one clock'):
        chosen_images(np.array([1, 2]), Trajectory(np.array([10**12]), np.zeros((1, 3))))


def test_rays_meet_in_points_also_in_one_that_is_infinitely_far():
    places = np.column_stack([np.linspace(0, 2, 6), np.zeros(6)])
    for point in ([1.0, 3.0, 0.5], [2e6, 3e6, 5e5]):
        away = np.array(point) - np.column_stack([places, np.zeros(6)])
        rays = away / np.linalg.norm(away, axis=1, keepdims=True)
        expected = triangulated(np.zeros(6, int), places, rays)
        assert_allclose(expected, rays, atol=1e-4)
    # Behind the camera no point lies: rays that would meet there are those of a far one.
    behind = np.column_stack([-0.1 * (places[:, 0] - 1.0), np.ones(6), np.zeros(6)]) * [-1, 1, 1]
    behind /= np.linalg.norm(behind, axis=1, keepdims=True)
    assert triangulated(np.zeros(6, int), places, behind)[:, 1].min() > 0.9


@pytest.mark.parametrize(('rate_hz', 'speed'), [(1.0, 0.3), (30.0, 1.0), (5.0, 0.5)])
def test_images_are_chosen_by_motion_at_any_rate_and_never_too_many(rate_hz, speed):
    stamps_ns = (np.arange(0.0, 900.0, 1 / rate_hz) * 1e9).astype(np.int64)
    poses = np.column_stack([speed * stamps_ns * 1e-9, 0 * stamps_ns, 0 * stamps_ns])
    chosen = chosen_images(stamps_ns, Trajectory(stamps_ns, poses.astype(float)))
    steps = np.diff(list(chosen)) * 1e-9 * speed
    assert len(chosen) <= 560 and steps.min() >= min(0.07, speed / rate_hz - 1e-6)
    assert max(chosen) > 0.8 * stamps_ns[-1]  # from all over the drive
    standing = Trajectory(stamps_ns, np.zeros((len(stamps_ns), 3)))
    assert len(chosen_images(stamps_ns, standing)) == 1


@pytest.mark.parametrize('scale', [1, 3])
def test_points_are_followed_in_rotating_images_and_not_beyond_the_rim(scale):
    """In a texture that turns about the center, also of large images; votes tell which way."""
    side = 300 * scale
    center, size = (side - 1) / 2, (side, side)
    lens = LensCalibration(
        camera_model='fisheye', image_width=side, image_height=side, fx=90.0 * scale,
        fy=90.0 * scale, cx=center, cy=center, radius_min=0.0, radius_max=0.0,
    )  # fmt: skip
    coarse = np.random.default_rng(3).integers(40, 256, (40, 40, 3), np.uint8)
    texture = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
    rows, columns = np.mgrid[:side, :side]
    inside = np.hypot(columns - center, rows - center) < 120 * scale
    turns = np.arange(8) * 0.15
    images = []
    for turn in turns:
        matrix = cv2.getRotationMatrix2D((center, center), np.degrees(turn), 1.0)
        images.append(cv2.warpAffine(texture, matrix, size) * inside[..., None].astype(np.uint8))
    cameras = [make_camera(replace(lens, mirrored=m), size) for m in ('no', 'yes')]
    tracker = PointTracker(cameras, images)
    for number, (image, turn) in enumerate(zip(images, turns, strict=True)):
        tracker.add(number, image, np.array([0.0, 0.0, turn]))
    tracks = tracker.tracks()
    assert len(tracks) > 30 and len(tracks.stamps_ns) == 8
    assert max(tracks.votes) == 7 and min(tracks.votes) == 0
    right = int(np.argmax(tracks.votes))
    rays = cameras[right].unproject(tracks.pixels)
    azimuth = np.arctan2(rays[:, 1], rays[:, 0]) + turns[tracks.image]
    spread = [np.abs(np.exp(1j * azimuth[tracks.point == k]).mean()) for k in range(len(tracks))]
    assert np.median(spread) > 0.9999
    assert lengths(tracks.pixels - center).max() < 120 * scale
    seen = changing(images)
    assert seen[side // 2, round(0.7 * side)] and not seen[0, 0]


@pytest.mark.parametrize('has_rim', [True, False])
def test_an_edge_in_the_scene_is_no_rim(has_rim):
    """Things move on both sides of the edge of a lawn; beyond a rim nothing does."""
    rows, columns = np.mgrid[:240, :320]
    inside = (np.hypot(columns - 165.0, rows - 118.0) < 90)[..., None]
    rng, samples = np.random.default_rng(5), []
    for _ in range(8):
        coarse = rng.integers(90, 250, (24, 32, 1), np.uint8).repeat(3, axis=2)
        texture = cv2.resize(coarse, (320, 240))
        beyond = 8 if has_rim else texture // 2
        samples.append(np.where(inside, texture, beyond).astype(np.uint8))
    (circle,) = LensGuess.of(samples).circles
    expected = (165.0, 118.0, 90.0) if has_rim else (159.5, 119.5, 200.0)
    assert (circle.column, circle.row, circle.radius) == pytest.approx(expected, abs=2.0)
    assert LensGuess.of(samples).base.radius_max == (circle.radius if has_rim else 0.0)
