# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A camera whose stamps are late or early: what it shows, and that the filter learns it."""

import math

import numpy as np
import pytest
from filter_drives import START_NS, Drive
from scipy.stats import chi2

from sfa_localization.camera_clock import DELAY_LIMIT, left_behind, look_back
from sfa_localization.config import FilterConfig
from sfa_localization.geometry import wrap_angle
from sfa_localization.motion import DELAY, OMEGA, SIZE, YAW, V
from sfa_localization.pose_filter import Level, PoseFilter

SECOND = 1_000_000_000
NOISY = {'v_std': 0.02, 'omega_std': 0.01, 'position_std': 0.1, 'yaw_std': 0.03, 'share': 0.5}


def curves(seconds, rate_hz=25.0, speed=1.0, seed=0):
    """True twists (N, 2) with turns of many sizes: on a straight line a delay is not to be seen."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    waves = zip(rng.uniform(0.2, 0.5, 3), rng.uniform(0.2, 0.9, 3), rng.uniform(0, 6, 3),
                strict=True)  # fmt: skip
    turn = sum(size * np.sin(rate * t + phase) for size, rate, phase in waves)
    return np.stack([np.full_like(t, speed), turn], 1)


def driven(delay, seconds=90, seed=0, **how):
    twists = curves(seconds, speed=how.pop('speed', 1.0), seed=seed)
    noise = {**NOISY, **how}
    return Drive(twists=twists, rate_hz=25.0, every=3, delay=delay, seed=seed, **noise)


# What an image shows.


def circling(v=1.0, omega=0.8, rate_hz=50, seconds=2.0):
    """The way behind on a circle from the origin: stamp, pose, trail."""
    trail, count = (), round(seconds * rate_hz)
    for k in range(count):
        trail = left_behind(
            trail, START_NS + k * SECOND // rate_hz, on_circle(v, omega, k / rate_hz)
        )
    return START_NS + count * SECOND // rate_hz, on_circle(v, omega, seconds), trail


def on_circle(v, omega, t):
    yaw = omega * t
    return v / omega * math.sin(yaw), v / omega * (1 - math.cos(yaw)), float(wrap_angle(yaw))


def believed(delay, pose=(5.0, -3.0, 1.0), v=1.0, omega=0.8):
    mean = np.zeros(SIZE)
    mean[:3], mean[V], mean[OMEGA], mean[DELAY] = pose, v, omega, delay
    return mean


@pytest.mark.parametrize('delay', [0.5, 0.31, 0.02, 1e-9, 0.0, -0.01, -0.5])
def test_an_image_shows_the_pose_at_the_time_it_was_taken(delay):
    stamp, here, trail = circling()
    sight = look_back(stamp, believed(delay), here, trail)
    then = on_circle(1.0, 0.8, 2.0 - delay)
    assert sight.reckoned == pytest.approx(then, abs=1e-4)
    # From (5, -3, 1) in the map the same way lies turned by 1 rad less the heading of here.
    turn = np.exp(1j * (1.0 - here[2]))
    way = turn * complex(then[0] - here[0], then[1] - here[1])
    assert sight.pose == pytest.approx(
        (5 + way.real, -3 + way.imag, 1.0 + then[2] - here[2]), abs=1e-4
    )
    assert sight.offset == pytest.approx((way.real, way.imag, -0.8 * delay), abs=1e-4)
    assert np.hypot(*sight.velocity[:2]) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize('delay', [0.31, 0.029, -0.2])
def test_its_velocity_is_the_derivative(delay):
    stamp, here, trail = circling()
    ends = [look_back(stamp, believed(delay + d), here, trail).pose for d in (1e-4, -1e-4)]
    numeric = (np.array(ends[1]) - ends[0]) / 2e-4
    found = look_back(stamp, believed(delay), here, trail)
    assert found.velocity == pytest.approx(numeric, abs=0.02)


def test_speed_that_changed_since_is_remembered():
    trail = ()
    for k in range(50):  # 1 m/s until half a second ago, standing since
        trail = left_behind(trail, START_NS + k * SECOND // 50, (min(k / 50, 0.5), 0.0, 0.0))
    sight = look_back(START_NS + SECOND, believed(0.5, v=0.0, omega=0.0), (0.5, 0.0, 0.0), trail)
    assert sight.offset == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    sight = look_back(
        START_NS + SECOND - SECOND // 5, believed(0.5, v=0.0, omega=0.0), (0.5, 0.0, 0.0), trail
    )
    assert np.hypot(*sight.offset[:2]) == pytest.approx(0.2)
    assert np.hypot(*sight.velocity[:2]) == pytest.approx(1.0)


def test_the_way_behind_is_bounded_and_covers_the_longest_delay():
    for rate_hz in (5, 50, 1000):
        stamp, _, trail = circling(rate_hz=rate_hz, seconds=20.0)
        assert len(trail) < 50
        assert stamp - trail[0][0] >= DELAY_LIMIT * SECOND


# What the filter makes of it.


@pytest.mark.parametrize('delay', [-0.3, -0.15, 0.0, 0.15, 0.3])
@pytest.mark.parametrize('seed', range(2))
def test_the_delay_is_learnt(delay, seed):
    drive = driven(delay, seed=seed)
    fused = PoseFilter()
    drive.feed(fused, heading=True)
    assert fused.state.camera_delay_s == pytest.approx(delay, abs=0.03)
    assert math.sqrt(fused.state.covariance[DELAY, DELAY]) < 0.03


@pytest.mark.parametrize('delay', [-0.2, 0.2])
def test_the_delay_is_learnt_from_positions_alone(delay):
    drive = driven(delay, seconds=180)
    fused = PoseFilter()
    drive.feed(fused)
    assert fused.state.camera_delay_s == pytest.approx(delay, abs=0.03)


def test_a_late_camera_costs_nothing_once_its_delay_is_known():
    errors = {}
    for delay in (0.0, 0.15):
        found = driven(delay, seconds=120).feed(PoseFilter(), heading=True)
        errors[delay] = np.mean([error for _, _, error, _ in found[300:]])
    assert errors[0.15] < 1.1 * errors[0.0]


def test_a_clock_known_to_be_right_is_left_alone():
    drive = driven(0.0)
    fused = PoseFilter(FilterConfig(camera_delay_std=0.0))
    drive.feed(fused, heading=True)
    assert abs(fused.state.camera_delay_s) < 1e-6


def test_a_delay_that_is_none_stays_within_what_is_claimed_over_40_seeds():
    nees = []
    for seed in range(40):
        fused = PoseFilter()
        driven(0.0, seconds=20, seed=seed).feed(fused, heading=True)
        nees.append(fused.state.mean[DELAY] ** 2 / fused.state.covariance[DELAY, DELAY])
    assert np.mean(nees) < chi2.ppf(0.999, 40) / 40


def test_a_standing_robot_learns_no_delay():
    fused = PoseFilter()
    rng = np.random.default_rng(0)
    for k in range(1, 500):
        fused.add_odometry(START_NS + k * SECOND // 10, 0.0, 0.0)
        seen = 0.1 * rng.standard_normal(3)
        fused.add_measurement(START_NS + k * SECOND // 10 + 1, seen, 0.01 * np.eye(3))
    assert fused.state.camera_delay_s == 0.0
    assert fused.state.covariance[DELAY, DELAY] == pytest.approx(
        FilterConfig().camera_delay_std ** 2
    )


def test_a_delay_beyond_belief_is_named_and_not_followed():
    drive = driven(0.9, seconds=60, position_std=0.3)
    fused = PoseFilter()
    drive.feed(fused, heading=True)
    assert fused.state.camera_delay_s <= DELAY_LIMIT
    assert fused.status.level is Level.DEGRADED
    assert any('stamps are off' in reason for reason in fused.status.reasons)


def test_a_start_on_the_move_knows_that_the_image_may_be_late():
    fused = PoseFilter()
    for k in range(1, 50):
        fused.add_odometry(START_NS + k * SECOND // 50, 2.0, 0.0, (1e-6, 1e-6))
    stamp = START_NS + 49 * SECOND // 50
    fused.add_measurement(stamp, [1.0, 2.0, math.pi / 2], np.diag([0.04, 0.04, 0.01]))
    covariance = fused.state.covariance
    # Facing along y: 2 m/s times 0.1 s along it, together with the delay; across, the picture's.
    assert covariance[1, 1] == pytest.approx(0.04 + (2.0 * 0.1) ** 2)
    assert covariance[1, DELAY] == pytest.approx(2.0 * 0.1**2)
    assert covariance[0, 0] == pytest.approx(0.04)
    assert np.linalg.eigvalsh(covariance)[0] > 0


@pytest.mark.parametrize('heading', [True, False])
@pytest.mark.parametrize('delay', [-0.25, 0.25])
def test_starts_and_recovers_with_a_camera_that_is_off(heading, delay):
    drive = driven(delay, seconds=60, seed=3)
    drive.kidnap(250, (5.0, -4.0, 2.0))
    fused = PoseFilter()
    found = drive.feed(fused, heading)
    assert np.mean([error for _, _, error, _ in found[150:250]]) < 0.2
    assert np.mean([error for _, _, error, _ in found[400:]]) < 0.2
    assert abs(wrap_angle(fused.state.mean[YAW] - drive.poses[-1, 2])) < 0.1


@pytest.mark.parametrize('delay', [-0.2, 0.2])
def test_late_messages_give_what_messages_in_time_give(delay):
    drive = driven(delay, seconds=20)
    rng = np.random.default_rng(1)
    ordered, late = PoseFilter(), PoseFilter()
    for event in drive.events():
        drive.give(ordered, event, True)
    delays = [rng.uniform(0, 2.0 if kind else 0.1) * 1e9 for _, kind, _ in drive.events()]
    arrivals = sorted(zip(drive.events(), delays, strict=True), key=lambda e: e[0][0] + e[1])
    for event, _ in arrivals:
        drive.give(late, event, True)
    assert np.abs(ordered.state.mean - late.state.mean).max() < 1e-9
    assert np.abs(ordered.state.covariance - late.state.covariance).max() < 1e-9
