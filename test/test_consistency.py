# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Images that contradict the odometry's motion cost the trust; so do repeated moves."""

import math

import numpy as np
import pytest
from filter_drives import Drive, from_rest, winding

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.fusion import consistency
from sfa_localization.fusion.belief import COMPARED_IMAGES, Evidence, Trust
from sfa_localization.fusion.consistency import (
    AGREEING_DISTANCE_M,
    APART_M,
    FORGIVEN_M,
    LONGEST_M,
    NOISIEST_TURNS,
    SPACING_M,
    UNLIKE_M,
    WINDOW_M,
    begun,
    contradiction,
    doubts,
    hesitant,
    moved,
    pulled,
    watched,
)
from sfa_localization.fusion.evidence import FEW_IMAGES
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import Level

NOISY = {'v_std': 0.03, 'omega_std': 0.02, 'position_std': 0.12, 'yaw_std': 0.03}


def seen(poses, places, yaws, std=0.1, yaw_std=0.03):
    """Evidence of images at places (complex) along a driven path of poses (N, 3)."""
    steps = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
    return tuple(
        Evidence(tuple(pose), traveled, (place.real, place.imag), yaw, std**2, yaw_std**2, False)
        for pose, traveled, place, yaw in zip(
            poses.tolist(), np.cumsum(steps).tolist(), places, yaws, strict=True
        )
    )


def bend(length_m=3.0, count=16, turn=1.0):
    """A path of odometry that turns, with the place and heading of each image in a turned map."""
    s = np.linspace(0, length_m, count)
    yaw = turn * s / max(length_m, 1e-9)
    radius = length_m / turn
    poses = np.column_stack([radius * np.sin(yaw), radius * (1 - np.cos(yaw)), yaw])
    places = (poses[:, 0] + 1j * poses[:, 1]) * np.exp(2j) + (3 - 4j)
    return poses, places, wrap_angle(yaw + 2.0)


def noise(count, std, seed=0):
    return np.random.default_rng(seed).normal(0, std, (count, 2)) @ np.array([1, 1j])


def test_images_on_the_path_of_odometry_contradict_nothing():
    for seed in range(200):
        poses, places, yaws = bend()
        rng = np.random.default_rng([seed, 1])
        drawn = yaws + rng.normal(0, 0.03, len(yaws))
        assert contradiction(seen(poses, places + noise(16, 0.1, seed), drawn)) == ''


@pytest.mark.parametrize('jitter_m', [0.03, 0.1, 0.2])
def test_images_of_a_standing_robot_whose_odometry_jitters_show_no_turned_camera(jitter_m):
    for seed in range(200):
        path, stands = noise(24, jitter_m, seed), np.full(24, 3 - 4j)
        poses = np.column_stack([path.real, path.imag, np.zeros(24)])
        found = contradiction(seen(poses, stands + noise(24, 0.1, seed + 1000), np.full(24, 2.0)))
        assert 'look' not in found


def test_a_third_of_wrong_images_contradict_nothing():
    poses, places, yaws = bend()
    places[::3] += 5.0
    assert contradiction(seen(poses, places, yaws)) == ''


@pytest.mark.parametrize('kind', ['repeated', 'alternating', 'elsewhere', 'backward'])
def test_images_that_move_otherwise_contradict(kind):
    poses, places, _ = bend(turn=2.0)
    number = np.arange(len(places))
    wrong = {
        'repeated': np.full(len(places), places[0]),
        'alternating': places[0] + 2.0 * (number % 2),
        'elsewhere': 5.0 * np.exp(2.4j * number),
        'backward': places[::-1] * np.exp(0.7j * number),
    }[kind]
    shown = contradiction(seen(poses, wrong + noise(16, 0.05), np.full(16, np.nan)))
    assert shown == 'images and odometry show different motions'


@pytest.mark.parametrize(('angle', 'noticed'), [(8, False), (25, True), (-40, True), (175, True)])
def test_a_camera_that_was_turned_is_noticed(angle, noticed):
    poses, places, yaws = bend()
    shown = contradiction(seen(poses, places, wrap_angle(yaws + math.radians(angle))))
    assert ('degrees off the motion: was the camera turned?' in shown) is noticed
    if noticed:
        assert f'look {angle} degrees off' in shown or f'look {-angle} degrees off' in shown


@pytest.mark.parametrize(('scatter', 'noticed'), [(0.05, True), (1.5, False)])
def test_images_that_claim_meters_show_a_turned_camera_where_they_lie_on_a_line(scatter, noticed):
    found = []
    for seed in range(40):
        poses, places, yaws = bend(length_m=4.0)
        drawn = wrap_angle(yaws + math.radians(25))
        weak = seen(poses, places + noise(16, scatter, seed), drawn, std=1.5)
        found.append('was the camera turned?' in contradiction(weak))
    assert np.mean(found) > 0.95 if noticed else np.mean(found) < 0.1


def stretched(factor, scatter, std, seeds=40):
    """How often images that move so many times as far as the odometry contradict it."""
    found = []
    for seed in range(seeds):
        poses, places, yaws = bend(length_m=4.0)
        off = places[0] + factor * (places - places[0]) + noise(16, scatter, seed)
        found.append('times as far as the odometry' in contradiction(seen(poses, off, yaws, std)))
    return np.mean(found)


@pytest.mark.parametrize(
    ('factor', 'noticed'), [(0.0, True), (0.6, True), (0.9, False), (1.15, False), (1.5, True)]
)
def test_images_that_move_farther_or_less_far_contradict(factor, noticed):
    """Whether they claim decimeters or meters, where they lie on a line."""
    for std in (0.5, 1.5):
        found = stretched(factor, 0.05, std)
        assert found > 0.95 if noticed else found < 0.05


def test_scattered_images_do_not_show_how_far_they_move():
    assert stretched(1.0, 1.0, 1.0, seeds=200) < 0.05


def test_by_how_much_images_move_otherwise_widens_what_is_published():
    poses, places, yaws = bend(length_m=4.0)
    near = 0.4 * places + noise(16, 0.02)
    trust = Trust()
    for item in seen(poses, near, yaws, std=1.0):
        trust = watched(trust, item)
    assert trust.problem.startswith('images move 0.4 times')
    assert math.sqrt(trust.variances(0.0)[0]) > 0.5 * WINDOW_M


def test_without_headings_only_the_motion_counts():
    poses, places, _ = bend()
    assert contradiction(seen(poses, places, np.full(16, np.nan))) == ''


@pytest.mark.parametrize(
    ('way_m', 'images', 'spread_m', 'stand'),
    [
        (0.6, 4, 0.005, True),
        (0.4, 4, 0.005, False),
        (0.6, 2, 0.005, False),
        (0.6, 4, 0.1, False),
        (3.0, 8, 0.005, True),
    ],
)
def test_images_in_one_place_are_noticed_after_half_a_meter(way_m, images, spread_m, stand):
    """However much each claims: they drove before, and stand while the odometry drives on."""
    poses, places, yaws = bend()
    x = np.linspace(0, way_m, images)
    more = poses[-1] + np.column_stack([x, 0 * x, 0 * x])
    items = seen(
        np.concatenate([poses, more[1:]]),
        np.concatenate([places, places[-1] + noise(images, spread_m)[1:]]),
        np.concatenate([yaws, np.full(images - 1, yaws[-1])]),
        std=0.8,
    )
    trust = Trust()
    for item in items[: len(poses)]:
        trust = watched(trust, item)
        assert not trust.problem
    for item in items[len(poses) :]:
        trust = watched(trust, item)
    shown = 'images stay in one place while the odometry drives'
    assert (trust.problem == shown) == stand
    assert trust.misfit[0] == pytest.approx(way_m if stand else 0.0, rel=0.3)


def test_while_wheels_spin_slowly_weak_images_show_it():
    """At 0.1 m/s what is compared otherwise takes 20 s."""
    spinning, moves = slice(1000, 1750), winding(100.0, speed=0.1)
    read, moves = moves.copy(), moves.copy()
    moves[spinning] = 0.0
    noise = {'v_std': 0.005, 'omega_std': 0.005, 'position_std': 0.5, 'yaw_std': 0.15}
    drive = Drive(twists=moves, seed=1, **noise)
    drive.read[spinning] += read[spinning]
    at = spinning.start // drive.every
    drive.seen[at : spinning.stop // drive.every] = drive.seen[at]
    found = fed(drive)
    assert wrong_and_sure(found, 0.8) == 0


def test_too_few_images_or_too_short_a_path_contradict_nothing():
    poses, places, yaws = bend()
    repeated = np.full(len(places), places[0])
    few = slice(0, COMPARED_IMAGES - 1)
    assert contradiction(seen(3 * poses[few], repeated[few], yaws[few])) == ''
    assert contradiction(seen(0.5 * poses, repeated, yaws)) == ''
    assert contradiction(seen(poses, repeated, yaws)) != ''


def test_the_window_holds_the_newest_images_over_both_distance_and_number():
    poses, places, yaws = bend(length_m=20.0, count=400)
    trust = Trust()
    for item in seen(poses, places, yaws):
        trust = watched(trust, item)
    recent = trust.recent
    steps = np.diff([item.traveled_m for item in recent])
    assert steps.min() >= SPACING_M
    assert WINDOW_M <= recent[-1].traveled_m - recent[0].traveled_m < WINDOW_M + 2 * SPACING_M
    poses, places, yaws = bend(length_m=40.0, count=41)
    for item in seen(poses, places, yaws):
        trust = watched(trust, item)
    assert len(trust.recent) == COMPARED_IMAGES


def compared(trust):
    """The trust after as many images, over as long a way, as a comparison needs."""
    poses, places, yaws = bend(AGREEING_DISTANCE_M + 0.1, COMPARED_IMAGES)
    trust = trust._replace(recent=())
    for item in seen(poses, places, yaws):
        trust = watched(trust, item._replace(traveled_m=item.traveled_m + trust.moved_m))
    return trust


def test_every_move_of_a_confirmed_place_doubles_the_distance_that_confirms():
    trust = Trust()
    assert doubts(trust, 0.0) == []
    trust = compared(moved(trust, 10.0))
    assert doubts(trust, 10.5) == ['placed anew, confirmed over 0.5 m: driving on confirms it']
    assert doubts(trust, 10.0 + AGREEING_DISTANCE_M) == []
    trust = compared(moved(trust, 20.0))
    shown = 'placed anew 2 times in a row, confirmed over 3.0 m: driving on confirms it'
    assert shown in doubts(trust, 23.0)
    assert doubts(trust, 20.0 + 2 * AGREEING_DISTANCE_M) == []
    for traveled_m in range(30, 130, 10):
        trust = compared(moved(trust, traveled_m))
    assert doubts(trust, 120 + LONGEST_M - 0.1) != [] and doubts(trust, 120 + LONGEST_M) == []


def test_what_was_not_confirmed_yet_is_moved_on_and_not_again():
    trust = compared(moved(Trust(), 10.0))
    for traveled_m in (10.5, 11.0, 11.5):
        trust = compared(moved(trust, traveled_m, accepted_m=traveled_m))
    assert doubts(trust, 11.5 + AGREEING_DISTANCE_M - 0.1) != []
    assert doubts(trust, 11.5 + AGREEING_DISTANCE_M) == []
    again = compared(moved(trust, 14.0, accepted_m=13.9))
    assert doubts(again, 14.0 + AGREEING_DISTANCE_M) != []


@pytest.mark.parametrize(('jump_m', 'again'), [(1.4, False), (1.6, True), (8.0, True)])
def test_wheels_that_spin_explain_no_move_beyond_the_way_driven(jump_m, again):
    trust = compared(moved(Trust(), 10.0, 8.0))
    trust = compared(moved(trust, 11.0, jump_m, accepted_m=10.8))
    assert (doubts(trust, 11.0 + AGREEING_DISTANCE_M) != []) == again


@pytest.mark.parametrize('share', [0.0, 0.5])
def test_two_meters_after_wheels_spun_or_slipped_the_filter_is_sure_again(share):
    """Images move the estimate many times meanwhile, and are right. A gyroscope shows the turns."""
    spinning, wheels = slice(1000, 1400), winding(60.0, speed=0.6)
    moves = wheels.copy()
    moves[spinning] *= share
    drive = Drive(twists=moves, **NOISY)
    drive.read[spinning, 0] += (wheels - moves)[spinning, 0]
    found = fed(drive)
    assert wrong_and_sure(found) <= 2
    levels = [status.level for status, *_ in found]
    ended = spinning.stop // drive.every
    assert levels[ended - 10] is not Level.LOCALISED
    assert set(levels[ended + round(10 * (AGREEING_DISTANCE_M + 1.0) / 0.6) :]) == {Level.LOCALISED}


@pytest.mark.parametrize(('meters', 'moves'), [(FORGIVEN_M, 1), (FORGIVEN_M + 3.0, 0)])
def test_an_estimate_that_stays_is_as_if_never_moved(meters, moves):
    poses, places, yaws = bend(length_m=meters, count=200)
    trust = moved(Trust(), 0.0)
    for item in seen(poses, places, yaws):
        trust = watched(trust, item)
    assert trust.moves == moves


def fed(drive, fused=None):
    """Status and error at every image."""
    fused, found = fused or PoseFilter(FilterConfig()), []
    for event in drive.events(True):
        drive.give(fused, event, True)
        if event[1] == 1 and fused.state is not None:
            error = fused.state.pose[:2] - drive.poses[drive.pictures[event[2]], :2]
            found.append((fused.status, math.hypot(*error), fused.state))
    return found


def wrong_and_sure(found, limit_m=1.0):
    return sum(status.level is Level.LOCALISED and error > limit_m for status, error, _ in found)


@pytest.mark.parametrize('kind', ['frozen', 'alternating'])
def test_while_images_repeat_the_filter_is_never_sure_and_wrong(kind):
    drive = Drive(seconds=40, **NOISY)
    stuck = drive.seen.copy()
    for k in range(100, 300):
        stuck[k] = drive.seen[100 if kind == 'frozen' else 100 - 20 * (k % 2)]
    drive.seen = stuck
    found = fed(drive)
    assert wrong_and_sure(found) == 0
    assert found[95][0].level is Level.LOCALISED and found[-1][1] < 0.5


def test_a_start_from_images_alone_is_confirmed_by_driving():
    drive = Drive(seconds=10, **NOISY)
    levels = [status.level for status, *_ in fed(drive)]
    steps = np.diff(drive.poses[:, :2], axis=0, prepend=drive.poses[:1, :2])
    driven = np.cumsum(np.hypot(*steps.T))
    confirmed = driven[drive.pictures] > AGREEING_DISTANCE_M + 0.5
    assert set(levels[: np.argmax(confirmed) - 8]) == {Level.DEGRADED}
    assert {level for level, sure in zip(levels, confirmed, strict=True) if sure} == {
        Level.LOCALISED
    }


@pytest.mark.parametrize('turn', [-0.4, 0.3])
def test_images_of_a_robot_that_turned_otherwise_confirm_nothing_soon(turn):
    """Both drive on, straight and as fast, for four meters more."""
    own = np.tile([1.0, 0.0], (350, 1))
    own[:150, 1] = turn
    drive, other = Drive(twists=own, **NOISY), Drive(twists=np.tile([1.0, 0.0], (350, 1)), **NOISY)
    drive.seen = other.seen + np.array([3.0, -2.0, 0.0])
    assert all(status.level is not Level.LOCALISED for status, *_ in fed(drive))


def test_contradictions_before_an_estimate_is_confirmed_put_that_off():
    for trust, way_m in (
        (compared(begun(10.0)), APART_M),
        (compared(moved(Trust(), 10.0)), AGREEING_DISTANCE_M),
    ):
        assert hesitant(trust, 11.0, 0, False, 1.0) == trust
        trust = hesitant(trust, 11.0, 0, True, 1.0)
        assert doubts(trust, 11.0 + way_m - 0.1) != [] and doubts(trust, 11.0 + way_m) == []
        assert hesitant(trust, 15.1, 0, True, 1.0) == trust, 'confirmed before'


def test_turns_that_no_wheels_explain_are_confirmed_over_a_longer_way_and_never_for_good():
    trust = compared(moved(Trust(), 10.0))
    unlike = hesitant(trust, 11.0, 0, False, 1.1 * NOISIEST_TURNS)
    assert doubts(unlike, 10.0 + UNLIKE_M - 0.1) != [] and doubts(unlike, 10.0 + UNLIKE_M) == []
    again = hesitant(unlike, 30.0, 0, True, 1.1 * NOISIEST_TURNS)
    assert doubts(again, 30.0 + UNLIKE_M - 0.1) != []
    moved_on = compared(moved(again, 31.0, 0.5, accepted_m=31.0))
    assert doubts(moved_on, 31.0 + UNLIKE_M - 0.1) != []


@pytest.mark.parametrize(('contradicted_m', 'way_m'), [
    (3.0, UNLIKE_M), (12.0, 12.0), (100.0, LONGEST_M),
])  # fmt: skip
@pytest.mark.parametrize('moves', [0, 1])
def test_what_was_driven_under_contradictions_is_driven_as_far_without(
    contradicted_m, way_m, moves
):
    """Where turns are unlike, and where images moved the estimate meanwhile."""
    trust = compared(begun(10.0))
    for part, traveled_m in enumerate(10.0 + np.linspace(0.0, contradicted_m, 41)):
        if moves and part == 20:
            trust = compared(moved(trust, traveled_m, 0.1, traveled_m))
        trust = hesitant(trust, traveled_m, 0, True, 1.1 * NOISIEST_TURNS)
    assert doubts(trust, traveled_m + way_m - 0.1) != []
    assert doubts(trust, traveled_m + way_m + 1e-9) == []


def test_images_that_were_rejected_for_long_before_they_moved_the_estimate_confirm_it_as_late():
    trust = compared(moved(Trust(), 10.0))
    for traveled_m in np.linspace(10.0, 15.0, 26):
        trust = hesitant(trust, traveled_m, FEW_IMAGES, False, 1.0)
    assert doubts(trust, 15.0 + AGREEING_DISTANCE_M - 0.1) != []
    trust = compared(moved(trust, 15.0, 3.0, accepted_m=10.0))
    assert doubts(trust, 19.9) != [] and doubts(trust, 20.0 + 1e-9) == []
    outlying = compared(moved(Trust(), 10.0))
    assert hesitant(outlying, 11.0, FEW_IMAGES - 1, False, 1.0) == outlying


@pytest.mark.parametrize('jump', [1.8, 1.4j])
def test_images_that_jump_aside_and_back_again_and_again_confirm_ever_less(jump):
    """Each time as a robot does that was carried; each place holds for four seconds."""
    drive = Drive(seconds=100, **NOISY)
    aside = np.arange(len(drive.seen)) // 40 % 2 == 1
    aside[:100] = aside[700:] = False
    drive.seen[aside, :2] += [jump.real, jump.imag]
    found = fed(drive)
    assert wrong_and_sure(found) <= 5
    assert found[-1][0].level is Level.LOCALISED


def test_a_start_that_was_given_needs_images_only():
    drive = Drive(twists=from_rest(winding(3)), **NOISY)
    levels = [status.level for status, *_ in fed(drive, PoseFilter(FilterConfig(
        initial_pose=(0.0, 0.0, 0.0))))]  # fmt: skip
    assert levels[-1] is Level.LOCALISED and levels.count(Level.LOCALISED) > 0.9 * len(levels)


@pytest.mark.parametrize('standing_s', [0, 8])
@pytest.mark.parametrize(('degrees', 'at_most_s'), [(25, 1.0), (40, 0.0)])
def test_a_camera_that_was_turned_before_the_start_shows_by_driving(standing_s, degrees, at_most_s):
    twists = np.zeros((50 * (standing_s + 20), 2))
    twists[50 * standing_s :] = [0.7, 0.1]
    drive = Drive(twists=twists, **NOISY)
    drive.seen[:, 2] += math.radians(degrees)
    sure = [status.level is Level.LOCALISED for status, *_ in fed(drive)]
    assert 0.1 * sum(sure) <= at_most_s


@pytest.mark.parametrize(('every', 'at_most_s'), [(10, 1.5), (50, 0.0), (100, 0.0)])
@pytest.mark.parametrize('degrees', [-22, -18, 18, 22])
def test_a_camera_mounted_askew_is_not_trusted_at_any_rate(degrees, every, at_most_s):
    drive = Drive(twists=np.tile([0.9, 0.08], (2500, 1)), every=every, **NOISY)
    drive.seen[:, 2] = wrap_angle(drive.seen[:, 2] + math.radians(degrees))
    sure = [status.level is Level.LOCALISED for status, *_ in fed(drive)]
    assert every / 50 * sum(sure) <= at_most_s


@pytest.mark.parametrize(
    ('length_m', 'images', 'confirmed'), [(9.0, 4, False), (9.0, 5, True), (1.95, 20, False)]
)
def test_images_that_could_not_be_compared_confirm_nothing(length_m, images, confirmed):
    """Too few of a slow camera, or over too short a way, whatever the last that fits says."""
    trust = moved(Trust(), 10.0)
    for item in seen(*bend(length_m, images)):
        trust = watched(trust, item._replace(traveled_m=item.traveled_m + 10.0))
    assert (doubts(trust, 20.0) == []) == confirmed
    # The image that moves the estimate once more is the first of those that are compared next.
    assert moved(trust, 20.0).recent == trust.recent[-1:]


def test_after_a_knock_of_the_camera_the_filter_is_not_sure():
    drive = Drive(seconds=40, **NOISY)
    drive.seen[100:, 2] = wrap_angle(drive.seen[100:, 2] + math.radians(35))
    found = fed(drive)
    assert found[95][0].level is Level.LOCALISED
    assert sum(status.level is Level.LOCALISED for status, *_ in found[130:]) == 0
    reasons = {reason for status, *_ in found[130:] for reason in status.reasons}
    assert any('was the camera turned?' in reason for reason in reasons)


def test_a_kidnapped_robot_is_trusted_again_after_two_meters():
    drive = Drive(seconds=40, **NOISY)
    drive.kidnap(150, (5.0, -4.0, 2.0))
    found = fed(drive)
    levels = [status.level for status, *_ in found]
    assert levels[145] is Level.LOCALISED and levels[153] is Level.DEGRADED
    assert levels[156] is Level.DEGRADED and levels[190] is Level.LOCALISED
    assert wrong_and_sure(found) <= 2  # until a third image does not match


@pytest.mark.parametrize(('wrong', 'doubted'), [(8, 5), (2, 0)])
def test_after_images_that_did_not_match_one_that_does_is_not_enough(wrong, doubted):
    drive = Drive(seconds=30, **NOISY)
    drive.seen[150 : 150 + wrong, :2] += np.random.default_rng(0).uniform(1.5, 3.0, (wrong, 2))
    levels = [status.level for status, *_ in fed(drive)][149 : 150 + wrong + 8]
    assert levels[0] is Level.LOCALISED
    after = levels[1 + wrong :]
    assert set(after[: max(doubted - 1, 0)]) <= {Level.DEGRADED}
    assert set(after[doubted:]) == {Level.LOCALISED}


def test_a_start_that_was_wrong_is_trusted_again_after_two_meters():
    drive = Drive(seconds=20, **NOISY)
    drive.seen[0, :2] += 6.0
    found = fed(drive)
    placed = next(k for k, (_, error, _) in enumerate(found) if error < 1.0)
    doubted = [status.level for status, *_ in found[placed : placed + 15]]
    assert set(doubted) == {Level.DEGRADED}
    assert found[placed + 30][0].level is Level.LOCALISED


def test_driving_without_images_confirms_nothing():
    """Kidnapped, found again, and then blind: 2.4 m within the time that images may be silent."""
    drive = Drive(seconds=40, **NOISY)
    drive.kidnap(150, (5.0, -4.0, 2.0))
    fused, levels, found_ns = PoseFilter(FilterConfig()), [], None
    for stamp_ns, kind, index in drive.events(True):
        if found_ns is None or kind == 0:
            drive.give(fused, (stamp_ns, kind, index), True)
        if found_ns is None and fused.counts['measurement: restarted elsewhere']:
            found_ns = stamp_ns
        if found_ns is not None and stamp_ns < found_ns + 2_900_000_000:
            levels.append(fused.status.level)
    assert len(levels) > 100 and set(levels) == {Level.DEGRADED}


OFFSETS = {
    'to one side': (lambda k: (0.8, 0.4), True),
    'to both sides': (lambda k: (0.8 * (-1) ** k, 0.4), False),
    'near, if by many standard deviations': (lambda k: (0.1, 0.1), False),
}


@pytest.mark.parametrize('kind', OFFSETS)
def test_images_on_one_side_of_the_estimate_are_noticed(kind):
    offset, suspected = OFFSETS[kind]
    variance = 0.01 if kind.startswith('near') else 0.64
    pull = None
    for k in range(80):
        pull = pulled(pull, 0.25 * k, complex(*offset(k)), variance)
    assert pull.suspected == suspected
    shown = ['images lie 0.9 m to one side of the estimate'] if suspected else []
    assert doubts(Trust(), 0.0, pull) == shown
    assert pull.variance == pytest.approx(0.4 * suspected, rel=0.1)
    standing = pulled(pull, 0.25 * 79, 9 + 9j, variance)
    assert standing.mean == pull.mean, 'a place where the map errs says nothing while one stands'
    for k in range(80, 160):
        pull = pulled(pull, 0.25 * k, 0j, variance)
    assert not pull.suspected


class Poor(Drive):
    """Images that err by less than they claim, as those of a covered camera in another light."""

    def covariance(self, heading):
        return np.diag([0.7**2, 0.7**2, 0.1**2][: 3 if heading else 2])


@pytest.mark.parametrize('scale', [1 / 0.7, 1 / 0.6])
def test_wheels_of_another_size_are_noticed_though_images_are_poor(scale, monkeypatch):
    way = from_rest(np.tile([1.0, 0.0], (50 * 40, 1)))
    drive = Poor(twists=way, scale=scale, position_std=0.2, yaw_std=0.03)

    monkeypatch.setattr(consistency, 'FAR_D2', np.inf)  # which alone notices them, too

    def times_wrong():
        """With limits that let weak images pass."""
        config = FilterConfig(degraded_std=1.0)
        return wrong_and_sure(fed(drive, PoseFilter(config, ErrorCorrelation(0.7, 0.6))))

    both = times_wrong()
    monkeypatch.setattr(consistency, 'STRETCHED', np.inf)
    by_side = times_wrong()
    monkeypatch.setattr(consistency, 'PULLED', np.inf)
    without = times_wrong()
    assert without > 50
    assert both <= by_side < 0.1 * without


@pytest.mark.parametrize('share', [0.0, 0.7])
def test_many_weak_images_make_no_sure_estimate_where_they_err_alike(share):
    """They may all be wrong for the same reason; sensors with white errors average out."""
    drive = Poor(seconds=30, position_std=0.3, yaw_std=0.03)
    correlation = ErrorCorrelation(share, 0.6)
    found = fed(drive, PoseFilter(FilterConfig(), correlation))
    statuses = [status for status, _, state in found if state.position_std < 0.4]
    assert len(statuses) > 50
    sure = np.mean([status.level is Level.LOCALISED for status in statuses])
    if share == 0.0:
        assert sure > 0.9
        return
    assert sure < 0.1
    reason = 'single images show the position to no better than 0.5 m'
    assert np.mean([reason in status.reasons for status in statuses]) > 0.9


def test_one_good_image_among_weak_ones_is_enough_for_a_while():
    drive = Poor(seconds=30, position_std=0.2, yaw_std=0.03)
    fused = PoseFilter(FilterConfig(), ErrorCorrelation(0.7, 0.6))
    fed(drive, fused)
    assert fused.status.level is Level.DEGRADED
    last_ns = int(drive.stamps_ns[-1])
    covariance = np.diag([0.1**2, 0.1**2, 0.05**2])
    fused.add_measurement(last_ns + 1, drive.poses[-1], covariance)
    assert fused.status.level is Level.LOCALISED


def test_constants_are_used(monkeypatch):
    """The share and the angle that separate outliers and drift from contradictions."""
    poses, places, yaws = bend()
    turned = seen(poses, places, wrap_angle(yaws + math.radians(25)))
    monkeypatch.setattr(consistency, 'TURNED_RAD', math.radians(30))
    assert contradiction(turned) == ''
    places[::3] += 5.0
    monkeypatch.setattr(consistency, 'AGREEING_HALF', 0.8)
    assert contradiction(seen(poses, places, yaws)) != ''
