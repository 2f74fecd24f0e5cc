# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The CTRV motion: against finite differences and hand-made arcs."""

import functools
import math

import numpy as np
import pytest

from sfa_localization.data.geometry import wrap_angle
from sfa_localization.fusion import motion
from sfa_localization.fusion.motion import ERROR, OMEGA, SCALE, SIZE, YAW, MotionNoise, Twist, V

NOISE = MotionNoise(slip_per_meter=0.02, yaw_per_radian=0.02, decorrelation_m=1.0)


def random_mean(rng):
    mean = rng.normal(size=SIZE)
    mean[YAW] = rng.uniform(-3, 3)
    mean[motion.BIAS], mean[SCALE] = rng.normal(size=2) * 0.05
    return mean


def differences(function, mean, step=1e-6):
    columns = []
    for i in range(SIZE):
        nudge = np.zeros(SIZE)
        nudge[i] = step
        change = function(mean + nudge) - function(mean - nudge)
        change[YAW] = wrap_angle(change[YAW])
        columns.append(change / (2 * step))
    return np.array(columns).T


@pytest.mark.parametrize('omega', [0.7, -1.5, 1e-3, 1e-7, 0.0])
@pytest.mark.parametrize('v', [1.0, -0.6])
def test_jacobians_are_the_derivatives_and_noise_is_symmetric_and_positive(v, omega):
    mean, twist = random_mean(np.random.default_rng(1)), Twist(v, omega, 1e-4, 1e-4)
    mean[V], mean[OMEGA] = v, omega
    changes = np.array([0.2, 0.1])
    for step in (
        motion.drive,
        functools.partial(motion.coast, changes=changes),
        functools.partial(motion.halt, changes=changes),
    ):
        _, jacobian, noise = step(mean, twist, 0.3, NOISE)
        assert np.allclose(noise, noise.T) and np.linalg.eigvalsh(noise)[0] > -1e-15
        # The shared error fades with the distance; that derivative is second order and left out.
        numeric = differences(lambda m, step=step: step(m, twist, 0.3, NOISE).mean, mean)
        assert np.allclose(jacobian[:ERROR], numeric[:ERROR], atol=1e-7)
        assert np.allclose(jacobian[ERROR:, ERROR:], numeric[ERROR:, ERROR:], atol=1e-7)


def test_a_quarter_circle_is_a_quarter_circle_and_the_heading_stays_wrapped():
    twist, start = Twist(math.pi / 2, math.pi / 2, 0.0, 0.0), np.zeros(SIZE)
    after = motion.drive(start, twist, 1.0, NOISE).mean
    assert np.allclose(after[:3], [1.0, 1.0, math.pi / 2], atol=1e-12)
    start[YAW] = 3.1
    after = motion.drive(start, Twist(1.0, 1.0, 0.0, 0.0), 0.2, NOISE).mean
    assert after[YAW] == pytest.approx(3.3 - 2 * math.pi)


def test_errors_of_readings_do_not_average_out_with_the_rate_of_messages():
    twist, smooth = Twist(1.0, 0.0, 0.04, 0.0), NOISE._replace(slip_per_meter=0.0)
    for hz in (1, 10, 1000):
        along = hz * motion.drive(np.zeros(SIZE), twist, 1 / hz, smooth).noise[0, 0]
        assert along == pytest.approx(0.04 * (motion.ODOMETRY_CORRELATION_S + 1 / hz), rel=0.3)


@pytest.mark.parametrize(('loss', 'v', 'omega', 'speed'), [
    (0.1, 0.5, 1.0, 0.4), (-0.1, -0.5, -1.0, -0.6),
    (0.1, 0.05, 1.0, 0.05),  # on the spot
    (0.4, 0.5, 1.0, 0.5),  # it would stop the robot
])  # fmt: skip
def test_a_loss_in_turns_slows_the_robot_and_never_turns_it_around(loss, v, omega, speed):
    mean = np.zeros(SIZE)
    mean[motion.LOSS] = loss
    step = motion.drive(mean, Twist(v, omega, 0.0, 0.0), 0.1, NOISE)
    assert step.mean[motion.V] == pytest.approx(speed)
    by_loss = 0.0 if speed == v else -math.copysign(abs(omega), v)
    assert step.jacobian[motion.V, motion.LOSS] == pytest.approx(by_loss)
