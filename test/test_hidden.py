# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the robot hides of the view is missing in textures, and is filled in where others saw it."""

from dataclasses import replace

import numpy as np
import pytest
from cylinder_worlds import Spheres, alone, lanes, place, recipe, run_in, visit, wander
from numpy.testing import assert_allclose
from places import distances, lengths

from sfa_localization import place_model
from sfa_localization.camera.body import robot_in_view, seen_mask, sentences
from sfa_localization.camera.panorama import Unwrapper, filled, repeated_pixels
from sfa_localization.camera.settings import CameraConfig, PanoramaConfig
from sfa_localization.camera.watch import drowned_columns
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.keyframes.hidden import (
    completed,
    correlated_part,
    masked,
    seen_in,
    turned_mask,
)
from sfa_localization.keyframes.texture import (
    columns_of,
    correlate,
    normalized,
    quantized,
    spectrum,
    texture,
    turned,
)
from sfa_localization.keyframes.training import choose_keyframes, fit_among
from sfa_localization.observer import Observer
from sfa_localization.training import learn_place

CONFIG = PanoramaConfig(width=120, height=24)
SECTOR = 150.0, 210.0
WORLD = Spheres.about(0)


def camera(config=CONFIG):
    return Unwrapper(CameraConfig(blind_sectors=SECTOR), config)


def pictures(poses, config=CONFIG):
    """Textures of what is not hidden, and the images (N, H, W, 3)."""
    images = np.clip(WORLD.panoramas(poses, config), 0, 255).astype(np.uint8)
    images = filled(images, repeated_pixels(camera(config).visible((config.height, config.width))))
    return quantized(np.stack([texture(image) for image in images])), images


def mask(rows, columns=80, config=CONFIG):
    return seen_in(camera(config).seen((config.height, config.width)), rows, columns)


def learnt(sees_all, config=CONFIG):
    poses = lanes()
    textures, _ = pictures(poses, config)
    seen = None if sees_all else mask(textures.shape[1], textures.shape[2], config)
    drives = np.zeros(len(poses), np.int32)
    return choose_keyframes(textures, poses, config.sphere, drives, seen)[0]


def errors(keyframes, config=CONFIG):
    """Mean errors, m and rad, at unseen poses."""
    rng = np.random.default_rng(3)
    poses = rng.uniform([-1.8, -1.8, -np.pi], [1.8, 1.8, np.pi], (60, 3))
    places = np.array([alone(keyframes, image).pose for image in pictures(poses, config)[1]])
    off = places - poses
    return lengths(off).mean(), np.abs(wrap_angle(off[:, 2])).mean()


def test_keyframes_that_saw_all_locate_an_image_by_the_part_that_it_shows():
    """As of a robot one of whose cameras is missing."""
    whole = learnt(sees_all=True)
    part = whole.seeing(camera().seen((CONFIG.height, CONFIG.width)))
    assert whole.seen is None and part.coarse is whole.coarse
    assert_allclose(part.seen, mask(whole.channels[-1].stop))
    far, turned_by = errors(part)
    unaware, _ = errors(whole)
    assert far < 0.06 and far < 0.5 * unaware
    assert turned_by < np.deg2rad(0.3)


def test_columns_that_light_drowns_are_not_compared(monkeypatch):
    """Those of a low sun: a white sky above the things around hides none of them."""
    run = visit()
    images = run.panoramas.read(0, len(run.panoramas)).copy()
    images[0, : images.shape[1] // 2] = 255
    assert not drowned_columns(images[0]).any()
    images[:, :, 20:32] = 255
    model = place().model

    def far():
        places = np.array([seen.pose[:2] for seen in model.locate_all(images)])
        return lengths(places - run.odometry.poses[:, :2]).mean()

    aware = far()
    assert Observer(model).observe(0, images[0]).drowned == 12 / 72
    monkeypatch.setattr(place_model, 'drowned_columns', lambda image: np.zeros(72, bool))
    assert aware < 0.5 * far()


@pytest.mark.parametrize('config', [CONFIG, replace(CONFIG, clockwise=False)])
def test_images_with_a_hidden_sector_are_located_by_what_was_seen(config):
    far, turned_by = errors(learnt(sees_all=False, config=config), config)
    unaware, _ = errors(learnt(sees_all=True, config=config), config)
    assert far < 0.03 and far < 0.3 * unaware
    assert turned_by < np.deg2rad(0.3)


@pytest.mark.parametrize('size', [(60, 600), (100, 400), (24, 120), (12, 48)])
def test_what_is_seen_of_panoramas_of_any_size_is_seen_in_textures(size):
    assert seen_in(np.ones(size, bool), 32, 80).all()
    panorama = np.ones(size, bool)
    panorama[: size[0] // 4] = False
    seen = seen_in(panorama, 32, 80)
    assert not seen[:4].any() and seen[5:16].all() and seen[24 + 3 :].all()


def test_of_a_dense_drive_the_missing_part_comes_from_lanes_that_head_another_way():
    """A hundred images of its own lane, which miss the same, are nearer than any of the other."""
    along = 0.01 * np.arange(100)
    places = np.concatenate([np.column_stack([along, y + 0 * along]) for y in (0.0, 2.0)])
    seen = np.ones((200, 4, 20), bool)
    seen[:100, :, :5] = seen[100:, :, 10:15] = False
    filled = columns_of(completed(spectrum(np.ones((200, 4, 20), np.float32)), seen, places), 20)
    assert_allclose(filled, 1.0, atol=0.01)


def test_the_mask_is_that_of_the_sector_in_all_channels():
    seen = mask(32)
    assert seen.shape == (32, 80) and (seen == seen[0]).all()
    assert seen[0].sum() == pytest.approx(80 * 300 / 360, abs=2)


@pytest.mark.parametrize('angle', [-2.0, 0.0, 0.3, 3.1])
def test_a_mask_turns_like_the_texture_and_hides_what_is_hidden_in_part(angle):
    seen = mask(32)
    shown = columns_of(turned(spectrum(seen.astype(np.float32)), angle), 80)
    moved = turned_mask(seen, angle)
    assert (shown[moved] > 0.8).all() and (~moved).sum() <= (~seen).sum() + 32


def test_the_seen_part_correlates_like_the_whole_whatever_is_in_the_hidden_part():
    rng = np.random.default_rng(0)
    whole, seen = normalized(rng.normal(size=(8, 40)).astype(np.float32)), np.ones((8, 40), bool)
    seen[:, :10] = False
    changed = whole + ~seen * rng.normal(size=whole.shape).astype(np.float32)
    (score,), (shift,) = correlate(correlated_part(changed, seen), spectrum(whole)[None], 40)
    assert score == pytest.approx(1.0, abs=0.1) and abs(wrap_angle(shift * np.pi / 20)) < 0.01
    assert_allclose(columns_of(masked(spectrum(changed), seen), 40), whole * seen, atol=1e-5)


def test_a_missing_part_is_filled_in_from_those_that_saw_it_and_is_0_where_nobody_did():
    rng = np.random.default_rng(1)
    places = rng.uniform(-1, 1, (60, 2))
    base, slopes = rng.normal(size=(6, 20)), 0.1 * rng.normal(size=(2, 6, 20))
    textures = (base + np.tensordot(places, slopes, 1)).astype(np.float32)
    seen = rng.random((60, 1, 20)).repeat(6, axis=1) < 0.7
    seen[:, :, 4] = False
    filled = columns_of(completed(spectrum(textures), seen, places), 20)
    assert_allclose(filled[seen], textures[seen], atol=1e-5)
    assert np.abs(filled[:, :, 4]).max() < 1e-5
    others = ~seen & (np.arange(20) != 4)
    assert np.abs(filled - textures)[others].mean() < 0.1 * np.abs(textures)[others].mean()


def test_a_keyframe_that_is_left_out_does_not_see_what_others_filled_in():
    keyframes = learnt(sees_all=False)
    row, among = 60, np.arange(len(keyframes.poses)) != 60
    before = fit_among(keyframes, row, among)
    values = keyframes.values.copy()
    noisy = columns_of(keyframes.spectrum(row), keyframes.columns)
    noisy = noisy + ~keyframes.seen * np.random.default_rng(0).normal(0, 0.02, noisy.shape)
    aligned = turned(spectrum(noisy.astype(np.float32)), keyframes.sign * keyframes.poses[row, 2])
    parts = np.ascontiguousarray(aligned.T).view(np.float32) / keyframes.step
    values[row] = np.rint(parts).clip(-127, 127)
    after = fit_among(replace(keyframes, values=values), row, among)
    assert_allclose(after.place, before.place, atol=0.01)
    assert after.yaw == pytest.approx(before.yaw, abs=0.01)


def test_a_model_does_without_what_stays_the_same_while_the_robot_turns():
    """Then images are located whatever hides that part."""
    run = run_in(Spheres.about(1), wander(400, 2, hz=4.0), recipe().panorama)
    images, body = run.panoramas.read(0, 400), slice(28, 46)
    images[:, :, body] = np.random.default_rng(4).integers(0, 256, (12, 18, 3))
    model = learn_place(place().model.network, [run], recipe()).model
    hidden = (model.repeated != np.arange(12 * 72).reshape(12, 72)).all(axis=0)
    assert hidden[body].all() and hidden.sum() <= 18 + 4
    seen, poses = np.concatenate([*visit().panoramas.batches(64)]), visit().odometry.poses
    seen[:, :, body] = 90
    places = np.array([observation.pose for observation in model.locate_all(seen)])
    assert distances(places, poses).mean() < 0.05


@pytest.mark.parametrize('clockwise', [True, False])
def test_parts_of_the_robot_of_any_height_are_told_from_what_is_around(clockwise):
    """A hood with a mast on it, and a cabin beside it; each with a column more on both sides."""
    rng = np.random.default_rng(3)
    textures = rng.integers(-100, 100, (400, 16, 80)).astype(np.int8)
    fixed = np.zeros((16, 80), bool)
    fixed[8:, 30:54] = fixed[:, 40:44] = fixed[:, 54:60] = True
    textures[:, fixed] = rng.integers(-100, 100, fixed.sum())
    robot = robot_in_view(textures, rng.uniform(-np.pi, np.pi, 400))
    for columns, row in ((slice(29, 39), 8), (slice(39, 45), 0), (slice(53, 61), 0)):
        assert robot[row:, columns].all() and not robot[:row, columns].any()
    assert not robot[:, :29].any() and not robot[:, 61:].any()
    sphere = replace(CONFIG, clockwise=clockwise).sphere
    (text,) = sentences(robot, sphere)
    assert text.startswith('the lower 72% of the view from 266 to 50 degrees') == clockwise
    assert sentences(robot & False, sphere) == []
    assert seen_mask(robot, (48, 240)).sum() == 9 * (~robot).sum()
