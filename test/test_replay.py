# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A replay is deterministic, and no decision of the filter hangs on a microsecond."""

import numpy as np
from filter_drives import Drive

from sfa_localization.fusion.pose_filter import PoseFilter

MICROSECOND = 1000
NOISY = {'position_std': 0.1, 'yaw_std': 0.03, 'v_std': 0.02, 'omega_std': 0.01}
SPREAD = np.diag([0.01, 0.01, 0.0009])


def kidnapped() -> Drive:
    drive = Drive(seconds=40, **NOISY)
    drive.kidnap(200, (4.0, 1.0, 0.5))
    return drive


def replayed(drive, later=lambda kind, index: 0):
    """Means, covariances, and what became of the images; each stamp is `later` by so many ns."""
    fused, means, spreads, reasons = PoseFilter(), [], [], []
    for stamp_ns, kind, index in drive.events():
        at_ns = stamp_ns + later(kind, index)
        if kind == 0:
            fused.add_odometry(at_ns, *drive.read[index], drive.variances())
        else:
            reasons.append(fused.add_measurement(at_ns, drive.seen[index], SPREAD).reason)
        state = fused.state
        if state is not None:
            means.append(state.mean)
            spreads.append(state.covariance)
    return np.array(means), np.array(spreads), reasons


def test_another_start_of_time_changes_no_bit():
    """All stamps later by a microsecond: as when a recording is replayed at another time."""
    drive = kidnapped()
    for first, then in zip(replayed(drive), replayed(drive, lambda *_: MICROSECOND), strict=True):
        np.testing.assert_array_equal(first, then)


def test_a_stamp_that_is_a_microsecond_late_changes_nothing():
    """Of each image: at 1 m/s the robot drives a micrometer, and the estimate moves no more."""
    drive = kidnapped()
    means, _, reasons = replayed(drive)
    assert 'restarted elsewhere' in reasons and 'outside the gate' in reasons
    later, _, same = replayed(drive, lambda kind, _: kind * MICROSECOND)
    assert same == reasons
    np.testing.assert_allclose(later[:, :3], means[:, :3], atol=5e-6)


def test_a_stamp_that_is_on_the_other_side_of_an_odometry_message_changes_no_decision():
    """Just before it, an image is fused by the motion of the message before: other noise, by which
    one at the border of the gate may lie on its other side.
    """
    drive = kidnapped()
    means, _, reasons = replayed(drive)
    earlier, _, same = replayed(drive, lambda kind, _: -kind * MICROSECOND)
    assert sum(a != b for a, b in zip(same, reasons, strict=True)) <= 1
    np.testing.assert_allclose(earlier[:, :3], means[:, :3], atol=0.01)
