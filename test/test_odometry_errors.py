# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of wheels that images show: in turns, by loop closures, and of the way lost in turns."""

import dataclasses

import numpy as np
import pytest
from cylinder_worlds import SMALL_RECIPE, Spheres, recipe, run_in, wander
from metric_worlds import drive, meander

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.geometry import align, wrap_angle
from sfa_localization.data.rig import Rig
from sfa_localization.data.run import Odometry, integrate
from sfa_localization.keyframes.closures import Closures
from sfa_localization.metric.dead_reckoning import TURN_SLIDE, OdometryTrack, Way
from sfa_localization.metric.odometry_errors import (
    CLOSURES_MIN,
    LARGEST_LOSS,
    PAIRS_MIN,
    Headings,
    corrections,
    way_of,
)
from sfa_localization.metric.settings import SegmentConfig
from sfa_localization.reports.summary import summary
from sfa_localization.sfa.network_training import ImageSequence, train_network
from sfa_localization.training import learn_place
from sfa_localization.training_input import TrainingInput

CONFIG = SegmentConfig()


def headings_of(runs, noise: float, sign: float = 1.0) -> list[Headings]:
    """Of images whose shifts have this white noise, rad per square root of s."""
    headings = []
    for seed, run in enumerate(runs):
        steps = np.diff(run.stamps_ns, prepend=run.stamps_ns[0]) * 1e-9
        white = np.random.default_rng(seed).standard_normal(len(steps))
        yaw = run.poses[:, 2] + np.cumsum(noise * np.sqrt(steps) * white)
        track = OdometryTrack.of(run.odometry, CONFIG)
        headings.append(Headings.of(track, run.stamps_ns, (sign * wrap_angle(yaw)).tolist()))
    return headings


def closures_of(runs, count: int) -> Closures:
    """Pairs of images of each run with their true turns."""
    rng, start, pairs, turns = np.random.default_rng(0), 0, [], []
    for run in runs:
        rows = rng.integers(0, len(run.poses), (count, 2))
        pairs.append(rows + start)
        turns.append(wrap_angle(np.diff(run.poses[rows, 2])[:, 0]))
        start += len(run.poses)
    return Closures(np.concatenate(pairs), np.concatenate(turns))


def drives(yaw_noise: float):
    """Two drives of 200 s whose odometry turns with this white noise, rad per square root of s."""
    per_step = yaw_noise * np.sqrt(50.0)
    return [drive(meander(200.0, seed=k)[0], yaw_noise=per_step, seed=k) for k in (3, 4)]


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_images_that_turn_better_correct_the_odometry(sign):
    """By closures, one of ten of which is wrong."""
    runs = drives(0.04)
    closures = closures_of(runs, 200)
    wrong = closures.turn + 1.5 * (np.arange(400) % 10 == 0)
    closures = dataclasses.replace(closures, turn=wrong)
    yaws, noise = corrections(headings_of(runs, 0.004, sign), closures)
    assert 0.002 < noise < 0.006
    for run, yaw in zip(runs, yaws, strict=True):
        before = OdometryTrack.of(run.odometry, CONFIG)
        after = before.corrected(run.stamps_ns, yaw, noise)
        at = np.searchsorted(after.stamps_ns, run.stamps_ns)
        (turned, missed), (turned_before, missed_before) = (
            (
                np.std(track.yaw[at] - np.unwrap(run.poses[:, 2])),
                np.hypot(*(track.poses[at, :2] - run.poses[:, :2]).T).mean(),
            )
            for track in (after, before)
        )
        assert turned < 0.25 * turned_before and missed < 0.5 * missed_before


def test_nothing_is_corrected_without_evidence_that_images_turn_better():
    good, bad = drives(0.005), drives(0.04)
    assert corrections(headings_of(good, 0.004), closures_of(good, 200)) is None
    assert corrections(headings_of(good, 0.04), closures_of(good, 200)) is None
    few = closures_of(bad, CLOSURES_MIN // 2 - 1)
    rng, first = np.random.default_rng(0), len(bad[0].poses)
    pairs = np.column_stack([rng.integers(0, first, 200), first + rng.integers(0, 500, 200)])
    for closures in (few, Closures(pairs, rng.uniform(-3, 3, 200))):
        assert corrections(headings_of(bad, 0.004), closures) is None


def test_a_training_turns_by_its_images_where_wheels_slip():
    """Columns grow counterclockwise; up to the segments, with and without loop closures."""
    panorama = PanoramaConfig(width=120, height=24, clockwise=False)
    config = dataclasses.replace(recipe(False), panorama=panorama)
    true = wander(400, 2, hz=4.0)
    run = run_in(Spheres.about(1), true, panorama)
    twists = true.twists.copy()
    twists[:, 1] += 0.1 * np.random.default_rng(0).standard_normal(len(twists))
    poses = integrate(true.stamps_ns, twists, true.poses[0])
    given = TrainingInput.of([run], config).drives
    assert [track.slide for track in given.tracks()] == [TURN_SLIDE]
    bad = dataclasses.replace(run, odometry=dataclasses.replace(true, twists=twists, poses=poses))
    items = (dataclasses.replace(given.items[0], run=bad),)
    errors = []
    for closures in (Closures.none(), given.closures):
        segments = dataclasses.replace(given, items=items, closures=closures).cut()
        turned = np.array([s.start[2] - true.poses[s.images[0], 2] for s in segments])
        errors.append(np.abs(wrap_angle(turned - turned[0])).mean())
    assert errors[1] < 0.5 * errors[0]


def losing(true: Odometry, loss: float) -> Odometry:
    """Odometry that counts more way in turns than was driven."""
    twists = true.twists + np.column_stack([loss * np.abs(true.twists[:, 1]), 0 * true.stamps_ns])
    return dataclasses.replace(true, twists=twists, poses=integrate(true.stamps_ns, twists))


def way(loss, before=None, map_scale=1.0, seconds=300.0, v=0.3):
    """The way by images of a turned map, of a robot that curves about and loses way in turns."""
    t = np.arange(0.0, seconds, 0.05)
    omega = 0.5 * np.sin(0.3 * t) * (np.sin(0.11 * t) > 0)
    stamps, twists = 10**9 + np.round(t * 1e9).astype(int), np.column_stack([0 * t + v, omega])
    true = Odometry(stamps, integrate(stamps, twists), twists, np.zeros_like(twists))
    x, y, yaw = true.poses[::4].T
    noise = np.random.default_rng(0).standard_normal((2, len(x)))
    places = map_scale * ((x + 1j * y) * np.exp(0.7j) + 0.03 * (noise[0] + 1j * noise[1]))
    poses = np.column_stack([places.real, places.imag, yaw + 0.7])
    track = OdometryTrack.of(losing(true, loss), SegmentConfig())
    return way_of(track, stamps[::4], poses, before)


@pytest.mark.parametrize('loss', [0.08, 0.25, -0.1])
def test_images_show_the_loss_forward_and_backward(loss):
    for v in (0.3, -0.3):
        assert way(np.sign(v) * loss, v=v)[:2] == pytest.approx((1.0, loss), abs=0.02)


def test_a_map_that_grew_or_shrank_shows_another_loss_but_no_other_scale():
    before = Way(1.0, 0.1)
    for map_scale in (0.95, 1.0, 1.05):
        by_map = way(0.15, before, map_scale)
        assert by_map.loss / by_map.scale == pytest.approx(0.15, abs=0.02)
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
    run = dataclasses.replace(run, odometry=losing(true, 0.15))
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
    assert np.hypot(*(placed - truth).T).mean() < 0.02
