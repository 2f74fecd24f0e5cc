# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A camera that sits elsewhere on the robot than in the training shows by the first turns."""

import math

import numpy as np
import pytest
from filter_drives import START_NS, Drive, from_rest, winding

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import Level

NOISY = {'v_std': 0.03, 'omega_std': 0.02, 'position_std': 0.12, 'yaw_std': 0.03}
ALIKE = {'share': 0.7, 'length': 0.6}


def displaced(drive, lever, pictures=slice(None)):
    """The drive with a camera that shows places beside the robot: ahead + i left, in m."""
    yaw = drive.poses[drive.pictures, 2]
    beside = np.exp(1j * yaw) * lever
    drive.seen[pictures, :2] += np.column_stack([beside.real, beside.imag])[pictures]
    return drive


def fed(drive, heading=True):
    """What the filter believes of the camera after each image, its status and its error."""
    fused, found = PoseFilter(FilterConfig(), ErrorCorrelation(0.7, 0.6)), []
    for event in drive.events():
        drive.give(fused, event, heading)
        if event[1] == 1:
            status, mounting = fused.status, fused._history.newest.mounting
            found.append((mounting, status, drive.error(fused, drive.pictures[event[2]])[0]))
    return found


def suspected(found):
    return [mounting is not None and mounting.suspected for mounting, *_ in found]


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('every', [10, 50])
@pytest.mark.parametrize('lever', [0.8, -1.2, 0.7j, 0.9 - 0.9j])
def test_a_camera_that_was_moved_is_noticed_and_found(lever, every, seed):
    drive = displaced(Drive(seconds=60, every=every, seed=seed, **NOISY, **ALIKE), lever)
    found = fed(drive)
    mounting, status, _ = found[-1]
    assert all(suspected(found)[len(found) // 2 :])
    assert abs(mounting.lever - lever) < 0.25
    assert status.level is not Level.LOCALISED and mounting.problem in status.reasons
    wrong = [level.level is Level.LOCALISED and off_m > 1.0 for _, level, off_m in found]
    assert every / 50 * sum(wrong) <= 1.0


def test_the_reason_says_where_the_camera_is_now():
    drive = displaced(Drive(seconds=60), 0.8 - 1.1j)
    mounting = fed(drive)[-1][0]
    shown = 'images show places 0.8 m ahead and 1.1 m right of the robot: was the camera moved?'
    assert mounting.problem == shown
    assert mounting.variance == pytest.approx((0.8**2 + 1.1**2) / 2, rel=0.1)


HONEST = {
    'noise': {},
    'errors that last': ALIKE,
    'larger wheels': {'scale': 1.08, **ALIKE},
    'smaller wheels': {'scale': 0.92, **ALIKE},
    'a gyroscope with bias': {'bias': 0.02, **ALIKE},
    'a slow camera': {'every': 100, **ALIKE},
    'straight ahead': {'twists': np.tile([1.0, 0.0], (3000, 1)), **ALIKE},
    'on a circle': {'twists': np.tile([0.8, 0.4], (3000, 1)), **ALIKE},
    'turns on the spot': {'twists': np.tile([0.0, 0.6], (3000, 1)), **ALIKE},
    'poor images': {'position_std': 0.6, 'yaw_std': 0.1, **ALIKE},
}


@pytest.mark.parametrize('kind', HONEST)
def test_on_honest_drives_the_camera_stays_where_it_was(kind):
    for seed in range(3):
        drive = Drive(**({'seconds': 60, 'seed': seed} | NOISY | HONEST[kind]))
        found = fed(drive)
        assert not any(suspected(found))
    if kind == 'straight ahead':
        assert found[-1][0].lever_variance > 0.3, 'nothing tells a lever from another place'


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('shift', [(5.0, -4.0, 2.0), (0.0, 12.0, -1.0)])
def test_a_robot_that_was_carried_has_its_camera_where_it_was(shift, seed):
    drive = Drive(seconds=60, seed=seed, **NOISY, **ALIKE)
    drive.kidnap(200, shift)
    found = fed(drive)
    assert found[-1][2] < 0.5 and not any(suspected(found))


MOVED = 'the robot was moved, or the camera on it: turn, to show which'


@pytest.mark.parametrize('lever', [1.8, -1.6, 2.0j])
def test_a_place_beside_the_robot_on_a_straight_line_is_not_trusted_before_it_turns(lever):
    twists = from_rest(np.tile([0.8, 0.0], (2500, 1)))
    drive = displaced(Drive(twists=twists, **NOISY, **ALIKE), lever, slice(150, None))
    found = fed(drive)
    assert found[140][1].level is Level.LOCALISED
    assert all(status.level is not Level.LOCALISED for _, status, _ in found[155:])
    assert MOVED in found[-1][1].reasons


@pytest.mark.parametrize('shift', [(1.5, 1.0, 0.0), (8.0, -3.0, 0.0)])
@pytest.mark.parametrize('turn', [0.0, 0.3])
def test_a_robot_that_was_carried_is_trusted_once_it_has_turned_or_was_carried_far(shift, turn):
    twists = from_rest(np.tile([0.8, 0.0], (2500, 1)))
    twists[800:1000, 1] = 0.3
    twists[1400:1600, 1] = turn
    drive = Drive(twists=twists, **NOISY, **ALIKE)
    drive.kidnap(240, shift)
    _, status, error = fed(drive)[-1]
    assert error < 0.3
    assert (MOVED in status.reasons) == (turn == 0.0 and math.hypot(*shift[:2]) < 3.0)


def test_after_the_robot_was_carried_the_lever_is_still_known():
    drive = Drive(seconds=60, **NOISY, **ALIKE)
    drive.kidnap(400, (5.0, -4.0, 2.0))
    found = fed(displaced(drive, 1.0))
    assert all(suspected(found)[200:])


def test_a_camera_that_was_put_back_is_trusted_again():
    drive = displaced(Drive(seconds=90, **NOISY, **ALIKE), 0.9j, slice(0, 300))
    found = fed(drive)
    assert suspected(found)[250] and not suspected(found)[-1]
    assert not found[-1][0].problem and found[-1][2] < 0.3


@pytest.mark.parametrize('seed', range(5))
def test_images_from_anywhere_show_no_lever_and_are_forgotten(seed):
    drive, rng = Drive(seconds=90, seed=seed, **NOISY, **ALIKE), np.random.default_rng(seed)
    drive.seen[200:350] = drive.seen[rng.integers(0, len(drive.seen), 150)]
    found = fed(drive)
    assert not any(suspected(found)[400:])
    assert abs(found[-1][0].lever) < 0.15


def test_images_that_show_no_direction_show_no_lever():
    drive = displaced(Drive(seconds=30, **NOISY), 0.9)
    assert {mounting for mounting, *_ in fed(drive, heading=False)} == {None}
    drive.yaw_std = 0.5
    assert {mounting for mounting, *_ in fed(drive)} == {None}


def test_what_is_known_does_not_depend_on_the_order_of_messages():
    drive = displaced(Drive(seconds=20, **NOISY), 0.7)
    events, rng = drive.events(), np.random.default_rng(0)
    late = sorted(range(len(events)), key=lambda i: events[i][0] + rng.uniform(0, 1.5e9))
    levers = []
    for order in (range(len(events)), late):
        fused = PoseFilter(FilterConfig())
        fused.set_pose(START_NS, drive.poses[0], np.diag([0.01, 0.01, 0.01]))
        for i in order:
            drive.give(fused, events[i], True)
        levers.append(fused._history.newest.mounting.lever)
    assert levers[0] == levers[1] and abs(levers[0] - 0.7) < 0.3


def test_the_turns_of_the_drive_are_what_shows_it():
    """Until the first turn a moved camera looks like another place; then it shows within meters."""
    twists = np.vstack([np.tile([1.0, 0.0], (1000, 1)), winding(40)])
    found = fed(displaced(Drive(twists=twists, **NOISY, **ALIKE), 0.9j))
    straight, turning = suspected(found)[:195], suspected(found)[250:]
    assert not any(straight) and all(turning)
