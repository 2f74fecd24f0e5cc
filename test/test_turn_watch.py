# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Images that turn at another time than the odometry are noticed, and nothing else is."""

import math
import re

import numpy as np
import pytest
from filter_drives import START_NS, Drive

from sfa_localization.data.geometry import wrap_angle
from sfa_localization.fusion.pace import TOLERATED_S
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import Level
from sfa_localization.fusion.turn_watch import Seen, TurnWatch

HZ, EVERY = 25, 5
NOISY = {'v_std': 0.03, 'omega_std': 0.02, 'position_std': 0.08, 'yaw_std': 0.02, 'rate_hz': HZ}


def curve(seconds=40.0):
    """Turn rates (N,) of a round that is not straight, not a circle, and repeats nothing."""
    count = round(seconds * HZ)
    rough = np.random.default_rng(7).normal(0.0, 1.0, count + 6 * HZ)
    smooth = np.convolve(rough, np.hanning(3 * HZ), 'same')[3 * HZ : 3 * HZ + count]
    return 0.3 + 0.12 * smooth / smooth.std()


def watched(
    omega, shown, seed=0, watch=None, noise=0.004, silent=(math.inf, math.inf), v=1.0, rate_std=0.02
):
    """Probability of being apart after each image, that shows the heading at time shown(t)."""
    rng, watch = np.random.default_rng(seed), watch or TurnWatch()
    yaw, found = np.cumsum(omega) / HZ, []
    heading = 0.0
    for i, rate in enumerate(omega):
        stamp_ns = START_NS + round(i * 1e9 / HZ)
        if not silent[0] <= i / HZ < silent[1]:
            watch.add_odometry(stamp_ns, v, rate + rng.normal(0, rate_std))
        if i % EVERY == 0:
            seen = np.interp(shown(i / HZ), np.arange(len(yaw)) / HZ, yaw)
            heading += rng.normal(0, noise)
            watch.add_heading(stamp_ns, float(wrap_angle(seen + heading)))
            found.append(watch.apart(0.0))
    return np.array(found), watch


def few_images(
    omega, gap_s, late=lambda t: 0.0, v=1.0, heading_std=0.0, seen_std=0.01, jitter_s=0.0
):
    """Times s of images that far apart, and the probability of being apart after each.

    They show the robot late(t) s ago, and not before it began; the headings that they add up to
    wander by `heading_std` per image, those in the map err by `seen_std`.
    """
    rng, watch, found, wandered = np.random.default_rng(0), TurnWatch(), [], 0.0
    yaw, at_s = np.cumsum(omega) / HZ, np.arange(len(omega)) / HZ
    for i, rate in enumerate(omega):
        now, stamp_ns = i / HZ, START_NS + round(i * 1e9 / HZ)
        watch.add_odometry(stamp_ns, v, rate + rng.normal(0, 0.02))
        if i % round(gap_s * HZ) == 0 and now >= late(now):
            shown = float(np.interp(now - late(now) + rng.normal(0, jitter_s), at_s, yaw))
            wandered += rng.normal(0, heading_std)
            watch.add_heading(stamp_ns, float(wrap_angle(shown + wandered)))
            seen = float(wrap_angle(shown + rng.normal(0, seen_std)))
            watch.add_seen(Seen(stamp_ns, seen, 0.02**2))
            found.append((now, watch.apart(0.0)))
    return np.transpose(found)


def test_images_in_time_are_never_suspected():
    for seed in range(4):
        for omega in (curve(), np.zeros(100 * HZ), np.full(100 * HZ, 0.4)):
            assert watched(omega, lambda t: t, seed)[0].max() < 0.5


def test_noise_of_the_odometry_on_a_straight_line_shows_no_delay():
    for seed in range(8):
        assert watched(np.zeros(100 * HZ), lambda t: t, seed, rate_std=0.1)[0].max() < 0.3


@pytest.mark.parametrize('seconds', [-1.2, -0.8, 0.8, 1.2, 2.0, 4.0])
def test_a_delay_is_noticed_and_measured(seconds):
    found, watch = watched(curve(), lambda t: t - seconds)
    assert np.argmax(found > 0.5) < 15 * HZ / EVERY  # seconds of a curve
    assert found[-50:].min() > 0.5
    shown = re.search(r'stamped ([0-9.]+) s (late|early)', watch.problem(0.0))
    assert float(shown[1]) == pytest.approx(abs(seconds), abs=0.25)
    assert shown[2] == ('late' if seconds > 0 else 'early')
    assert watch.error_s(0.0) == pytest.approx(abs(seconds), abs=0.3)


@pytest.mark.parametrize('seconds', [-0.3, 0.3])
def test_a_small_delay_is_tolerated_and_a_compensated_one_too(seconds):
    found, watch = watched(curve(), lambda t: t - seconds)
    assert found.max() < 0.5
    assert watch.apart(seconds) < 0.1
    assert watch.apart(seconds - math.copysign(2 * TOLERATED_S, seconds)) > 0.9


@pytest.mark.parametrize(
    ('v', 'turns', 'delay_s', 'small'),
    [(0.3, 1.0, 0.6, True), (0.1, 0.5, 0.9, True), (0.1, 3.0, 0.6, False), (2.0, 1.0, 0.42, False)],
)
def test_what_delay_is_small_is_a_matter_of_how_fast_the_robot_moves(v, turns, delay_s, small):
    found, watch = watched(turns * curve(), lambda t: t - delay_s, v=v)
    assert found[-50:].max() < 0.2 if small else found[-50:].min() > 0.5
    assert (watch.error_s(0.0) < 0.3) == small
    # A stop makes no delay small: the robot drives on.
    before = watch.tolerated_s
    watch.add_odometry(START_NS + 41_000_000_000, 0.0, 0.0)
    assert watch.tolerated_s == before


@pytest.mark.parametrize('turn_rate', [0.0, 0.4])
def test_minutes_that_show_no_delay_suggest_none(turn_rate):
    for noise, most in ((0.004, 0.0), (0.008, 0.1)):
        for seed in range(3):
            found, _ = watched(np.full(200 * HZ, turn_rate), lambda t: t, seed, noise=noise)
            assert np.mean(found > 0.5) <= most


@pytest.mark.parametrize('gap_s', [0.36, 0.52, 2.0])
def test_a_fast_robot_with_few_images_is_in_time(gap_s):
    """At 2.5 m/s near things shift between images; exposures begin a little early or late."""
    omega = 4.0 * (curve(60.0) - 0.3)
    _, apart = few_images(omega, gap_s, v=2.5, heading_std=0.1, jitter_s=0.02)
    assert apart.max() < 0.5


def test_what_was_found_lasts_on_a_straight_line_and_ends_with_the_fault():
    omega = np.concatenate([curve(20.0), np.zeros(20 * HZ), curve(30.0)])
    found, _ = watched(omega, lambda t: t - 2.0 if 5.0 <= t < 42.0 else t)
    at = np.arange(len(found)) * EVERY / HZ
    assert found[at < 5.0].max() < 0.1
    assert found[(at > 19.0) & (at < 40.0)].min() > 0.5
    assert found[-25:].max() < 0.1


def test_a_video_that_loops_is_noticed():
    found, watch = watched(curve(60.0), lambda t: t if t < 20.0 else 12.0 + (t - 20.0) % 8.0)
    assert found[: 20 * HZ // EVERY].max() < 0.1
    assert np.mean(found[30 * HZ // EVERY :] > 0.5) > 0.5
    assert watch.problem(0.0)


def test_a_video_that_runs_slowly_is_noticed():
    found, watch = watched(curve(60.0), lambda t: t - 0.1 * max(t - 15.0, 0.0))
    assert found[: 15 * HZ // EVERY].max() < 0.1 and found[-50:].min() > 0.9
    assert 'late' in watch.problem(0.0)


def test_turns_that_odometry_did_not_report_are_no_evidence():
    found, _ = watched(curve(), lambda t: t, silent=(15.0, 21.0))
    assert found.max() < 0.1


def test_after_a_move_of_the_estimate_less_evidence_is_enough():
    plain, moved = TurnWatch(), TurnWatch()
    moved.doubt()
    late = [watched(curve(8.0), lambda t: t - 1.0, watch=w)[0] for w in (plain, moved)]
    assert np.argmax(late[1] > 0.5) < np.argmax(late[0] > 0.5)


def driven(delay_s, seconds=40.0):
    """Status, error and estimate of a filter whose images are late, on a curve."""
    drive = Drive(every=EVERY, twists=np.column_stack([np.ones(round(seconds * HZ)),
                                                       curve(seconds)]), **NOISY)  # fmt: skip
    lag, fused, found = round(delay_s * HZ / EVERY), PoseFilter(FilterConfig()), []
    shown = drive.seen[np.maximum(np.arange(len(drive.seen)) - lag, 0)]
    for stamp_ns, kind, index in drive.events():
        if kind == 0:
            drive.give(fused, (stamp_ns, kind, index))
            continue
        if index < lag:
            continue
        fused.add_turned(stamp_ns, float(drive.poses[drive.pictures[index - lag], 2]))
        fused.add_measurement(stamp_ns, shown[index], drive.covariance(True))
        error = math.hypot(*(fused.state.pose - drive.poses[drive.pictures[index]])[:2])
        found.append((fused.status, error, fused.state))
    return found


def test_a_filter_in_time_stays_localised():
    begun = 3 * HZ // EVERY  # until driving has confirmed the start
    levels = {status.level for status, *_ in driven(0.0)[begun:]}
    assert levels == {Level.LOCALISED}


@pytest.mark.parametrize(('gap_s', 'delay_s'), [(1.0, 0.0), (1.0, 1.2), (2.0, 0.0), (2.0, 1.5)])
def test_headings_in_the_map_show_delays_of_slow_cameras(gap_s, delay_s):
    """Images a second or more apart: their visual turns do not count, those of their poses do."""
    _, apart = few_images(curve(80.0), gap_s, lambda t: delay_s)
    assert apart[-20:].min() > 0.5 if delay_s else apart.max() < 0.3


@pytest.mark.parametrize('gap_s', [0.5, 1.0, 2.0])
@pytest.mark.parametrize('growth', [0.05, 0.1])
def test_a_delay_that_grows_shows_in_few_images_as_well(gap_s, growth):
    def late(t):
        return growth * max(t - 10.0, 0.0)

    at_s, apart = few_images(curve(60.0), gap_s, late, heading_std=0.004, seen_std=0.02)
    late_s = np.array([late(t) for t in at_s])
    assert apart[late_s < 0.2].max() < 0.5 and np.mean(apart[late_s > 1.2] > 0.5) > 0.7


@pytest.mark.parametrize(('delay_s', 'at_most_s'), [(1.2, 4.0), (2.0, 2.0), (4.0, 2.0)])
def test_a_filter_with_late_images_is_sure_and_wrong_for_seconds_only(delay_s, at_most_s):
    found = driven(delay_s)
    wrong = [status.level is Level.LOCALISED and error > 1.0 for status, error, _ in found]
    assert sum(wrong) <= at_most_s * HZ / EVERY
    settled = found[len(found) // 2 :]
    assert any('synchronize the clocks' in why for s, *_ in settled for why in s.reasons)
    # What it claims holds the error.
    assert np.mean([error <= 2.45 * state.position_std for _, error, state in settled]) > 0.9
