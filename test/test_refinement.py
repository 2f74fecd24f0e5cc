# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Properties of the second, finer map: turning, recovery, honesty."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import metric_worlds as worlds
import numpy as np
import pytest
from scipy.stats import chi2

from sfa_localization.data.errors import DataError
from sfa_localization.features.image_features import spectrum
from sfa_localization.metric import learning, selection
from sfa_localization.metric.learning import MetricResult
from sfa_localization.metric.refinement import (
    LearnedRefinement,
    Projection,
    learn_refinement,
    turned_back,
)
from sfa_localization.metric.segments import Segments, cut
from sfa_localization.metric.settings import MetricConfig, SegmentConfig

COLUMNS, CHANNELS, ORDERS = 24, 6, 5
COARSE_NOISE = 0.25
HALF = (4.0, 4.5)
"""Half of the driven area, m; the robot starts somewhere in it, at the world's origin."""
CONFIG = MetricConfig(slow_features=8)


def maps_at(poses, sign=-1.0, noise=0.02, seed=0):
    """Maps (T, 2, COLUMNS, CHANNELS) whose first ORDERS harmonics are functions of the place."""
    rng = np.random.default_rng(5)
    shape = (2, CHANNELS, ORDERS)
    waves, phases = rng.normal(0, 0.22, (*shape, 2)), rng.uniform(0, 2 * np.pi, shape)
    lags = rng.uniform(0, 2 * np.pi, shape)
    size = np.cos(np.einsum('rckd,td->trck', waves, poses[:, :2]) + phases)
    bearing = 2 * np.pi * np.arange(COLUMNS) / COLUMNS + sign * poses[:, 2:]
    angle = np.arange(ORDERS) * bearing[:, None, :, None, None] + lags[:, None]
    maps = np.einsum('trck,trnck->trnc', size, np.cos(angle))
    maps += noise * np.random.default_rng(seed).standard_normal(maps.shape)
    return maps.astype(np.float32)


@dataclass
class World:
    """A drive, the coarse map learnt from noisy slow features, and the refinement."""

    segments: Segments
    coarse: MetricResult
    spectra: np.ndarray
    views: np.ndarray
    fitted: LearnedRefinement


@cache
def world() -> World:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(selection, 'INDUCING_POINTS', 150)
        return learned_world()


def learned_world() -> World:
    # The robot starts at the world's origin, so that the map frame is the world's.
    twists, start = worlds.criss_cross(12, half=HALF, seed=1, shortest=4.0)
    drive = worlds.drive(twists, yaw_noise=0.01, seed=2)
    assert start[2] == 0.0
    segments = cut(drive.odometry, drive.stamps_ns, SegmentConfig())
    slow = worlds.garden_features(drive.poses[:, :2], noise=COARSE_NOISE, seed=3)
    coarse = learning.learn_metric(slow, segments, CONFIG)
    spectra = spectrum(maps_at(drive.poses))
    views = np.ones(len(spectra))
    return World(segments, coarse, spectra, views, fitted_of(segments, coarse, spectra, views))


def fitted_of(segments, coarse, spectra, views) -> LearnedRefinement:
    return learn_refinement(spectra, views, segments, coarse, -1.0)


def unseen(count=200, seed=4):
    """Poses (count, 3) inside the driven area."""
    start = np.array(worlds.criss_cross(1, half=HALF, seed=1, shortest=4.0)[1])
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (count, 3)) * [2.5, 2.8, np.pi] - start


def estimates(poses, yaw_error=0.0, yaw_variance=1e-4, coarse=None):
    """Coarse and refined estimates of unseen images."""
    ours = world()
    slow = worlds.garden_features(poses[:, :2], noise=COARSE_NOISE, seed=6)
    first = ours.coarse.map.predict(slow) if coarse is None else coarse
    count = len(poses)
    refined = ours.fitted.refinement.refine(
        spectrum(maps_at(poses, seed=7)),
        poses[:, 2] + yaw_error,
        np.full(count, yaw_variance),
        np.ones(count),
        first,
    )
    return first, refined


def agreeing(poses, yaw_variance=1e-4):
    """The same with unsure coarse estimates that lie where the finer map puts the images."""
    spectra = spectrum(maps_at(poses, seed=7))
    places, _ = world().fitted.refinement.predict(spectra, poses[:, 2], np.ones(len(poses)))
    coarse = places, np.tile(0.3**2 * np.eye(2), (len(poses), 1, 1))
    return estimates(poses, yaw_variance=yaw_variance, coarse=coarse)


def mean_error(places, poses):
    return float(np.hypot(*(places - poses[:, :2]).T).mean())


def share_inside(estimate, places):
    """Share of true places inside the 95 % ellipses."""
    apart = estimate[0] - places
    squared = np.einsum('ti,tij,tj->t', apart, np.linalg.inv(estimate[1]), apart)
    return float((squared < chi2.ppf(0.95, 2)).mean())


@pytest.mark.parametrize('sign', [-1.0, 1.0])
@pytest.mark.parametrize('steps', [0, 1, 7, -3])
def test_a_roll_of_the_columns_is_a_turn_of_the_robot(sign, steps):
    maps = np.random.default_rng(0).standard_normal((3, 2, COLUMNS, 4)).astype(np.float32)
    yaw = np.full(3, -sign * 2 * np.pi * steps / COLUMNS)
    rolled = turned_back(spectrum(np.roll(maps, steps, axis=2)), yaw, sign)
    np.testing.assert_allclose(rolled, turned_back(spectrum(maps), np.zeros(3), sign), atol=2e-6)


@pytest.mark.parametrize('sign', [-1.0, 1.0])
def test_features_do_not_depend_on_the_heading_between_columns(sign):
    poses = unseen(20)
    turned = replace_yaw(poses, np.random.default_rng(1).uniform(-9, 9, 20))
    features = [
        turned_back(spectrum(maps_at(p, sign, noise=0.0)), p[:, 2], sign) for p in (poses, turned)
    ]
    np.testing.assert_allclose(*features, atol=2e-5)
    assert np.abs(features[0]).max() > 0.5


def replace_yaw(poses, yaw):
    return np.column_stack([poses[:, :2], yaw])


def test_principal_components_hold_what_the_vectors_span():
    rng = np.random.default_rng(3)
    spanned = rng.standard_normal((300, 4)) @ rng.standard_normal((4, 60))
    vectors = (spanned + 1.0).astype(np.float32)
    projection = Projection.fit(vectors)
    features = projection.features(vectors)
    assert features.shape == (300, 4)
    np.testing.assert_allclose(projection.axes.T @ projection.axes, np.eye(4), atol=1e-4)
    assert np.all(np.diff(features.var(0)) < 0)
    np.testing.assert_allclose(features @ projection.axes.T + projection.mean, vectors, atol=1e-3)


def test_maps_that_never_change_cannot_refine():
    with pytest.raises(DataError, match='equal'):
        Projection.fit(np.ones((50, 8), np.float32))


def test_unseen_places_are_found_better_than_by_the_slow_features():
    poses = unseen()
    coarse, refined = estimates(poses)
    assert mean_error(refined[0], poses) < 0.5 * mean_error(coarse[0], poses)
    assert mean_error(refined[0], poses) < 0.15
    assert share_inside(refined, poses[:, :2]) >= 0.85


def test_two_estimates_that_differ_inflate_the_covariance():
    poses = unseen(40)
    _, (places, agreed) = agreeing(poses)
    away = places + np.array([2.0, 0.0])
    _, (kept, inflated) = estimates(poses, coarse=(away, np.tile(0.3**2 * np.eye(2), (40, 1, 1))))
    np.testing.assert_allclose(kept, places)
    assert np.all(inflated[:, 0, 0] > 5 * agreed[:, 0, 0])
    np.testing.assert_allclose(inflated[:, 1, 1], agreed[:, 1, 1])
    assert share_inside((kept, inflated), away) == 1.0


@pytest.mark.parametrize('yaw_error, yaw_variance', [(np.nan, 1e-4), (0.0, np.pi**2 / 3)])
def test_without_a_heading_the_coarse_estimate_stays(yaw_error, yaw_variance):
    coarse, refined = estimates(unseen(20), yaw_error=yaw_error, yaw_variance=yaw_variance)
    for kept, first in zip(refined, coarse, strict=True):
        np.testing.assert_array_equal(kept, first)
