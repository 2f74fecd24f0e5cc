# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The noise that a log is made with is found in the log, whatever outliers it holds."""

import numpy as np
import pytest
from filter_drives import Drive

from sfa_localization import filtering
from sfa_localization.cli import main
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import integrate
from sfa_localization.fusion.inputs import RATE_STD_FLOOR
from sfa_localization.fusion.motion import ODOMETRY_CORRELATION_S
from sfa_localization.fusion.settings import FilterConfig

pytestmark = pytest.mark.slow  # trains, or replays many drives

USUAL = {'v_std': 0.05, 'omega_std': 0.02, 'position_std': 0.2, 'scale': 1.01, 'bias': 0.002}


def tables(drive, stated=0.2):
    """Tables of a drive whose positions state a standard deviation, or none."""
    odometry = filtering.Table(drive.stamps_ns, dict(zip(('v', 'omega'), drive.read.T.copy(),
                                                         strict=True)))  # fmt: skip
    columns = {'x': drive.seen[:, 0].copy(), 'y': drive.seen[:, 1].copy()}
    if stated:
        columns |= dict.fromkeys(('var_x', 'var_y'), np.full(len(drive.pictures), stated**2))
    return odometry, filtering.Table(drive.stamps_ns[drive.pictures], columns)


def position_std(fit, stated=0.2):
    return stated * np.sqrt(fit.config.measurement_factor)


def wandering(seconds, rate_hz, turn_walk, seed=0):
    """Twists of a slow robot, and what it turned instead: more by a white rate (rad/sqrt(s))."""
    rng, count = np.random.default_rng(seed), round(seconds * rate_hz)
    t = np.arange(count) / rate_hz
    read = np.column_stack([np.full(count, 0.2), 0.3 * np.sign(np.sin(0.25 * t))])
    return read, read + np.outer(rng.standard_normal(count), [0, turn_walk * np.sqrt(rate_hz)])


@pytest.mark.parametrize('far', [0.0, 50.0])
def test_the_noise_of_positions_is_found_whatever_the_outliers(far):
    drive = Drive(seconds=200, rate_hz=10, every=5, **{**USUAL, 'position_std': 0.5})
    rng = np.random.default_rng(1)
    wrong = rng.random(len(drive.seen)) < 0.02
    drive.seen[wrong, :2] += far * rng.standard_normal((wrong.sum(), 2))
    for stated in (0.2, None):
        fit = filtering.fitted(*tables(drive, stated), FilterConfig())
        assert position_std(fit, stated or 0.3) == pytest.approx(0.5, rel=0.15)
        assert fit.correlation.share < 0.2


def test_stated_variances_that_are_right_stay():
    drive = Drive(seconds=200, rate_hz=10, every=5, **USUAL)
    fit = filtering.fitted(*tables(drive), FilterConfig())
    assert position_std(fit) == pytest.approx(0.2, rel=0.1)
    assert fit.correlation.share == 0.0
    assert np.array_equal(fit.odometry.columns['v'], drive.read[:, 0])


def test_errors_that_neighbors_share_are_found():
    drive = Drive(seconds=300, rate_hz=10, every=3, share=0.8, length=0.6,
                  **{**USUAL, 'position_std': 0.3})  # fmt: skip
    fit = filtering.fitted(*tables(drive, 0.3), FilterConfig())
    assert 0.6 < fit.correlation.share < 0.93
    assert 0.3 < fit.correlation.distance_m < 1.3


def test_a_small_share_that_neighbors_have_in_common_is_found_and_none_where_there_is_none():
    shares = []
    for share in (0.0, 0.15):
        drive = Drive(seconds=300, rate_hz=10, every=5, share=share, length=1.0,
                      **{**USUAL, 'position_std': 0.2})  # fmt: skip
        shares.append(float(filtering.fitted(*tables(drive), FilterConfig()).correlation.share))
    assert shares[0] == 0.0 and shares[1] == pytest.approx(0.15, abs=0.08)


@pytest.mark.parametrize('walk', [0.05, 0.15])
def test_the_noise_of_turns_is_found(walk):
    read, true = wandering(300, 10, walk)
    drive = Drive(twists=true, rate_hz=10, every=5, position_std=0.1)
    drive.read = read
    fit = filtering.fitted(*tables(drive, 0.1), FilterConfig())
    density = fit.config.rate_std**2 * (0.1 + ODOMETRY_CORRELATION_S)
    density += fit.config.yaw_per_radian**2 * 0.3
    assert np.sqrt(density) == pytest.approx(walk, rel=0.4)


@pytest.mark.parametrize('smooth', [False, True])
@pytest.mark.parametrize('lag_s', [-0.4, 0.4])
def test_a_robot_that_moves_late_by_its_odometry_is_set_right(lag_s, smooth):
    drive = Drive(seconds=150, rate_hz=10, every=5, **{**USUAL, 'position_std': 0.1})
    drive.read = np.roll(drive.read, -round(lag_s * 10), axis=0)
    odometry, positions = tables(drive, 0.1)
    start = FilterConfig(initial_pose=tuple(drive.poses[0].tolist()))
    fit = filtering.fitted(odometry, positions, start)
    assert fit.lag_ns * 1e-9 == pytest.approx(lag_s, abs=0.1)
    errors = []
    for lag_ns in (0, fit.lag_ns):
        found = filtering.run_filter(fit.odometry, positions, fit.config,
                                     False, smooth, fit.correlation, lag_ns)  # fmt: skip
        inner = found.stamps_ns[(found.stamps_ns > drive.stamps_ns[20])]
        inner = inner[inner < drive.stamps_ns[-20]]
        at, there = np.searchsorted(found.stamps_ns, inner), np.searchsorted(drive.stamps_ns, inner)
        assert np.array_equal(drive.stamps_ns[there], inner)
        errors.append(np.abs(wrap_angle(found.poses[at, 2] - drive.poses[there, 2])).mean())
    assert errors[1] < 0.6 * errors[0]


def test_commanded_speeds_that_hold_until_the_next_are_recognized():
    rng, count = np.random.default_rng(3), 800
    true = np.column_stack([np.full(count, 0.4), rng.uniform(-1.5, 1.5, count)])
    drive = Drive(twists=true, rate_hz=4.0, every=2, position_std=0.05)
    stamps_ns = drive.stamps_ns[0] + np.cumsum(rng.uniform(0.05e9, 0.45e9, count)).astype(np.int64)
    seen = integrate(stamps_ns, true)[::2, :2] + 0.05 * rng.standard_normal((count // 2, 2))
    commanded = dict(zip(('v', 'omega'), np.roll(true, -1, axis=0).T, strict=True))
    places = {'x': seen[:, 0], 'y': seen[:, 1], **dict.fromkeys(('var_x', 'var_y'), np.full(
        count // 2, 0.05**2))}  # fmt: skip
    fit = filtering.fitted(filtering.Table(stamps_ns, commanded),
                           filtering.Table(stamps_ns[::2], places), FilterConfig())  # fmt: skip
    assert np.array_equal(fit.odometry.columns['omega'][1:-1], true[1:-1, 1])


def test_stated_variances_of_odometry_are_scaled_too():
    read, true = wandering(300, 10, 0.1)
    drive = Drive(twists=true, rate_hz=10, every=5, position_std=0.1)
    drive.read = read
    odometry, positions = tables(drive, 0.1)
    stated = {'var_v': np.full(len(read), 4e-4), 'var_omega': np.full(len(read), 1e-4)}
    odometry = filtering.Table(odometry.stamps_ns, {**odometry.columns, **stated})
    fit = filtering.fitted(odometry, positions, FilterConfig())
    assert fit.odometry.columns['var_omega'][0] > 4 * RATE_STD_FLOOR**2


@pytest.mark.parametrize('stated', [0.2, 1.0])
def test_worthless_positions_do_no_more_harm_than_stated(tmp_path, capsys, stated):
    """Positions from nowhere: the estimate is no worse than odometry by more than its sigma."""
    drive = Drive(seconds=120, rate_hz=10, every=5, **USUAL)
    rng = np.random.default_rng(0)
    center = drive.poses[:, :2].mean(0)
    drive.seen[:, :2] = center + rng.uniform(-10, 10, (len(drive.seen), 2))
    odometry, positions = tables(drive, stated)
    assert not filtering.fitted(odometry, positions, FilterConfig()).fits
    for path, table in zip(('o.csv', 'p.csv'), (odometry, positions), strict=True):
        rows = np.column_stack([table.stamps_ns * 1e-9 - 1.7e9, *table.columns.values()])
        np.savetxt(tmp_path / path, rows, delimiter=',', fmt='%.9f')
    start = [str(value) for value in drive.poses[0]]
    code = main(['filter', str(tmp_path / 'o.csv'), str(tmp_path / 'p.csv'), '--initial-pose',
                 *start, '--output', str(tmp_path / 'out.tum')])  # fmt: skip
    assert code == 0 and 'positions are left out' in capsys.readouterr().out
    found = np.loadtxt(tmp_path / 'out.tum')[:, 1:3]
    alone = integrate(drive.stamps_ns, drive.read, drive.poses[0])
    assert np.abs(found - alone[:, :2]).max() < 0.1


def test_a_robot_that_stands_has_positions_that_fit():
    drive = Drive(twists=np.zeros((2000, 2)), rate_hz=10, every=5, position_std=0.3)
    fit = filtering.fitted(*tables(drive, 0.3), FilterConfig())
    assert fit.fits and position_std(fit, 0.3) == pytest.approx(0.3, rel=0.1)


def test_few_positions_change_nothing():
    drive = Drive(seconds=20, rate_hz=10, every=5, **USUAL)
    odometry, positions = tables(drive)
    fit = filtering.fitted(odometry, positions, FilterConfig())
    assert fit.config == FilterConfig() and fit.odometry is odometry


def test_settings_of_the_user_stay():
    drive = Drive(seconds=100, rate_hz=10, every=5, **USUAL)
    config = FilterConfig(measurement_factor=3.0, speed_std=0.3, rate_std=0.4, yaw_per_radian=0.1)
    found = filtering.fitted(*tables(drive), config).config
    for name in ('measurement_factor', 'speed_std', 'rate_std', 'yaw_per_radian'):
        assert getattr(found, name) == pytest.approx(getattr(config, name))
