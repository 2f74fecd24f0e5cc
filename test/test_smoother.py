# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A smoothed drive is nearer to the truth; test_filter_consistency.py tests its covariances."""

import numpy as np
import pytest
from filter_drives import NOISY, FilterDrive, fed

from sfa_localization.fusion.smoother import Smoother

pytestmark = pytest.mark.slow  # replays drives backward


def distances(drive, states):
    at = np.searchsorted(drive.stamps_ns, [state.stamp_ns for state in states])
    places = np.array([state.pose[:2] for state in states])
    return np.hypot(*(places - drive.poses[at, :2]).T)


@pytest.mark.parametrize('heading', [True, False])
def test_a_smoothed_drive_is_nearer_to_the_truth(heading):
    drive, fused, live = FilterDrive(seconds=40, start=(3.0, -2.0, 2.9), **NOISY), Smoother(), []
    for event in drive.events():
        drive.give(fused, event, heading)
        if event[1] == 0 and fused.state is not None:
            live.append(fused.at(event[0]))
    states = fused.smoothed()
    assert len(states) == len(live)
    assert distances(drive, states).mean() < 0.82 * distances(drive, live).mean()
    assert np.allclose(states[-1].mean, live[-1].mean)
    assert np.allclose(states[-1].covariance, live[-1].covariance)


def test_nothing_reaches_back_beyond_a_kidnapping():
    drive = FilterDrive(seconds=60, **NOISY)
    drive.kidnap(len(drive.pictures) // 2, (8.0, 5.0, 1.0))
    far = distances(drive, fed(Smoother(), drive).smoothed())
    # Only until the filter noticed that it was elsewhere.
    assert np.median(far) < 0.2 and np.count_nonzero(far > 1) < 4 * 50


def test_late_messages_are_smoothed_as_if_in_time_and_a_reset_begins_another_drive():
    drive, fused = FilterDrive(seconds=20, **NOISY), Smoother()
    late = sorted(drive.events(), key=lambda event: event[0] + event[1] * 400_000_000)
    a, b = (fed(Smoother(), drive, events).smoothed() for events in (None, late))
    assert max(np.abs(x.mean - y.mean).max() for x, y in zip(a, b, strict=True)) < 1e-9
    assert fused.smoothed() == []
    events = drive.events()
    fed(fused, drive, events[: len(events) // 2]).reset()
    states = fed(fused, drive, events[len(events) // 2 :]).smoothed()
    assert distances(drive, states).mean() < 0.15
    assert len(states) > 0.97 * len(drive.stamps_ns)
