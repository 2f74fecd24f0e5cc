# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Images that show where the robot was before are noticed by their poses, and nothing else is."""

import math
from itertools import pairwise

import numpy as np
import pytest
from filter_drives import START_NS, Drive, from_rest

from sfa_localization.fusion.driven_path import KNOT_NS, LATEST_S, extended
from sfa_localization.fusion.lateness import CLEARED, Lateness, followed, unrelated
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import Level

HZ, EVERY = 25, 5
CONFIRMED_S = 3.0
"""By then driving has confirmed where an image put the robot."""
NOISY = {'v_std': 0.03, 'omega_std': 0.02, 'position_std': 0.08, 'yaw_std': 0.02, 'rate_hz': HZ}
COVARIANCE = np.diag([0.05**2, 0.05**2, 0.01**2])


def drive_of(omega, v=1.0, rested=False, **options):
    """A noisy drive at a speed with turn rates (N,); one that has not `rested` was under way."""
    twists = np.column_stack([np.full(len(omega), v), omega])
    return Drive(every=EVERY, twists=from_rest(twists, HZ) if rested else twists,
                 **{**NOISY, **options})  # fmt: skip


def winding(seconds):
    t = np.arange(round(seconds * HZ)) / HZ
    return 0.3 + 0.25 * np.sin(0.5 * t)


def driven(drive, shown, turned=False, silent=(0.0, 0.0), unseen=(0.0, 0.0), fused=None):
    """A filter, new or `fused`, and per picture: its stamp s, level, error m, lateness; pictures
    show shown(t).

    Between the times `silent` s there are no messages, between `unseen` s no pictures.
    """
    fused, found = fused or PoseFilter(FilterConfig()), []
    for stamp_ns, kind, index in drive.events():
        if silent[0] < (stamp_ns - START_NS) * 1e-9 < silent[1]:
            continue
        if kind == 0:
            drive.give(fused, (stamp_ns, kind, index))
            continue
        at_s = (stamp_ns - START_NS) * 1e-9
        if unseen[0] < at_s < unseen[1]:
            continue
        content = min(max(round(shown(at_s) * HZ / EVERY) - 1, 0), index)
        if turned:
            fused.add_turned(stamp_ns, float(drive.poses[drive.pictures[content], 2]))
        fused.add_measurement(stamp_ns, drive.seen[content], drive.covariance(True))
        error = math.hypot(*(fused.state.pose - drive.poses[drive.pictures[index]])[:2])
        found.append((at_s, fused.status.level, error, fused._history.newest.lateness))
    return fused, found


def sure_and_wrong_s(found):
    return (
        sum(level is Level.LOCALISED and error > 1.0 for _, level, error, _ in found) * EVERY / HZ
    )


@pytest.mark.parametrize('omega', [np.zeros(60 * HZ), np.full(60 * HZ, 0.3), winding(60)])
@pytest.mark.parametrize('seed', [0, 1])
def test_images_in_time_are_never_suspected(omega, seed):
    _, found = driven(drive_of(omega, seed=seed, rested=True), lambda t: t)
    assert max(late.apart for *_, late in found) < 0.3
    assert all(level is Level.LOCALISED for at_s, level, *_ in found if at_s > CONFIRMED_S)


@pytest.mark.parametrize(('v', 'rate'), [(1.0, 0.1), (1.0, 0.15), (1.0, 0.2), (3.0, 0.03)])
@pytest.mark.parametrize('omega', [0.3, 0.5])
def test_on_a_circle_a_delay_that_grows_is_noticed_before_it_is_large(v, rate, omega):
    drive = drive_of(np.full(50 * HZ, omega), v, rested=True)
    _, found = driven(drive, lambda t: t - rate * max(t - 10.0, 0.0))
    assert sure_and_wrong_s(found) <= 2.0
    assert max(late.apart for at_s, *_, late in found if at_s < 10.0) < 0.1


@pytest.mark.parametrize(('v', 'omega', 'rate', 'longest_s'), [
    (0.8, 0.8, 0.16, 4.5), (1.0, 0.4, 0.2, 3.0), (0.7, 0.6, 0.1, 3.0),
])  # fmt: skip
def test_on_a_circle_a_queue_that_has_grown_is_not_forgotten(v, omega, rate, longest_s):
    """Until the robot drives otherwise."""
    drive = drive_of(np.append(np.full(80 * HZ, omega), winding(30)), v)
    _, found = driven(drive, lambda t: t - min(rate * t, longest_s) * (t < 85.0))
    first_s = next(at_s for at_s, *_, late in found if late.suspected)
    assert first_s < 10.0
    assert all(late.suspected for at_s, *_, late in found if first_s < at_s < 85.0)
    assert sure_and_wrong_s(found) == 0.0
    assert not found[-1][-1].suspected


def test_a_video_that_loops_is_noticed_at_once_and_its_delay_is_named():
    fused, found = driven(
        drive_of(winding(22)), lambda t: t if t < 14.0 else 6.0 + (t - 14.0) % 8.0
    )
    assert sure_and_wrong_s(found) == 0.0
    first_s = next(at_s for at_s, *_, late in found if late.suspected)
    assert 14.0 <= first_s < 15.0
    assert found[-1][-1].error_s == pytest.approx(8.0, abs=0.3)
    assert 'images are stamped 8.' in ' '.join(fused.status.reasons)
    assert fused.state.position_std > 2.0


@pytest.mark.parametrize('delay_s', [1.0, 3.0, 7.0])
def test_a_delay_that_begins_is_measured_and_its_end_is_noticed(delay_s):
    _, found = driven(drive_of(winding(40)), lambda t: t - delay_s if 12.0 <= t < 24.0 else t)
    during = [late for at_s, *_, late in found if 14.0 < at_s < 23.5]
    assert min(late.apart for late in during) > 0.9
    assert during[-1].error_s == pytest.approx(delay_s, abs=0.25)
    assert all(late.apart < CLEARED for at_s, *_, late in found if at_s > 30.0)


def circle_from_rest(seconds, omega=0.4, **options):
    """A robot that stands for three seconds, then drives on a circle."""
    twists = from_rest(np.tile([1.0, omega], (seconds * HZ, 1)), HZ, 3.0, 2.0)
    return Drive(every=EVERY, twists=twists, **NOISY, **options)


@pytest.mark.parametrize('delay_s', [1.0, 2.0])
@pytest.mark.parametrize('unseen', [(0.0, 0.0), (0.5, 5.0)])
def test_on_a_circle_a_delay_that_a_start_from_rest_has_shown_is_not_forgotten(delay_s, unseen):
    """A circle shows no delay, so it shows no end of one either. Repeated images are left out."""
    drive = circle_from_rest(90)
    fused = PoseFilter(FilterConfig())
    fused.add_measurement(START_NS, drive.poses[0], drive.covariance(True))
    _, found = driven(drive, lambda t: t - delay_s, unseen=unseen, fused=fused)
    assert not any(level is Level.LOCALISED for _, level, *_ in found)
    assert all(late.suspected for at_s, *_, late in found if at_s > 6.0)


@pytest.mark.parametrize('omega', [0.0, 0.3, 0.8])
def test_in_time_from_rest_on_a_circle_or_a_line_nothing_is_suspected(omega):
    """However long it is, and though nothing shows that images are still in time."""
    _, found = driven(circle_from_rest(240, omega), lambda t: t)
    assert not any(late.suspected for *_, late in found)
    assert all(level is Level.LOCALISED for at_s, level, *_ in found if at_s > 10.0)


@pytest.mark.parametrize(('omega', 'rate'), [(0.4, 0.03), (0.8, 0.02), (-0.5, 0.06)])
def test_on_a_circle_images_that_fall_behind_by_some_percent_are_doubted_in_time(omega, rate):
    """They look like odometry that turns too far. Other driving shows their time again."""
    circle = np.tile([1.0, omega], (120 * HZ, 1))
    twists = np.append(circle, np.column_stack([np.ones(30 * HZ), winding(30)]), axis=0)
    drive = Drive(every=EVERY, twists=from_rest(twists, HZ, 3.0, 2.0), **NOISY)
    fused, found = driven(drive, lambda t: t - rate * max(t - 3.0, 0.0) * (t < 124.0))
    assert sure_and_wrong_s(found) == 0.0
    doubted = [late.untested or late.suspected for at_s, *_, late in found if 80.0 < at_s < 124.0]
    assert all(doubted)
    assert fused.status.level is Level.LOCALISED


@pytest.mark.parametrize('bias', [-0.004, 0.004])
def test_on_a_circle_the_errors_of_good_odometry_are_no_doubt(bias):
    _, found = driven(circle_from_rest(120, 0.4, bias=bias), lambda t: t)
    assert all(level is Level.LOCALISED for at_s, level, *_ in found if at_s > 10.0)


OPEN = 'nothing shows whether images are late'


@pytest.mark.parametrize('delay_s', [0.0, 1.0, 2.0, 6.0])
@pytest.mark.parametrize('omega', [0.0, 0.4])
def test_of_a_robot_that_drove_steadily_all_the_time_images_may_be_late(omega, delay_s):
    """On a line or a circle under way, nothing shows it until the robot turns otherwise."""
    steady = np.full(30 * HZ, omega)
    unheard = -1.0, delay_s  # until images show what is after the begin of the recording
    fused, found = driven(drive_of(steady), lambda t: t - delay_s, silent=unheard)
    assert not any(level is Level.LOCALISED for _, level, *_ in found)
    assert OPEN in ' '.join(fused.status.reasons)
    turning = drive_of(np.append(steady, np.full(20 * HZ, -0.5)))
    _, found = driven(turning, lambda t: t - delay_s, silent=unheard)
    assert not any(level is Level.LOCALISED for at_s, level, *_ in found if at_s < 30.0)
    after = [level is Level.LOCALISED for at_s, level, *_ in found if at_s > 34.0]
    assert all(after) if delay_s == 0.0 else not any(after)


def test_late_images_whose_estimate_wheels_that_spin_have_moved_show_their_time_anew():
    """By the first turn: wheels that turn too fast make images look late that are in time."""
    drive = drive_of(np.repeat([0.4, -0.4], [40 * HZ, 20 * HZ]), rested=True)
    drive.read[12 * HZ : 18 * HZ, 0] *= 3.0
    late, found = driven(drive, lambda t: t - 2.0 * (t > 11.0))
    assert late.counts['measurement: restarted elsewhere'] > 0
    assert not any(level is Level.LOCALISED for at_s, level, *_ in found if at_s > 12.0)
    in_time, found = driven(drive, lambda t: t)
    assert in_time.counts['measurement: restarted elsewhere'] > 0
    assert all(level is Level.LOCALISED for at_s, level, *_ in found if at_s > 45.0)


def test_where_a_robot_stands_it_does_not_matter_whether_images_are_late():
    """It drives steadily when it is first heard of, and stops."""
    v = np.repeat([1.0, 0.0, 1.0], [6 * HZ, 6 * HZ, 30 * HZ])
    _, found = driven(drive_of(0.0 * v, v), lambda t: t)
    level = {round(at_s, 1): level for at_s, level, *_ in found}
    assert level[5.8] is Level.DEGRADED
    assert all(level[at_s] is Level.LOCALISED for at_s in level if at_s > 8.0)


def test_a_pose_that_is_set_says_nothing_about_the_time_of_images():
    drive = drive_of(winding(30))
    fused, _ = driven(drive, lambda t: t)
    assert fused._history.newest.lateness.lasting is None
    fused.set_pose(fused._history.newest_ns, drive.poses[-1], np.diag([0.01, 0.01, 0.01]))
    assert fused._history.newest.lateness.lasting is None
    late, _ = driven(drive_of(winding(30)), lambda t: t - 3.0 * (t > 15.0))
    late.set_pose(late._history.newest_ns, drive.poses[-1], np.diag([0.01, 0.01, 0.01]))
    assert late._history.newest.lateness.suspected


def test_what_images_showed_before_the_odometry_began_makes_none_late():
    """The robot was driving all the time; its odometry comes only after five seconds."""
    drive = drive_of(winding(40))
    fused = PoseFilter(FilterConfig())
    for event in drive.events():
        if event[1] == 1 or event[0] > START_NS + 5e9:
            drive.give(fused, event, heading=True)
            late = fused._history.newest.lateness
            assert late is None or not late.suspected
    assert fused.status.level is Level.LOCALISED


def test_images_of_elsewhere_are_in_time_again_where_the_filter_did_not_jump():
    """As after a camera that stood, of a robot so uncertain that any image is within the gate."""
    knots, trail, late = path_of(0.3, 40.0), (), None
    rng = np.random.default_rng(7)
    for k, knot in enumerate(knots):
        trail = extended(trail, knot)
        if k % 4 == 0:
            shown = knots[200] if 200 <= k < 400 else knot
            pose = shown[1:] + rng.normal([8.0, -5.0, 0.0], [0.1, 0.1, 0.02])
            pose[2] = math.remainder(pose[2], math.tau)
            late = followed(late, trail, knot, pose, COVARIANCE, False, 0.0)
            assert late.suspected or not 12.0 <= 0.05 * k < 20.0
    assert late.apart < 0.1


def test_odometry_covers_images_of_long_before():
    """Nothing was seen for longer than the path is remembered: where the robot is is still known,
    and images of where it was before are late.
    """
    knots, trail, late = path_of(0.3, 30.0), (), None
    for k, knot in enumerate(knots):
        trail = extended(trail, knot)
        seconds = 0.05 * k
        if k % 4 == 0 and not 5.0 < seconds < 20.0:
            shown = knots[k] if seconds < 10.0 else knots[k - 60]
            pose = np.array([*shown[1:3], math.remainder(shown[3], math.tau)])
            late = followed(late, trail, knot, pose, COVARIANCE, False, 0.0)
            assert late.suspected or seconds < 21.0
    assert late.error_s == pytest.approx(3.0, abs=0.3)


@pytest.mark.parametrize(('v', 'small'), [(0.2, True), (1.0, False)])
def test_a_second_is_a_small_delay_of_a_slow_robot(v, small):
    _, found = driven(drive_of(v * winding(60), v), lambda t: t - 1.0)
    late = found[-1][-1]
    assert late.suspected != small
    assert (late.error_s < 0.3) == small and bool(late.problem) != small


def test_a_robot_that_was_carried_is_not_late_where_it_is_found_again():
    drive = drive_of(winding(40))
    drive.kidnap(75, (6.0, -9.0, 2.0))
    fused, found = driven(drive, lambda t: t)
    assert fused.status.level is Level.LOCALISED and found[-1][2] < 0.5
    assert any(late.odds[-1] > 0.5 for *_, late in found[75:85])
    assert found[-1][-1].apart < 0.1


@pytest.mark.parametrize('seconds', [1.0, 4.0])
def test_a_motion_that_no_message_shows_makes_no_images_late(seconds):
    omega = winding(40)
    omega[12 * HZ : round((12 + seconds) * HZ)] = 1.2
    _, found = driven(drive_of(omega), lambda t: t, silent=(12.0, 12.0 + seconds))
    assert not any(late.suspected for at_s, *_, late in found if at_s > 17.0)
    assert all(level is Level.LOCALISED for at_s, level, *_ in found if at_s > 20.0)


@pytest.mark.parametrize('scale', [0.94, 1.06])
def test_wheels_of_another_size_make_no_images_late(scale):
    _, found = driven(
        drive_of(0.3 * np.sin(0.5 * np.arange(50 * HZ) / HZ), scale=scale), lambda t: t
    )
    assert not any(late.suspected for *_, late in found)


def test_without_odometry_nothing_is_concluded_from_motion():
    drive, fused = drive_of(winding(40)), PoseFilter(FilterConfig())
    for event in drive.events():
        if event[1] == 1 or not 15.0 <= (event[0] - START_NS) * 1e-9 < 25.0:
            drive.give(fused, event, heading=True)
    late = fused._history.newest.lateness
    assert late.apart < 0.1 and fused.status.level is Level.LOCALISED


def test_the_lateness_does_not_depend_on_the_order_of_messages():
    drive = drive_of(np.full(20 * HZ, 0.3))
    rng, ordered, shuffled = np.random.default_rng(3), PoseFilter(), PoseFilter()
    events = drive.events()
    late_by = [rng.uniform(0.0, 2.0 if kind else 0.1) * 1e9 for _, kind, _ in events]
    order = sorted(range(len(events)), key=lambda i: events[i][0] + late_by[i])
    for fused, sequence in ((ordered, range(len(events))), (shuffled, order)):
        # Both know from the start when their clock begins.
        fused.set_pose(START_NS, drive.poses[0], np.diag([0.01, 0.01, 0.01]))
        for i in sequence:
            stamp_ns, kind, index = events[i]
            content = round(index - 0.2 * max(index - 25, 0))
            if kind == 0:
                drive.give(fused, events[i])
            else:
                fused.add_measurement(stamp_ns, drive.seen[content], drive.covariance(True))
    a, b = (fused._history.newest.lateness for fused in (ordered, shuffled))
    assert a.suspected and b.suspected
    np.testing.assert_allclose(a.odds, b.odds, atol=1e-9)
    assert ordered.status == shuffled.status


def path_of(omega, seconds):
    """A trail at 1 m/s, by hand: knots each 50 ms on a line or a circle."""
    t = np.arange(0.0, seconds, 0.05)
    yaw = omega * t
    if omega:
        x, y = np.sin(yaw) / omega, (1 - np.cos(yaw)) / omega
    else:
        x, y = t, np.zeros_like(t)
    stamps = START_NS + np.round(t * 1e9).astype(np.int64)
    return [(int(s), *map(float, p)) for s, *p in zip(stamps, x, y, yaw, strict=True)]


def test_images_before_any_motion_change_nothing():
    knots = path_of(0.0, 1.0)
    first = followed(None, (), knots[0], np.zeros(3), COVARIANCE, False, 0.0)
    again = followed(
        first, (knots[0],), knots[1], np.array([9.0, 9.0, 1.0]), COVARIANCE, False, 0.0
    )
    np.testing.assert_array_equal(first.odds, again.odds)
    assert first.problem == '' and first.apart < 0.05


def test_images_that_show_little_change_nothing():
    knots = path_of(0.0, 3.0)
    first = followed(None, (), knots[0], np.zeros(3), COVARIANCE, False, 0.0)
    vague = np.diag([100.0, 100.0, 0.1])
    assert followed(first, tuple(knots), knots[-1], np.zeros(3), vague, False, 0.0) is first
    assert followed(None, (), knots[0], np.zeros(3), vague, False, 0.0) is None
    assert unrelated(None, (), knots[0], np.zeros(3), COVARIANCE) is None


def test_odds_stay_probabilities_with_any_images():
    rng, trail, late = np.random.default_rng(5), (), None
    for k, knot in enumerate(path_of(0.2, 60.0)):
        trail = extended(trail, knot)
        if k % 4 == 0:
            pose, covariance = rng.uniform(-20.0, 20.0, 3), COVARIANCE * 10 ** rng.uniform(-8, 3)
            late = followed(late, trail, knot, pose, covariance, k % 60 == 0, rng.uniform(-1, 1))
            assert isinstance(late, Lateness)
            assert late.odds.min() >= 0 and late.odds.sum() == pytest.approx(1.0)
            assert np.isfinite(late.shift).all() and np.abs(late.turn) == pytest.approx(1.0)
            assert (late.variance > 0).all() and (late.yaw_variance > 0).all()
    assert late.suspected and late.problem == 'images and odometry show different motions'


def test_the_trail_holds_the_last_seconds_in_steps():
    trail = ()
    for knot in path_of(0.0, 30.0):
        trail = extended(trail, knot)
        trail = extended(trail, (knot[0] + 1_000_000, *knot[1:]))
    assert trail[-1][0] - trail[0][0] >= LATEST_S * 1e9
    assert len(trail) <= LATEST_S / 0.05 + 3
    assert all(b[0] - a[0] >= KNOT_NS for a, b in pairwise(trail))


def test_a_first_image_that_contradicts_a_young_estimate_is_a_doubt():
    drive, fused = drive_of(winding(5)), PoseFilter(FilterConfig())
    for event in drive.events():
        stamp_ns, kind, index = event
        if kind == 1 and index == 2:
            wrong = drive.seen[index] + [0.0, 0.0, 0.7]
            assert not fused.add_measurement(stamp_ns, wrong, drive.covariance(True)).accepted
            assert fused.status.level is Level.DEGRADED
            return
        drive.give(fused, event, heading=True)
