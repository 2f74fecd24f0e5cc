# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The pose filter against filterpy alone, and a run of a million steps: `python bench_filter.py`.

Both sides predict and update with the same motion model on the same data, in turns, in one run;
what the ratio shows is the price of the history, the gate, recovery and immutable states.
"""

from __future__ import annotations

import json
import math
import resource
import statistics
import sys
import time

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.fusion import motion
from sfa_localization.fusion.health import LIKELY
from sfa_localization.fusion.motion import ERROR, SIZE, YAW, MotionNoise, Twist
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig

START_NS = 1_700_000_000_000_000_000
STEP_NS = 20_000_000
READING = (0.8, 0.3, 4e-4, 1e-4)
CORRELATION = ErrorCorrelation()
NOISE = MotionNoise(
    FilterConfig().slip_per_meter, FilterConfig().yaw_per_radian, CORRELATION.distance_m
)
SPREAD = np.diag([0.04, 0.04, 0.0025])


class Bare(ExtendedKalmanFilter):
    """filterpy with the CTRV model: the least that anyone would write."""

    def predict_x(self, u: object = 0) -> None:
        self.x = self.next_x


def wrapped(z: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Difference of poses with its angle in [-pi, pi)."""
    difference = z - predicted
    difference[2] = (difference[2] + math.pi) % (2 * math.pi) - math.pi
    return difference


def bare_steps(poses: np.ndarray) -> float:
    """Seconds that filterpy alone takes for one predict and update per pose."""
    twist = Twist(*READING)
    ekf = Bare(SIZE, 3)
    ekf.x, ekf.P = np.zeros(SIZE), PoseFilter()._ekf.blank(0).covariance
    share = CORRELATION.share
    start = time.thread_time()
    for pose in poses:
        step = motion.drive(ekf.x, twist, STEP_NS * 1e-9, NOISE)
        ekf.F, ekf.Q, ekf.next_x = step.jacobian, step.noise, step.mean
        ekf.predict()
        h = np.zeros((3, SIZE))
        h[:, :3] = np.eye(3)
        h[:, ERROR:] = math.sqrt(share) * np.linalg.cholesky(SPREAD)
        ekf.update(
            pose, lambda _, h=h: h, lambda x, h=h: h @ x, (1 - share) * SPREAD, residual=wrapped
        )
        ekf.x[YAW] = (ekf.x[YAW] + math.pi) % (2 * math.pi) - math.pi
    return time.thread_time() - start


def our_steps(poses: np.ndarray) -> float:
    """Seconds that PoseFilter takes for the same."""
    fused = PoseFilter()
    fused.set_pose(START_NS, poses[0], SPREAD)
    trusted, start = 0, time.thread_time()
    for k, pose in enumerate(poses, 1):
        stamp_ns = START_NS + k * STEP_NS
        fused.add_odometry(stamp_ns, *READING[:2], READING[2:])
        fused.add_measurement(stamp_ns, pose, SPREAD)
        trusted += fused.health.well > LIKELY
    return time.thread_time() - start


def circle(steps: int) -> np.ndarray:
    """Where the reading leads, with errors as large as told (steps, 3)."""
    mean = np.zeros(SIZE)
    rng = np.random.default_rng(1)
    poses = np.empty((steps, 3))
    for k in range(steps):
        mean = motion.drive(mean, Twist(*READING), STEP_NS * 1e-9, NOISE).mean
        poses[k] = mean[:3] + rng.standard_normal(3) * np.sqrt(np.diag(SPREAD)) / 2
    return poses


def bench_filter(steps: int = 500, rounds: int = 15) -> dict[str, float]:
    """Median ratio of the two, and what one step costs."""
    poses = circle(steps)
    our_steps(poses[:50])
    ratios, ours = [], []
    for turn in range(rounds):
        sides = [bare_steps, our_steps]
        if turn % 2:
            sides.reverse()
        taken = {side: side(poses) for side in sides}
        ratios.append(taken[our_steps] / taken[bare_steps])
        ours.append(taken[our_steps] / steps * 1e6)
    return {
        'filter_over_filterpy': round(statistics.median(ratios), 3),
        'filter_step_us': round(statistics.median(ours), 1),
    }


def bench_long_run(steps: int = 1_000_000) -> dict[str, float]:
    """Odometry at 50 Hz with a picture at 5 Hz: the covariance's least eigenvalue, and memory."""
    fused = PoseFilter()
    fused.set_pose(START_NS, (0, 0, 0), SPREAD)
    least, memory = math.inf, 0
    for k in range(1, steps + 1):
        stamp_ns = START_NS + k * STEP_NS
        fused.add_odometry(stamp_ns, *READING[:2], READING[2:])
        if k % 10 == 0:
            fused.add_measurement(stamp_ns, fused.state.pose, SPREAD)
        if k % 1000 == 0:
            covariance = fused.state.covariance
            assert np.array_equal(covariance, covariance.T)
            least = min(least, float(np.linalg.eigvalsh(covariance)[0]))
        if k == steps // 10:
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
    return {
        'filter_steps': steps,
        'filter_least_eigenvalue': least,
        'filter_memory_growth_mib': round(grown / 1024, 1),
    }


if __name__ == '__main__':
    sys.stdout.write(json.dumps(bench_filter()) + '\n')
    if '--long' in sys.argv:
        sys.stdout.write(json.dumps(bench_long_run()) + '\n')
