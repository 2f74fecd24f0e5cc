# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Tuning: the likelihood finds the noise that is there, the grid the least error."""

import numpy as np
import pytest
from filter_drives import Drive

from sfa_localization import tuning
from sfa_localization.data.errors import DataError
from sfa_localization.data.run import Odometry, Trajectory
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.tuning import Outcome, Sight, Tour, TuneConfig


def tour(told=0.2, true=0.2, seed=0, truth=True, seconds=40):
    """A drive whose pictures err by `true` m and say `told` m."""
    drive = Drive(seconds=seconds, rate_hz=20, every=4, v_std=0.02, omega_std=0.01,
                  position_std=true, yaw_std=0.05, share=0.7, seed=seed)  # fmt: skip
    count = len(drive.pictures)
    variances = np.tile([4e-4, 1e-4], (len(drive.stamps_ns), 1))
    spread = np.diag([told**2, told**2, 0.05**2])
    return Tour(
        Odometry(drive.stamps_ns, drive.poses, drive.read, variances),
        Sight(drive.stamps_ns[drive.pictures], drive.seen, np.tile(spread, (count, 1, 1))),
        Trajectory(drive.stamps_ns, drive.poses) if truth else None,
    )  # fmt: skip


def test_the_likelihood_is_best_near_the_true_noise():
    tours = [tour(told=0.2, true=0.4)]
    costs = {
        factor: tuning.likelihood_cost(tours, FilterConfig(measurement_factor=factor))
        for factor in (0.25, 4.0, 64.0)
    }
    assert costs[4.0] < costs[0.25] and costs[4.0] < costs[64.0]


def test_refusing_everything_is_not_likely():
    tours = [tour(told=0.2, true=0.2)]
    tiny = FilterConfig(measurement_factor=1e-3, position_std_floor=1e-3, yaw_std_floor=1e-3)
    assert tuning.likelihood_cost(tours, tiny) > tuning.likelihood_cost(tours, FilterConfig()) + 0.5


def test_the_optimizer_improves_and_needs_no_truth():
    tours = [tour(told=0.1, true=0.4, truth=False)]
    trials = []
    best = tuning.tune_by_likelihood(tours, FilterConfig(), 40, lambda: trials.append(1))
    assert best.cost < tuning.likelihood_cost(tours, FilterConfig()) - 0.05
    assert best.config.measurement_factor > 2.0
    assert 10 < len(trials) <= 45


def test_the_grid_takes_the_least_error(monkeypatch):
    monkeypatch.setattr(tuning, 'FACTORS', (0.25, 1.0, 16.0))
    tours = [tour(told=0.05, true=0.4)]
    outcomes = tuning.tune_by_grid(tours, FilterConfig(), lambda: None)
    assert len(outcomes) == 9
    assert [o.cost for o in outcomes] == sorted(o.cost for o in outcomes)
    assert outcomes[0].cost == tuning.error_cost(tours, outcomes[0].config)
    assert outcomes[0].config.measurement_factor > 0.25


def test_the_error_is_measured_after_rigid_alignment():
    plain = tour()
    moved = Tour(
        plain.odometry,
        plain.sight,
        Trajectory(plain.truth.stamps_ns, plain.truth.poses + np.array([100.0, -50.0, 0.0])),
    )
    config = FilterConfig()
    assert tuning.error_cost([moved], config) == pytest.approx(tuning.error_cost([plain], config))


def test_the_method_is_chosen_by_the_settings(monkeypatch):
    monkeypatch.setattr(tuning, 'FACTORS', (1.0,))
    found = tuning.tune([tour()], FilterConfig(), TuneConfig(method='grid'), progress=False)
    assert found == Outcome(FilterConfig(), tuning.error_cost([tour()], FilterConfig()))


def test_the_grid_without_truth_says_what_to_do():
    with pytest.raises(DataError, match='use the likelihood'):
        tuning.tune_by_grid([tour(truth=False)], FilterConfig(), lambda: None)


def test_too_few_pictures_are_refused():
    with pytest.raises(DataError, match='too few'):
        tuning.tune([tour(seconds=2)], FilterConfig(), TuneConfig(), progress=False)


def test_tuned_settings_stay_in_their_ranges():
    far = tuning._with_logs(FilterConfig(), np.full(len(tuning.TUNED), 90.0))
    near = tuning._with_logs(FilterConfig(), np.full(len(tuning.TUNED), -90.0))
    assert far.measurement_factor == 1e4 and near.measurement_factor == 1e-3
