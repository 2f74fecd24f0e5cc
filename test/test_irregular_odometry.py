# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry whose stamps are irregular, because messages are bundled or stamped on reception."""

import math

import numpy as np
import pytest
from filter_drives import START_NS, Drive, known

from sfa_localization.data.run import Trajectory
from sfa_localization.fusion.pose_filter import Level, PoseFilter


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
    held = (times % 1.0) > 0.6
    end = np.floor(times) + 1.0
    return np.where(held, end - 1e-4 * (1 + 50 - count % 50), times)


@pytest.mark.parametrize('stamped', [bursts, received, stalled])
def test_odometry_with_poses_may_be_stamped_irregularly(stamped):
    """The poses show how far it was, whatever the stamps; images come at 8 Hz in between."""
    drive, fused, errors = Drive(seconds=20, omega_std=0.01, v_std=0.02), PoseFilter(), []
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
        update = fused.add_measurement(stamp_ns, pose, np.diag([0.0025, 0.0025, 0.0004]))
        errors.append(math.hypot(*(fused.state.pose - pose)[:2]))
        assert update.accepted and abs(fused.state.twist[0]) < 2.5
        if t > 8.0:
            assert fused.status.level is Level.LOCALISED
    assert max(errors) < 0.1


def test_images_stamped_with_the_odometry_after_a_stall_belong_where_they_came():
    """A delay of 20 ms would put an image before all that came together, 0.4 m away."""
    drive, fused = Drive(seconds=20, omega_std=0.01, v_std=0.02, every=7), PoseFilter()
    errors = []
    fused.expect_delay(0.02)
    times = stalled(np.arange(len(drive.stamps_ns)) / 50.0)
    for i, t in enumerate(times.tolist()):
        stamp_ns = START_NS + round(t * 1e9)
        fused.add_odometry(stamp_ns, *drive.read[i], drive.variances(), drive.reckoned[i])
        if i in drive.pictures:
            pose, covariance = drive.poses[i], np.diag([0.0025, 0.0025, 0.0004])
            assert fused.add_measurement(stamp_ns + 50_000, pose, covariance).accepted
            errors.append(math.hypot(*(fused.state.pose - pose)[:2]))
    assert max(errors) < 0.1


def test_a_speed_that_no_twist_says_is_not_that_of_a_stall():
    """Of odometry that fills its poses only, bundled ones show how far it was, not how fast."""
    drive, fused = Drive(seconds=10), known()
    times = stalled(np.arange(len(drive.stamps_ns)) / 50.0)
    speeds = []
    for t, pose in zip(times.tolist(), drive.reckoned, strict=True):
        fused.add_odometry(START_NS + round(t * 1e9), 0.0, 0.0, (0.0, 0.0), pose)
        speeds.append(fused.state.twist[0])
    assert max(speeds) < 2.5
