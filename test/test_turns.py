# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Turns by odometry and images together: by the noise of both, which the drive shows."""

from dataclasses import replace

import numpy as np
import pytest
from cylinder_worlds import Spheres, recipe, run_in, wander

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import Odometry, integrate
from sfa_localization.keyframes.closures import Closures
from sfa_localization.mapping.drives import rig_of
from sfa_localization.motion.dead_reckoning import BRIDGE_MAX_S, OdometryTrack
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.motion.turns import Headings, estimated
from sfa_localization.training_input import TrainingInput

CONFIG = SegmentConfig()
RATE, EVERY = 20, 10


def robot(seconds=400.0, v=0.2, seed=0):
    """Stamps (N,) and true twists (N, 2) of a robot that drives ways and turns between them."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, 1 / RATE)
    turning = np.repeat(rng.random(len(t) // 40 + 1) < 0.4, 40)[: len(t)]
    rate = np.repeat(rng.uniform(-0.8, 0.8, len(t) // 40 + 1), 40)[: len(t)]
    return 10**9 + np.round(t * 1e9).astype(int), np.column_stack([v + 0 * t, turning * rate])


def odometry(stamps, twists, factor=1.0, noise=0.0, seed=0):
    """Odometry that counts `factor` times the turns, with noise, rad per square root of s."""
    twists, rng = twists * [1.0, factor], np.random.default_rng(seed)
    twists[:, 1] += noise * np.sqrt(RATE) * rng.standard_normal(len(twists))
    return Odometry(stamps, integrate(stamps, twists), twists, np.zeros_like(twists))


def turns_of(stamps, twists, measured, image_std=0.002, parallax=0.0, sign=1.0, seed=0):
    """The estimate of turns, the true headings of the images, and those of the track."""
    true, rng = integrate(stamps, twists)[::EVERY], np.random.default_rng(seed)
    seen = true[:, 2] + np.cumsum(image_std * rng.standard_normal(len(true)))
    seen += parallax * true[:, 0]  # an angle that depends on the place
    track = OdometryTrack.of(measured, CONFIG)
    headings = Headings.of(track, stamps[::EVERY], (sign * wrap_angle(seen)).tolist())
    turns = estimated([headings], Closures.none())
    return turns and turns[0], np.unwrap(true[:, 2]), headings.track


def spread(headings):
    return float(np.std(headings))


@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.parametrize('factor', [0.6, 1.0, 1.5])
def test_where_wheels_slip_turns_are_those_of_the_images(sign, factor):
    stamps, twists = robot()
    turns, true, counted = turns_of(
        stamps, twists, odometry(stamps, twists, factor, 0.05), 0.002, 0.0, sign
    )
    error = counted + turns.add - true
    assert spread(error) < 0.2 * spread(counted - true)
    assert turns.factor.value == pytest.approx(1 / factor, rel=3 * turns.factor.std)
    # The error grows as its variance says.
    assert 0.2 < spread(np.diff(error)) / np.sqrt(np.diff(turns.variance).mean()) < 2.0


def test_where_wheels_are_good_things_beside_the_way_do_not_bend_a_drive():
    """Images alone would err by 0.03 rad/m."""
    stamps, twists = robot()
    turns, true, counted = turns_of(
        stamps, twists, odometry(stamps, twists, 1.04, 0.001), 0.002, 0.03
    )
    error = counted + turns.add - true
    assert spread(error) < 0.4 * spread(0.03 * integrate(stamps, twists)[::EVERY, 0])
    assert spread(error) < 0.8 * spread(counted - true)  # the factor of the wheels is found
    assert turns.factor.value == pytest.approx(1 / 1.04, abs=0.01)


def test_images_that_turn_otherwise_than_the_robot_change_nothing():
    stamps, twists = robot()
    other = integrate(stamps, robot(seed=1)[1])[::EVERY, 2]
    track = OdometryTrack.of(odometry(stamps, twists), CONFIG)
    headings = Headings.of(track, stamps[::EVERY], other.tolist())
    assert estimated([headings], Closures.none()) is None


def test_where_closures_show_that_wheels_turn_better_images_change_nothing():
    """As of a robot that hides a part of the view: its images turn by less than it does."""
    stamps, twists = robot()
    true = integrate(stamps, twists)[::EVERY, 2]
    rows = np.random.default_rng(0).integers(0, len(true), (200, 2))
    closures = Closures(rows, wrap_angle(np.diff(true[rows])[:, 0]))
    good = OdometryTrack.of(odometry(stamps, twists, 1.0, 0.002), CONFIG)
    bad = OdometryTrack.of(odometry(stamps, twists, 1.2, 0.02), CONFIG)
    for track, images, used in ((good, 0.9 * true, False), (bad, true, True)):
        headings = Headings.of(track, stamps[::EVERY], images.tolist())
        assert (estimated([headings], closures) is not None) == used


def test_images_that_match_by_chance_do_not_turn_a_robot_of_good_wheels():
    stamps, twists = robot()
    track = OdometryTrack.of(odometry(stamps, twists, 1.0, 0.002), CONFIG)
    true = integrate(stamps, twists)[::EVERY, 2]
    wrong = np.cumsum(np.where(np.arange(len(true)) % 50 == 7, 2.0, 0.0))
    headings = Headings.of(track, stamps[::EVERY], wrap_angle(true + wrong).tolist())
    turns = estimated([headings], Closures.none())[0]
    assert spread(headings.track + turns.add - np.unwrap(true)) < 0.5


def test_a_short_pause_is_bridged_and_images_show_the_turn_in_it():
    """The robot turns while messages are lost, which then say that it stands."""
    stamps, twists = robot()
    lost = slice(2000, 2000 + round(0.8 * BRIDGE_MAX_S * RATE))
    twists[lost, 1] = 0.7
    measured = twists.copy()
    measured[lost.stop : lost.stop + 3] = 0.0
    kept = np.delete(np.arange(len(stamps)), lost)
    poses = integrate(stamps[kept], measured[kept])
    given = Odometry(stamps[kept], poses, measured[kept], np.zeros((len(kept), 2)))
    turns, true, counted = turns_of(stamps, twists, given)
    track = OdometryTrack.of(given, CONFIG)
    assert track.part[-1] == 0 and (track.bridged[-1] > 0.01).all()
    error, before = counted + turns.add - true, counted - true
    assert abs(error[-1] - error[0]) < 0.25 < 0.5 < abs(before[-1] - before[0])


def test_a_training_turns_by_its_images_where_wheels_slip():
    """Columns grow counterclockwise; up to the segments, and to the robot of the model."""
    panorama = PanoramaConfig(width=120, height=24, clockwise=False)
    config = replace(recipe(False), panorama=panorama)
    true = wander(400, 2, hz=4.0)
    run = run_in(Spheres.about(1), true, panorama)
    twists = true.twists * [1.0, 1.2]
    twists[:, 1] += 0.1 * np.random.default_rng(0).standard_normal(len(twists))
    poses = integrate(true.stamps_ns, twists, true.poses[0])
    bad = replace(run, odometry=replace(true, twists=twists, poses=poses))
    drives = TrainingInput.of([bad], config).drives
    segments = drives.cut()
    turned = np.array([s.start[2] - true.poses[s.images[0], 2] for s in segments])
    by_wheels = np.interp([s.images[0] for s in segments], np.arange(400), np.unwrap(poses[:, 2]))
    wheels = by_wheels - [true.poses[s.images[0], 2] for s in segments]
    assert spread(np.unwrap(turned)) < 0.2 * spread(np.unwrap(wrap_angle(wheels)))
    assert rig_of(drives, segments).turn_factor.value == pytest.approx(1 / 1.2, abs=0.05)
