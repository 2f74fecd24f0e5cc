# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The filter as a whole: exact on exact data, consistent on noisy data, and hard to fool."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from filter_drives import START_NS, Drive, winding
from scipy.stats import chi2

from sfa_localization.data.error_correlation import LEAST_M, ErrorCorrelation
from sfa_localization.data.errors import ConfigError, DataError
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.fusion import inputs, motion, recover
from sfa_localization.fusion import update as update_module
from sfa_localization.fusion.belief import LARGEST_STD_M
from sfa_localization.fusion.pace import TOLERATED_S
from sfa_localization.fusion.pose_filter import HISTORY_S, Level, PoseFilter
from sfa_localization.fusion.settings import FilterConfig

SECOND = 1_000_000_000
NOISY = {
    'v_std': 0.02, 'omega_std': 0.01, 'position_std': 0.2, 'yaw_std': 0.05, 'share': 0.7,
    'bias': 0.002, 'scale': 1.01,
}  # fmt: skip


def known(config=None, pose=(0.0, 0.0, 0.0), std=0.05):
    fused = PoseFilter(config)
    fused.set_pose(START_NS, pose, np.diag([std**2, std**2, std**2]))
    return fused


def snapshot(fused):
    state = fused.state
    return state.stamp_ns, state.mean.tolist(), state.covariance.tolist()


# Exactness.


@pytest.mark.parametrize('heading', [True, False])
@pytest.mark.parametrize('start', [(0, 0, 0), (3.0, -2.0, math.pi), (0, 0, -math.pi + 1e-3)])
def test_exact_data_gives_zero_error(heading, start):
    drive = Drive(seconds=20, start=start)
    fused = known(pose=start)
    assert max(error for _, _, error, _ in drive.feed(fused, heading)) < 1e-6
    assert all(update.accepted for _, update, _, _ in drive.feed(known(pose=start), heading))


@pytest.mark.parametrize('speed', [1.0, -0.7])
@pytest.mark.parametrize('turn', [0.0, 1e-7, 0.8])
def test_exact_data_straight_turning_and_reversing(speed, turn):
    drive = Drive(twists=np.tile([speed, turn], (500, 1)))
    fused = known()
    assert max(error for _, _, error, _ in drive.feed(fused)) < 1e-6


def test_dead_reckoning_is_the_integral_of_the_odometry():
    drive = Drive(seconds=10)
    fused = known()
    drive.feed(fused, pictures=False)
    assert np.allclose(fused.state.pose, drive.poses[-1], atol=1e-9)


@pytest.mark.parametrize('askew', [0.0, math.pi / 2, -2.0])
def test_odometry_whose_pose_is_headed_off_its_motion_gives_way_to_its_twist(askew):
    """As of a pose in another frame than the twist, from the start or after a reset."""
    drive, fused = Drive(seconds=10), known()
    for i, stamp_ns in enumerate(drive.stamps_ns.tolist()):
        x, y, yaw = drive.reckoned[i].tolist()
        pose = (x, y, float(wrap_angle(yaw + askew)))
        fused.add_odometry(stamp_ns, *drive.read[i], drive.variances(), pose)
    assert np.allclose(fused.state.pose, drive.poses[-1], atol=1e-3)


# Delay and order.


@pytest.mark.parametrize('heading', [True, False])
@pytest.mark.parametrize('late_s', [TOLERATED_S, 2.0])
@pytest.mark.parametrize('seed', range(3))
def test_shuffled_and_late_messages_give_what_messages_in_time_give(heading, late_s, seed):
    drive = Drive(seconds=20, **NOISY, seed=seed)
    drive.seen[40:44, :2] += 3.0
    rng = np.random.default_rng(seed)
    ordered, late = known(), known()
    for event in drive.events():
        drive.give(ordered, event, heading)
    # Pictures come late, odometry up to 0.1 s: then in the order of arrival.
    delays = [rng.uniform(0, late_s if kind else 0.1) * 1e9 for _, kind, _ in drive.events()]
    arrivals = sorted(zip(drive.events(), delays, strict=True), key=lambda e: e[0][0] + e[1])
    for event, _ in arrivals:
        drive.give(late, event, heading)
    assert np.abs(ordered.state.mean - late.state.mean).max() < 1e-9
    # Images that arrive too late are suspected of having been stamped early.
    if late_s <= TOLERATED_S:
        assert np.abs(ordered.state.covariance - late.state.covariance).max() < 1e-9
        assert ordered.status == late.status
    assert set(ordered.status.reasons) <= set(late.status.reasons)


def test_the_same_messages_give_the_same_bytes():
    drive = Drive(seconds=10, **NOISY)
    first, second = known(), known()
    drive.feed(first)
    drive.feed(second)
    assert snapshot(first) == snapshot(second)


def test_what_is_older_than_the_history_is_rejected_and_counted():
    drive = Drive(seconds=20)
    fused = known()
    drive.feed(fused)
    before = snapshot(fused)
    update = fused.add_measurement(START_NS + SECOND, [0, 0], np.eye(2))
    assert not update.accepted and update.reason == 'too old'
    assert fused.add_odometry(START_NS + SECOND, 1.0, 0.0) == 'too old'
    assert fused.counts['measurement: too old'] == fused.counts['odometry: too old'] == 1
    assert snapshot(fused) == before


def test_duplicate_stamps_are_rejected_and_counted():
    drive = Drive(seconds=2)
    fused = known()
    drive.feed(fused)
    before = snapshot(fused)
    newest = int(drive.stamps_ns[-1])
    assert fused.add_odometry(newest, 5.0, 5.0) == 'duplicate stamp'
    stamp = int(drive.stamps_ns[drive.pictures[-1]])
    assert fused.add_measurement(stamp, [9, 9], np.eye(2)).reason == 'duplicate stamp'
    assert snapshot(fused) == before


@pytest.mark.parametrize('seconds', [60, 2])
def test_a_bag_that_loops_starts_the_filter_anew(seconds):
    config = FilterConfig(initial_pose=(0.0, 0.0, 0.0))
    drive = Drive(seconds=seconds)
    once, looped = PoseFilter(config), PoseFilter(config)
    drive.feed(once)
    drive.feed(looped)
    drive.feed(looped)
    assert looped.counts['clock went back'] == 1
    # A few messages were spent on noticing; the end is that of a drive begun after them.
    assert np.allclose(looped.state.pose, once.state.pose, atol=0.2)
    assert looped.state.stamp_ns == once.state.stamp_ns
    assert looped.status.level is Level.LOCALISED


@pytest.mark.parametrize('back_s', [0.83, 1.71, 2.303])
def test_a_clock_that_goes_back_by_less_than_the_history_starts_the_filter_anew(back_s):
    drive, fused = Drive(seconds=20), known()
    sure = []
    for stamp_ns, kind, index in drive.events():
        after_s = (stamp_ns - START_NS) * 1e-9 - 10.0
        if after_s >= 0:
            stamp_ns -= round(back_s * 1e9)
        if kind == 0:
            fused.add_odometry(stamp_ns, *drive.read[index], drive.variances())
        else:
            fused.add_measurement(stamp_ns, drive.seen[index], drive.covariance(True))
        if 0 <= after_s < 1 and fused.status.level is Level.LOCALISED:
            sure.append(after_s)
    assert max(sure) < 0.1
    assert fused.counts['clock went back'] == 1
    assert fused.status.level is Level.LOCALISED
    assert drive.error(fused, -1)[0] < 0.05


@pytest.mark.parametrize('held_s', [0.5, 2.0])
def test_odometry_that_was_held_up_does_not_come_once_more(held_s):
    drive, fused, ordered = Drive(seconds=12), known(), known()
    held = [event for event in drive.events() if 0 <= (event[0] - START_NS) * 1e-9 - 6 < held_s]
    prompt = [event for event in drive.events() if event not in held]
    cut = next(i for i, event in enumerate(prompt) if event[0] > held[-1][0] + SECOND)
    for event in prompt[:cut] + held + prompt[cut:]:
        drive.give(fused, event)
    for event in drive.events():
        drive.give(ordered, event)
    assert fused.counts['clock went back'] == 0
    assert np.abs(ordered.state.mean - fused.state.mean).max() < 1e-9


def test_one_stamp_far_ahead_does_no_harm():
    drive = Drive(seconds=4)
    fused = known()
    drive.feed(fused, stop=2)
    before = snapshot(fused)
    ahead = START_NS + 10**6 * SECOND
    assert fused.add_odometry(ahead, 1.0, 0.0) == 'stamp far ahead'
    assert fused.add_measurement(ahead + SECOND, [0, 0], np.eye(2)).reason == 'stamp far ahead'
    assert snapshot(fused) == before
    assert all(update.accepted for _, update, _, _ in drive.feed(fused, start=2))


def test_stamps_far_ahead_are_believed_only_in_a_row():
    """A driver that spoils one stamp in a second must not start the filter anew."""
    drive = Drive(seconds=8)
    fused = known()
    for number, event in enumerate(drive.events()):
        drive.give(fused, event)
        if number % 20 == 19:
            assert fused.add_odometry(START_NS + 7200 * SECOND, 1.0, 0.0) == 'stamp far ahead'
    assert fused.counts['gap in time'] == fused.counts['reset'] == 0
    assert fused.status.level is Level.LOCALISED


def test_a_long_pause_of_the_recording_is_survived_and_reported():
    drive = Drive(seconds=10)
    fused = known()
    drive.feed(fused, stop=5)
    sure = fused.state.position_std
    for step in range(20):
        stamp = START_NS + 1000 * SECOND + step * SECOND // 50
        fused.add_odometry(stamp, 0.0, 0.0)
    assert fused.counts['gap in time'] == 1
    assert fused.state.position_std > 10 * sure
    assert fused.status.level is Level.LOST


@pytest.mark.parametrize('apart_s', [-1e9, -100, -7, 7, 100])
def test_images_of_another_clock_neither_end_the_odometry_nor_go_unnoticed(apart_s):
    drive = Drive(seconds=8)
    fused = known()
    for stamp_ns, kind, index in drive.events():
        if kind == 0:
            drive.give(fused, (stamp_ns, kind, index))
        else:
            stamp_ns = int(stamp_ns + apart_s * SECOND)
            fused.add_measurement(stamp_ns, drive.seen[index, :2], np.eye(2))
    assert fused.counts['reset'] == fused.counts['clock went back'] == 0
    assert fused.counts['odometry: used'] == len(drive.stamps_ns)
    assert drive.error(fused, -1)[0] < 0.1
    assert fused.status.level is Level.DEGRADED
    where = 'behind' if apart_s < 0 else 'ahead of'
    said = f'images are stamped {abs(apart_s):.0f} s {where} the odometry'
    assert any(said in reason for reason in fused.status.reasons)
    # Once the clocks agree, all is forgotten.
    drive.feed(fused, start=8 - 0.11)
    fused.add_measurement(int(drive.stamps_ns[-1]) + 1, drive.poses[-1, :2], np.eye(2) * 1e-2)
    assert not any('stamped' in reason for reason in fused.status.reasons)


def test_after_a_pause_images_alone_go_on():
    drive = Drive(seconds=2)
    fused = known()
    drive.feed(fused)
    reasons = [
        fused.add_measurement(START_NS + (20 + k) * SECOND, [0.0, 0.0], np.eye(2)).reason
        for k in range(4)
    ]
    assert reasons[:2] == ['stamp ahead of the odometry'] * 2
    assert 'stamp' not in reasons[2] and 'stamp' not in reasons[3]


def test_prediction_to_a_stamp_recalls_and_extrapolates():
    drive = Drive(twists=np.tile([1.0, 0.0], (200, 1)))
    fused = known()
    drive.feed(fused, pictures=False)
    newest = int(drive.stamps_ns[-1])
    assert fused.at(newest).pose[0] == pytest.approx(199 / 50, abs=1e-6)
    assert fused.at(newest + SECOND // 10).pose[0] == pytest.approx(199 / 50 + 0.1, abs=1e-6)
    assert fused.at(newest - SECOND).pose[0] == pytest.approx(149 / 50, abs=1e-6)
    assert fused.at(newest + SECOND).position_std > fused.state.position_std
    assert fused.at(newest - 100 * SECOND) is None


# Consistency.


def consistency(drive, fused, heading):
    """Mean NEES of the pose, mean NIS over degrees of freedom, of one drive."""
    nees, nis = [], []
    for event in drive.events():
        update = drive.give(fused, event, heading)
        if not event[1]:
            continue
        if math.isfinite(update.d2):
            nis.append(update.d2 / (3 if heading else 2))
        miss = fused.state.pose - drive.poses[drive.pictures[event[2]]]
        miss[2] = wrap_angle(miss[2])
        nees.append(miss @ np.linalg.solve(fused.state.pose_covariance, miss))
    return np.mean(nees[len(nees) // 2 :]), np.mean(nis)


WHITE = FilterConfig(slip_per_metre=0.0, yaw_per_radian=0.0)


@pytest.fixture
def white(monkeypatch):
    """A filter for robots whose odometry has white errors, a bias and a scale, and no others."""
    for name in ('ODOMETRY_CORRELATION_S', 'YAW_PER_METER', 'BIAS_WALK', 'SCALE_WALK'):
        monkeypatch.setattr(motion, name, 0.0)
    for name in ('SPEED_STD_FLOOR', 'RATE_STD_FLOOR'):
        monkeypatch.setattr(inputs, name, 1e-4)
    monkeypatch.setattr(recover, 'BIAS_STD', 0.005)
    monkeypatch.setattr(recover, 'SCALE_STD', 0.02)
    monkeypatch.setattr(update_module, '_GATES', {2: 27.6, 3: 30.7})  # one in a million outside
    return lambda: PoseFilter(WHITE, ErrorCorrelation(0.7, 0.6))


@pytest.mark.parametrize('heading', [True, False])
def test_errors_and_innovations_are_as_large_as_claimed_over_100_seeds(heading, white):
    nees, nis = [], []
    for seed in range(100):
        rng = np.random.default_rng(1000 + seed)
        drive = Drive(
            seconds=12, rate_hz=20, every=2, v_std=0.05, omega_std=0.05, position_std=0.2,
            yaw_std=0.05, share=0.7, length=0.6, bias=0.005 * rng.standard_normal(),
            scale=1 + 0.02 * rng.standard_normal(), seed=seed,
        )  # fmt: skip
        fused = white()
        start = rng.standard_normal(3) * [0.1, 0.1, 0.05]
        fused.set_pose(START_NS, start, np.diag(np.square([0.1, 0.1, 0.05])))
        one, other = consistency(drive, fused, heading)
        nees.append(one)
        nis.append(other)
    # One drive's mean NEES is at worst one sample of chi2(3): their mean lies in chi2(300) / 100.
    low, high = chi2.ppf([0.001, 0.999], 300) / 100
    assert low < np.mean(nees) < high
    assert 0.93 < np.mean(nis) < 1.07


def test_standing_still_neither_drifts_nor_becomes_overconfident():
    drive = Drive(seconds=5, **NOISY)
    fused = known()
    drive.feed(fused, heading=True)
    before = fused.state
    stamp, wrong = int(drive.stamps_ns[-1]), drive.seen[-1] + [0.15, -0.15, 0.02]
    rng = np.random.default_rng(0)
    fused.add_odometry(stamp + SECOND // 10, 0.0, 0.0, (4e-4, 1e-4))
    for k in range(1, 3600):
        fused.add_odometry(stamp + k * SECOND, 0.0, 0.0, (4e-4, 1e-4))
        seen = wrong + 0.02 * rng.standard_normal(3)
        fused.add_measurement(stamp + k * SECOND + 1, seen, np.diag([0.04, 0.04, 0.0025]))
    after = fused.state
    # The deviation of white errors alone would have shrunk by a factor of 100.
    assert after.position_std > 0.5 * before.position_std
    assert math.dist(after.pose[:2], before.pose[:2]) < 2 * before.position_std
    assert fused.status.level is not Level.LOST


def test_covariance_stays_symmetric_positive_over_a_long_run():
    fused = known()
    twists = winding(120, 50.0)
    drive = Drive(twists=twists, **NOISY, every=10)
    lap = int(drive.stamps_ns[-1] - drive.stamps_ns[0]) + SECOND // 50
    seen = {int(i): k for k, i in enumerate(drive.pictures)}
    for k in range(40_000):
        i, stamp = (
            k % len(twists),
            START_NS + (k // len(twists)) * lap + int(drive.stamps_ns[k % len(twists)] - START_NS),
        )
        fused.add_odometry(stamp, *drive.read[i], (4e-4, 1e-4))
        if i in seen:
            fused.add_measurement(stamp, fused.state.pose, np.diag([0.04, 0.04, 0.0025]))
        if k % 1000 == 0:
            covariance = fused.state.covariance
            assert np.array_equal(covariance, covariance.T)
            assert np.linalg.eigvalsh(covariance)[0] > 0
    assert fused.counts['odometry: used'] == 40_000


def test_bias_and_scale_are_learnt():
    drive = Drive(seconds=120, v_std=0.01, omega_std=0.005, position_std=0.1, yaw_std=0.03,
                  share=0.7, bias=0.01, scale=1.03)  # fmt: skip
    learning = known()
    drive.feed(learning, heading=True)
    assert learning.state.yaw_rate_bias == pytest.approx(0.01, abs=0.002)
    assert learning.state.wheel_scale == pytest.approx(1.03, abs=0.01)


def test_it_beats_images_and_odometry():
    drive = Drive(seconds=60, **NOISY)
    fused, blind = known(), known()
    errors = [error for _, _, error, _ in drive.feed(fused)]
    drift = [error for _, _, error, _ in drive.feed(blind, pictures=False)] or [
        drive.error(blind, -1)[0]
    ]
    alone = np.hypot(*(drive.seen[:, :2] - drive.poses[drive.pictures, :2]).T)
    assert np.mean(errors) < 0.7 * alone.mean()
    assert errors[-1] < drift[-1]


# The gate.


@pytest.mark.parametrize('heading', [True, False])
def test_a_spike_is_rejected_and_moves_nothing(heading):
    drive = Drive(seconds=20, **NOISY)
    drive.seen[100, :2] += [3.0, 3.0]
    found = drive.feed(known(), heading)
    assert not found[100][1].accepted and found[100][1].reason == 'outside the gate'
    assert (
        found[100][1].d2
        > found[100][1].threshold
        == pytest.approx(chi2.ppf(0.999, 3 if heading else 2))
    )
    assert max(error for _, _, error, _ in found) < 0.6


def test_the_gate_covers_the_heading_too():
    drive = Drive(seconds=20, **NOISY)
    drive.seen[100, 2] = wrap_angle(drive.seen[100, 2] + 1.0)
    found = drive.feed(known(), heading=True)
    assert not found[100][1].accepted


@pytest.mark.parametrize('heading', [True, False])
def test_a_sustained_offset_is_believed_in_the_end(heading):
    drive = Drive(seconds=40, **NOISY)
    drive.seen[150:, :2] += [1.5, 0.0]
    found = drive.feed(known(), heading)
    lasting = drive.seen[:, :2] - drive.poses[drive.pictures, :2]
    assert not found[152][1].accepted
    assert abs(found[-1][2] - 1.5) < 0.5 and np.abs(lasting[-1, 0] - 1.5) < 1.0


@pytest.mark.parametrize('heading', [True, False])
def test_wrong_images_that_contradict_each_other_are_never_believed(heading):
    drive = Drive(seconds=40, **NOISY)
    wrong = np.random.default_rng(3).uniform(-8, 8, (30, 2))
    drive.seen[150:180, :2] += wrong
    found = drive.feed(known(), heading)
    assert max(error for _, _, error, _ in found) < 1.0
    assert found[-1][2] < 0.5


@pytest.mark.parametrize('heading', [True, False])
@pytest.mark.parametrize('outage', [5.0, 30.0])
def test_a_cluster_of_wrong_images_after_an_outage_is_not_admitted(heading, outage):
    drive = Drive(seconds=60, **NOISY)
    fused = known()
    drive.feed(fused, heading, stop=15)
    drive.feed(fused, heading, start=15, stop=15 + outage, pictures=False)
    drift = drive.error(fused, np.searchsorted(drive.stamps_ns, fused.state.stamp_ns))[0]
    first = int(np.searchsorted(drive.pictures, (15 + outage) * 50))
    drive.seen[first : first + 12, :2] += [3.0, 4.0]
    found = drive.feed(fused, heading, start=15 + outage)
    assert not any(update.accepted for _, update, _, _ in found[:12])
    assert max(error for _, _, error, _ in found) < max(1.0, 2 * drift)
    assert np.mean([error for _, _, error, _ in found[40:]]) < 0.4


# Start and recovery.


def test_one_picture_with_heading_starts_at_once():
    drive = Drive(seconds=5, start=(4.0, -3.0, 2.0), **NOISY)
    fused = PoseFilter()
    assert fused.state is None and fused.status.level is Level.UNINITIALISED
    found = drive.feed(fused, heading=True)
    assert found[0][1].accepted and found[0][1].reason == 'started'
    assert found[-1][2] < 0.6 and abs(found[-1][3]) < 0.2


def test_five_pictures_with_heading_suffice_in_19_of_20_starts():
    good = 0
    for seed in range(200):
        noise = {**NOISY, 'position_std': 0.15}
        drive = Drive(seconds=0.6, start=(1.0, 2.0, seed), **noise, seed=seed)
        found = drive.feed(PoseFilter(), heading=True)[4]
        good += found[2] < 0.5 and abs(found[3]) < math.radians(5)
    assert good >= 0.95 * 200


def test_without_heading_the_first_metres_start_it():
    for seed in range(20):
        drive = Drive(seconds=8, start=(4.0, -3.0, 2.0 + seed), **NOISY, seed=seed)
        fused = PoseFilter()
        found = drive.feed(fused)
        started = next(k for k, (_, update, _, _) in enumerate(found) if update.accepted)
        assert drive.pictures[started] / 50 < 3.0
        assert abs(found[-1][3]) < 0.3 and found[-1][2] < 0.8


def test_a_first_picture_that_is_wrong_is_outvoted():
    drive = Drive(seconds=5, **NOISY)
    drive.seen[0] = [9.0, 9.0, 2.0]
    found = drive.feed(PoseFilter(), heading=True)
    assert found[0][1].accepted and found[1][1].reason == 'outside the gate'
    assert found[3][2] < 0.8


def test_positions_without_motion_show_no_heading():
    fused = PoseFilter()
    for k in range(100):
        fused.add_odometry(START_NS + k * SECOND // 50, 0.0, 0.0)
        update = fused.add_measurement(START_NS + k * SECOND // 50, [1.0, 2.0], 0.04 * np.eye(2))
    assert not update.accepted and fused.state is None
    assert fused.status.reasons == ('images show no heading yet: drive on',)


@pytest.mark.parametrize('seed', range(5))
def test_a_kidnapped_robot_recovers_after_five_images_with_heading(seed):
    drive = Drive(seconds=30, **NOISY, seed=seed)
    drive.kidnap(150, (5.0, -4.0, 2.0))
    found = drive.feed(known(), heading=True)
    assert found[154][1].reason == 'restarted elsewhere'
    assert max(error for _, _, error, _ in found[156:]) < 0.9
    assert found[-1][2] < 0.5


@pytest.mark.parametrize('seed', range(5))
def test_a_kidnapped_robot_recovers_within_three_meters_without_heading(seed):
    drive = Drive(seconds=30, **NOISY, seed=seed)
    drive.kidnap(150, (5.0, -4.0, 2.0))
    found = drive.feed(known())
    assert max(error for _, _, error, _ in found[180:]) < 1.2
    assert found[-1][2] < 0.6


@pytest.mark.parametrize('heading', [True, False])
def test_while_lost_the_state_shows_it_and_the_covariance_covers_the_error(heading, monkeypatch):
    monkeypatch.setattr(recover, 'START_YAW_STD', 0.01)  # no recovery
    drive = Drive(seconds=30, **NOISY)
    drive.kidnap(150, (5.0, -4.0, 2.0))
    fused = known()
    drive.feed(fused, heading, stop=16.5)
    assert fused.status.level is Level.LOST
    assert any('contradict' in reason for reason in fused.status.reasons)
    error, _ = drive.error(fused, np.searchsorted(drive.stamps_ns, fused.state.stamp_ns))
    assert error > 4 and error < 4 * fused.state.position_std


def test_a_pose_from_outside_is_taken_at_any_time():
    drive = Drive(seconds=10)
    fused = known(pose=(50.0, 50.0, 1.0))
    drive.feed(fused, stop=5, pictures=False)
    fused.set_pose(fused.state.stamp_ns, drive.poses[249], np.eye(3) * 1e-4)
    drive.feed(fused, start=5, pictures=False)
    assert np.allclose(fused.state.pose, drive.poses[-1], atol=1e-6)


@pytest.mark.parametrize('stamp', [1, START_NS - SECOND, START_NS + 10**6 * SECOND])
def test_a_pose_given_before_the_first_message_is_not_lost(stamp):
    drive = Drive(seconds=5, start=(3.0, 1.0, math.pi))
    fused = PoseFilter()
    fused.set_pose(stamp, (3.0, 1.0, math.pi), np.eye(3) * 1e-4)
    assert np.allclose(fused.state.pose[:2], [3.0, 1.0])
    drive.feed(fused, pictures=False)
    assert drive.error(fused, -1)[0] < 1e-6


@pytest.mark.parametrize(('off_m', 'std'), [(1.6, 0.2), (1.2, 0.1), (2.5, 0.7)])
def test_a_pose_from_outside_that_its_first_images_deny_claims_no_more(off_m, std):
    fused, covariance = PoseFilter(), np.diag(np.square([0.5, 0.5, 0.1]))
    fused.set_pose(START_NS, (off_m, 0.0, 0.0), np.diag(np.square([std, std, 0.1])))
    for i, stamp_ns in enumerate(range(START_NS, START_NS + 30 * SECOND, SECOND // 20)):
        fused.add_odometry(stamp_ns, 0.0, 0.0)
        if i % 7 == 6:
            fused.add_measurement(stamp_ns, np.zeros(3), covariance)
        if i > 6:
            assert math.hypot(*fused.state.pose[:2]) < 2 * fused.state.position_std


@pytest.mark.parametrize('pose', [(math.nan, 0, 0), (0, 0), (1e12, 0, 0)])
def test_a_malformed_pose_is_rejected(pose):
    with pytest.raises(DataError):
        PoseFilter().set_pose(1, pose)
    with pytest.raises(DataError):
        PoseFilter().set_pose(1, (0, 0, 0), -np.eye(3))


# Bad input and silence.


BAD_MEASUREMENTS = [
    ([math.nan, 0], np.eye(2), 'position is not finite'),
    ([math.inf, 0], np.eye(2), 'position is not finite'),
    ([1e300, 0], np.eye(2), 'position is not finite'),
    ([0, 0], -np.eye(2), 'covariance is not symmetric positive'),
    ([0, 0], [[1, 5], [5, 1]], 'covariance is not symmetric positive'),
    ([0, 0], [[1, 0.5], [0, 1]], 'covariance is not symmetric positive'),
    ([0, 0], np.full((2, 2), math.nan), 'covariance is not symmetric positive'),
    ([0, 0], np.eye(2) * 1e308, 'covariance is not symmetric positive'),
    ([0, 0], np.eye(2) * 1e9, 'covariance means that nothing is known'),
    ([0, 0, 0, 0], np.eye(4), 'shape is not that of a position or a pose'),
    ([0, 0], np.eye(3), 'shape is not that of a position or a pose'),
]


@pytest.mark.parametrize(('value', 'covariance', 'reason'), BAD_MEASUREMENTS)
def test_a_malformed_measurement_is_counted_and_changes_nothing(value, covariance, reason):
    drive = Drive(seconds=2)
    fused = known()
    drive.feed(fused)
    before = snapshot(fused)
    update = fused.add_measurement(int(drive.stamps_ns[-1]) + 1, value, covariance)
    assert not update.accepted and update.reason == reason
    assert fused.counts[f'measurement: {reason}'] == 1 and snapshot(fused) == before


@pytest.mark.parametrize(('v', 'omega', 'reason'), [
    (math.nan, 0, 'not finite'), (0, math.inf, 'not finite'), (1e6, 0, 'absurdly fast'),
])  # fmt: skip
def test_malformed_odometry_is_counted_and_changes_nothing(v, omega, reason):
    drive = Drive(seconds=2)
    fused = known()
    drive.feed(fused)
    before = snapshot(fused)
    assert fused.add_odometry(int(drive.stamps_ns[-1]) + 1, v, omega) == reason
    assert fused.add_odometry(0, 1.0, 0.0) == 'zero or negative stamp'
    assert fused.counts[f'odometry: {reason}'] == 1 and snapshot(fused) == before


@pytest.mark.parametrize(
    'variances', [(0, 0), (-1, -1), (math.nan, math.inf), (1e300, 1e300), (1e3, 1e3)]
)
def test_unusable_variances_give_way_to_the_configured_ones(variances):
    fused, plain = known(), known()
    drive = Drive(seconds=2)
    for i, stamp in enumerate(drive.stamps_ns):
        fused.add_odometry(int(stamp), *drive.read[i], variances)
        plain.add_odometry(int(stamp), *drive.read[i])
    assert snapshot(fused) == snapshot(plain)


def test_a_heading_that_is_not_known_is_left_out():
    drive = Drive(seconds=2)
    with_unknown, without = known(), known()
    drive.feed(with_unknown)
    drive.feed(without)
    stamp = int(drive.stamps_ns[-1]) + 1
    at = drive.poses[-1]
    flat = np.diag([0.04, 0.04, math.pi**2 / 3])
    with_unknown.add_measurement(stamp, [at[0], at[1], math.nan], flat)
    without.add_measurement(stamp, at[:2], flat[:2, :2])
    assert snapshot(with_unknown) == snapshot(without)


def test_zero_covariance_means_unknown_not_certain():
    fused = known()
    Drive(seconds=2).feed(fused)
    update = fused.add_measurement(fused.state.stamp_ns + 1, [50.0, 0.0], np.zeros((2, 2)))
    assert not update.accepted
    assert fused.state.position_std > 0.01


def test_silent_odometry_makes_the_estimate_less_and_less_sure():
    drive = Drive(seconds=5)
    fused = known()
    drive.feed(fused)
    newest = fused.state.stamp_ns
    stds = [fused.at(newest + k * SECOND).position_std for k in (0, 1, 2, 5, 20)]
    assert all(a < b for a, b in itertools.pairwise(stds))
    far = fused.at(newest + 10**5 * SECOND)
    assert far.position_std <= LARGEST_STD_M * 1.5
    # It does not run on for ever at the last speed.
    assert math.dist(far.pose[:2], fused.state.pose[:2]) < 2.5


def test_images_alone_carry_it_through_an_outage_of_the_odometry():
    drive = Drive(seconds=30, **NOISY)
    fused = known()
    drive.feed(fused, heading=True, stop=10)
    for event in drive.events():
        if 10 <= (event[0] - START_NS) * 1e-9 < 20 and event[1]:
            drive.give(fused, event, True)
    assert fused.status.level is not Level.LOCALISED
    assert any('no odometry' in reason for reason in fused.status.reasons)
    assert drive.error(fused, 999)[0] < 1.0
    found = drive.feed(fused, heading=True, start=20)
    assert found[-1][2] < 0.5 and fused.status.level is Level.LOCALISED


def test_after_a_long_gap_positions_are_followed_and_the_heading_is_found_again():
    drive = Drive(seconds=60, **NOISY)
    fused = known()
    found = []
    for event in drive.events():
        t = (event[0] - START_NS) * 1e-9
        if event[1] or not 20 < t < 40:
            drive.give(fused, event)
        if event[1]:
            found.append(drive.error(fused, drive.pictures[event[2]]))
        if event[1] and 30 < t < 40:
            assert fused.status.level is Level.LOST
            assert any('heading' in reason for reason in fused.status.reasons)
    assert max(error for error, _ in found) < 1.5
    assert found[-1][0] < 0.4 and abs(found[-1][1]) < 0.2
    assert fused.status.level is Level.LOCALISED


def test_a_standing_robot_with_lost_heading_does_not_average_its_images_away():
    fused = PoseFilter()
    fused.set_pose(START_NS, (0.0, 0.0, 0.0), np.diag([1.0, 1.0, 4.0]))
    rng = np.random.default_rng(1)
    for k in range(1, 2000):
        stamp = START_NS + k * SECOND // 10
        fused.add_odometry(stamp, 0.0, 0.0)
        seen = [0.2, -0.1] + 0.05 * rng.standard_normal(2)
        update = fused.add_measurement(stamp + 1, seen, 0.09 * np.eye(2))
        assert update.reason == 'position only: heading unknown'
    # Pictures of one place err alike by 0.7 of their variance: sqrt(0.7) * 0.3 m remains.
    assert 0.2 < fused.state.position_std < 0.3
    assert fused.state.pose[:2] == pytest.approx([0.2, -0.1], abs=0.05)
    assert np.linalg.eigvalsh(fused.state.covariance)[0] > 0


@pytest.mark.parametrize('gap', [0.3, 1.5])
def test_dropouts_of_the_odometry_are_bridged(gap):
    drive = Drive(seconds=30, **NOISY)
    fused = known()
    for event in drive.events():
        t = (event[0] - START_NS) * 1e-9
        if event[1] or t % 5.0 > gap:
            drive.give(fused, event, True)
    assert drive.error(fused, len(drive.stamps_ns) - 1)[0] < 0.6


def test_another_models_correlation_may_be_much_longer_or_shorter():
    fused, drive = known(), Drive(seconds=30, position_std=0.05, yaw_std=0.02)
    correlations = {10.0: (0.3, LEAST_M), 15.0: (0.7, 1e6), 20.0: (0.9, LEAST_M), 25.0: (0.7, 1.0)}
    for begin_s in (0.0, *correlations):
        if begin_s in correlations:
            fused.reconfigure(correlation=ErrorCorrelation(*correlations[begin_s]))
        drive.feed(fused, True, begin_s, begin_s + (10.0 if begin_s == 0 else 5.0))
        assert np.isfinite(fused.state.covariance).all()
    assert drive.error(fused, -1)[0] < 0.15


def through_a_gap(pose=None):
    """Straight on at 0.5 m/s; unseen for 1 s, after which the odometry is at a pose; the state."""
    fused = PoseFilter()
    fused.set_pose(START_NS, (0.0, 0.0, 0.0), np.diag(np.square([0.05, 0.05, 0.02])))
    for k in range(11):
        at = None if pose is None else (0.05 * k, 0.0, 0.0)
        fused.add_odometry(START_NS + k * SECOND // 10, 0.5, 0.0, (1e-4, 1e-4), at)
    fused.add_odometry(START_NS + 2 * SECOND, 0.5, 0.0, (1e-4, 1e-4), pose)
    return fused.state


def test_what_the_robot_did_in_a_gap_of_the_odometry_is_uncertain():
    state = through_a_gap()
    assert state.pose == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert 0.25 < state.yaw_std < 0.5 and 0.25 < state.position_std < 0.5


def test_what_the_robot_did_before_its_first_odometry_is_uncertain():
    stds = []
    for silence_s in (1, 5):
        fused = PoseFilter()
        fused.set_pose(START_NS, (0.0, 0.0, 0.0), np.diag(np.square([0.05, 0.05, 0.02])))
        fused.add_measurement(START_NS + 1, [0.0, 0.0, 0.0], np.diag([0.01, 0.01, 0.001]))
        fused.add_odometry(START_NS + silence_s * SECOND, 0.5, 0.0, (1e-4, 1e-4))
        stds.append(fused.state.position_std)
    assert stds[0] < 0.2 and stds[1] > 1.0


def test_a_heading_that_is_hardly_known_is_degraded():
    for std, reasons in ((0.15, ()), (0.25, ('heading known to 14 deg only',))):
        fused = PoseFilter()
        fused.set_pose(START_NS, (0.0, 0.0, 0.0), np.diag(np.square([0.05, 0.05, std])))
        fused.add_odometry(START_NS + 1, 0.0, 0.0)
        fused.add_measurement(START_NS + 2, [0.0, 0.0], 0.09 * np.eye(2))
        assert fused.status.reasons == reasons
        assert fused.status.level is (Level.DEGRADED if reasons else Level.LOCALISED)


def test_the_odometrys_own_pose_bridges_a_gap():
    straight = through_a_gap((1.0, 0.0, 0.0))
    assert straight.pose == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert straight.yaw_std < 0.05 and straight.position_std < 0.08
    turned = through_a_gap((0.9, 0.2, 0.8))
    assert turned.pose == pytest.approx([0.9, 0.2, 0.8], abs=0.05)
    assert 0.3 < turned.yaw_std < 0.5  # readings do not expect it
    reset = through_a_gap((0.0, 0.0, 2.5))
    assert reset.pose == pytest.approx([1.0, 0.0, 0.0], abs=1e-6) and reset.yaw_std > 0.25


def test_the_state_machine_reports_why():
    drive = Drive(seconds=30, **NOISY)
    fused = PoseFilter()
    assert fused.status.reasons == ('no odometry and no images yet',)
    drive.feed(fused, stop=0.05)
    assert fused.status.reasons == ('no usable image yet',)
    drive.feed(fused, heading=True, start=0.05, stop=10)
    assert fused.status.level is Level.LOCALISED and fused.status.reasons == ()
    drive.feed(fused, start=10, stop=14, pictures=False)
    assert fused.status.level is Level.DEGRADED
    assert 'no usable image for 4 s' in fused.status.reasons
    drive.feed(fused, heading=True, start=14)
    assert fused.status.level is Level.LOCALISED


@pytest.mark.parametrize('stds', [(2.5, 0.1, 0.1), (0.1, 2.5, 0.1), (0.1, 0.1, 0.9)])
def test_an_uncertain_image_does_not_start_the_filter(stds):
    fused = PoseFilter()
    update = fused.add_measurement(START_NS, [1, 2, 0], np.diag(np.square(stds)))
    assert update.reason == 'too uncertain to start from' and fused.state is None
    sure = fused.add_measurement(START_NS + 1, [1, 2, 0], np.diag(np.square([1.5, 1.5, 0.5])))
    assert sure.accepted and fused.status.level is Level.DEGRADED


def test_parameters_change_without_losing_the_estimate():
    drive = Drive(seconds=10)
    fused = known()
    drive.feed(fused, stop=5)
    before = snapshot(fused)
    fused.reconfigure(dataclasses.replace(fused.config, measurement_factor=4.0))
    assert snapshot(fused) == before
    assert all(update.accepted for _, update, _, _ in drive.feed(fused, start=5))


def test_reset_forgets_the_pose_but_not_the_counts():
    drive = Drive(seconds=2)
    fused = known()
    drive.feed(fused)
    fused.reset()
    assert fused.state is None and fused.counts['reset'] == 1
    assert fused.counts['odometry: used'] == 100


def test_the_history_stays_bounded():
    fused = known()
    drive = Drive(seconds=120, rate_hz=20)
    drive.feed(fused)
    assert len(fused._history) < 2 * 20 * 1.3 * HISTORY_S


@pytest.mark.parametrize(('values', 'why'), [
    ({'degraded_std': 3.0}, 'degraded_std'), ({'lost_std': 200.0}, 'outside'),
    ({'speed_std': math.nan}, 'finite'), ({'odometry_factor': 0.0}, 'outside'),
    ({'initial_pose': (1.0, 2.0)}, '2 numbers given; give x'),
    ({'initial_pose': (1.0, 2.0, math.inf)}, 'finite'),
    ({'initial_pose': (1.0, 2.0, 90.0)}, 'give radians'),
    ({'initial_pose': ('x', 2.0, 3.0)}, 'initial_pose'),
])  # fmt: skip
def test_parameters_are_checked_together(values, why):
    with pytest.raises(ConfigError, match=why):
        FilterConfig(**values)


def test_unusable_images_in_a_row_are_noticed_before_they_are_missed():
    """A dark image shows at once that nothing is seen; one alone may be a flicker."""
    drive = Drive(seconds=20, **NOISY)
    fused = PoseFilter(FilterConfig())
    drive.feed(fused, heading=True)
    last_ns, nothing = int(drive.stamps_ns[-1]), np.diag([1e6, 1e6, 1e6])
    dark = [
        fused.add_measurement(last_ns + k, np.zeros(3), nothing) and fused.status for k in (1, 2)
    ]
    assert [status.level for status in dark] == [Level.LOCALISED, Level.DEGRADED]
    assert dark[1].reasons == ('2 images in a row are unusable',)
    assert fused.add_measurement(last_ns + 3, drive.poses[-1], drive.covariance(True)).accepted
    assert fused.status.level is Level.LOCALISED


@pytest.mark.parametrize('v', [5e-324, 1e-302, -1e-200, 1e-30])
@pytest.mark.parametrize('omega', [0.0, 5e-324, 0.1])
def test_the_smallest_speeds_are_numbers_like_others(v, omega):
    drive = Drive(seconds=5, twists=np.tile([v, omega], (250, 1)), **NOISY)
    drive.read = drive.twists
    fused = PoseFilter(FilterConfig())
    for stamp_ns, kind, index in drive.events():
        drive.give(fused, (stamp_ns, kind, index), heading=True)
        if kind == 1:
            fused.add_turned(stamp_ns, float(drive.poses[drive.pictures[index], 2]))
    assert np.isfinite(fused.state.covariance).all()


def test_unusable_images_show_how_long_the_odometry_has_been_silent():
    drive = Drive(seconds=20, **NOISY)
    fused = PoseFilter(FilterConfig())
    drive.feed(fused, heading=True)
    assert fused.status.level is Level.LOCALISED
    last_ns, nothing = int(drive.stamps_ns[-1]), np.diag([1e6, 1e6, 1e6])
    levels = []
    for late_s in (0.2, 1.0, 5.0, 20.0, 90.0):
        fused.add_measurement(last_ns + round(late_s * 1e9), np.zeros(3), nothing)
        levels.append(fused.status.level)
    # A minute is no silence, but another clock.
    assert levels == [Level.LOCALISED, Level.DEGRADED, Level.LOST, Level.LOST, Level.DEGRADED]
    assert fused.status.reasons == ('5 images in a row are unusable',)
    assert fused.add_odometry(last_ns + 20_000_000, *drive.read[-1]) == ''
    assert fused.status.reasons == ('5 images in a row are unusable',)
