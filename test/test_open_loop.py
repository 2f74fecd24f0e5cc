# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry that repeats commands: the robot follows them by the camera's delay later."""

import numpy as np
import pytest
from filter_drives import SECOND, START_NS, Drive, known

from sfa_localization.fusion.inputs import OpenLoop

DELAY_S, RATE_HZ = 0.3, 50


def held(noise=0.0, speed=1.0):
    """Twists (N, 2) that are commanded twice a second, and read with noise."""
    rng = np.random.default_rng(0)
    commands = np.column_stack([speed * rng.uniform(0.5, 1.0, 24), speed * rng.uniform(-1, 1, 24)])
    return np.repeat(commands, RATE_HZ // 2, 0) + noise * rng.standard_normal((600, 2))


@pytest.mark.parametrize(('twists', 'repeats'), [
    (held(), True), (np.tile([0.5, 0.0], (600, 1)), True),
    (held(noise=1e-3), False), (held(speed=0.0), False), (held()[:100], False),
])  # fmt: skip
def test_equal_twists_of_a_robot_that_moves_are_commands(twists, repeats):
    odometry = OpenLoop()
    for v, omega in twists.tolist():
        odometry.add(v, omega)
    assert odometry.found is repeats


def after(noise):
    """A filter that knows the camera's delay, after odometry alone; the poses that it reports."""
    drive, fused = Drive(twists=held(noise)), known(std=0.01)
    drive.read = drive.twists
    fused.expect_delay(DELAY_S)
    for stamp_ns, (v, omega) in zip(drive.stamps_ns.tolist(), drive.read.tolist(), strict=True):
        fused.add_odometry(stamp_ns, v, omega)
    return drive, fused


@pytest.mark.parametrize(('noise', 'delay_s'), [(0.0, DELAY_S), (1e-3, 0.0)])
def test_the_estimate_is_where_commands_led_a_camera_delay_ago(noise, delay_s):
    drive, fused = after(noise)
    for i in (450, 520, 599):
        state = fused.at(int(drive.stamps_ns[i]))
        assert state.stamp_ns == int(drive.stamps_ns[i])
        assert np.allclose(state.pose, drive.poses[i - round(delay_s * RATE_HZ)], atol=1e-4)
    assert np.array_equal(fused.state.pose, state.pose)


def test_it_is_continuous_from_the_past_into_the_future():
    _, fused = after(0.0)
    seconds = np.arange(9.0, 13.0, 0.005)
    poses = np.array([fused.at(START_NS + round(s * SECOND)).pose for s in seconds])
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    # A twist holds from the stamp before: what a message changes is known one period later.
    assert steps.max() < 0.02 and np.abs(np.diff(poses[:, 2])).max() < 0.03
