# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The forecast of a training against drives whose every place is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from metric_worlds import criss_cross, drive, garden_features, grid, lanes, meander
from places import distances, lengths
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import align, rotation
from sfa_localization.mapping import drive_check, selection
from sfa_localization.mapping.forecast import REACH_M
from sfa_localization.mapping.learning import learn_metric
from sfa_localization.mapping.selection import folds
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.metric.stack import Stack

CONFIG = MetricConfig(slow_features=12)
DRIVES = {
    'straight legs': criss_cross(30, half=(5.0, 5.0), seed=1, shortest=5.0),
    'wandering': meander(250.0, seed=3),
    'lanes along and across': (grid(10.0, 1.0, 9), (-5.0, -5.0, 0.0)),
}


@cache
def trained(name):
    """True poses at the images, segments, features and the map of a noisy drive."""
    run = drive(*DRIVES[name], bias=1.4e-3, yaw_noise=0.01, speed_noise=0.03, seed=5)
    segments = run.segments()
    features = garden_features(run.poses, noise=0.05)
    with pytest.MonkeyPatch.context() as patch:
        quick_and_tolerant(patch)
        return run.poses, segments, features, learn_metric(features, segments, CONFIG)


def quick_and_tolerant(patch):
    """Few inducing points, and directions as uncertain as they may be."""
    patch.setattr(selection, 'INDUCING_POINTS', 300)
    patch.setattr(drive_check, 'ANGLE_STD_MAX_DEG', 180.0)


def between(trained, count=1500):
    """Places (N, 2) drawn evenly in the middle of the trained ones, and near to any of them."""
    low, high = np.quantile(trained, [0.05, 0.95], axis=0)
    places = np.random.default_rng(6).uniform(low, high, (count, 2))
    near = [distances(trained, place).min() < REACH_M for place in places]
    return places[near]


def judged(name):
    """Forecast over true error of single images on paths between, and share in the ellipse."""
    poses, _, features, result = trained(name)
    images = result.images
    frame = align(result.map.predict(features[images])[0], poses[images, :2])
    places = between(poses[images, :2])
    predicted, covariances = result.map.predict(garden_features(places, noise=0.05, seed=9))
    off = (frame.apply(predicted) - places) @ rotation(frame.yaw_rad)
    squared = np.einsum('ni,nij,nj->n', off, np.linalg.inv(covariances), off)
    return result.forecast.expected_m / lengths(off).mean(), np.mean(squared < 5.991)


def test_forecasts_and_ellipses_are_right():
    ratios, shares = np.transpose([judged(name) for name in DRIVES])
    assert ratios.min() > 0.7 and ratios.max() < 1.5 and 0.8 < ratios.mean() < 1.25
    assert 0.91 < shares.mean() < 0.985


@pytest.mark.parametrize('name', DRIVES)
def test_at_no_place_more_error_is_expected_than_images_show_there(name):
    """A corner that was driven once is far from the rest when it is left out, and only then."""
    poses, _, features, result = trained(name)
    images, forecast = result.images, result.forecast
    frame = align(result.map.predict(features[images])[0], poses[images, :2])
    rng = np.random.default_rng(4)
    around = poses[images, :2] + rng.normal(0.0, 0.3, (5, len(images), 2))
    predicted, _ = result.map.predict(garden_features(around.reshape(-1, 2), noise=0.05, seed=9))
    errors = lengths(frame.apply(predicted) - around.reshape(-1, 2))
    near = cKDTree(around.reshape(-1, 2)).query_ball_point(poses[images, :2], REACH_M)
    true = np.array([errors[rows].mean() for rows in near])
    for share in (50, 95, 100):
        assert 0.5 < np.percentile(forecast.local, share) / np.percentile(true, share) < 2.0, share


def test_it_is_worst_where_the_images_mislead(monkeypatch):
    quick_and_tolerant(monkeypatch)
    poses, segments, features, _ = trained('straight legs')
    misled = poses[:, 0] > 2.5
    noise = 0.6 * np.random.default_rng(1).standard_normal(features.shape)
    result = learn_metric(features + np.where(misled, 1.0, 0.0)[:, None] * noise, segments, CONFIG)
    images, places = result.images, result.poses[:, :2]
    x, y, error = result.forecast.worst
    assert poses[images[distances(places, [x, y]).argmin()], 0] > 2.0
    assert error > 1.5 * result.forecast.expected_m


def test_a_map_of_weak_images_keeps_the_shape_of_its_odometry_and_says_how_weak():
    """Features that hold little of the place, and noise that neighboring images share."""
    run = drive(
        *criss_cross(8, half=(5.5, 5.5), seed=1, shortest=5.0),
        bias=1.4e-3,
        yaw_noise=0.1,
        speed_noise=0.03,
        seed=5,
    )
    truth, rng = run.poses[:, :2], np.random.default_rng(0)
    noises = gaussian_filter1d(rng.normal(size=(2, len(truth), 12)), 5, axis=1)
    first, again = garden_features(truth) + 2.0 * noises / noises.std()
    segments = run.segments()
    with pytest.MonkeyPatch.context() as patch:
        quick_and_tolerant(patch)
        result = learn_metric(first, segments, CONFIG)
    images, places = result.images, result.poses[:, :2]
    laid = align(places, truth[images])
    assert distances(laid.apply(places), truth[images]).mean() < 0.3
    off = laid.apply(result.map.predict(again[images])[0]) - truth[images]
    assert 0.5 < result.forecast.expected_m / lengths(off).mean() < 2.0
    assert result.explained < 0.6


@pytest.mark.parametrize('length_m', [0.1, 1e4])
def test_few_segments_are_never_held_out_all_at_once_and_a_single_segment_is_refused(
    length_m, monkeypatch
):
    run = drive(lanes(8.0, 1.0, 4))
    segments = run.segments()
    monkeypatch.setattr(selection, 'HELD_OUT_LENGTH_M', length_m)
    for many, number in ((2, 2), (3, 8), (5, 2)):
        monkeypatch.setattr(selection, 'HELD_OUT_FOLDS', number)
        few = Stack.of(replace(segments, items=segments.items[:many]))
        assert 2 <= len(np.unique(folds(few, 0))) <= number
    with pytest.raises(DataError, match='drive farther'):
        folds(Stack.of(replace(segments, items=segments.items[:1])), 0)
