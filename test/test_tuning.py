# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Tuning: the likelihood finds the noise that is there, the grid the least error."""

import dataclasses

import numpy as np
import pytest
from filter_drives import Drive

from sfa_localization import tuning
from sfa_localization.cli import main
from sfa_localization.config import load_changes, write_config
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.data.run import Odometry, Trajectory
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.tuning import ImagePoses, Outcome, TuneConfig, TuningDrive


def tuning_drive(claimed=0.2, true=0.2, seed=0, truth=True, seconds=40):
    """A drive whose images err by `true` m and claim a standard deviation of `claimed` m."""
    drive = Drive(seconds=seconds, rate_hz=20, every=4, v_std=0.02, omega_std=0.01,
                  position_std=true, yaw_std=0.05, share=0.7, seed=seed)  # fmt: skip
    count = len(drive.pictures)
    variances = np.tile([4e-4, 1e-4], (len(drive.stamps_ns), 1))
    spread = np.diag([claimed**2, claimed**2, 0.05**2])
    return TuningDrive(
        Odometry(drive.stamps_ns, drive.poses, drive.read, variances),
        ImagePoses(drive.stamps_ns[drive.pictures], drive.seen, np.tile(spread, (count, 1, 1))),
        Trajectory(drive.stamps_ns, drive.poses) if truth else None,
    )  # fmt: skip


def test_the_likelihood_is_best_near_the_true_noise():
    drives = [tuning_drive(claimed=0.2, true=0.4)]
    costs = {
        factor: tuning.likelihood_cost(drives, FilterConfig(measurement_factor=factor))
        for factor in (0.25, 4.0, 64.0)
    }
    assert costs[4.0] < costs[0.25] and costs[4.0] < costs[64.0]


def test_rejecting_everything_is_not_likely():
    drives = [tuning_drive(claimed=0.2, true=0.6)]
    tiny, right = (FilterConfig(measurement_factor=factor) for factor in (1e-3, 9.0))
    assert tuning.likelihood_cost(drives, tiny) > tuning.likelihood_cost(drives, right) + 0.5


def test_the_optimizer_improves_and_needs_no_truth():
    drives = [tuning_drive(claimed=0.1, true=0.4, truth=False)]
    trials = []
    best = tuning.tune_by_likelihood(drives, FilterConfig(), 40, lambda: trials.append(1))
    assert best.cost < tuning.likelihood_cost(drives, FilterConfig()) - 0.05
    assert best.config.measurement_factor > 2.0
    assert 10 < len(trials) <= 45


def test_the_grid_takes_the_least_error(monkeypatch):
    monkeypatch.setattr(tuning, 'FACTORS', (0.25, 1.0, 16.0))
    drives, tried = [tuning_drive(claimed=0.05, true=0.4)], []
    best = tuning.tune_by_grid(drives, FilterConfig(), lambda: tried.append(1))
    assert len(tried) == 9
    assert best.cost == tuning.error_cost(drives, best.config)
    assert best.cost <= tuning.error_cost(drives, FilterConfig())
    assert best.config.measurement_factor > 0.25


def test_the_error_is_measured_after_rigid_alignment():
    plain = tuning_drive()
    moved = TuningDrive(
        plain.odometry,
        plain.images,
        Trajectory(plain.truth.stamps_ns, plain.truth.poses + np.array([100.0, -50.0, 0.0])),
    )
    config = FilterConfig()
    assert tuning.error_cost([moved], config) == pytest.approx(tuning.error_cost([plain], config))


def test_the_method_is_chosen_by_the_settings(monkeypatch):
    monkeypatch.setattr(tuning, 'FACTORS', (1.0,))
    found = tuning.tune([tuning_drive()], FilterConfig(), TuneConfig(method='grid'), progress=False)
    assert found == Outcome(FilterConfig(), tuning.error_cost([tuning_drive()], FilterConfig()))


def test_the_grid_without_truth_says_what_to_do():
    with pytest.raises(DataError, match='use the likelihood'):
        tuning.tune_by_grid([tuning_drive(truth=False)], FilterConfig(), lambda: None)


def test_too_few_images_are_rejected():
    with pytest.raises(DataError, match='too few'):
        tuning.tune([tuning_drive(seconds=2)], FilterConfig(), TuneConfig(), progress=False)


def test_tuned_settings_stay_in_their_ranges():
    far = tuning.with_logs(FilterConfig(), np.full(len(tuning.TUNED), 90.0))
    near = tuning.with_logs(FilterConfig(), np.full(len(tuning.TUNED), -90.0))
    assert far.measurement_factor == 1e4 and near.measurement_factor == 1e-3


def test_the_models_error_correlation_is_used():
    """Errors that neighbors share are no surprise to a filter that expects them."""
    drive = tuning_drive()
    white = dataclasses.replace(drive, correlation=ErrorCorrelation(0.0, 1.0))
    shared = dataclasses.replace(drive, correlation=ErrorCorrelation(0.7, 0.6))
    config = FilterConfig()
    assert tuning.likelihood_cost([shared], config) < tuning.likelihood_cost([white], config)


@pytest.mark.parametrize(('factor', 'better'), [(16.0, True), (0.05, False)])
def test_what_is_worse_on_drives_not_seen_is_noticed(monkeypatch, factor, better):
    drives = [tuning_drive(claimed=0.1, true=0.4, seed=seed) for seed in range(3)]
    asked = []

    def found(others, *_):
        asked.append([k for k, one in enumerate(drives) if any(one is o for o in others)])
        return Outcome(FilterConfig(measurement_factor=factor), 0.0)

    monkeypatch.setattr(tuning, 'tune', found)
    judged = tuning.validate(drives, FilterConfig(), TuneConfig(), progress=False)
    assert asked == [[1, 2], [0, 2], [0, 1]] and judged.better == better


def test_one_drive_is_judged_by_halves():
    whole = tuning_drive()
    first, second = whole.halves()
    assert len(first.images.stamps_ns) + len(second.images.stamps_ns) == len(whole.images.stamps_ns)
    assert first.images.stamps_ns[-1] < second.images.stamps_ns[0]
    assert first.odometry.stamps_ns[-1] < second.odometry.stamps_ns[0]
    assert tuning.validate([whole], FilterConfig(), TuneConfig(trials=10), progress=False)
    few = [tuning_drive(seconds=2)]
    assert tuning.validate(few, FilterConfig(), TuneConfig(), progress=False) is None


def test_settings_of_the_user_stay_where_it_would_write(tmp_path, capsys):
    mine = tmp_path / 'mine.yaml'
    write_config(mine, {'ekf_node': {'lost_std': 7.5}})
    assert main(['tune', 'bag', '--model', 'none.npz', '--output', str(mine)]) == 1
    error = f'error: {mine}: holds more than defaults: give another name, or remove it\n'
    assert capsys.readouterr().err == error
    assert load_changes(mine)['ekf_node']['lost_std'] == 7.5
