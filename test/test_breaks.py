# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Breaks of odometry: what is known between two parts of a drive, and what is not."""

from dataclasses import replace

import numpy as np
import pytest

from sfa_localization.data.geometry import compose
from sfa_localization.data.run import Odometry, PanoramaArray, Run, integrate
from sfa_localization.keyframes.closures import STRETCH_M, Closures, driven
from sfa_localization.metric.breaks import contradicted, parted
from sfa_localization.metric.motion_check import check_motion
from sfa_localization.metric.motion_sources import compare_map
from sfa_localization.metric.odometry_errors import same_scale

STAMPS = 10**9 + np.arange(751) * 40_000_000
"""Odometry at 25 Hz for 30 s; images every 0.2 s."""
IMAGES = STAMPS[::5]
SPEED = 0.4


def odometry(speeds, omega=0.0) -> Odometry:
    """Of speeds (751,) m/s and a turn rate; nothing breaks in it."""
    twists = np.column_stack([speeds, np.full(len(STAMPS), omega)])
    return Odometry(STAMPS, integrate(STAMPS, twists), twists, np.zeros_like(twists))


def between(begin_s: float, end_s: float) -> np.ndarray:
    """Mask (751,) of a part of the drive."""
    seconds = (STAMPS - STAMPS[0]) * 1e-9
    return (seconds > begin_s + 1e-6) & (seconds < end_s + 1e-6)


def textures(true_speeds, noise: float = 1.0) -> np.ndarray:
    """Of images along a way: the correlation of two of them falls by the half in each meter."""
    rng = np.random.default_rng(0)
    way = np.abs(np.diff(np.cumsum(true_speeds * 0.04)[::5], prepend=0.0))
    images, last = [], rng.normal(0, 30, (10, 50))
    for kept in 0.5**way:
        last = kept * last + np.sqrt(1 - kept**2) * rng.normal(0, 30, last.shape)
        images.append(last + rng.normal(0, noise, last.shape))
    return np.clip(np.rint(images), -127, 127).astype(np.int8)


DRIVING = np.full(len(STAMPS), SPEED)


def lengths(found: Odometry) -> list[int]:
    """Messages of the parts that hold more than a second."""
    counts = np.unique(found.part, return_counts=True)[1]
    return counts[counts > 25].tolist()


def test_images_that_change_with_the_way_contradict_nothing():
    wheels = odometry(DRIVING)
    found, texts = contradicted(wheels, IMAGES, textures(DRIVING))
    assert texts == [] and not found.part.any()


def test_straight_ways_of_a_drive_full_of_turns_contradict_nothing():
    """A turn changes much more of an image than a way."""
    turning = (np.arange(len(STAMPS)) // 75) % 3 > 0
    speeds, seen = np.where(turning, 0.02, SPEED), np.where(turning, 30.0, SPEED)
    twists = np.column_stack([speeds, 1.0 * turning])
    wheels = replace(odometry(speeds), twists=twists, poses=integrate(STAMPS, twists))
    assert contradicted(wheels, IMAGES, textures(seen))[1] == []


@pytest.mark.parametrize('omega', [0.0, 0.5])
def test_wheels_that_turn_while_images_stand_are_cut_off(omega):
    stuck = between(12.0, 16.0)
    wheels = odometry(DRIVING, 0.0)
    spinning = replace(wheels, twists=wheels.twists + np.outer(stuck, [0.0, omega]))
    spinning = replace(spinning, poses=integrate(STAMPS, spinning.twists))
    found, texts = contradicted(spinning, IMAGES, textures(np.where(stuck, 0.0, SPEED)))
    (text,) = texts
    begin, end = (float(word) for word in text.split() if word[0].isdigit())
    assert text.startswith('the wheels turn from') and text.endswith('images stand: cut there')
    assert begin == pytest.approx(12.0, abs=0.7) and end == pytest.approx(16.0, abs=0.7)
    before, after = lengths(found)
    assert 280 < before <= 300 and 330 < after <= 350
    # Of what is inside, each message is a part, so that no image there has a place.
    inside = between(12.0, 16.0)
    assert len(np.unique(found.part[inside])) == inside.sum()


def test_a_robot_that_is_carried_while_its_wheels_stand_is_cut_off():
    true = np.where(between(12.0, 16.0), 0.0, SPEED)
    same, carried = textures(true), between(14.0, 30.0)[::5]
    other = np.where(carried[:, None, None], np.flip(same, 1), same)
    found, texts = contradicted(odometry(true), IMAGES, other)
    (text,) = texts
    begin, end = (float(word) for word in text.split() if word[0].isdigit())
    assert 'while the wheels stand, move: cut there' in text
    assert begin < 14.0 < end and end - begin < 5.5
    assert len(lengths(found)) == 2
    # A robot that stood, and shows the same place, was not carried.
    assert contradicted(odometry(true), IMAGES, same)[1] == []


def test_a_pose_that_jumps_goes_on_only_where_its_twist_says_so():
    wheels = odometry(DRIVING)
    poses = wheels.poses + np.outer(between(10.0, 30.0), [0.6, 0.3, 0.0])
    jumping = replace(wheels, poses=poses)
    found, text = parted(jumping)
    assert 'jumps once, by up to 0.67 m: joined by its motion around' in text
    assert not found.part.any()
    np.testing.assert_allclose(found.poses, wheels.poses, atol=0.01)
    # Ticks that jump, of which the twist is made.
    at = int(np.flatnonzero(between(10.0, 30.0))[0])
    ticks = jumping.twists.copy()
    ticks[at, 0] += 0.6 / 0.04
    found, text = parted(replace(jumping, twists=ticks))
    assert 'cut there' in text and np.flatnonzero(np.diff(found.part)).tolist() == [at - 1]
    # And a driver that publishes no twist.
    found, text = parted(replace(jumping, twists=0 * ticks))
    assert 'cut there' in text and found.part.max() == 1


def test_a_restart_during_a_pause_breaks_odometry_there():
    wheels = odometry(DRIVING)
    kept = ~between(10.0, 14.0)
    poses = wheels.poses - np.outer(between(14.0, 30.0), [5.6, 0.0, 0.0])
    paused = Odometry(*(part[kept] for part in (STAMPS, poses, wheels.twists, wheels.variances)))
    found, text = parted(paused)
    assert text == '' and np.flatnonzero(np.diff(found.part)).tolist() == [250]


def test_nothing_is_compared_across_a_break():
    """The map moves with the odometry in both parts, which lie in different frames."""
    wheels = odometry(DRIVING, 0.1)
    true = wheels.trajectory.at(IMAGES)
    second = between(15.0, 30.0)
    moved = compose(np.array([3.0, 9.0, 2.0]), wheels.poses)
    reset = replace(wheels, poses=np.where(second[:, None], moved, wheels.poses))
    assert (
        compare_map(reset, IMAGES, true).differs('alike')
        or compare_map(reset, IMAGES, true).scale < 0.95
    )
    broken = replace(reset, part=second.astype(np.int64))
    pair = compare_map(broken, IMAGES, true)
    assert not pair.differs('alike') and pair.scale == pytest.approx(1.0, abs=0.01)
    # Places on both sides may be the same: see find_closures.
    path = np.diff(driven(broken, IMAGES))
    assert path[75] == pytest.approx(STRETCH_M, abs=0.2) and path.sum() < STRETCH_M + 12


@pytest.mark.parametrize('degrees', [12.0, 5.0, -8.0])
@pytest.mark.parametrize('speed', [SPEED, -SPEED])
def test_a_heading_beside_the_way_is_turned_to_it(degrees, speed):
    wheels = odometry(np.full(len(STAMPS), speed), 0.1)
    off = wheels.poses + np.array([0.0, 0.0, np.radians(degrees)])
    check = check_motion(replace(wheels, poses=off))
    text = f'the heading of the pose lies {abs(degrees):.1f} degrees beside its way'
    assert any(text in said for said in check.corrected)
    error = np.exp(1j * (check.odometry.poses[:, 2] - wheels.poses[:, 2]))
    assert np.abs(np.angle(error)).max() < np.radians(0.1)


def test_a_heading_along_the_way_stays():
    rng = np.random.default_rng(0)
    wheels = odometry(DRIVING + 0.1 * rng.standard_normal(len(STAMPS)), 0.1)
    check = check_motion(wheels)
    assert check.corrected == [] and (check.odometry.poses == wheels.poses).all()


def test_a_drive_whose_wheels_count_more_is_learned_with_the_scale_of_the_first():
    wheels = odometry(np.full(len(STAMPS), 1.0), 0.3)
    images = PanoramaArray(IMAGES, np.zeros((len(IMAGES), 1, 1, 3), np.uint8))
    one = Run('one', images, wheels)
    larger = replace(wheels, poses=wheels.poses * [1.08, 1.08, 1.0])
    two = Run('two', images, replace(larger, twists=wheels.twists * [1.08, 1.0]))
    rows, count = np.arange(0, len(IMAGES), 2), len(IMAGES)
    near = np.clip(rows + np.random.default_rng(0).integers(-1, 2, len(rows)), 0, count - 1)
    closures = Closures(np.column_stack([rows, count + near]), np.zeros(len(rows)))
    first, second = same_scale([one, two], closures)
    assert first is one
    np.testing.assert_allclose(second.odometry.poses, wheels.poses, atol=0.05)
    np.testing.assert_allclose(second.odometry.twists, wheels.twists, rtol=0.01)
    assert same_scale([one, replace(one, name='two')], closures)[1].odometry is wheels
