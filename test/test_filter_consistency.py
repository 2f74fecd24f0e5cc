# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The filter as shipped is consistent: chi-square tests over many simulated robots.

Every robot has a wheel scale and a gyro bias of its white, slips, reads its speed with errors that
last, and takes images whose errors correlate as its model states.
"""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from filter_drives import stamps
from scipy.stats import chi2

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import compose, wrap_angle
from sfa_localization.data.rig import Rig
from sfa_localization.fusion import ekf
from sfa_localization.fusion.motion import (
    BIAS_STD,
    ODOMETRY_CORRELATION_S,
    TURN_RADIUS_M,
    YAW_PER_METER,
)
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.smoother import Smoother

pytestmark = pytest.mark.slow  # trains, or replays many drives

SHIPPED = FilterConfig()
V_STD, OMEGA_STD = 0.03, 0.02
PICTURE_STD = np.array([0.15, 0.15, 0.04])


@dataclass(frozen=True)
class FilterConditions:
    """What the robots of a test have in common; `error` is the correlation of image errors."""

    speed: float
    rate_hz: float
    every: int
    seconds: float
    error: ErrorCorrelation
    heading: bool = True


def lasting(rng, count, dt):
    """Unit errors (count, 2) of readings, correlated over ODOMETRY_CORRELATION_S."""
    ratio = 1 + ODOMETRY_CORRELATION_S / dt
    fade = (ratio - 1) / (ratio + 1)
    errors = np.empty((count, 2))
    errors[0] = rng.standard_normal(2)
    for k in range(1, count):
        errors[k] = fade * errors[k - 1] + math.sqrt(1 - fade**2) * rng.standard_normal(2)
    return errors


def arc(v, omega, dt):
    chord, turn = v * dt * np.sinc(omega * dt / 2 / np.pi), omega * dt
    return np.stack([chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn], -1)


class Robot:
    """One drive of one robot: readings (N, 2), true poses (N, 3), pictures with their poses."""

    def __init__(self, world, seed):
        rng, dt = np.random.default_rng(seed), 1 / world.rate_hz
        count = round(world.seconds * world.rate_hz)
        t = np.arange(count) * dt
        turns = zip(rng.uniform(0.1, 0.5, 3), rng.uniform(0.2, 0.9, 3), rng.uniform(0, 6, 3),
                    strict=True)  # fmt: skip
        omega = sum(size * np.sin(rate * t + phase) for size, rate, phase in turns)
        planned = np.stack([np.full(count, world.speed), omega], 1)
        stds = BIAS_STD, Rig().wheel_scale.std
        bias, scale = stds * rng.standard_normal(2) + [0.0, 1.0]
        self.stamps_ns = stamps(count, world.rate_hz)
        self.read = planned
        error = lasting(rng, count, dt) * [V_STD, OMEGA_STD]
        self.true = (planned + error) * [scale, 1] - [0, bias]
        self.poses = self._driven(rng, dt)
        self.pictures = np.arange(world.every, count, world.every)
        self.seen = self._seen(rng, world.error)

    def _driven(self, rng, dt):
        way, turn = np.abs(self.true[:, 0]) * dt, np.abs(self.true[:, 1]) * dt
        slip = SHIPPED.slip_per_meter * np.sqrt(way)
        yaw = np.sqrt(YAW_PER_METER**2 * way + SHIPPED.yaw_per_radian**2 * turn)
        steps = arc(*self.true.T, dt)
        poses = [np.array([*rng.uniform(-5, 5, 2), rng.uniform(-3, 3)])]
        for k in range(1, len(steps)):
            drift = rng.standard_normal(3) * [slip[k], slip[k], yaw[k]]
            poses.append(compose(poses[-1], steps[k]) + drift)
        return np.array(poses)

    def _seen(self, rng, error):
        poses = self.poses[self.pictures]
        moved = np.abs(self.true) @ [1, TURN_RADIUS_M]
        moved = np.cumsum(moved) * (self.stamps_ns[1] - self.stamps_ns[0]) * 1e-9
        fades = np.exp(-np.diff(moved[self.pictures], prepend=0) / error.distance_m)
        common, seen = rng.standard_normal(3), []
        for pose, fade in zip(poses, fades, strict=True):
            common = fade * common + math.sqrt(1 - fade**2) * rng.standard_normal(3)
            white = math.sqrt(1 - error.share) * rng.standard_normal(3)
            seen.append(pose + PICTURE_STD * (math.sqrt(error.share) * common + white))
        return np.array(seen)


def nees_of(state, pose):
    """Normalized estimation error squared of x, y and yaw."""
    miss = state.pose - pose
    miss[2] = wrap_angle(miss[2])
    return miss @ np.linalg.solve(state.pose_covariance, miss)


def judged(world, robot, fused):
    """NEES (3,) of the pose at three times, sum and degrees of freedom of the NIS, refused."""
    seen = dict(zip(robot.pictures.tolist(), robot.seen, strict=True))
    size = 3 if world.heading else 2
    spread = np.diag(PICTURE_STD**2)[:size, :size]
    count = len(robot.stamps_ns)
    checks, nees, nis, refused = {count // 2, 3 * count // 4, count - 1}, [], [], 0
    for k, stamp_ns in enumerate(robot.stamps_ns.tolist()):
        fused.add_odometry(stamp_ns, *robot.read[k], (V_STD**2, OMEGA_STD**2))
        if k in seen:
            update = fused.add_measurement(stamp_ns, seen[k][:size], spread)
            if math.isfinite(update.d2):
                nis.append(update.d2)
                refused += not update.accepted
        if k in checks:
            nees.append(nees_of(fused.state, robot.poses[k]))
    return nees, sum(nis), size * len(nis), refused / len(nis)


WORLDS = {
    'garden': FilterConditions(1.0, 50, 10, 25, ErrorCorrelation(0.7, 1.0)),
    'slow, white': FilterConditions(0.05, 20, 10, 80, ErrorCorrelation(0.0, 1.0)),
    'slow, alike': FilterConditions(0.05, 20, 10, 80, ErrorCorrelation(0.8, 0.3)),
    'no heading': FilterConditions(0.8, 20, 5, 40, ErrorCorrelation(0.5, 1.0), heading=False),
}
SEEDS = 20


def test_limits_are_quantiles_of_squared_distances():
    for limits, share in ((ekf.GATE, 0.999), (ekf.OUTLYING, 0.8)):
        assert limits == pytest.approx({size: chi2.ppf(share, size) for size in (2, 3)})


@pytest.mark.parametrize('name', WORLDS)
def test_the_filter_as_shipped_errs_as_it_says(name):
    world, nees, total, freedom, refused = WORLDS[name], [], 0.0, 0, []
    for seed in range(SEEDS):
        fused = PoseFilter(SHIPPED, world.error)
        result = judged(world, Robot(world, seed), fused)
        nees.append(result[0])
        total, freedom = total + result[1], freedom + result[2]
        refused.append(result[3])
    # At each of the three times, robots are independent of each other: their sum is chi-square.
    low, high = chi2.ppf([0.0005, 0.9995], 3 * SEEDS)
    assert np.all((low < np.sum(nees, 0)) & (np.sum(nees, 0) < high))
    # Innovations of one robot are nearly white; the gate cuts what is beyond 99.9 %.
    low, high = chi2.ppf([0.0005, 0.9995], freedom) / freedom
    assert low - 0.02 < total / freedom < high
    assert np.mean(refused) < 0.005


@pytest.mark.parametrize('name', ['garden', 'slow, white', 'no heading'])
def test_smoothed_estimates_err_as_they_say(name):
    world, nees = WORLDS[name], []
    for seed in range(SEEDS):
        robot, fused = Robot(world, seed), Smoother(SHIPPED, world.error)
        judged(world, robot, fused)
        states, k = {state.stamp_ns: state for state in fused.smoothed()}, len(robot.read) // 2
        nees.append(nees_of(states[int(robot.stamps_ns[k])], robot.poses[k]))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * SEEDS)
    assert low < sum(nees) < high
