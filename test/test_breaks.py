# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Breaks of odometry: what is known between two parts of a drive, and what is not."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfa_localization.data.geometry import compose
from sfa_localization.data.run import Odometry, PanoramaArray, Run, integrate
from sfa_localization.keyframes.closures import STRETCH_M, Closures, driven
from sfa_localization.motion.breaks import contradicted, parted
from sfa_localization.motion.check import check_motion
from sfa_localization.motion.odometry_errors import same_scale
from sfa_localization.motion.sources import compare_map

STAMPS = 10**9 + np.arange(751) * 40_000_000
"""Odometry at 25 Hz for 30 s; images every 0.2 s."""
IMAGES = STAMPS[::5]
DRIVING = np.full(len(STAMPS), 0.4)


def odometry(speeds, omega=0.0):
    """Of speeds (751,) m/s and turn rates; nothing breaks in it."""
    twists = np.stack(np.broadcast_arrays(speeds, omega), 1)
    return Odometry(STAMPS, integrate(STAMPS, twists), twists, np.zeros_like(twists))


def between(begin_s, end_s):
    """Mask (751,) of a part of the drive."""
    seconds = (STAMPS - STAMPS[0]) * 1e-9
    return (seconds > begin_s + 1e-6) & (seconds < end_s + 1e-6)


def textures(true_speeds):
    """Of images along a way: the correlation of two of them falls by the half in each meter."""
    rng = np.random.default_rng(0)
    way = np.abs(np.diff(np.cumsum(true_speeds * 0.04)[::5], prepend=0.0))
    images, last = [], rng.normal(0, 30, (10, 50))
    for kept in 0.5**way:
        last = kept * last + np.sqrt(1 - kept**2) * rng.normal(0, 30, last.shape)
        images.append(last + rng.normal(0, 1.0, last.shape))
    return np.clip(np.rint(images), -127, 127).astype(np.int8)


def lengths(broken):
    """Messages of the parts that hold more than a second."""
    counts = np.unique(broken.part, return_counts=True)[1]
    return counts[counts > 25].tolist()


def seconds_in(text):
    return [float(word) for word in text.split() if word[0].isdigit()]


def test_a_turn_changes_much_more_of_an_image_than_a_way():
    turning = (np.arange(len(STAMPS)) // 75) % 3 > 0
    wheels = odometry(np.where(turning, 0.02, 0.4), 1.0 * turning)
    assert contradicted(wheels, IMAGES, textures(np.where(turning, 30.0, 0.4)))[1] == []


@pytest.mark.parametrize('omega', [0.0, 0.5])
def test_wheels_that_turn_while_images_stand_are_cut_off(omega):
    stuck = between(12.0, 16.0)
    spinning = odometry(DRIVING, omega * stuck)
    broken, (text,) = contradicted(spinning, IMAGES, textures(np.where(stuck, 0.0, 0.4)))
    begin, end = seconds_in(text)
    assert text.startswith('the wheels turn from') and text.endswith('images stand: cut there')
    assert (begin, end) == pytest.approx((12.0, 16.0), abs=0.7)
    before, after = lengths(broken)
    assert 280 < before <= 300 and 330 < after <= 350
    # Of what is inside, each message is a part, so that no image there has a place.
    assert len(np.unique(broken.part[stuck])) == stuck.sum()


def test_a_robot_that_is_carried_while_its_wheels_stand_is_cut_off():
    true = np.where(between(12.0, 16.0), 0.0, 0.4)
    same, carried = textures(true), between(14.0, 30.0)[::5]
    other = np.where(carried[:, None, None], np.flip(same, 1), same)
    broken, (text,) = contradicted(odometry(true), IMAGES, other)
    begin, end = seconds_in(text)
    assert 'while the wheels stand, move: cut there' in text
    assert begin < 14.0 < end and end - begin < 5.5
    assert len(lengths(broken)) == 2
    # A robot that stood, and shows the same place, was not carried.
    assert contradicted(odometry(true), IMAGES, same)[1] == []


def test_a_pose_that_jumps_goes_on_only_where_its_twist_says_so():
    wheels = odometry(DRIVING)
    poses = wheels.poses + np.outer(between(10.0, 30.0), [0.6, 0.3, 0.0])
    jumping = replace(wheels, poses=poses)
    joined, text = parted(jumping)
    assert 'jumps once, by up to 0.67 m: joined by its motion around' in text
    assert not joined.part.any()
    assert_allclose(joined.poses, wheels.poses, atol=0.01)
    often = wheels.poses
    for at_s in range(3, 30, 3):
        moved = compose(np.array([0.3, 0.2, 0.1]), often)
        often = np.where(between(at_s, 31.0)[:, None], moved, often)
    joined, text = parted(replace(wheels, poses=often))
    assert 'jumps 9 times' in text and 'record the frame odom instead of map' in text
    assert_allclose(joined.poses, wheels.poses, atol=0.02)
    # Ticks that jump, of which the twist is made; and a driver that publishes no twist.
    at = int(np.flatnonzero(between(10.0, 30.0))[0])
    ticks = jumping.twists + np.outer(np.arange(len(STAMPS)) == at, [0.6 / 0.04, 0.0])
    for twists in (ticks, 0 * ticks):
        cut, text = parted(replace(jumping, twists=twists))
        assert 'cut there' in text and np.flatnonzero(np.diff(cut.part)).tolist() == [at - 1]


def test_a_restart_during_a_pause_breaks_odometry_there():
    wheels = odometry(DRIVING)
    kept = ~between(10.0, 14.0)
    poses = wheels.poses - np.outer(between(14.0, 30.0), [5.6, 0.0, 0.0])
    paused = Odometry(*(part[kept] for part in (STAMPS, poses, wheels.twists, wheels.variances)))
    broken, text = parted(paused)
    assert 'pauses once, first after 10.0 s, and goes on 3.98 m from' in text
    assert np.flatnonzero(np.diff(broken.part)).tolist() == [250]


def test_nothing_is_compared_across_a_break():
    """The map moves with the odometry in both parts, which lie in different frames."""
    wheels, second = odometry(DRIVING, 0.1), between(15.0, 30.0)
    true, moved = wheels.trajectory.at(IMAGES), compose(np.array([3.0, 9.0, 2.0]), wheels.poses)
    reset = replace(wheels, poses=np.where(second[:, None], moved, wheels.poses))
    broken = replace(reset, part=second.astype(np.int64))
    without, pair = (compare_map(each, IMAGES, true) for each in (reset, broken))
    assert without.differs('alike') or without.scale < 0.95
    assert not pair.differs('alike') and pair.scale == pytest.approx(1.0, abs=0.01)
    # Places on both sides may be the same: see find_closures.
    path = np.diff(driven(broken, IMAGES))
    assert path[75] == pytest.approx(STRETCH_M, abs=0.2) and path.sum() < STRETCH_M + 12


@pytest.mark.parametrize(('degrees', 'speed'), [(12.0, 0.4), (-5.0, -0.4)])
def test_a_heading_beside_the_way_is_turned_to_it(degrees, speed):
    rng = np.random.default_rng(0)
    wheels = odometry(speed + 0.1 * rng.standard_normal(len(STAMPS)), 0.1)
    check = check_motion(wheels)
    assert check.corrected == [] and (check.odometry.poses == wheels.poses).all()
    off = wheels.poses + np.array([0.0, 0.0, np.radians(degrees)])
    check = check_motion(replace(wheels, poses=off))
    text = f'the heading of the pose lies {abs(degrees):.1f} degrees beside its way'
    assert text in ' '.join(check.corrected)
    error = np.exp(1j * (check.odometry.poses[:, 2] - wheels.poses[:, 2]))
    assert np.abs(np.angle(error)).max() < np.radians(0.1)


def test_drives_whose_wheels_count_differently_are_learned_with_the_median_scale():
    wheels = odometry(np.full(len(STAMPS), 1.0), 0.3)
    images = PanoramaArray(IMAGES, np.zeros((len(IMAGES), 1, 1, 3), np.uint8))
    poses, twists = wheels.poses * [1.08, 1.08, 1.0], wheels.twists * [1.08, 1.0]
    run = Run('first', images, wheels)
    larger = replace(run, odometry=replace(wheels, poses=poses, twists=twists))
    rows, count = np.arange(0, len(IMAGES), 2), len(IMAGES)
    near = np.clip(rows + np.random.default_rng(0).integers(-1, 2, len(rows)), 0, count - 1)
    pairs = np.column_stack([rows, count + near]), np.column_stack([rows, 2 * count + near])
    closures = Closures(np.concatenate(pairs), np.zeros(2 * len(rows)))
    first, second, third = same_scale([run, larger, run], closures)
    assert first is run and third is run
    assert_allclose(second.odometry.poses, wheels.poses, atol=0.05)
    assert_allclose(second.odometry.twists, wheels.twists, rtol=0.01)
    for pair in ([run, larger], [larger, run]):
        for drive in same_scale(pair, closures):
            assert_allclose(drive.odometry.twists[:, 0], np.sqrt(1.08), rtol=0.01)
    assert same_scale([run, run], closures)[1].odometry is wheels
    alone = Closures(pairs[0][:5], np.zeros(5))
    assert same_scale([run, larger], alone)[1] is larger
