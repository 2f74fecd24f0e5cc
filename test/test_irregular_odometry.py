# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry whose stamps are irregular, because messages are bundled or stamped on reception; and
odometry that repeats commands, which the robot follows by the camera's delay later.
"""

import math

import numpy as np
import pytest
from filter_drives import SECOND, START_NS, FilterDrive, started

from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.data.run import Trajectory
from sfa_localization.fusion.inputs import OpenLoop
from sfa_localization.fusion.pose_filter import Level, PoseFilter

SURE = np.diag([0.0025, 0.0025, 0.0004])


def bursts(times):
    """Stamps s of odometry at 50 Hz that is stamped in pairs, 1 ms apart."""
    return times + np.where(np.arange(len(times)) % 2, 0.0, 0.019)


def received(times):
    """Stamps s of odometry that is stamped on reception, exponentially late; order is kept."""
    late = np.random.default_rng(0).exponential(0.01, len(times))
    return np.maximum.accumulate(times + late) + 1e-6 * np.arange(len(times))


def stalled(times):
    """Stamps s of odometry of which 0.4 s arrive together, 0.1 ms apart, every second."""
    count = np.arange(len(times))
    end = np.floor(times) + 1.0
    return np.where((times % 1.0) > 0.6, end - 1e-4 * (1 + 50 - count % 50), times)


@pytest.mark.parametrize('stamped', [bursts, received, stalled])
def test_odometry_with_poses_may_be_stamped_irregularly(stamped):
    """The poses show how far it was, whatever the stamps; images come at 8 Hz in between."""
    drive, fused, errors = FilterDrive(seconds=20, omega_std=0.01, v_std=0.02), PoseFilter(), []
    times = np.arange(len(drive.stamps_ns)) / 50.0
    coming = [(t, 0, i) for i, t in enumerate(stamped(times).tolist())]
    coming += [(t, 1, 0) for t in np.arange(1.013, 19.0, 0.125).tolist()]
    path = Trajectory(drive.stamps_ns, drive.poses)
    for t, kind, i in sorted(coming):
        stamp_ns = START_NS + round(t * 1e9)
        if kind == 0:
            fused.add_odometry(stamp_ns, *drive.read[i], drive.variances(), drive.reckoned[i])
            continue
        pose = path.at(np.array([stamp_ns]))[0]
        update = fused.add_measurement(stamp_ns, pose, SURE)
        errors.append(math.hypot(*(fused.state.pose - pose)[:2]))
        assert update.accepted and abs(fused.state.twist[0]) < 2.5
        if t > 8.0:
            assert fused.status.level is Level.LOCALISED
    assert max(errors) < 0.1


def test_a_speed_that_no_twist_says_is_not_that_of_a_stall():
    """Of odometry that fills its poses only, bundled ones show how far it was, not how fast."""
    drive, fused = FilterDrive(seconds=10), started()
    times = stalled(np.arange(len(drive.stamps_ns)) / 50.0)
    for t, pose in zip(times.tolist(), drive.reckoned, strict=True):
        fused.add_odometry(START_NS + round(t * 1e9), 0.0, 0.0, (0.0, 0.0), pose)
        assert fused.state.twist[0] < 2.5


# Commands.

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
    assert odometry.repeats is repeats


@pytest.mark.parametrize(('noise', 'delay_s'), [(0.0, DELAY_S), (1e-3, 0.0)])
def test_the_estimate_is_where_commands_led_a_camera_delay_ago(noise, delay_s):
    drive, fused = FilterDrive(twists=held(noise)), started(std=0.01)
    fused.expect(Rig(camera_delay=Quantity(DELAY_S, 0.2)))
    for stamp_ns, (v, omega) in zip(drive.stamps_ns.tolist(), drive.twists.tolist(), strict=True):
        fused.add_odometry(stamp_ns, v, omega)
    for i in (450, 520, 599):
        state = fused.at(int(drive.stamps_ns[i]))
        assert state.stamp_ns == int(drive.stamps_ns[i])
        assert np.allclose(state.pose, drive.poses[i - round(delay_s * RATE_HZ)], atol=1e-4)
    assert np.array_equal(fused.state.pose, state.pose)
    times = START_NS + np.round(np.arange(9.0, 13.0, 0.005) * SECOND).astype(int)
    poses = np.array([fused.at(at).pose for at in times.tolist()])
    # A twist holds from the stamp before: what a message changes is known one period later.
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.02
    assert np.abs(np.diff(poses[:, 2])).max() < 0.03
