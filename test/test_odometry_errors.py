# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of the way of wheels that images show: a loss in turns, and an offset of the speed."""

from dataclasses import replace

import numpy as np
import pytest
from cylinder_worlds import SMALL_RECIPE, Spheres, run_in, wander
from places import distances

from sfa_localization.data.geometry import align
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.data.run import Odometry, integrate
from sfa_localization.motion.dead_reckoning import OdometryTrack, Way
from sfa_localization.motion.odometry_errors import (
    LARGEST_LOSS,
    PAIRS_MIN,
    way_of,
)
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.reports.summary import summary
from sfa_localization.sfa.network_training import ImageSequence, train_network
from sfa_localization.training import learn_place


def losing(true, loss, offset=0.0):
    """Odometry that counts more way in turns than was driven, and less speed."""
    v = loss * np.abs(true.twists[:, 1]) - offset
    twists = true.twists + np.column_stack([v, 0 * v])
    return replace(true, twists=twists, poses=integrate(true.stamps_ns, twists))


def way(loss, before=None, map_scale=1.0, seconds=300.0, v=0.3, offset=0.0):
    """The way by images of a turned map, of a robot that curves about and loses way in turns."""
    t = np.arange(0.0, seconds, 0.05)
    omega = 0.5 * np.sin(0.3 * t) * (np.sin(0.11 * t) > 0)
    v = v * (1 + 0.5 * np.sin(0.05 * t) * (offset != 0))  # one speed hides an offset
    stamps, twists = 10**9 + np.round(t * 1e9).astype(int), np.column_stack([0 * t + v, omega])
    true = Odometry(stamps, integrate(stamps, twists), twists, np.zeros_like(twists))
    x, y, yaw = true.poses[::4].T
    noise = np.random.default_rng(0).standard_normal((2, len(x)))
    places = map_scale * ((x + 1j * y) * np.exp(0.7j) + 0.03 * (noise[0] + 1j * noise[1]))
    poses = np.column_stack([places.real, places.imag, yaw + 0.7])
    track = OdometryTrack.of(losing(true, loss, offset), SegmentConfig())
    return way_of(track, stamps[::4], poses, before)


@pytest.mark.parametrize('loss', [0.08, 0.25, -0.1])
def test_images_show_the_loss_forward_and_backward(loss):
    for v in (0.3, -0.3):
        by_images = way(np.sign(v) * loss, v=v)
        assert by_images.values == pytest.approx([1.0, loss, 0.0], abs=0.02)


def test_images_show_an_offset_of_the_speed():
    """Also of wheels that count backwards while the robot stands."""
    by_images = way(0.08, offset=0.06, seconds=1500.0)
    assert by_images.values == pytest.approx([1.0, 0.08, 0.06], abs=0.02)
    stamps = 10**9 + np.arange(0, 10**10, 10**8)
    twists = np.tile([-0.06, 0.0], (100, 1))
    standing = Odometry(stamps, integrate(stamps, twists), twists, np.zeros_like(twists))
    track = OdometryTrack.of(standing, SegmentConfig())
    corrected = track.driven(Way(1.0, offset=Quantity(0.06, 0.001)))
    assert track.length[-1] == pytest.approx(0.594) and corrected.length[-1] < 1e-9


def test_a_map_that_grew_or_shrank_shows_another_loss_but_no_other_scale():
    before = Way(1.0, Quantity(0.1, 0.01))
    for map_scale in (0.95, 1.0, 1.05):
        by_map = way(0.15, before, map_scale)
        assert by_map.loss.value / by_map.scale == pytest.approx(0.15, abs=0.02)
        # A smaller loss with the same scale as the larger one with more way.
        assert 1.0 < by_map.scale == pytest.approx(way(0.15, before).scale)


def test_where_images_show_no_loss_nothing_is_corrected():
    assert way(0.0) is None
    assert way(1.5 * LARGEST_LOSS) is None  # no wheel loses so much
    assert way(0.1, seconds=0.9 * PAIRS_MIN) is None  # 0.3 m each


@pytest.mark.slow
def test_wheels_that_lose_way_in_turns_give_nearly_as_good_a_map():
    """With the loss uncorrected the map errs by 0.030 m."""
    true, panorama = wander(400, 2, hz=4.0), SMALL_RECIPE.panorama
    run = run_in(Spheres.about(1), true, panorama)
    network = train_network(SMALL_RECIPE.architecture, [ImageSequence.of(run)])
    run = replace(run, odometry=losing(true, 0.15))
    trained = learn_place(network, [run], SMALL_RECIPE)
    loss = trained.model.rig.turn_loss
    assert loss.value == pytest.approx(0.15, abs=0.06) and loss.std < Rig().turn_loss.std
    assert 'm per radian in turns: taken into account' in summary(trained)
    images = run.panoramas.read(0, len(run.panoramas))
    places = np.array([each.position for each in trained.model.locate_all(images)])
    truth = true.poses[:, :2]
    placed, center = align(places, truth).apply(places), truth.mean(0)
    # Odometry that loses way does not show the scale.
    placed = center + (placed - center) * (truth - center).std() / (placed - center).std()
    assert distances(placed, truth).mean() < 0.02
