# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The filter as shipped is consistent: chi-square tests over many simulated robots.

Every robot has a wheel scale and a gyro bias of its own, slips, reads its speed with errors that
last, and takes images whose errors correlate as its model states.
"""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from filter_drives import FilterDrive, lasting
from scipy.stats import chi2

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import compose, relative, wrap_angle
from sfa_localization.data.rig import Rig
from sfa_localization.data.run import integrate
from sfa_localization.fusion import ekf
from sfa_localization.fusion.motion import BIAS_STD, ODOMETRY_CORRELATION_S, YAW_PER_METER
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.smoother import Smoother

pytestmark = pytest.mark.slow  # replays many drives

SHIPPED, SEEDS = FilterConfig(), 20


@dataclass
class Robot(FilterDrive):
    """A drive whose errors are those that the filter assumes."""

    speed: float = 1.0

    def _driven(self, rng):
        count, dt = round(self.seconds * self.rate_hz), 1 / self.rate_hz
        sizes, rates, phases = rng.uniform([[0.1], [0.2], [0]], [[0.5], [0.9], [6]], (3, 3))
        omega = np.sin(np.outer(np.arange(count) * dt, rates) + phases) @ sizes
        read = np.column_stack([np.full(count, self.speed), omega])
        ratio = 1 + ODOMETRY_CORRELATION_S / dt
        error = lasting(rng, np.full(count, (ratio - 1) / (ratio + 1)), 2)
        scale, bias = 1 + Rig().wheel_scale.std * rng.standard_normal(), BIAS_STD * rng.normal()
        self.twists = (read + error * [self.v_std, self.omega_std]) * [scale, 1] - [0, bias]
        way, turn = np.abs(self.twists).T * dt
        slip = SHIPPED.slip_per_meter * np.sqrt(way)
        yaw = np.sqrt(YAW_PER_METER**2 * way + SHIPPED.yaw_per_radian**2 * turn)
        drift = rng.standard_normal((count, 3)) * np.column_stack([slip, slip, yaw])
        smooth, poses = integrate(self.stamps_ns, self.twists), [np.array(self.start)]
        for step, slipped in zip(relative(smooth[:-1], smooth[1:]), drift, strict=False):
            poses.append(compose(poses[-1], step) + slipped)
        return read, np.array(poses)


def nees_of(state, pose):
    """Normalized estimation error squared of x, y and yaw."""
    miss = state.pose - pose
    miss[2] = wrap_angle(miss[2])
    return miss @ np.linalg.solve(state.pose_covariance, miss)


WORLDS = {
    'garden': {'every': 10, 'seconds': 25, 'share': 0.7, 'length': 1.0},
    'slow, white': {'speed': 0.05, 'rate_hz': 20, 'every': 10, 'seconds': 80, 'length': 1.0},
    'slow, alike': {'speed': 0.05, 'rate_hz': 20, 'every': 10, 'seconds': 80, 'share': 0.8,
                    'length': 0.3},
    'no heading': {'speed': 0.8, 'rate_hz': 20, 'seconds': 40, 'share': 0.5, 'length': 1.0},
}  # fmt: skip


def robots(name):
    """As many as SEEDS, with the correlation of their images, which have a heading or not."""
    stds = {'v_std': 0.03, 'omega_std': 0.02, 'position_std': 0.15, 'yaw_std': 0.04}
    for seed in range(SEEDS):
        robot = Robot(**WORLDS[name], **stds, seed=seed)
        yield robot, ErrorCorrelation(robot.share, robot.length), name != 'no heading'


def test_limits_are_quantiles_of_squared_distances():
    for limits, share in ((ekf.GATE, 0.999), (ekf.OUTLYING, 0.8)):
        assert limits == pytest.approx({size: chi2.ppf(share, size) for size in (2, 3)})


@pytest.mark.parametrize('name', WORLDS)
def test_the_filter_as_shipped_errs_as_it_says(name):
    nees, updates = np.zeros(3), []
    for robot, correlation, heading in robots(name):
        fused, count = PoseFilter(SHIPPED, correlation), len(robot.read)
        checks = [count // 2, 3 * count // 4, count - 1]
        for event in robot.events():
            update = robot.give(fused, event, heading)
            if event[1]:
                updates += [update] if math.isfinite(update.d2) else []
            elif event[2] in checks:
                nees[checks.index(event[2])] += nees_of(fused.state, robot.poses[event[2]])
    # At each of the three times, robots are independent of each other: their sum is chi-square.
    low, high = chi2.ppf([0.0005, 0.9995], 3 * SEEDS)
    assert np.all((low < nees) & (nees < high))
    # Innovations of one robot are nearly white; the gate cuts what is beyond 99.9 %.
    freedom = len(updates) * (3 if heading else 2)
    low, high = chi2.ppf([0.0005, 0.9995], freedom) / freedom
    assert low - 0.02 < sum(update.d2 for update in updates) / freedom < high
    assert np.mean([not update.accepted for update in updates]) < 0.005


@pytest.mark.parametrize('name', ['garden', 'no heading'])
def test_smoothed_estimates_err_as_they_say(name):
    nees = 0.0
    for robot, correlation, heading in robots(name):
        fused, k = Smoother(SHIPPED, correlation), len(robot.read) // 2
        robot.feed(fused, heading)
        states = {state.stamp_ns: state for state in fused.smoothed()}
        nees += nees_of(states[int(robot.stamps_ns[k])], robot.poses[k])
    low, high = chi2.ppf([0.0005, 0.9995], 3 * SEEDS)
    assert low < nees < high
