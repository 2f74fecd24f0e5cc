# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The filter command on logs as people have them: headers, gaps, disorder, missing variances."""

import math
import os

import numpy as np
import pytest
from filter_drives import START_NS, FilterDrive
from places import distances

from sfa_localization.cli import main
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.run import Trajectory
from sfa_localization.filtering import (
    ODOMETRY,
    POSITIONS,
    Table,
    read_table,
    run_filter,
    write_trajectory,
)
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig

STARTED = FilterConfig(initial_pose=(0.0, 0.0, 0.0))
NOISY = {'v_std': 0.02, 'omega_std': 0.01, 'position_std': 0.2, 'scale': 1.01, 'bias': 0.002}


def seconds(stamp_ns):
    return f'{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}'


def write_logs(folder, drive, head='stamp_s,v_mps,omega_radps', sep=',', variance=True):
    odometry = [head] if head else []
    for stamp, (v, omega) in zip(drive.stamps_ns, drive.read, strict=True):
        odometry.append(sep.join([seconds(int(stamp)), f'{v:.12g}', f'{omega:.12g}']))
    positions = ['stamp_s,x_m,y_m' + (',var_x,var_y' if variance else '')]
    for k, i in enumerate(drive.pictures):
        row = [seconds(int(drive.stamps_ns[i])), *map(repr, drive.seen[k, :2].tolist())]
        positions.append(','.join(row + (['0.04', '0.04'] if variance else [])))
    paths = folder / 'odom.csv', folder / 'positions.csv'
    for path, lines in zip(paths, (odometry, positions), strict=True):
        path.write_text('\n'.join(lines) + '\n')
    return paths


def read_tum(path):
    rows = [line.split() for line in path.read_text().splitlines()]
    stamps = np.array([int(s) * 10**9 + int(f) for s, f in (row[0].split('.') for row in rows)])
    numbers = np.array([[float(cell) for cell in row[1:]] for row in rows])
    yaw = 2 * np.arctan2(numbers[:, 5], numbers[:, 6])
    return stamps, np.column_stack([numbers[:, :2], yaw])


def errors(drive, stamps, poses, shift_ns=0):
    at = np.searchsorted(drive.stamps_ns, stamps - shift_ns)
    assert np.array_equal(drive.stamps_ns[at], stamps - shift_ns)
    return distances(poses, drive.poses[at])


def alone(drive):
    """The mean error of the positions."""
    return distances(drive.seen, drive.poses[drive.pictures]).mean()


def test_the_command_writes_what_the_live_filter_would_have_said(tmp_path):
    drive = FilterDrive(seconds=20, **NOISY, seed=1)
    logs, output = write_logs(tmp_path, drive), tmp_path / 'out.tum'
    assert main(['filter', *map(str, logs), '--output', str(output)]) == 0
    stamps, poses = read_tum(output)
    live, said = PoseFilter(FilterConfig(), ErrorCorrelation(share=0.0)), {}
    for stamp_ns, kind, index in drive.events():
        if kind:
            live.add_measurement(stamp_ns, drive.seen[index, :2], 0.04 * np.eye(2))
        else:
            live.add_odometry(stamp_ns, *drive.read[index])
        if live.state is not None:
            said[stamp_ns] = live.at(stamp_ns).pose
    assert set(stamps) == set(said) and len(stamps) > 850
    assert max(np.abs(said[s][:2] - p[:2]).max() for s, p in zip(stamps, poses, strict=True)) < 1e-5
    lines = (tmp_path / 'out.covariance.csv').read_text().splitlines()
    assert lines[0] == 'stamp_s,var_x,cov_xy,cov_xyaw,var_y,cov_yyaw,var_yaw'
    assert [line.split(',')[0] for line in lines[1:]] == [seconds(stamp) for stamp in stamps]
    cells = np.array([[float(cell) for cell in line.split(',')[1:]] for line in lines[1:]])
    assert np.all(cells[:, [0, 3, 5]] > 0)


def test_headers_and_separators_of_all_kinds_read_alike_and_nanoseconds_survive(tmp_path):
    drive, path = FilterDrive(seconds=2), tmp_path / 'p.csv'
    for how in (
        {'head': ''}, {'head': '# a remark\nstamp_s, v_mps , "omega_radps"'}, {'sep': '\t'},
        {'sep': ';', 'head': 'stamp_s;v_mps;omega_radps'},
    ):  # fmt: skip
        table = read_table(write_logs(tmp_path, drive, **how)[0], ODOMETRY)
        assert np.array_equal(table.stamps_ns, drive.stamps_ns) and table.skipped == ()
        assert np.allclose(table.values[:, :2], drive.read)
    for stamp, name in (('1700000000123456789', 'stamp_ns'), ('1700000000.123456789', 'stamp_s')):
        path.write_text(f'note,y_m,x_m,{name},var_y\nhello,2,1,{stamp},\n')
        table = read_table(path, POSITIONS)
        assert table.stamps_ns[0] == 1700000000123456789
        assert table.values[0, :2].tolist() == [1, 2] and math.isnan(table.values[0, 3])


def test_disorder_is_sorted_and_bad_rows_are_counted(tmp_path):
    drive = FilterDrive(seconds=10, **NOISY)
    odometry, positions = write_logs(tmp_path, drive)
    head, *rows = odometry.read_text().splitlines()
    np.random.default_rng(0).shuffle(rows)
    bad = ['nan,1,1', 'x,1,1', ',,', '5', f'{rows[0].split(",")[0]},inf,0', '1700000001.0,,',
           '1700000000000000000,1,1', '1e999999,1,1']  # fmt: skip
    odometry.write_text('\n'.join([head, *rows[:50], *bad, *rows[50:], rows[0], '', '']))
    table = read_table(odometry, ODOMETRY)
    assert len(table.stamps_ns) == len(drive.stamps_ns) + 1 and table.skipped == (*range(52, 60),)
    assert np.all(np.diff(table.stamps_ns) >= 0)
    done = run_filter(table, read_table(positions, POSITIONS), STARTED)
    assert done.counts['odometry: duplicate stamp'] == 1
    assert errors(drive, done.stamps_ns, done.poses).max() < 0.6


def test_a_heading_with_its_variance_starts_the_filter(tmp_path):
    odometry = Table(np.array([10, 14]) * 10**8, np.zeros((2, 4)))
    for columns, cells, started in (('', '', 0), (',yaw_rad', ',1.5', 0),
                                    (',yaw_rad,var_yaw', ',1.5,0.01', 2)):  # fmt: skip
        (tmp_path / 'p.csv').write_text(f'stamp_s,x_m,y_m{columns}\n1,5,6{cells}\n')
        done = run_filter(odometry, read_table(tmp_path / 'p.csv', POSITIONS), FilterConfig())
        assert len(done.poses) == started
    assert done.poses[-1] == pytest.approx([5, 6, 1.5])


def test_missing_variances_and_stamps_from_zero_or_below_are_survived(tmp_path):
    drive = FilterDrive(seconds=60, rate_hz=10, every=5, **NOISY)
    odometry, positions = write_logs(tmp_path, drive, variance=False)
    tables = read_table(odometry, ODOMETRY), read_table(positions, POSITIONS)
    for shift in (-START_NS, -START_NS - 10**12):
        done = run_filter(*(t._replace(stamps_ns=t.stamps_ns + shift) for t in tables), STARTED)
        assert len(done.stamps_ns) == len(drive.stamps_ns)
        assert errors(drive, done.stamps_ns, done.poses, shift).mean() < 0.5 * alone(drive)


ROW = 'stamp_s,x_m,y_m\n1,2,3\n'


@pytest.mark.parametrize(('odometry', 'positions', 'why'), [
    ('', ROW, 'none of its 0 rows'),
    ('stamp_s,v_mps\n1,2\n', ROW, 'no column omega_radps among stamp_s, v_mps'),
    ('stamp_s,\x1b[31mv,omega\n0,1,0\n', ROW, 'no column v_mps among stamp_s, ?[31mv, omega'),
    ('stamp_s,v_mps,omega_radps\nx,y,z\n', ROW, 'none of its 1 rows has stamp_s, v_mps and omega'),
    ('stamp_s,v_mps,omega_radps\n1700000000000,1,0\n', ROW, 'in these units'),
    ('stamp_s,v_mps,omega_radps\n1,2,3\n', 'stamp_s,x_m,y_m\n9,2,3\n',
     'odom.csv (1.000000000 to 1.000000000 s) and positions from'),
    ('stamp_s,v_mps,omega_radps\n1,0,0\n', ROW, 'never started'),
    (bytes(range(256)), ROW, 'odom.csv: cannot be read'),
])  # fmt: skip
def test_logs_that_cannot_be_used_are_named_in_one_line(tmp_path, capsys, odometry, positions, why):
    paths = tmp_path / 'odom.csv', tmp_path / 'p.csv'
    paths[0].write_bytes(odometry if isinstance(odometry, bytes) else odometry.encode())
    paths[1].write_text(positions)
    code = main(['filter', *map(str, paths), '--output', str(tmp_path / 'out.tum')])
    error = capsys.readouterr().err
    assert code == 1 and why in error and error.count('\n') == 1
    assert not (tmp_path / 'out.tum').exists() and len(list(tmp_path.iterdir())) == 2


def test_a_log_that_is_no_file_or_never_ends_is_one_error_line(tmp_path, capsys):
    """A pipe would wait for its writer, and a device fill the memory."""
    os.mkfifo(tmp_path / 'pipe.csv')
    positions, output = tmp_path / 'positions.csv', str(tmp_path / 'o.tum')
    positions.write_text(ROW)
    for odometry in (tmp_path / 'pipe.csv', '/dev/zero', tmp_path / 'none.csv'):
        assert main(['filter', str(odometry), str(positions), '--output', output]) == 1
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and f'{odometry}: cannot be read' in lines[0]


@pytest.mark.parametrize('name', ['odom.csv', 'link.csv', 'positions.csv', 'poses.tum'])
def test_nothing_that_is_read_is_replaced(tmp_path, capsys, name):
    logs = write_logs(tmp_path, FilterDrive(seconds=5))
    (tmp_path / 'link.csv').symlink_to(logs[0])
    if name == 'poses.tum':
        logs = logs[0], logs[1].rename(tmp_path / 'poses.covariance.csv')
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert main(['filter', *map(str, logs), '--output', str(tmp_path / name)]) == 1
    assert 'would be replaced' in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_trajectory_is_written_for_evo(tmp_path):
    """A heading that is unknown is 0."""
    stamps = np.array([1_700_000_000_123_456_789, 1_700_000_001_000_000_000])
    poses = np.array([[1.5, -2.0, np.pi / 3], [0.0, 1.0, np.nan]])
    write_trajectory(Trajectory(stamps, poses), tmp_path / 'new' / 'truth.tum')
    assert (tmp_path / 'new' / 'truth.tum').read_text().splitlines() == [
        '1700000000.123456789 1.500000 -2.000000 0 0 0 0.500000000 0.866025404',
        '1700000001.000000000 0.000000 1.000000 0 0 0 0.000000000 1.000000000',
    ]
