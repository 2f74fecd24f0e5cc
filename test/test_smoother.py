# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Smoothing a drive: better than filtering, and as certain as it says."""

import numpy as np
import pytest
from filter_drives import Drive
from filterpy.kalman import KalmanFilter
from scipy.stats import chi2
from test_filter_consistency import OMEGA_STD, PICTURE_STD, SEEDS, SHIPPED, V_STD, WORLDS, Robot

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.fusion import smoother
from sfa_localization.fusion.belief import OdometryEvent
from sfa_localization.fusion.motion import SIZE, YAW
from sfa_localization.fusion.recover import Recovery
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.smoother import Smoother

pytestmark = pytest.mark.slow  # trains, or replays many drives

NOISY = {'v_std': 0.03, 'omega_std': 0.02, 'position_std': 0.2, 'yaw_std': 0.05}


def fed(drive, events=None, heading=True):
    fused = Smoother(FilterConfig())
    for event in events or drive.events(heading):
        drive.give(fused, event, heading)
    return fused


def distances(drive, states):
    at = np.searchsorted(drive.stamps_ns, [state.stamp_ns for state in states])
    places = np.array([state.pose[:2] for state in states])
    return np.hypot(*(places - drive.poses[at, :2]).T)


def filtered(drive, heading=True):
    fused, states = Smoother(FilterConfig()), []
    for event in drive.events(heading):
        drive.give(fused, event, heading)
        if event[1] == 0 and fused.state is not None:
            states.append(fused.at(event[0]))
    return states


@pytest.mark.parametrize('heading', [True, False])
def test_a_smoothed_drive_is_nearer_to_the_truth(heading):
    drive = Drive(seconds=40, start=(3.0, -2.0, 2.9), **NOISY)
    states = fed(drive, heading=heading).smoothed()
    live = filtered(drive, heading)
    assert len(states) == len(live)
    assert distances(drive, states).mean() < 0.7 * distances(drive, live).mean()
    newest = states[-1], live[-1]
    assert np.allclose(newest[0].mean, newest[1].mean)
    assert np.allclose(newest[0].covariance, newest[1].covariance)


def test_a_robot_that_stands_was_always_where_it_is_found_in_the_end():
    drive = Drive(twists=np.zeros((500, 2)), start=(3.0, -2.0, 2.9), **NOISY)
    drive.read[:] = 0.0
    states = fed(drive).smoothed()
    poses = np.array([state.pose for state in states])
    assert np.abs(poses - poses[-1]).max() < 1e-3
    stds = np.array([state.position_std for state in states])
    assert np.allclose(stds, stds[-1], rtol=0.02)


def test_on_a_linear_model_it_is_filterpys_smoother():
    rng = np.random.default_rng(1)
    model = KalmanFilter(SIZE, 2)
    model.F = np.eye(SIZE) + 0.1 * rng.normal(size=(SIZE, SIZE))
    model.F[YAW], model.F[YAW, YAW] = 0.0, 1.0  # the only angle: it must not wrap
    model.H, model.Q, model.R = np.eye(2, SIZE), 0.01 * np.eye(SIZE), 0.04 * np.eye(2)
    model.x = np.zeros((SIZE, 1))
    means, covariances, predicted, spreads = model.batch_filter(rng.normal(size=(30, 2, 1)))
    theirs, their_spreads, *_ = model.rts_smoother(means, covariances)
    blank = Recovery(FilterConfig(), ErrorCorrelation()).blank(0)._replace(located=True)
    stages, before = [], blank
    for k in range(30):
        link = smoother._Link(before, model.F, predicted[k, :, 0], spreads[k])
        before = blank._replace(mean=means[k, :, 0], covariance=covariances[k])
        event = OdometryEvent(k, blank.twist)
        stages.append(smoother._Stage(event, before, (link,), k > 0))
    ours = smoother._smoothed(stages)
    assert np.allclose([state.mean for state in ours], theirs[:, :, 0], atol=1e-8)
    assert np.allclose([state.covariance for state in ours], their_spreads, atol=1e-8)


def test_nothing_reaches_back_beyond_a_kidnapping():
    drive = Drive(seconds=60, start=(0.0, 0.0, 0.0), **NOISY)
    drive.kidnap(len(drive.pictures) // 2, (8.0, 5.0, 1.0))
    states = fed(drive).smoothed()
    far = distances(drive, states)
    assert np.median(far) < 0.15
    # Only until the filter noticed that it was elsewhere.
    assert np.count_nonzero(far > 1) < 4 * 50


def test_late_messages_are_smoothed_as_if_in_time():
    drive = Drive(seconds=20, **NOISY)
    events = drive.events(True)
    late = sorted(events, key=lambda event: event[0] + (event[1] == 1) * 400_000_000)
    a, b = fed(drive, events).smoothed(), fed(drive, late).smoothed()
    assert len(a) == len(b)
    assert max(np.abs(x.mean - y.mean).max() for x, y in zip(a, b, strict=True)) < 1e-9


def test_a_reset_begins_another_drive():
    drive = Drive(seconds=20, **NOISY)
    fused, events = Smoother(FilterConfig()), drive.events(True)
    for number, event in enumerate(events):
        if number == len(events) // 2:
            fused.reset()
        drive.give(fused, event, True)
    states = fused.smoothed()
    assert distances(drive, states).mean() < 0.12
    assert len(states) > 0.97 * len(drive.stamps_ns)


def test_without_messages_there_is_nothing_to_smooth():
    assert Smoother(FilterConfig()).smoothed() == []


@pytest.mark.parametrize('name', ['garden', 'slow, white', 'no heading'])
def test_smoothed_estimates_err_as_they_say(name):
    world, nees = WORLDS[name], []
    for seed in range(SEEDS):
        robot = Robot(world, seed)
        fused = Smoother(SHIPPED, world.error)
        size = 3 if world.heading else 2
        spread = np.diag(PICTURE_STD**2)[:size, :size]
        seen = dict(zip(robot.pictures.tolist(), robot.seen, strict=True))
        for k, stamp_ns in enumerate(robot.stamps_ns.tolist()):
            fused.add_odometry(stamp_ns, *robot.read[k], (V_STD**2, OMEGA_STD**2))
            if k in seen:
                fused.add_measurement(stamp_ns, seen[k][:size], spread)
        states = {state.stamp_ns: state for state in fused.smoothed()}
        k = len(robot.stamps_ns) // 2
        state = states[int(robot.stamps_ns[k])]
        miss = state.pose - robot.truth(k)
        miss[2] = wrap_angle(miss[2])
        nees.append(miss @ np.linalg.solve(state.pose_covariance, miss))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * SEEDS)
    assert low < sum(nees) < high
