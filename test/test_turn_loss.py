# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Wheels that lose way in turns: what images show of it, and what training makes of that."""

import dataclasses

import numpy as np
import pytest
from cylinder_worlds import Spheres, place, recipe, run_in, wander

from sfa_localization.data.geometry import align
from sfa_localization.data.run import Odometry, integrate
from sfa_localization.metric.dead_reckoning import OdometryTrack, Way
from sfa_localization.metric.odometry_errors import LARGEST_LOSS, PAIRS_MIN, way_of
from sfa_localization.metric.settings import SegmentConfig
from sfa_localization.reports.summary import summary
from sfa_localization.training import learn_place


def losing(loss, seconds=300.0, hz=20.0, v=0.3):
    """Poses of a robot that curves about, and odometry that counts way which turns take."""
    count = round(seconds * hz)
    stamps = 10**9 + np.arange(count) * round(1e9 / hz)
    t = np.arange(count) / hz
    omega = 0.5 * np.sin(0.3 * t) * (np.sin(0.11 * t) > 0)
    true = np.column_stack([np.full(count, v), omega])
    read = true + np.column_stack([loss * np.abs(omega), 0 * omega])
    odometry = Odometry(stamps, integrate(stamps, read), read, np.zeros((count, 2)))
    return integrate(stamps, true), odometry


def shown(poses, every, std=0.03, turn=0.7):
    """Images of a map that is turned, with errors."""
    rng = np.random.default_rng(0)
    chosen = poses[::every]
    places = (chosen[:, 0] + 1j * chosen[:, 1]) * np.exp(1j * turn)
    places = places + std * (
        rng.standard_normal(len(chosen)) + 1j * rng.standard_normal(len(chosen))
    )
    return places, chosen[:, 2] + turn


def found(loss, every=4, before=None, larger=1.0, **how):
    poses, odometry = losing(loss, **how)
    places, yaw = shown(poses, every)
    places = larger * places
    track = OdometryTrack.of(odometry, SegmentConfig(), None)
    poses = np.column_stack([places.real, places.imag, yaw])
    return track, way_of(track, odometry.stamps_ns[::every], poses, before)


@pytest.mark.parametrize('v', [0.3, -0.3])
def test_the_loss_is_found_forward_and_backward(v):
    for loss in (0.08, 0.15, 0.25, -0.1):
        _, way = found(np.sign(v) * loss, v=v)
        assert way.loss == pytest.approx(loss, abs=0.02)
        assert way.scale == pytest.approx(1.0, abs=0.02)


def test_a_map_that_grew_or_shrank_shows_another_loss_but_no_other_scale():
    for larger in (0.95, 1.0, 1.05):
        _, way = found(0.15, larger=larger, before=Way(1.0, 0.1))
        assert way.loss / way.scale == pytest.approx(0.15, abs=0.02)
        # A smaller loss with the same scale as the larger one with more way.
        assert 1.0 < way.scale == pytest.approx(found(0.15, before=Way(1.0, 0.1))[1].scale)


def test_where_images_show_none_nothing_is_corrected():
    assert found(0.0)[1] is None
    assert found(1.5 * LARGEST_LOSS)[1] is None  # no wheel loses so much
    assert found(0.1, seconds=0.9 * PAIRS_MIN)[1] is None  # 0.3 m each


def errors(loss):
    """Mean error (m) of a map of images, with odometry that loses way; and the training."""
    config, true = recipe(), wander(400, 2, hz=4.0)
    run = run_in(Spheres.about(1), true, config.panorama)
    read = true.twists + np.column_stack(
        [loss * np.abs(true.twists[:, 1]), np.zeros(len(true.twists))]
    )
    odometry = Odometry(true.stamps_ns, integrate(true.stamps_ns, read), read, np.zeros((400, 2)))
    run = dataclasses.replace(run, odometry=odometry)
    # The same images, and so the same network.
    trained = learn_place(place().model.network, [run], config) if loss else place()
    estimates = trained.model.locate_all(run.panoramas.read(0, len(run.panoramas)))
    places, truth = np.array([one.position for one in estimates]), true.poses[:, :2]
    placed = align(places, truth).apply(places)
    # The scale of odometry that loses way on average is nobody's to know.
    scale = (placed - truth.mean(0)).std() / (truth - truth.mean(0)).std()
    placed = truth.mean(0) + (placed - truth.mean(0)) / scale
    return np.hypot(*(placed - truth).T).mean(), trained


@pytest.mark.slow
def test_wheels_that_lose_way_in_turns_give_nearly_as_good_a_map(monkeypatch):
    exact, plain = errors(0.0)
    lost, trained = errors(0.15)
    assert plain.model.rig.turn_loss.value == 0.0
    assert trained.model.rig.turn_loss.value == pytest.approx(0.15, abs=0.06)
    assert trained.model.rig.turn_loss.std < plain.model.rig.turn_loss.std
    assert 'm per radian in turns: taken into account' in summary(trained)
    monkeypatch.setattr('sfa_localization.metric.drives.way_of', lambda *_: None)
    bent, _ = errors(0.15)
    assert lost < exact + 0.5 * (bent - exact)
