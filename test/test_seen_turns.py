# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Turns of odometry and images together: loop closures say which of them is right."""

import dataclasses
import itertools

import numpy as np
import pytest
from cylinder_worlds import Spheres, recipe, run_in, wander
from metric_worlds import DriveWithTruth, drive, meander

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import integrate
from sfa_localization.keyframes.closures import Closures
from sfa_localization.metric.dead_reckoning import TURN_SLIDE, OdometryTrack, TurnCorrection
from sfa_localization.metric.odometry_errors import CLOSURES_MIN, Headings, corrections
from sfa_localization.metric.segments import cut_track
from sfa_localization.metric.settings import SegmentConfig
from sfa_localization.training_input import TrainingInput

CONFIG = SegmentConfig()


def walk(run: DriveWithTruth, noise: float, seed: int) -> np.ndarray:
    """Headings of a gyroscope of this white noise, rad per square root of s, wrapped."""
    steps = np.diff(run.stamps_ns, prepend=run.stamps_ns[0]) * 1e-9
    drift = np.cumsum(
        noise * np.sqrt(steps) * np.random.default_rng(seed).standard_normal(len(steps))
    )
    return wrap_angle(run.poses[:, 2] + drift)


def closures_of(runs: list[DriveWithTruth], count: int, seed: int = 0) -> Closures:
    """Pairs of images of each run with their true turns."""
    rng, start, pairs, turns = np.random.default_rng(seed), 0, [], []
    for run in runs:
        own = rng.integers(0, len(run.poses), (count, 2))
        yaw = run.poses[:, 2]
        pairs.append(own + start)
        turns.append(wrap_angle(yaw[own[:, 1]] - yaw[own[:, 0]]))
        start += len(run.poses)
    return Closures(np.concatenate(pairs), np.concatenate(turns))


def headings_of(runs: list[DriveWithTruth], noise: float, sign: float = 1.0) -> list[Headings]:
    tracks = [OdometryTrack.of(run.odometry, CONFIG, None) for run in runs]
    return [
        Headings.of(track, run.stamps_ns, (sign * walk(run, noise, k)).tolist())
        for k, (run, track) in enumerate(zip(runs, tracks, strict=True))
    ]


def drives(yaw_noise: float) -> list[DriveWithTruth]:
    """Two drives of 200 s whose odometry turns with this white noise, rad per square root of s."""
    per_step = yaw_noise * np.sqrt(50.0)
    return [drive(meander(200.0, seed=k)[0], yaw_noise=per_step, seed=k) for k in (3, 4)]


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_images_that_turn_better_correct_the_odometry(sign):
    runs = drives(0.04)
    found = corrections(headings_of(runs, 0.004, sign), closures_of(runs, 200))
    assert found is not None
    for run, correction in zip(runs, found, strict=True):
        assert 0.002 < correction.noise < 0.006
        before = OdometryTrack.of(run.odometry, CONFIG, None)
        after = before.corrected(correction)
        at = np.searchsorted(after.stamps_ns, run.stamps_ns)
        true = np.unwrap(run.poses[:, 2])
        assert np.std(after.yaw[at] - true) < 0.25 * np.std(before.yaw[at] - true)
        np.testing.assert_allclose(wrap_angle(after.yaw - after.poses[:, 2]), 0.0, atol=1e-9)
        missed = np.hypot(*(after.poses[at, :2] - run.poses[:, :2]).T).mean()
        assert missed < 0.5 * np.hypot(*(before.poses[at, :2] - run.poses[:, :2]).T).mean()


def test_odometry_that_is_as_good_stays_as_it_is():
    runs = drives(0.005)
    assert corrections(headings_of(runs, 0.004), closures_of(runs, 200)) is None
    assert corrections(headings_of(runs, 0.04), closures_of(runs, 200)) is None


def test_few_closures_or_such_between_drives_decide_nothing():
    runs = drives(0.04)
    few = closures_of(runs, CLOSURES_MIN // 2 - 1)
    rng, first = np.random.default_rng(0), len(runs[0].poses)
    pairs = np.column_stack([rng.integers(0, first, 200), first + rng.integers(0, 500, 200)])
    for closures in (few, Closures(pairs, rng.uniform(-3, 3, 200))):
        assert corrections(headings_of(runs, 0.004), closures) is None


def test_a_few_wrong_closures_change_little():
    runs = drives(0.04)
    closures = closures_of(runs, 200)
    turn = closures.turn.copy()
    turn[::10] += 1.5
    right, wrong = (
        corrections(headings_of(runs, 0.004), dataclasses.replace(closures, turn=t))
        for t in (closures.turn, turn)
    )
    assert right is not None and wrong is not None
    np.testing.assert_allclose(wrong[0].yaw, right[0].yaw, atol=0.02 * np.ptp(right[0].yaw))


def test_segments_have_the_corrected_turns_and_their_noise_and_are_longer():
    """Without: what turns may have misplaced uses them up, and links as weak shrink the map."""
    (run, _) = drives(0.04)
    known = np.unwrap(run.poses[:, 2])
    own = OdometryTrack.of(run.odometry, CONFIG, None)
    at = np.searchsorted(own.stamps_ns, run.stamps_ns)
    exact = TurnCorrection(run.stamps_ns, known - own.yaw[at], 0.002)
    track = OdometryTrack.of(run.odometry, CONFIG)
    segments = cut_track(track.corrected(exact), run.stamps_ns, CONFIG)
    for a, b in itertools.pairwise(segments.items):
        true = wrap_angle(known[b.images[0]] - known[a.images[0]])
        assert abs(wrap_angle(a.turn_rad - true)) < 1e-6
        assert a.turn_variance >= 0.002**2 * a.turn_time_s * 0.99
    (run, _) = drives(0.0)
    nothing = TurnCorrection(run.stamps_ns, np.zeros(len(run.stamps_ns)), CONFIG.yaw_noise)
    track = OdometryTrack.of(run.odometry, CONFIG)
    tracks = track, track.corrected(nothing)
    parts = [cut_track(one, run.stamps_ns, CONFIG) for one in tracks]
    before, after = (
        np.median([s.displacement_variance / s.turn_time_s for s in part if s.linked])
        for part in parts
    )
    assert len(parts[1]) < len(parts[0]) and after < before


@pytest.mark.parametrize('clockwise', [True, False])
def test_a_training_turns_by_its_images_where_wheels_slip(clockwise):
    """The steps of a training up to the segments, with wheels that slip and with good ones."""
    config = dataclasses.replace(recipe(clockwise), panorama=PanoramaConfig(
        width=120, height=24, clockwise=clockwise))  # fmt: skip
    true = wander(600, 2, hz=4.0)
    run = run_in(Spheres.about(1), true, config.panorama)
    twists = true.twists.copy()
    twists[:, 1] += 0.1 * np.random.default_rng(0).standard_normal(len(twists))
    slipping = dataclasses.replace(
        true, twists=twists, poses=integrate(true.stamps_ns, twists, true.poses[0])
    )
    given = TrainingInput.of([run], config).drives
    assert [track.slide for track in given.tracks()] == [TURN_SLIDE]
    bad = dataclasses.replace(run, odometry=slipping)
    (drive,) = given.items
    slipped = dataclasses.replace(given, items=(dataclasses.replace(drive, run=bad),))
    assert [track.slide for track in slipped.tracks()] != [TURN_SLIDE]
    errors = []
    for seen in (dataclasses.replace(slipped, closures=Closures.none()), slipped):
        segments = seen.cut()
        turned = np.array([s.start[2] - true.poses[s.images[0], 2] for s in segments])
        errors.append(np.abs(wrap_angle(turned - turned[0])).mean())
    assert errors[1] < 0.5 * errors[0]
