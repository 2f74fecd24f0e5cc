# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Robots unlike the simulator's: what must not matter does not, over many random drives.

The odometry frame lies anywhere, the gyroscope has a bias and gaps, odometry comes at any rate and
with pauses, and a second drive starts elsewhere.
"""

from dataclasses import dataclass

import numpy as np
from metric_worlds import criss_cross, drive, garden_features

from sfa_localization.data.geometry import align, compose, wrap_angle
from sfa_localization.data.run import Odometry, YawRate
from sfa_localization.metric import learning as metric
from sfa_localization.metric.segments import cut, join
from sfa_localization.metric.settings import MetricConfig, SegmentConfig

QUICK = MetricConfig(metric_map='monomials', slow_features=5)
CUT = SegmentConfig()


@dataclass(frozen=True)
class Robot:
    """What is unlike the simulator's robot about one robot, drawn at random."""

    frame: np.ndarray
    gyro: str
    gyro_bias: float
    gyro_gap_s: tuple[float, float]
    every: int
    pause_s: tuple[float, float]

    @classmethod
    def draw(cls, seed, length_s):
        rng = np.random.default_rng([77, seed])
        frame = np.array([*rng.uniform(-100, 100, 2), rng.uniform(-np.pi, np.pi)])
        at = rng.uniform(0.2, 0.7, 2) * length_s
        return cls(
            frame=frame,
            gyro=str(rng.choice(['none', 'whole', 'gap', 'ends', 'whole'])),
            gyro_bias=float(rng.normal(0, 0.01)),
            gyro_gap_s=(at[0], at[0] + rng.uniform(3, 10)),
            every=int(rng.choice([1, 2, 5, 10])),
            pause_s=(at[1], at[1] + float(rng.choice([0.0, 4.0]))),
        )

    def odometry(self, exact):
        """The odometry as this robot's driver publishes it, (N,) at its own rate."""
        seconds = (exact.stamps_ns - exact.stamps_ns[0]) * 1e-9
        kept = np.arange(len(seconds)) % self.every == 0
        kept &= (seconds < self.pause_s[0]) | (seconds >= self.pause_s[1])
        poses = compose(self.frame, exact.poses[kept])
        return Odometry(exact.stamps_ns[kept], poses, exact.twists[kept], exact.variances[kept])

    def yaw_rate(self, exact):
        """The gyroscope's readings, or None."""
        if self.gyro == 'none':
            return None
        seconds = (exact.stamps_ns - exact.stamps_ns[0]) * 1e-9
        start, stop = self.gyro_gap_s
        kept = np.ones(len(seconds), bool)
        if self.gyro == 'gap':
            kept = (seconds < start) | (seconds >= stop)
        if self.gyro == 'ends':
            kept = seconds < start
        omega = exact.omega + self.gyro_bias
        return YawRate(exact.stamps_ns[kept], omega[kept], exact.variance[kept])


def learn(runs, seed):
    """The map of drives (odometry, image stamps, yaw rate, true poses); (images, places, truth)."""
    parts = [cut(odometry, stamps, CUT, gyro) for odometry, stamps, gyro, _ in runs]
    offsets = np.cumsum([0, *(len(stamps) for _, stamps, _, _ in runs)])[:-1]
    segments = join(parts, [int(offset) for offset in offsets])
    truth = np.concatenate([poses for *_, poses in runs])
    features = garden_features(truth[:, :2], noise=0.02, count=5, world=seed)
    result = metric.learn_metric(features, segments, QUICK)
    images, places = metric.positions(result, segments)
    return result, images, places, metric.headings(result, segments)[1], truth


def errors(runs, draw):
    """Mean error, m and degrees, of a map of drives, after rigid alignment."""
    _, images, places, headings, truth = learn(runs, draw)
    laid = align(places, truth[images, :2])
    off = np.hypot(*(laid.apply(places) - truth[images, :2]).T)
    turned = wrap_angle(laid.apply_yaw(headings) - truth[images, 2])
    return off.mean(), np.degrees(np.abs(turned).mean())


def two_drives(draw, others):
    """Two drives through one place, by the simulator's robot or by two unlike it."""
    runs = []
    for second in (False, True):
        twists, start = criss_cross(8, seed=draw + 1000 * second)
        run = drive(twists, start=start, yaw_noise=0.005, seed=draw + second)
        robot = Robot.draw(draw + 500 * second, len(twists) / 50)
        odometry = robot.odometry(run.odometry) if others else run.odometry
        gyro = robot.yaw_rate(run.gyro) if others else run.gyro
        runs.append((odometry, run.stamps_ns, gyro, run.poses))
    return runs


def test_any_robot_gives_nearly_as_good_a_map():
    """Eight robots, beside the simulator's on the same way: rates, gaps, frames."""
    plain, other = (
        np.array([errors(two_drives(draw, others), draw) for draw in range(8)])
        for others in (False, True)
    )
    assert np.all(np.median(other, axis=0) < 1.2 * np.median(plain, axis=0) + [0.02, 0.2])
    assert np.all(other < 2.0 * plain + [0.3, 3.0])
