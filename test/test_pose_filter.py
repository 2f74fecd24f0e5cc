# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The filter as a whole: exact on exact data, right on noisy data, and hard to fool."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from filter_drives import NOISY, SECOND, START_NS, FilterDrive, fed, snapshot, started, winding
from filterpy.kalman import ExtendedKalmanFilter
from numpy.testing import assert_allclose
from places import distances

from sfa_localization.data.error_correlation import LEAST_M, ErrorCorrelation
from sfa_localization.data.errors import ConfigError, DataError
from sfa_localization.data.geometry import compose, wrap_angle
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.data.run import integrate
from sfa_localization.fusion.ekf import Ekf, Kalman, replaced
from sfa_localization.fusion.health import MISSING
from sfa_localization.fusion.motion import DELAY, LOSS, SCALE, SIZE, Pace, Twist
from sfa_localization.fusion.pose_filter import Level, PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import uncertainty

either = pytest.mark.parametrize('heading', [True, False])


# Exactness.


@either
@pytest.mark.parametrize('speed', [1.0, -0.7, 1e-30])
@pytest.mark.parametrize('turn', [0.0, 5e-324, 1e-7, 0.8])
def test_exact_data_straight_turning_and_reversing(speed, turn, heading):
    start = (3.0, -2.0, math.pi)
    drive, fused = FilterDrive(twists=winding(4, 50, speed, turn), start=start), started(start)
    outcomes = drive.feed(fused, heading)
    assert max(error for _, _, error, _ in outcomes) < 1e-6
    assert all(update.accepted for _, update, _, _ in outcomes)
    assert np.isfinite(fused.state.covariance).all()


@pytest.mark.parametrize('askew', [0.0, math.pi / 2, -2.0])
def test_odometry_whose_pose_is_headed_off_its_motion_gives_way_to_its_twist(askew):
    """As of a pose in another frame than the twist, from the start or after a reset."""
    drive, fused = FilterDrive(seconds=10), started()
    for i, stamp_ns in enumerate(drive.stamps_ns.tolist()):
        x, y, yaw = drive.reckoned[i].tolist()
        pose = (x, y, float(wrap_angle(yaw + askew)))
        fused.add_odometry(stamp_ns, *drive.read[i], drive.variances(), pose)
    assert np.allclose(fused.state.pose, drive.poses[-1], atol=1e-3)


def test_prediction_to_a_stamp_recalls_and_extrapolates_less_and_less_sure():
    drive, fused = FilterDrive(twists=np.tile([1.0, 0.0], (200, 1))), started()
    drive.feed(fused, pictures=False)
    newest, seconds = fused.state.stamp_ns, (-1, 0, 0.1, 1, 5, 1e5)
    later = [fused.at(newest + round(each * SECOND)) for each in seconds]
    assert fused.at(newest - 100 * SECOND) is None
    assert [at.pose[0] for at in later[:3]] == pytest.approx([2.98, 3.98, 4.08], abs=1e-6)
    assert all(a.position_std < b.position_std for a, b in itertools.pairwise(later))
    # It does not run on for ever at the last speed.
    assert np.isfinite(later[-1].covariance).all() and later[-1].pose[0] < 6.5


def test_without_odometry_the_estimate_gets_uncertain_as_this_robot_was_seen_to_drive():
    lost_after_s = []
    for turn, seconds in ((0.3, 40), (3.0, 40), (0.3, 1)):
        drive = FilterDrive(twists=winding(seconds, 20, turn=turn), rate_hz=20, **NOISY)
        fused = fed(started(), drive)
        states = [fused.at(fused.state.stamp_ns + later * SECOND) for later in range(30)]
        lost = [later for later, s in enumerate(states) if uncertainty(s, fused.config)]
        assert lost == list(range(lost[0], 30)), 'it never gets more certain'
        lost_after_s.append(lost[0])
    assert lost_after_s[0] > 3 > lost_after_s[1] and lost_after_s[2] <= 2, lost_after_s
    pace, robot = Pace(), winding(20, 20)
    for k, twist in enumerate(robot.tolist()):
        pace = pace.after(k * SECOND // 20, Twist(*twist, 0.0, 0.0))
    changes = np.mean((robot[20:] - robot[:-20])[::20] ** 2, axis=0)
    assert np.allclose(pace.changes, (changes * 19 + 1.0) / 20, rtol=0.01)


def test_a_forgotten_pose_may_be_anywhere_and_what_was_learned_of_the_robot_stays():
    config, drive = FilterConfig(initial_pose=(0.0, 0.0, 0.0)), FilterDrive(seconds=60, **NOISY)
    fused = PoseFilter(config)
    fused.forget_pose()
    fused.add_odometry(START_NS - 10**8, 0.0, 0.0)
    assert fused.state is None, 'nor does it start at the configured pose'
    drive.feed(fused, heading=True, stop=40)
    before = fused.state
    fused.forget_pose()
    assert fused.state is None and fused.status.level is Level.UNINITIALISED
    drive.kidnap(399, (8.0, -3.0, 2.0))
    ((_, update, error, _),) = drive.feed(fused, heading=True, start=40, stop=40.05)
    assert update.reason == 'started' and error < 0.6
    assert np.array_equal(fused.state.mean[5:9], before.mean[5:9])


# Time.


@pytest.mark.parametrize(('late_s', 'heading'), [(0.5, False), (4.0, True)])
def test_shuffled_and_late_messages_give_what_messages_in_time_give(late_s, heading):
    drive, rng = FilterDrive(seconds=15, **NOISY), np.random.default_rng(1)
    drive.seen[40:44, :2] += 3.0
    # Pictures come late, odometry up to 0.1 s: then in the order of arrival.
    arrives = {e: e[0] + rng.uniform(0, late_s if e[1] else 0.1) * 1e9 for e in drive.events()}
    ordered = fed(started(), drive, heading=heading)
    late = fed(started(), drive, sorted(drive.events(), key=arrives.get), heading)
    assert np.abs(ordered.state.mean - late.state.mean).max() < 1e-9
    assert np.abs(ordered.state.covariance - late.state.covariance).max() < 1e-9
    assert ordered.status == late.status


@pytest.mark.parametrize(('later_ns', 'moved_m', 'decided'), [
    (lambda kind: 1000, 0.0, 0),
    (lambda kind: 1000 * kind, 5e-6, 0),  # at 1 m/s, the robot drives a micrometer
    (lambda kind: -1000 * kind, 0.05, 1),  # fused by the motion of the message before
])  # fmt: skip
def test_no_decision_hangs_on_a_microsecond_and_another_start_of_time_changes_no_bit(
    later_ns, moved_m, decided
):
    drive, runs = FilterDrive(seconds=25, **NOISY), []
    drive.kidnap(120, (4.0, 1.0, 0.5))
    for shift in (lambda kind: 0, later_ns):
        fused, poses, reasons = PoseFilter(), [], []
        for stamp_ns, kind, index in drive.events():
            update = drive.give(fused, (stamp_ns + shift(kind), kind, index), True)
            reasons += [update.reason] if kind else []
            poses += [fused.state.pose] if fused.state else []
        runs.append((np.array(poses), reasons))
    (plain, said), (later, then) = runs
    assert 'restarted elsewhere' in said and 'outside the gate' in said
    assert sum(a != b for a, b in zip(said, then, strict=True)) <= decided
    assert_allclose(later, plain, rtol=0, atol=moved_m)


@pytest.mark.parametrize('seconds', [15, 2])
def test_a_bag_that_loops_starts_the_filter_anew(seconds):
    config, drive = FilterConfig(initial_pose=(0.0, 0.0, 0.0)), FilterDrive(seconds=seconds)
    once = fed(PoseFilter(config), drive, heading=False)
    looped = fed(PoseFilter(config), drive, drive.events() * 2, heading=False)
    assert looped.counts['clock went back'] == 1
    # A few messages were spent on noticing; the end is that of a drive begun after them.
    assert np.allclose(looped.state.pose, once.state.pose, atol=0.2)
    assert looped.state.stamp_ns == once.state.stamp_ns
    assert looped.status.level is Level.LOCALISED


def test_images_are_not_fused_anew_for_each_odometry_that_comes_late(monkeypatch):
    drive, steps, step = FilterDrive(seconds=2, every=2, **NOISY), [], Ekf.step
    monkeypatch.setattr(Ekf, 'step', lambda *given: steps.append(given[2]) or step(*given))
    first, *events = drive.events()
    fused = fed(started(), drive, [first, *sorted(events, key=lambda event: -event[1])])
    assert len(steps) < 3 * len(events)
    assert snapshot(fused) == snapshot(fed(started(), drive))


def test_odometry_that_was_held_up_does_not_come_once_more():
    drive = FilterDrive(seconds=12)
    held = drive.events(6, 8)
    prompt = [event for event in drive.events() if event not in held]
    cut = next(i for i, event in enumerate(prompt) if event[0] > held[-1][0] + SECOND)
    fused = fed(started(), drive, prompt[:cut] + held + prompt[cut:])
    assert fused.counts['clock went back'] == 0
    assert np.abs(fed(started(), drive).state.mean - fused.state.mean).max() < 0.01


def test_a_long_pause_of_the_recording_is_survived_and_reported():
    drive, fused = FilterDrive(seconds=5), started()
    drive.feed(fused)
    sure = fused.state.position_std
    for step in range(20):
        fused.add_odometry(START_NS + 1000 * SECOND + step * SECOND // 50, 0.0, 0.0)
    assert fused.state.stamp_ns > START_NS + 1000 * SECOND
    assert fused.state.position_std > 10 * sure and fused.status.level is Level.LOST


@pytest.mark.parametrize('ahead_s', [-1e9, -7, 100])
def test_images_of_another_clock_neither_end_the_odometry_nor_go_unnoticed(ahead_s):
    drive, fused = FilterDrive(seconds=8), started()
    for stamp_ns, kind, index in drive.events():
        drive.give(fused, (stamp_ns + kind * int(ahead_s * SECOND), kind, index))
    assert fused.counts['reset'] == fused.counts['clock went back'] == 0
    assert fused.counts['odometry: used'] == len(drive.stamps_ns)
    assert drive.error(fused, -1)[0] < 0.1 and fused.status.level is Level.DEGRADED
    where = 'behind' if ahead_s < 0 else 'ahead of'
    said = f'images are stamped {abs(ahead_s):.1f} s {where} the odometry'
    assert said in ' '.join(fused.status.reasons)
    fused.waited_s = 2.0  # of a program that has no time for its messages
    assert 'stamped' not in ' '.join(fused.status.reasons)
    fused.waited_s = 0.0
    # Once the clocks agree, all is forgotten.
    fused.add_measurement(int(drive.stamps_ns[-1]) + 1, drive.poses[-1, :2], np.eye(2) * 1e-2)
    assert 'stamped' not in ' '.join(fused.status.reasons)


@pytest.mark.parametrize('late_s', [0.3, -0.3, 0.9])
def test_turns_show_by_how_much_images_are_stamped_late(late_s):
    drive, fused, errors = FilterDrive(seconds=90, rate_hz=25, every=4, **NOISY), PoseFilter(), []
    fused.expect(Rig(camera_delay=Quantity(0.0, 0.05)))
    late_ns = round(late_s * 1e9)
    order = sorted(drive.events(), key=lambda event: event[0] + event[1] * max(late_ns, 0))
    for stamp_ns, kind, index in order:
        if kind:
            drive.give_turned(fused, stamp_ns + late_ns, index)
            drive.give(fused, (stamp_ns + late_ns, kind, index), True)
        else:
            drive.give(fused, (stamp_ns, kind, index))
            errors.append(drive.error(fused, index)[0])
    assert fused.camera_clock.delay_s == pytest.approx(late_s, abs=0.05)
    assert fused.state.mean[DELAY] == pytest.approx(late_s, abs=0.1)
    if abs(late_s) > 0.5:
        assert fused.status.level is not Level.LOCALISED
        assert 'synchronize the clocks' in ' '.join(fused.status.reasons)
        fused.waited_s = 2.0
        assert 'synchronize the clocks' not in ' '.join(fused.status.reasons)
        assert 'this computer is too busy' in ' '.join(fused.status.reasons)
    else:
        assert np.mean(errors[-500:]) < 0.15 and fused.status.level is Level.LOCALISED


def test_where_odometry_is_lost_no_other_fault_is_named():
    """As on a computer that is too busy, whose queues overflow: half of each five seconds."""
    drive, fused, said = FilterDrive(seconds=45, rate_hz=25, every=4, **NOISY), started(), set()
    for stamp_ns, kind, index in drive.events():
        if kind or (stamp_ns - drive.stamps_ns[0]) % (5 * SECOND) > 2.4 * SECOND:
            drive.give(fused, (stamp_ns, kind, index), True)
            said.update(fused.status.reasons)
    assert MISSING in said
    named = 'stamped', 'the camera', 'skid', 'times as far', 'different motions'
    assert [text for text in said if any(word in text for word in named)] == []


def test_messages_that_waited_show_no_clock():
    drive, fused = FilterDrive(seconds=60, rate_hz=25, every=4, **NOISY), PoseFilter()
    fused.waited_s = 1.0
    for stamp_ns, kind, index in drive.events():
        if kind:
            drive.give_turned(fused, stamp_ns + SECOND // 4, index)
        drive.give(fused, (stamp_ns, kind, index))
    assert not fused.camera_clock.is_estimated


@pytest.mark.parametrize('ahead_s', [37, -18.0, -3600.5, 0.2])
def test_an_offset_of_clocks_is_used_once_turns_confirm_it(ahead_s):
    drive, fused = FilterDrive(seconds=90, rate_hz=25, every=4, **NOISY), PoseFilter()
    fused.expect(Rig(camera_delay=Quantity(0.0, 0.05)))
    for stamp_ns, kind, index in drive.events(stop=60):
        if kind:  # images arrive 0.12 s late
            shown = max(index - 1, 0)
            stamp_ns = int(drive.stamps_ns[drive.pictures[shown]]) + round(ahead_s * SECOND)
            drive.give_turned(fused, stamp_ns, shown)
            update = drive.give(fused, (stamp_ns, 1, shown), True)
        else:
            drive.give(fused, (stamp_ns, 0, index))
    assert fused.status.level is Level.LOCALISED and fused.status.reasons == ()
    assert drive.error(fused, index)[0] < 0.2 and abs(update.stamp_ns - stamp_ns) < SECOND
    said = [name for name in fused.counts if name.startswith('images: stamped')]
    assert len(said) == (abs(ahead_s) > 1)


def test_images_that_only_arrive_late_are_not_taken_for_those_of_another_clock():
    drive, fused = FilterDrive(seconds=60, rate_hz=25, every=4, **NOISY), started()
    events = sorted(drive.events(), key=lambda event: event[0] + event[1] * 8 * SECOND)
    for stamp_ns, kind, index in events:
        if kind:
            drive.give_turned(fused, stamp_ns, index)
        drive.give(fused, (stamp_ns, kind, index), True)
    assert not any(name.startswith('images: stamped') for name in fused.counts)


def test_a_delay_that_turns_contradict_gives_way_and_the_pose_follows():
    mean, covariance = np.zeros(SIZE), np.eye(SIZE)
    covariance[DELAY, DELAY] = covariance[0, DELAY] = covariance[DELAY, 0] = 0.05**2  # at 1 m/s
    blank = Ekf(FilterConfig(), ErrorCorrelation()).blank(SECOND)
    belief = blank._replace(mean=mean, covariance=covariance, located=True)
    assert replaced(belief, DELAY, Quantity(0.1, 0.05)) is belief  # 1.4 standard deviations
    after = replaced(belief, DELAY, Quantity(-0.3, 0.02))
    assert after.mean[[0, DELAY]] == pytest.approx([-0.3, -0.3])
    assert after.covariance[[0, 0, DELAY], [0, DELAY, DELAY]] == pytest.approx(
        [1 + 0.02**2 - 0.05**2, 0.02**2, 0.02**2]
    )
    assert np.array_equal(after.covariance[1:3], covariance[1:3])


# Consistency; see also test_filter_consistency.py.


@pytest.mark.parametrize('size', [2, 3])
def test_an_update_is_that_of_filterpy(size):
    reference, rng = ExtendedKalmanFilter(SIZE, size), np.random.default_rng(size)
    root, jacobian = rng.normal(size=(SIZE, SIZE)), rng.normal(size=(size, SIZE))
    blank = Ekf(FilterConfig(), ErrorCorrelation()).blank(SECOND)
    belief = blank._replace(mean=0.1 * rng.normal(size=SIZE), covariance=root @ root.T)
    z, noise = 0.1 * rng.normal(size=size), np.diag(rng.uniform(0.1, 1.0, size))
    reference.x, reference.P = belief.mean, belief.covariance
    reference.update(z, lambda _: jacobian, jacobian.dot, noise)
    reference.x[2] = wrap_angle(reference.x[2])
    d2 = reference.y @ reference.SI @ reference.y
    expected = reference.x, reference.P, reference.y, reference.S, d2
    for ours, theirs in zip(Kalman().corrected(belief, z, jacobian, noise), expected, strict=True):
        assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)


def test_standing_still_neither_drifts_nor_becomes_overconfident():
    drive, rng = FilterDrive(seconds=5, **NOISY), np.random.default_rng(0)
    fused = fed(started(), drive)
    before = fused.state
    stamp, wrong = int(drive.stamps_ns[-1]), drive.seen[-1] + [0.15, -0.15, 0.02]
    fused.add_odometry(stamp + SECOND // 10, 0.0, 0.0, (4e-4, 1e-4))
    for k in range(1, 1200):
        fused.add_odometry(stamp + k * SECOND, 0.0, 0.0, (4e-4, 1e-4))
        seen = wrong + 0.02 * rng.standard_normal(3)
        fused.add_measurement(stamp + k * SECOND + 1, seen, np.diag([0.04, 0.04, 0.0025]))
    # The deviation of white errors alone would have shrunk by a factor of 100.
    assert fused.state.position_std > 0.5 * before.position_std
    assert math.dist(fused.state.pose[:2], before.pose[:2]) < 2 * before.position_std
    assert fused.status.level is not Level.LOST


def test_covariance_stays_symmetric_positive_over_a_long_run():
    drive, fused = FilterDrive(seconds=120, rate_hz=20, every=4, **NOISY), started()
    for event in drive.events():
        drive.give(fused, event, True)
        if event[2] % 100 == 0:
            covariance = fused.state.covariance
            assert np.array_equal(covariance, covariance.T)
            assert np.linalg.eigvalsh(covariance)[0] > 0


def test_it_learns_bias_and_scale_and_beats_images_and_odometry():
    drive = FilterDrive(seconds=60, **{**NOISY, 'bias': 0.03, 'scale': 1.08})
    fused, blind = started(), started()
    errors = [error for _, _, error, _ in drive.feed(fused)]
    drive.feed(blind, pictures=False)
    alone = distances(drive.seen, drive.poses[drive.pictures])
    assert np.mean(errors) < 0.7 * alone.mean() and errors[-1] < drive.error(blind, -1)[0]
    assert fused.state.yaw_rate_bias == pytest.approx(0.03, abs=0.008)
    assert fused.state.wheel_scale == pytest.approx(1.08, abs=0.04)


@pytest.mark.parametrize('factor', [0.6, 0.8, 1.3, 1.7])
def test_it_learns_by_how_much_tracks_skid_in_turns(factor):
    """The odometry turns so many times as far as the robot; nobody told the filter."""
    drive, fused, errors = FilterDrive(seconds=60, rate_hz=25, **NOISY), started(), []
    drive.read[:, 1] *= factor
    drive.reckoned = integrate(drive.stamps_ns, drive.read)
    for stamp_ns, kind, index in drive.events():
        if kind:
            drive.give_turned(fused, stamp_ns, index)
        drive.give(fused, (stamp_ns, kind, index), True)
        if not kind:
            errors.append(drive.error(fused, index)[0])
    assert fused.status.level is Level.LOCALISED and np.mean(errors) < 0.1
    assert fused.state.turn_factor == pytest.approx(1 / factor, rel=0.06)
    clock = fused.camera_clock
    assert clock.turn_factor.value == pytest.approx(1 / factor, rel=0.06)
    assert abs(clock.delay_s) < 0.05


def test_images_that_lie_off_pull_less():
    """Though they are inside the gate: errors of images have heavy tails."""
    drive, pulls = FilterDrive(seconds=5, position_std=0.2, yaw_std=0.05), []
    for off_m in (0.2, 0.45):
        fused = fed(started(), drive)
        before = fused.state.pose
        seen = compose(before, np.array([0.0, off_m, 0.0]))
        update = fused.add_measurement(fused.state.stamp_ns + 1, seen, drive.covariance(True))
        assert update.accepted
        pulls.append(math.dist(fused.state.pose[:2], before[:2]))
    assert 0 < pulls[1] < pulls[0]


@pytest.mark.parametrize(('share', 'length_m'), [(0.3, LEAST_M), (0.7, 1e6)])
def test_parameters_and_errors_of_the_model_change_without_losing_the_estimate(share, length_m):
    fused, drive = started(), FilterDrive(seconds=20, position_std=0.05, yaw_std=0.02)
    drive.feed(fused, True, stop=10)
    before, correlation = snapshot(fused), ErrorCorrelation(share, length_m)
    fused.reconfigure(replace(fused.config, measurement_factor=4.0))
    fused.reconfigure(correlation=correlation)
    assert snapshot(fused) == before and fused.correlation == correlation
    assert all(update.accepted for _, update, _, _ in drive.feed(fused, True, start=10))
    assert np.isfinite(fused.state.covariance).all() and drive.error(fused, -1)[0] < 0.15


# The gate.


@pytest.mark.parametrize(('off', 'heading'), [
    ((3.0, 3.0, 0.0), True), ((3.0, 3.0, 0.0), False), ((0.0, 0.0, 1.0), True),
])  # fmt: skip
def test_a_spike_is_rejected_and_moves_nothing(off, heading):
    drive = FilterDrive(seconds=15, **NOISY)
    drive.seen[100] = drive.seen[100] + off
    outcomes = drive.feed(started(), heading)
    update = outcomes[100][1]
    assert not update.accepted and update.reason == 'outside the gate'
    assert update.d2 > update.threshold and max(error for _, _, error, _ in outcomes) < 0.6


@either
def test_a_sustained_offset_is_believed_in_the_end_but_no_images_in_disagreement(heading):
    drive, other = FilterDrive(seconds=25, **NOISY), FilterDrive(seconds=25, **NOISY)
    drive.seen[150:, :2] += [1.5, 0.0]
    outcomes = drive.feed(started(), heading)
    assert not outcomes[152][1].accepted and abs(outcomes[-1][2] - 1.5) < 0.5
    other.seen[150:180, :2] += np.random.default_rng(3).uniform(-8, 8, (30, 2))
    outcomes = other.feed(started(), heading)
    assert max(error for _, _, error, _ in outcomes) < 1.0 and outcomes[-1][2] < 0.5


@pytest.mark.parametrize(('outage', 'heading'), [(5.0, True), (30.0, False)])
def test_a_cluster_of_wrong_images_after_an_outage_is_not_trusted_at_once(outage, heading):
    drive, fused = FilterDrive(seconds=60, **NOISY), started()
    drive.feed(fused, heading, stop=15)
    first = int(np.searchsorted(drive.pictures, (15 + outage) * 50))
    drive.seen[first : first + 12, :2] += [3.0, 4.0]
    for event in drive.events(15):
        if event[1] == 0 or event[2] >= first:
            drive.give(fused, event, heading)
            if event[1] and event[2] < first + 5:
                assert fused.status.level is not Level.LOCALISED
    assert drive.error(fused, -1)[0] < 0.5 and fused.status.level is Level.LOCALISED


# Start and recovery.


def test_one_picture_with_heading_starts_at_once_and_one_that_is_wrong_is_outvoted():
    drive, fused = FilterDrive(seconds=5, start=(4.0, -3.0, 2.0), **NOISY), PoseFilter()
    assert fused.state is None and fused.status.level is Level.UNINITIALISED
    outcomes = drive.feed(fused, heading=True)
    assert outcomes[0][1].accepted and outcomes[0][1].reason == 'started'
    assert outcomes[-1][2] < 0.6 and abs(outcomes[-1][3]) < 0.2
    drive = FilterDrive(seconds=5, **NOISY)
    drive.seen[0] = [9.0, 9.0, 2.0]
    outcomes = drive.feed(PoseFilter(), heading=True)
    assert outcomes[0][1].accepted and not outcomes[1][1].accepted and outcomes[3][2] < 0.8


@pytest.mark.parametrize('stds', [(2.5, 0.1, 0.1), (0.1, 2.5, 0.1), (0.1, 0.1, 0.9)])
def test_an_uncertain_image_does_not_start_the_filter(stds):
    fused = PoseFilter()
    update = fused.add_measurement(START_NS, [1, 2, 0], np.diag(np.square(stds)))
    assert update.reason == 'too uncertain to start from' and fused.state is None
    sure = fused.add_measurement(START_NS + 1, [1, 2, 0], np.diag(np.square([1.5, 1.5, 0.5])))
    assert sure.accepted and fused.status.level is Level.DEGRADED


@pytest.mark.parametrize(('heading', 'images'), [(True, 5), (False, 30)])
def test_a_kidnapped_robot_knows_that_it_is_lost_and_recovers(heading, images):
    """After five images, or three meters where they have no heading."""
    drive, fused = FilterDrive(seconds=30, **NOISY), started()
    drive.kidnap(150, (5.0, -4.0, 2.0))
    outcomes = drive.feed(fused, heading, stop=15.6)
    error, _ = drive.error(fused, np.searchsorted(drive.stamps_ns, fused.state.stamp_ns))
    if not heading:
        assert 4 < error < 4 * fused.state.position_std and fused.status.level is Level.LOST
    outcomes += drive.feed(fused, heading, start=15.6)
    assert any(update.reason == 'restarted elsewhere' for _, update, _, _ in outcomes)
    assert max(error for _, _, error, _ in outcomes[150 + images :]) < 1.2
    assert outcomes[-1][2] < 0.6 and fused.status.level is Level.LOCALISED


# Poses from outside, and settings.


@pytest.mark.parametrize('stamp', [1, START_NS + 10**6 * SECOND, None, 'later'])
def test_a_pose_from_outside_is_taken_at_any_time(stamp):
    """Also before the first message, by its own clock, and where the filter was wrong."""
    pose = (3.0, 1.0, math.pi)
    drive = FilterDrive(seconds=5, start=pose)
    fused = PoseFilter(FilterConfig(initial_pose=() if stamp else pose))
    if stamp == 'later':
        fused.set_pose(START_NS, (50.0, 50.0, 1.0), np.eye(3))
        drive.feed(fused, stop=2.5, pictures=False)
        fused.set_pose(fused.state.stamp_ns, drive.poses[124], np.eye(3) * 1e-4)
    elif stamp:
        fused.set_pose(stamp, pose, np.eye(3) * 1e-4)
    drive.feed(fused, start=2.5 if stamp == 'later' else 0, pictures=False)
    assert drive.error(fused, -1)[0] < 1e-6


def test_a_malformed_pose_and_parameters_that_do_not_fit_are_rejected():
    for pose in ((math.nan, 0, 0), (0, 0), (1e12, 0, 0)):
        with pytest.raises(DataError):
            PoseFilter().set_pose(1, pose)
    with pytest.raises(DataError):
        PoseFilter().set_pose(1, (0, 0, 0), -np.eye(3))
    for values, why in (
        ({'degraded_std': 3.0}, 'degraded_std'), ({'odometry_factor': 0.0}, 'outside'),
        ({'speed_std': math.nan}, 'finite'), ({'initial_pose': ('x', 2.0, 3.0)}, 'initial_pose'),
        ({'initial_pose': (1.0, 2.0)}, '2 numbers given; give x'),
        ({'initial_pose': (1.0, 2.0, 90.0)}, 'give radians'),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=why):
            FilterConfig(**values)


# Bad input and silence.

SHAPE = 'shape is not that of a position or a pose'
NOT_POSITIVE, FAST = 'covariance is not symmetric positive', 'not finite, or absurdly fast'


def test_what_cannot_be_used_is_counted_and_changes_nothing():
    fused = fed(started(), FilterDrive(seconds=12))
    before, newest, counted = snapshot(fused), fused.state.stamp_ns, dict(fused.counts)
    taken = START_NS + 5 * (SECOND // 50) * (599 // 5)
    for stamp_ns, value, covariance, reason in (
        (newest + 1, [math.nan, 0], np.eye(2), 'position is not finite'),
        (newest + 1, [1e300, 0], np.eye(2), 'position is not finite'),
        (newest + 1, [0, 0], [[1, 5], [5, 1]], NOT_POSITIVE),
        (newest + 1, [0, 0], [[1, 0.5], [0, 1]], NOT_POSITIVE),
        (newest + 1, [0, 0], np.full((2, 2), math.nan), NOT_POSITIVE),
        (newest + 1, [0, 0], np.eye(2) * 1e9, 'covariance means that nothing is known'),
        (newest + 1, [0, 0, 0, 0], np.eye(4), SHAPE),
        (newest + 1, [0, 0], np.eye(3), SHAPE),
        (START_NS + SECOND, [0, 0], np.eye(2), 'too old'),
        (taken, [9, 9], np.eye(2), 'duplicate stamp'),
    ):
        update = fused.add_measurement(stamp_ns, value, covariance)
        assert not update.accepted and update.reason == reason
        counted[f'measurement: {reason}'] = counted.get(f'measurement: {reason}', 0) + 1
    for stamp_ns, v, reason in (
        (newest + 1, math.nan, FAST), (newest + 1, 1e6, FAST), (0, 1.0, 'zero or negative stamp'),
        (START_NS + SECOND, 1.0, 'too old'), (newest, 5.0, 'duplicate stamp'),
    ):  # fmt: skip
        assert fused.add_odometry(stamp_ns, v, 0.0) == reason
        counted[f'odometry: {reason}'] = counted.get(f'odometry: {reason}', 0) + 1
    assert snapshot(fused) == before and dict(fused.counts) == counted
    fused.reset()
    assert fused.state is None and dict(fused.counts) == {**counted, 'reset': 1}


@pytest.mark.parametrize('variances', [(0, 0), (math.nan, math.inf), (1e300, 1e3)])
def test_unusable_variances_give_way_to_the_configured_ones(variances):
    fused, plain, drive = started(), started(), FilterDrive(seconds=2)
    for i, stamp in enumerate(drive.stamps_ns):
        fused.add_odometry(int(stamp), *drive.read[i], variances)
        plain.add_odometry(int(stamp), *drive.read[i])
    assert snapshot(fused) == snapshot(plain)


def test_a_heading_that_is_not_known_is_left_out_and_zero_covariance_is_unknown_not_certain():
    drive = FilterDrive(seconds=2)
    with_unknown, without = fed(started(), drive), fed(started(), drive)
    stamp, (x, y, _) = int(drive.stamps_ns[-1]) + 1, drive.poses[-1]
    flat = np.diag([0.04, 0.04, math.pi**2 / 3])
    with_unknown.add_measurement(stamp, [x, y, math.nan], flat)
    without.add_measurement(stamp, [x, y], flat[:2, :2])
    assert snapshot(with_unknown) == snapshot(without)
    update = without.add_measurement(stamp + 1, [50.0, 0.0], np.zeros((2, 2)))
    assert not update.accepted and without.state.position_std > 0.01


def test_odometry_alone_carries_it_through_an_outage_of_the_images_and_the_state_says_why():
    drive, fused = FilterDrive(seconds=20, **NOISY), PoseFilter()
    for start, stop, pictures, level, reasons in (
        (0, 0, True, Level.UNINITIALISED, ('no odometry and no images yet',)),
        (0, 0.05, True, Level.UNINITIALISED, ('no usable image yet',)),
        (0.05, 10, True, Level.LOCALISED, ()),
        (10, 14, False, Level.DEGRADED, ('no usable image for 4 s',)),
        (14, 20, True, Level.LOCALISED, ()),
    ):
        drive.feed(fused, True, start, stop, pictures)
        assert fused.status.level is level and fused.status.reasons == reasons


def test_images_alone_carry_it_through_an_outage_of_the_odometry():
    drive, fused = FilterDrive(seconds=30, **NOISY), started()
    drive.feed(fused, heading=True, stop=10)
    fed(fused, drive, [event for event in drive.events(10, 20) if event[1]])
    assert fused.status.level is not Level.LOCALISED and drive.error(fused, 999)[0] < 1.0
    assert 'no odometry' in ' '.join(fused.status.reasons)
    outcomes = drive.feed(fused, heading=True, start=20)
    assert outcomes[-1][2] < 0.5 and fused.status.level is Level.LOCALISED
    # After a pause of both, some images are too far ahead; then it goes on with them.
    last = fused.state.stamp_ns
    reasons = [fused.add_measurement(last + (20 + k) * SECOND, [0.0, 0.0], np.eye(2)).reason
               for k in range(4)]  # fmt: skip
    assert reasons[:2] == ['stamp ahead of those before'] * 2
    assert 'stamp' not in reasons[2] + reasons[3]


def through_a_gap(pose=None):
    """Straight on at 0.5 m/s; unseen for 1 s, after which the odometry is at a pose; the state."""
    fused = started(std=0.02)
    for k in range(11):
        at = None if pose is None else (0.05 * k, 0.0, 0.0)
        fused.add_odometry(START_NS + k * SECOND // 10, 0.5, 0.0, (1e-4, 1e-4), at)
    for k in range(-2, 1):  # a single message so far ahead could be wrong
        at = None if pose is None else compose(np.array(pose), np.array([0.01 * k, 0.0, 0.0]))
        fused.add_odometry(START_NS + 2 * SECOND + k * SECOND // 50, 0.5, 0.0, (1e-4, 1e-4), at)
    return fused.state


def test_the_pose_of_the_odometry_bridges_its_gaps_and_speed_alone_is_uncertain():
    unseen, straight = through_a_gap(), through_a_gap((1.0, 0.0, 0.0))
    for state in (unseen, straight, reset := through_a_gap((0.0, 0.0, 2.5))):
        assert state.pose == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert straight.yaw_std < 0.05 and straight.position_std < 0.08
    assert 0.4 < unseen.yaw_std < 0.7 and 0.4 < unseen.position_std < 0.7
    assert reset.yaw_std > 0.25
    turned = through_a_gap((0.9, 0.2, 0.8))
    assert turned.pose == pytest.approx([0.9, 0.2, 0.8], abs=0.05)


def test_the_filter_begins_with_the_robot_that_training_learned():
    rig = Rig(wheel_scale=Quantity(1.05, 0.01), turn_loss=Quantity(0.08, 0.004))
    fused = PoseFilter()
    fused.expect(rig)
    fused.set_pose(START_NS, (0.0, 0.0, 0.0), np.diag([1e-4] * 3))
    stds = np.sqrt(fused.state.covariance.diagonal()[[LOSS, SCALE]])
    assert stds == pytest.approx([0.004, 0.01 / 1.05])
    for k in range(1, 51):  # in an arc: 1 m counted, less 0.08 m per radian
        fused.add_odometry(START_NS + k * 20_000_000, 1.0, 0.5)
    chord = (1.05 - 0.08 * 0.5) * np.sin(0.25) / 0.25
    assert np.hypot(*fused.state.pose[:2]) == pytest.approx(chord, abs=0.002)
