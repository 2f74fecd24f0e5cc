# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The noise of the odometry's turns, found while the map is learned; and maps of one route."""

import dataclasses
import logging
import warnings

import numpy as np
import pytest
from cylinder_worlds import PLACE_ARCHITECTURE, Spheres, recipe, run_in, wander

from sfa_localization import training
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import Odometry, integrate
from sfa_localization.features.closures import Closures
from sfa_localization.features.network_training import ImageSequence, train_network
from sfa_localization.fusion.camera_clock import CameraClock
from sfa_localization.metric.drive_check import ROUTE
from sfa_localization.metric.odometry_noise import against_images, expected_noise, turn_noise
from sfa_localization.metric.settings import SegmentConfig
from sfa_localization.training import learn_place


def walk(noise, heading_std, count=3000, step_s=0.2, seed=0):
    """Times, and the differences of a heading without drift and one with white turn noise."""
    rng = np.random.default_rng(seed)
    drift = np.cumsum(noise * np.sqrt(step_s) * rng.standard_normal(count))
    return np.arange(count) * step_s, drift + heading_std * rng.standard_normal(count)


@pytest.mark.parametrize('noise', [0.005, 0.02, 0.08])
def test_the_noise_of_turns_is_found_below_that_of_the_headings(noise):
    times, residuals = walk(noise, heading_std=0.02)
    found = turn_noise(times, wrap_angle(residuals), np.zeros(len(times), int))
    assert found == pytest.approx(noise, rel=0.35)


def test_wrong_headings_and_borders_between_drives_do_not_count():
    times, residuals = walk(0.02, 0.01)
    chains = (np.arange(len(times)) // 1000).astype(int)
    residuals[::15] += 2.0
    residuals += chains * 1.0
    assert turn_noise(times, residuals, chains) == pytest.approx(0.02, rel=0.35)


def test_a_drive_too_short_shows_no_noise():
    times, residuals = walk(0.02, 0.01, count=20)
    assert turn_noise(times, residuals, np.zeros(20, int)) is None


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_headings_of_the_images_bound_the_noise_whichever_way_columns_grow(sign):
    rng, count = np.random.default_rng(3), 3000
    stamps = 10**9 + np.arange(count) * 100_000_000
    twists = np.column_stack([np.full(count, 0.5), 0.4 * np.sin(np.arange(count) / 30)])
    seen = sign * integrate(stamps, twists)[:, 2]
    noisy = twists + np.column_stack([0 * seen, 0.03 / np.sqrt(0.1) * rng.standard_normal(count)])
    odometry = Odometry(stamps, integrate(stamps, noisy), noisy, np.zeros((count, 2)))
    found = against_images(odometry, None, stamps, seen.tolist(), SegmentConfig())
    assert found == pytest.approx(0.03, rel=0.35)


def slipping(noise):
    """The wandering drive of `cylinder_worlds.place`, with noisy turns that state no variance."""
    true = wander(400, 2, hz=4.0)
    rng = np.random.default_rng(7)
    twists = true.twists.copy()
    twists[:, 1] += noise / np.sqrt(0.25) * rng.standard_normal(len(twists))
    poses = integrate(true.stamps_ns, twists)
    run = run_in(Spheres.about(1), true, recipe().panorama)
    return dataclasses.replace(
        run, odometry=Odometry(true.stamps_ns, poses, twists, np.zeros((len(twists), 2)))
    )


@pytest.mark.parametrize(('given', 'calls'), [(0.003, 2), (0.004, 1)])
def test_where_no_map_can_be_learned_the_images_bound_the_noise(monkeypatch, given, calls):
    """Unless the user gave one."""
    run, config = (
        slipping(0.3),
        dataclasses.replace(recipe(), segments=SegmentConfig(yaw_noise=given)),
    )
    noises = []

    def fail(images, segments, *rest):
        noises.append(expected_noise(segments))
        raise DataError('directions are uncertain')

    monkeypatch.setattr(training, '_map_and_compass', fail)
    monkeypatch.setattr(training, 'against_images', lambda *a: 0.05)
    with pytest.raises(DataError, match='uncertain'):
        training._learn_map(
            None, Closures.none(), [run], [CameraClock()], [[]], config, None, progress=False
        )
    assert len(noises) == calls
    assert calls == 1 or noises[1] > 3 * noises[0]


def straight_route(speed):
    """A drive straight ahead of 12 m at 4 Hz and less, whose odometry states no variance."""
    count = 400
    stamps = 10**9 + np.arange(count) * round(12e9 / speed / count)
    twists = np.tile([speed, 0.0], (count, 1))
    poses = integrate(stamps, twists, np.array([-6.0, 0.0, 0.0]))
    odometry = Odometry(stamps, poses, twists, np.zeros((count, 2)))
    return run_in(Spheres.about(1), odometry, recipe().panorama)


@pytest.mark.slow
@pytest.mark.parametrize('speed', [0.03, 0.12])
def test_one_straight_route_gives_a_model_and_one_sentence(speed, caplog):
    run = straight_route(speed)
    network = train_network(PLACE_ARCHITECTURE, [ImageSequence.of(run)])
    with warnings.catch_warnings(), caplog.at_level(logging.WARNING):
        warnings.simplefilter('error')
        trained = learn_place(network, [run], recipe())
    assert [record.message for record in caplog.records].count(ROUTE) == 1
    assert trained.segments.images.skipped == {}
    aside = np.array([[x, 1.5, 0.0] for x in (-2.0, 0.0, 2.0)])
    on = trained.model.locate_all(run.panoramas.read(150, 250))
    off = trained.model.locate_all(Spheres.about(1).panoramas(aside, recipe().panorama))
    places = np.array([one.position for one in on])
    assert np.hypot(*(places - run.odometry.poses[150:250, :2]).T).mean() < 0.1
    surest, least = (
        pick(np.trace(one.covariance[:2, :2]) for one in part)
        for pick, part in ((max, on), (min, off))
    )
    assert least > 10 * surest
    with pytest.raises(DataError, match='no track crosses another'):
        learn_place(network, [run], recipe(), strict=True)
