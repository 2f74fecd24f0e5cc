# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Tuning: the likelihood finds the noise that is there, the grid the least error."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from filter_drives import FilterDrive
from places import as_complex

from sfa_localization import tuning
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.run import Odometry, Trajectory
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.observer import Observation, unusable_covariance
from sfa_localization.tuning import TuningDrive


def tuning_drive(claimed=0.2, true=0.2):
    """A drive whose images err by `true` m and claim a standard deviation of `claimed` m."""
    drive = FilterDrive(seconds=20, rate_hz=20, every=4, v_std=0.02, omega_std=0.01,
                  position_std=true, yaw_std=0.05, share=0.7)  # fmt: skip
    variances = np.tile([4e-4, 1e-4], (len(drive.stamps_ns), 1))
    spread = np.diag([claimed**2, claimed**2, 0.05**2])
    images = [
        Observation(pose, spread, np.zeros(1), stamp_ns=stamp_ns, turned=yaw_rad)
        for stamp_ns, pose, yaw_rad in zip(
            drive.stamps_ns[drive.pictures].tolist(), drive.seen, drive.poses[drive.pictures, 2],
            strict=True,
        )
    ]  # fmt: skip
    odometry = Odometry(drive.stamps_ns, drive.poses, drive.read, variances)
    return TuningDrive(odometry, images, Trajectory(drive.stamps_ns, drive.poses))


def test_the_likelihood_needs_no_truth_and_is_best_near_the_true_noise():
    """Also when a filter that expects too little noise rejects nearly all."""
    drives = [replace(tuning_drive(claimed=0.2, true=0.4), truth=None)]
    costs = {
        factor: tuning.likelihood_cost(drives, FilterConfig(measurement_factor=factor))
        for factor in (1e-3, 0.25, 4.0, 64.0)
    }
    assert costs[4.0] < costs[0.25] and costs[4.0] < costs[64.0]
    assert costs[1e-3] > costs[4.0] + 0.5


def test_the_searches_find_the_least_cost_and_stay_in_the_ranges(monkeypatch):
    def cost(_, config):
        return as_complex(np.log([config.measurement_factor / 4, config.odometry_factor / 0.5]))

    monkeypatch.setattr(tuning, 'TRIALS', 400)
    monkeypatch.setattr(tuning, 'likelihood_cost', lambda *at: abs(cost(*at)))
    monkeypatch.setattr(tuning, 'error_cost', lambda *at: abs(cost(*at)))
    for search in (tuning.tune_by_likelihood, tuning.tune_by_grid):
        best = search([], FilterConfig())
        assert [best.measurement_factor, best.odometry_factor] == pytest.approx([4, 0.5], rel=0.1)
    monkeypatch.setattr(tuning, 'likelihood_cost', lambda _, config: -config.measurement_factor)
    assert tuning.tune_by_likelihood([], FilterConfig()).measurement_factor == 1e4


def test_the_error_is_measured_after_alignment_and_the_models_error_correlation_is_used():
    """Errors that neighbors share are no surprise to a filter that expects them."""
    plain, config = tuning_drive(), FilterConfig()
    there = Trajectory(plain.truth.stamps_ns, plain.truth.poses + np.array([100.0, -50.0, 0.0]))
    moved = tuning.error_cost([replace(plain, truth=there)], config)
    assert moved == pytest.approx(tuning.error_cost([plain], config))
    white, shared = (
        tuning.likelihood_cost(
            [replace(plain, filter_for=partial(PoseFilter, correlation=correlation))], config
        )
        for correlation in (ErrorCorrelation(0.0, 1.0), ErrorCorrelation(0.7, 0.6))
    )
    assert shared < white


def test_images_that_are_stamped_late_are_no_noise_and_unusable_ones_do_not_count():
    """Turns of the images show the delay in a trial as they do live."""
    plain, config = tuning_drive(claimed=0.05, true=0.02), FilterConfig()
    late = [replace(image, stamp_ns=image.stamp_ns + 300_000_000) for image in plain.observations]
    by_turns = replace(plain, observations=late)
    unturned = replace(plain, observations=[replace(image, turned=math.nan) for image in late])
    # Without turns the filter learns the delay from the way alone, later.
    assert tuning.error_cost([by_turns], config) < 0.5 * tuning.error_cost([unturned], config)
    unusable = {'problem': 'dark', 'covariance': unusable_covariance()}
    dark = [replace(image, **unusable, stamp_ns=image.stamp_ns + 1) for image in plain.observations]
    images = sorted([*plain.observations, *dark], key=lambda image: image.stamp_ns)
    with_dark = replace(plain, observations=images)
    for cost in (tuning.likelihood_cost, tuning.error_cost):
        assert cost([with_dark], config) == pytest.approx(cost([plain], config))
