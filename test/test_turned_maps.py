# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Turned maps: what they do not depend on, what a map of them finds, and how sure it is."""

from __future__ import annotations

from functools import cache

import metric_worlds as worlds
import numpy as np
import pytest
from numpy.testing import assert_allclose
from places import distances
from scipy.stats import chi2

from sfa_localization.data.errors import DataError
from sfa_localization.mapping import learning, selection
from sfa_localization.mapping.learning import learn_turned
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.mapping.turned_maps import TurnedMaps, turned_back
from sfa_localization.sfa.image_features import spectrum

COLUMNS, CHANNELS, ORDERS = 24, 6, 5
NOISE = 0.25
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


@cache
def world():
    """The map of noisy slow features of a drive, and that of its turned maps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(selection, 'INDUCING_POINTS', 150)
        # The robot starts at the world's origin, so that the map frame is the world's.
        twists, start = worlds.criss_cross(12, half=HALF, seed=1, shortest=4.0)
        drive = worlds.drive(twists, yaw_noise=0.01, seed=2)
        assert start[2] == 0.0
        segments = drive.segments()
        slow = worlds.garden_features(drive.poses[:, :2], noise=NOISE, seed=3)
        first = learning.learn_metric(slow, segments, CONFIG)
        return first, *learn_turned(spectrum(maps_at(drive.poses)), segments, first, -1.0)


def unseen(count=200, seed=4):
    """Poses (count, 3) inside the driven area."""
    start = np.array(worlds.criss_cross(1, half=HALF, seed=1, shortest=4.0)[1])
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (count, 3)) * [2.5, 2.8, np.pi] - start


def located(poses, yaw_error=0.0, yaw_variance=1e-4):
    """Positions of unseen images by their turned maps, covariances, and what the yaw adds."""
    _, turned, result = world()
    given = poses[:, 2] + yaw_error, np.full(len(poses), yaw_variance)
    places, by_map, by_yaw = turned.predict(result.map, spectrum(maps_at(poses, seed=7)), *given)
    return places, by_map + by_yaw, by_yaw


def mean_error(places, poses):
    return float(distances(places, poses).mean())


def share_inside(estimate, places):
    """Share of true places inside the 95 % ellipses."""
    off = estimate[0] - places
    squared = np.einsum('ti,tij,tj->t', off, np.linalg.inv(estimate[1]), off)
    return float((squared < chi2.ppf(0.95, 2)).mean())


@pytest.mark.parametrize('sign', [-1.0, 1.0])
def test_features_do_not_depend_on_the_heading_between_columns(sign):
    poses = unseen(20)
    yaw = np.random.default_rng(1).uniform(-9, 9, 20)
    turned = np.column_stack([poses[:, :2], yaw])
    exact = (spectrum(maps_at(each, sign, noise=0.0)) for each in (poses, turned))
    features = [turned_back(next(exact), each[:, 2], sign) for each in (poses, turned)]
    assert_allclose(*features, atol=2e-5)
    assert np.abs(features[0]).max() > 0.5


def test_maps_that_are_all_equal_are_refused():
    with pytest.raises(DataError, match='equal'):
        TurnedMaps.fit(np.ones((50, 8, 1), np.complex64), np.zeros(50), 1.0)


def test_unseen_places_are_located_better_than_by_the_slow_features():
    poses = unseen()
    slow = worlds.garden_features(poses[:, :2], noise=NOISE, seed=6)
    first = world()[0].map.predict(slow)[0]
    estimate = located(poses)
    assert mean_error(estimate[0], poses) < 0.5 * mean_error(first, poses)
    assert mean_error(estimate[0], poses) < 0.15
    assert share_inside(estimate, poses[:, :2]) >= 0.85


def test_an_uncertain_heading_widens_the_covariance():
    """By how far the place moves with it."""
    poses, step = unseen(40), 0.02
    _, _, added = located(poses, yaw_variance=step**2)
    slope = (located(poses, step)[0] - located(poses, -step)[0]) / 2
    moved = np.einsum('ti,tj->tij', slope, slope)
    assert_allclose(added, moved, atol=0.2 * moved.max())
    off = located(poses, np.random.default_rng(2).uniform(-np.pi, np.pi, 40), np.pi**2 / 3)
    assert share_inside(off, poses[:, :2]) >= 0.65  # three headings do not show every place
