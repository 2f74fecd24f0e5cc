# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Tuning: the likelihood finds the noise that is there, the grid the least error."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from filter_drives import Drive

from sfa_localization import tuning
from sfa_localization.cli import main
from sfa_localization.config import load_changes, write_config
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.data.run import Odometry, Trajectory
from sfa_localization.fusion import inputs
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


def test_rejecting_everything_is_not_likely(monkeypatch):
    drives = [tuning_drive(claimed=0.2, true=0.2)]
    monkeypatch.setattr(inputs, 'POSITION_STD_FLOOR', 1e-3)
    monkeypatch.setattr(inputs, 'YAW_STD_FLOOR', 1e-3)
    tiny = FilterConfig(measurement_factor=1e-3)
    assert (
        tuning.likelihood_cost(drives, tiny) > tuning.likelihood_cost(drives, FilterConfig()) + 0.5
    )


def test_the_optimizer_improves_and_needs_no_truth():
    drives = [tuning_drive(claimed=0.1, true=0.4, truth=False)]
    trials = []
    best = tuning.tune_by_likelihood(drives, FilterConfig(), 40, lambda: trials.append(1))
    assert best.cost < tuning.likelihood_cost(drives, FilterConfig()) - 0.05
    assert best.config.measurement_factor > 2.0
    assert 10 < len(trials) <= 45


def test_the_grid_takes_the_least_error(monkeypatch):
    monkeypatch.setattr(tuning, 'FACTORS', (0.25, 1.0, 16.0))
    drives = [tuning_drive(claimed=0.05, true=0.4)]
    outcomes = tuning.tune_by_grid(drives, FilterConfig(), lambda: None)
    assert len(outcomes) == 9
    assert [o.cost for o in outcomes] == sorted(o.cost for o in outcomes)
    assert outcomes[0].cost == tuning.error_cost(drives, outcomes[0].config)
    assert outcomes[0].config.measurement_factor > 0.25


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
    far = tuning._with_logs(FilterConfig(), np.full(len(tuning.TUNED), 90.0))
    near = tuning._with_logs(FilterConfig(), np.full(len(tuning.TUNED), -90.0))
    assert far.measurement_factor == 1e4 and near.measurement_factor == 1e-3


def test_the_models_error_correlation_is_used():
    """Errors that neighbors share are no surprise to a filter that expects them."""
    drive = tuning_drive()
    white = dataclasses.replace(drive, correlation=ErrorCorrelation(0.0, 1.0))
    shared = dataclasses.replace(drive, correlation=ErrorCorrelation(0.7, 0.6))
    config = FilterConfig()
    assert tuning.likelihood_cost([shared], config) < tuning.likelihood_cost([white], config)


def test_what_is_worse_on_drives_not_seen_is_noticed():
    drives = [tuning_drive(claimed=0.1, true=0.4, seed=seed) for seed in range(3)]
    asked = []

    def found(factor):
        def of(others):
            asked.append(others)
            return FilterConfig(measurement_factor=factor)

        return of

    good = tuning.validate(drives, FilterConfig(), found(16.0), tuning.likelihood_cost)
    bad = tuning.validate(drives, FilterConfig(), found(0.05), tuning.likelihood_cost)
    assert asked[:3] == [[1, 2], [0, 2], [0, 1]]
    assert good.better and not bad.better and good.before == bad.before


def test_one_drive_is_judged_by_halves():
    whole = tuning_drive()
    first, second = tuning.parts_of([whole])
    assert len(first.images.stamps_ns) + len(second.images.stamps_ns) == len(whole.images.stamps_ns)
    assert first.images.stamps_ns[-1] < second.images.stamps_ns[0]
    assert first.odometry.stamps_ns[-1] < second.odometry.stamps_ns[0]
    assert tuning.validate([whole], FilterConfig(), lambda _: FilterConfig(), max) is None


def log_of(folder, name, seed, claimed):
    """CSV files of a drive whose positions err by 0.3 m and claim another standard deviation."""
    drive = Drive(seconds=130, rate_hz=10, every=5, v_std=0.03, omega_std=0.02, position_std=0.3,
                  seed=seed)  # fmt: skip
    seconds = (drive.stamps_ns - drive.stamps_ns[0]) * 1e-9 + 100
    paths = folder / f'{name}_odom.csv', folder / f'{name}_positions.csv'
    at, seen = seconds[drive.pictures], drive.seen[:, :2]
    variances = np.full((len(at), 2), claimed**2)
    np.savetxt(paths[0], np.column_stack([seconds, drive.read]), '%.9f', ',')
    np.savetxt(paths[1], np.column_stack([at, seen, variances]), '%.9f', ',')
    return [str(path) for path in paths]


@pytest.mark.parametrize('logs', [2, 1])
def test_logs_without_ros_are_tuned_and_judged(tmp_path, capsys, logs):
    paths = [path for k in range(logs) for path in log_of(tmp_path, f'log{k}', k, 0.1)]
    code = main(['tune', *paths, '--output', str(tmp_path / 'tuned.yaml')])
    said = capsys.readouterr().out
    assert code == 0 and 'on what it did not see' in said and 'the settings stay' not in said
    factor = load_changes(tmp_path / 'tuned.yaml')['ekf_node']['measurement_factor']
    assert factor == pytest.approx(9.0, rel=0.3)


def test_a_result_that_is_worse_on_other_logs_is_rejected(tmp_path, capsys):
    paths = log_of(tmp_path, 'a', 0, 0.05) + log_of(tmp_path, 'b', 1, 1.5)
    code = main(['tune', *paths, '--output', str(tmp_path / 'tuned.yaml')])
    assert code == 0 and 'the settings stay' in capsys.readouterr().out
    assert load_changes(tmp_path / 'tuned.yaml')['ekf_node']['measurement_factor'] == 1.0


def test_settings_of_the_user_stay_where_it_would_write(tmp_path, capsys):
    mine, again = tmp_path / 'mine.yaml', tmp_path / 'again.yaml'
    write_config(mine, {'ekf_node': {'lost_std': 7.5}})
    paths = log_of(tmp_path, 'log', 0, 0.1)
    words = ['tune', *paths, '--config', str(mine), '--output']
    assert [main([*words, str(again)]) for _ in range(2)] == [0, 0]
    again.write_text(again.read_text().replace('lost_std: 7.5', 'lost_std: 6.5'))
    before = again.read_bytes()
    assert main([*words, str(again)]) == 1
    assert main(['tune', *paths, '--output', str(mine)]) == 1
    error = f'error: {mine}: holds more than defaults: give another name, or remove it\n'
    assert capsys.readouterr().err.endswith(error)
    assert again.read_bytes() == before and load_changes(mine)['ekf_node']['lost_std'] == 7.5


@pytest.mark.parametrize(('rows', 'later_s', 'problem'), [
    ((1, 99), 0, 'odom.csv: 1 rows'), ((99, 3), 0, 'positions.csv: 3 rows'),
    ((1300, 250), 1e6, 'the filter fused nothing'),
])  # fmt: skip
def test_logs_that_show_nothing_are_named_and_nothing_is_written(
    tmp_path, capsys, rows, later_s, problem
):
    paths = [Path(path) for path in log_of(tmp_path, 'log', 0, 0.1)]
    for path, count in zip(paths, rows, strict=True):
        table = np.loadtxt(path, delimiter=',')[:count]
        table[:, 0] += later_s if 'positions' in path.name else 0
        np.savetxt(path, table, '%.9f', ',')
    assert main(['tune', *map(str, paths), '--output', str(tmp_path / 'x.yaml')]) == 1
    assert problem in capsys.readouterr().err
    assert not (tmp_path / 'x.yaml').exists()


@pytest.mark.parametrize('paths', [['a.csv'], ['a.csv', 'bag'], ['bag']])
def test_what_cannot_be_tuned_on_is_named(tmp_path, capsys, paths):
    assert main(['tune', *paths, '--output', str(tmp_path / 'x.yaml')]) == 1
    assert ('CSV' in capsys.readouterr().err) == (paths != ['bag'])
