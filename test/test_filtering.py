# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The filter command on logs as people have them: headers, gaps, disorder, missing variances."""

import math
import os

import numpy as np
import pytest
from filter_drives import START_NS, Drive

from sfa_localization import filtering
from sfa_localization.cli import main
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig

STARTED = FilterConfig(initial_pose=(0.0, 0.0, 0.0))
NOISY = {'v_std': 0.02, 'omega_std': 0.01, 'position_std': 0.2, 'scale': 1.01, 'bias': 0.002}


def seconds(stamp_ns):
    return f'{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}'


def write_logs(folder, drive, shift_ns=0, head='stamp_s,v_mps,omega_radps', sep=',', variance=True):
    odometry = [head] if head else []
    for stamp, (v, omega) in zip(drive.stamps_ns, drive.read, strict=True):
        odometry.append(sep.join([seconds(int(stamp) + shift_ns), f'{v:.12g}', f'{omega:.12g}']))
    positions = ['stamp_s,x_m,y_m' + (',var_x,var_y' if variance else '')]
    for k, i in enumerate(drive.pictures):
        row = [seconds(int(drive.stamps_ns[i]) + shift_ns), *map(repr, drive.seen[k, :2].tolist())]
        positions.append(','.join(row + (['0.04', '0.04'] if variance else [])))
    paths = folder / 'odom.csv', folder / 'positions.csv'
    for path, lines in zip(paths, (odometry, positions), strict=True):
        path.write_text('\n'.join(lines) + '\n')
    return paths


def run(folder, drive, *options, **how):
    odometry, positions = write_logs(folder, drive, **how)
    code = main(['filter', str(odometry), str(positions), '--output', str(folder / 'out.tum'),
                 *options])  # fmt: skip
    return code, read_tum(folder / 'out.tum') if code == 0 else None


def read_tum(path):
    rows = [line.split() for line in path.read_text().splitlines()]
    stamps = np.array([int(s) * 10**9 + int(f) for s, f in (row[0].split('.') for row in rows)])
    numbers = np.array([[float(cell) for cell in row[1:]] for row in rows])
    yaw = 2 * np.arctan2(numbers[:, 5], numbers[:, 6])
    return stamps, np.column_stack([numbers[:, :2], yaw])


def errors(drive, found, shift_ns=0):
    stamps, poses = found
    at = np.searchsorted(drive.stamps_ns, stamps - shift_ns)
    assert np.array_equal(drive.stamps_ns[at], stamps - shift_ns)
    return np.hypot(*(poses[:, :2] - drive.poses[at, :2]).T)


def test_the_command_tells_what_the_live_filter_would_have(tmp_path):
    drive = Drive(seconds=20, **NOISY, seed=1)
    code, (stamps, poses) = run(tmp_path, drive)
    assert code == 0
    tables = (
        filtering.read_odometry_table(tmp_path / 'odom.csv'),
        filtering.read_position_table(tmp_path / 'positions.csv'),
    )
    live = PoseFilter(FilterConfig(), ErrorCorrelation(share=0.0))
    read = np.column_stack([tables[0].columns[name] for name in ('v', 'omega')])
    told = {}
    for event in drive.events():
        if event[1]:
            seen = drive.seen[event[2], :2]
            live.add_measurement(event[0], seen, 0.04 * np.eye(2))
        else:
            live.add_odometry(event[0], *read[event[2]])
        if live.state is not None:
            told[event[0]] = live.at(event[0]).pose
    assert set(stamps) <= set(told) and len(stamps) > 850
    assert max(np.abs(told[s][:2] - p[:2]).max() for s, p in zip(stamps, poses, strict=True)) < 1e-5


@pytest.mark.parametrize('name', ['odom.csv', 'positions.csv', 'truth.tum', 'link.csv'])
def test_nothing_that_is_read_is_replaced(tmp_path, capsys, name):
    drive = Drive(seconds=5)
    logs = write_logs(tmp_path, drive)
    (tmp_path / 'link.csv').symlink_to(logs[0])
    (tmp_path / 'truth.tum').write_text('0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n')
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    truth = ['--truth', str(tmp_path / 'truth.tum')]
    assert main(['filter', *map(str, logs), *truth, '--output', str(tmp_path / name)]) == 1
    assert 'would be replaced' in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize('folder', ['.', '/', '', '..'])
def test_a_folder_is_no_output(tmp_path, capsys, folder):
    logs = write_logs(tmp_path, Drive(seconds=5))
    assert main(['filter', *map(str, logs), '--output', folder]) == 1
    assert 'cannot be written: it is a folder' in capsys.readouterr().err


def test_an_output_that_cannot_be_is_noticed_before_the_work(tmp_path, capsys):
    absent = [str(tmp_path / name) for name in ('o.csv', 'p.csv')]
    reading, writing = os.pipe()  # where a terminal's `| less` leads
    for output in ('/dev/null', f'/dev/fd/{writing}'):
        assert main(['filter', *absent, '--output', output]) == 1
        assert f'{output}: cannot be written: it is no regular file' in capsys.readouterr().err
    os.close(reading)
    os.close(writing)


def test_a_start_is_checked_on_the_command_line_and_read_from_the_parameter_file(tmp_path, capsys):
    drive = Drive(seconds=5, start=(4.0, 2.0, 1.0))
    with pytest.raises(SystemExit):
        run(tmp_path, drive, '--initial-pose', '0', '0', 'north')
    logs = [str(path) for path in write_logs(tmp_path, drive)]
    output = ['--output', str(tmp_path / 'poses.tum')]
    assert main(['filter', *logs, *output, '--initial-pose', '1e9', '0', '0']) == 1
    assert 'initial_pose: 1000000000.0 is outside' in capsys.readouterr().err
    start = ['ekf_node:', '  ros__parameters:', '    initial_pose: [4.0, 2.0, 1.0]']
    (tmp_path / 'start.yaml').write_text('\n'.join(start))
    assert main(['filter', *logs, *output, '--config', str(tmp_path / 'start.yaml')]) == 0
    assert 'before the start' not in capsys.readouterr().out


def test_the_covariances_beside_the_output_replace_nothing_that_is_read(tmp_path, capsys):
    odometry, positions = write_logs(tmp_path, Drive(seconds=5))
    moved = positions.rename(tmp_path / 'poses.covariance.csv')
    before = moved.read_bytes()
    output = ['--output', str(tmp_path / 'poses.tum')]
    assert main(['filter', str(odometry), str(moved), *output]) == 1
    assert 'would be replaced' in capsys.readouterr().err and moved.read_bytes() == before


def test_control_characters_of_a_header_are_not_shown(tmp_path):
    (tmp_path / 'odom.csv').write_text('stamp_s,\x1b]0;title\x07\x1b[31mv,omega\n0,1,0\n')
    with pytest.raises(DataError, match='no column v_mps') as raised:
        filtering.read_odometry_table(tmp_path / 'odom.csv')
    assert str(raised.value).isprintable()


def test_without_a_pose_it_starts_from_the_way_and_beats_the_positions(tmp_path):
    drive = Drive(seconds=60, start=(500.0, -200.0, 2.5), **NOISY)
    _, found = run(tmp_path, drive)
    alone = np.hypot(*(drive.seen[:, :2] - drive.poses[drive.pictures, :2]).T).mean()
    assert errors(drive, found).mean() < 0.6 * alone


def test_with_a_pose_every_row_is_answered(tmp_path):
    drive = Drive(seconds=10, start=(1.0, 2.0, -3.0), **NOISY)
    _, found = run(tmp_path, drive, '--initial-pose', '1', '2', '-3')
    assert len(found[0]) == len(drive.stamps_ns) and errors(drive, found).max() < 0.6


@pytest.mark.parametrize('how', [
    {'head': ''}, {'head': '# stamp_s, v_mps, omega_radps'}, {'head': ' Time , V , Yaw_Rate '},
    {'head': '"timestamp","linear_x","angular_z"'}, {'sep': ' ', 'head': 't v w'},
    {'sep': ';', 'head': 't;v;omega'}, {'sep': '\t', 'head': 't\tv\twz'},
    {'head': '# my robot\n# another remark\nt,v,omega'},
])  # fmt: skip
def test_headers_and_separators_of_all_kinds_read_alike(tmp_path, how):
    drive = Drive(seconds=2)
    path, _ = write_logs(tmp_path, drive, **how)
    table = filtering.read_odometry_table(path)
    assert np.array_equal(table.stamps_ns, drive.stamps_ns)
    assert np.allclose(table.columns['omega'], drive.read[:, 1])
    assert not table.skipped


def test_columns_are_found_by_name_in_any_order(tmp_path):
    path = tmp_path / 'p.csv'
    path.write_text('note,y_m,x_m,stamp_ns,var_y\nhello,2,1,1700000000123456789,\n')
    table = filtering.read_position_table(path)
    assert table.stamps_ns[0] == 1700000000123456789
    assert (table.columns['x'][0], table.columns['y'][0]) == (1, 2)
    assert math.isnan(table.columns['var_y'][0])


def test_nanoseconds_survive(tmp_path):
    path = tmp_path / 'o.csv'
    path.write_text('stamp_s,v_mps,omega_radps\n1700000000.123456789,1,0\n')
    assert filtering.read_odometry_table(path).stamps_ns[0] == 1700000000123456789


def test_disorder_is_sorted_and_bad_rows_are_counted(tmp_path):
    drive = Drive(seconds=10, **NOISY)
    odometry, positions = write_logs(tmp_path, drive)
    head, *rows = odometry.read_text().splitlines()
    np.random.default_rng(0).shuffle(rows)
    bad = ['nan,1,1', 'x,1,1', ',,', '5', f'{rows[0].split(",")[0]},inf,0', '1700000001.0,,']
    odometry.write_text('\n'.join([head, *rows[:50], *bad, *rows[50:], rows[0], '', '']))
    table = filtering.read_odometry_table(odometry)
    assert len(table) == len(drive.stamps_ns) + 1
    assert table.skipped['no stamp'] == 3 and table.skipped['no number'] == 3
    assert np.all(np.diff(table.stamps_ns) >= 0)
    done = filtering.run_filter(table, filtering.read_position_table(positions), STARTED)
    assert done.counts['odometry: duplicate stamp'] == 1
    assert errors(drive, (done.stamps_ns, done.poses)).max() < 0.6


@pytest.mark.parametrize(('stated', 'reason'), [
    ('-1', 'negative variance'),
    ('1e300', 'variance that means that nothing is known'),
])  # fmt: skip
def test_rows_with_impossible_variances_are_left_out_and_counted(tmp_path, stated, reason):
    path = tmp_path / 'positions.csv'
    path.write_text(f'stamp_s,x_m,y_m,var_x,var_y\n1,0,0,0.1,0.1\n2,1,0,{stated},0.1\n3,1,0,0,\n')
    table = filtering.read_position_table(path)
    assert len(table) == 2 and table.skipped == {reason: 1}
    path.write_text(f'stamp_s,x_m,y_m,var_x,var_y\n1,0,0,{stated},0.1\n')
    with pytest.raises(DataError, match=f'positions.csv: none of the 1 rows.*{reason}'):
        filtering.read_position_table(path)


def test_a_covariance_that_is_none_is_counted(tmp_path):
    path = tmp_path / 'positions.csv'
    path.write_text('stamp_s,x_m,y_m,var_x,var_y,var_xy\n1,0,0,0.01,0.01,0.05\n2,0,0,0.01,,0.001\n')
    table = filtering.read_position_table(path)
    assert len(table) == 1 and table.skipped == {'var_xy larger than var_x and var_y allow': 1}


@pytest.mark.parametrize('stamp', [1_700_000_000_000, 1_700_000_000 * 10**9, '1e999999', '-1e30'])
def test_stamps_in_another_unit_are_named(tmp_path, stamp):
    path = tmp_path / 'positions.csv'
    path.write_text(f'stamp_s,x_m,y_m\n{stamp},0,0\n')
    with pytest.raises(DataError, match=r'none of the 1 rows.*in another unit.*stamp_ns'):
        filtering.read_position_table(path)


def test_headings_count_without_variances_of_positions_but_not_without_their_own(tmp_path):
    """With a heading the first row starts the filter; without, it waits for some meters."""
    drive = Drive(seconds=30, **NOISY, yaw_std=0.05)
    odometry, positions = write_logs(tmp_path, drive, variance=False)
    head, *rows = positions.read_text().splitlines()
    yaws = [f'{row},{yaw!r}' for row, yaw in zip(rows, drive.seen[:, 2].tolist(), strict=True)]
    waited = {}
    for name, lines in {
        'none': [head, *rows],
        'unsure': [head + ',yaw_rad', *yaws],
        'sure': [head + ',yaw_rad,var_yaw', *(f'{row},0.0025' for row in yaws)],
    }.items():
        positions.write_text('\n'.join(lines))
        table = filtering.read_position_table(positions)
        left = {'(heading without var_yaw, left out)': len(rows)} if name == 'unsure' else {}
        assert table.skipped == left
        done = filtering.run_filter(filtering.read_odometry_table(odometry), table, FilterConfig())
        waited[name] = done.before_start
    assert waited['sure'] <= drive.every < waited['none'] == waited['unsure']


@pytest.mark.parametrize('shift', [-START_NS, -START_NS - 10**12])
def test_stamps_may_count_from_zero_or_below(tmp_path, shift):
    drive = Drive(seconds=10, **NOISY)
    odometry, positions = write_logs(
        tmp_path, drive, shift_ns=shift if shift > -START_NS - 1 else 0
    )
    tables = filtering.read_odometry_table(odometry), filtering.read_position_table(positions)
    if shift <= -START_NS - 1:
        tables = tuple(filtering.Table(t.stamps_ns + shift, t.columns, t.skipped) for t in tables)
    done = filtering.run_filter(*tables, STARTED)
    assert len(done.stamps_ns) == len(drive.stamps_ns)
    assert errors(drive, (done.stamps_ns, done.poses), shift).max() < 0.6


@pytest.mark.parametrize('rate', [1, 5, 200])
def test_odd_rates(tmp_path, rate):
    drive = Drive(seconds=60, rate_hz=rate, every=max(1, rate // 2), **NOISY)
    _, found = run(tmp_path, drive)
    assert errors(drive, found)[-rate * 20 :].mean() < 0.3


def test_odometry_every_four_seconds_does_little_harm(tmp_path):
    drive = Drive(twists=np.tile([0.5, 0.05], (100, 1)), rate_hz=0.25, every=1, position_std=0.2)
    _, found = run(tmp_path, drive)
    alone = np.hypot(*(drive.seen[:, :2] - drive.poses[drive.pictures, :2]).T).mean()
    assert errors(drive, found)[-50:].mean() < 1.3 * alone


def test_gaps_in_either_log_are_survived(tmp_path):
    drive = Drive(seconds=90, **NOISY)
    keep = (drive.stamps_ns - START_NS < 30e9) | (drive.stamps_ns - START_NS > 45e9)
    odometry = filtering.Table(
        drive.stamps_ns[keep], {'v': drive.read[keep, 0], 'omega': drive.read[keep, 1]}
    )
    stamps = drive.stamps_ns[drive.pictures]
    seen = (stamps - START_NS < 50e9) | (stamps - START_NS > 70e9)
    positions = filtering.Table(stamps[seen], {'x': drive.seen[seen, 0], 'y': drive.seen[seen, 1]})
    done = filtering.run_filter(odometry, positions, FilterConfig())
    found = errors(drive, (done.stamps_ns, done.poses))
    assert found[-500:].mean() < 0.3


def test_missing_variances_are_those_of_a_usual_position(tmp_path):
    drive = Drive(seconds=300, rate_hz=10, every=5, **NOISY)
    _, found = run(tmp_path, drive, variance=False)
    alone = np.hypot(*(drive.seen[:, :2] - drive.poses[drive.pictures, :2]).T).mean()
    assert errors(drive, found).mean() < 0.5 * alone


def test_headings_in_the_log_are_fused(tmp_path):
    path = tmp_path / 'p.csv'
    path.write_text('stamp_s,x_m,y_m,var_x,var_y,yaw_rad,var_yaw\n1,5,6,0.04,0.04,1.5,0.01\n')
    odometry = filtering.Table(
        np.array([10**9, 2 * 10**9]), {'v': np.zeros(2), 'omega': np.zeros(2)}
    )
    done = filtering.run_filter(odometry, filtering.read_position_table(path), FilterConfig())
    assert done.poses[-1] == pytest.approx([5, 6, 1.5])


def test_a_parameter_file_is_obeyed(tmp_path, capsys):
    (tmp_path / 'c.yaml').write_text('ekf_node:\n  ros__parameters:\n    slip_per_metre: 99999.0\n')
    code, _ = run(tmp_path, Drive(seconds=1), '--config', str(tmp_path / 'c.yaml'))
    assert code == 1 and 'slip_per_metre' in capsys.readouterr().err


@pytest.mark.parametrize(('odometry', 'positions', 'why'), [
    ('', 'stamp_s,x_m,y_m\n1,2,3\n', 'holds no rows'),
    ('stamp_s,v_mps\n1,2\n', 'stamp_s,x_m,y_m\n1,2,3\n', 'no column omega_radps'),
    ('a,b,c\n1,2,3\n', 'stamp_s,x_m,y_m\n1,2,3\n', 'no column stamp_s'),
    ('t,v,v,omega\n1,2,3,4\n', 'stamp_s,x_m,y_m\n1,2,3\n', 'has 2 columns v: give each'),
    ('stamp_s,v_mps,omega_radps\nx,y,z\n', 'stamp_s,x_m,y_m\n1,2,3\n', 'none of the 1 rows'),
    ('stamp_s,v_mps,omega_radps\n1,2,3\n', 'stamp_s,x_m,y_m\n9,2,3\n', 'no time in common'),
    ('stamp_s,v_mps,omega_radps\n1,0,0\n', 'stamp_s,x_m,y_m\n1,2,3\n', 'never started'),
    ('stamp_s,v_mps,omega_radps\n', 'stamp_s,x_m,y_m\n1,2,3\n', 'holds no rows below'),
])  # fmt: skip
def test_logs_that_cannot_be_used_are_named_in_one_line(tmp_path, capsys, odometry, positions, why):
    paths = tmp_path / 'o.csv', tmp_path / 'p.csv'
    paths[0].write_text(odometry)
    paths[1].write_text(positions)
    code = main(['filter', *map(str, paths), '--output', str(tmp_path / 'out.tum')])
    told = capsys.readouterr().err
    assert code == 1 and why in told and told.count('\n') == 1
    assert not (tmp_path / 'out.tum').exists() and len(list(tmp_path.iterdir())) == 2


def test_both_logs_without_a_time_in_common_are_named(tmp_path, capsys):
    paths = tmp_path / 'o.csv', tmp_path / 'p.csv'
    for path, head, start in zip(paths, ('v_mps,omega_radps', 'x_m,y_m'), (0, 100), strict=True):
        rows = ''.join(f'{start + n},1,0\n' for n in range(1, 30))
        path.write_text(f'stamp_s,{head}\n{rows}')
    assert main(['filter', *map(str, paths), '--output', str(tmp_path / 'out.tum')]) == 1
    assert (
        f'odometry from {paths[0]} (1.000000000 to 29.000000000 s) and positions from {paths[1]} '
        '(101.000000000 to 129.000000000 s) have no time in common'
    ) in capsys.readouterr().err


def test_a_missing_or_binary_file_is_named(tmp_path, capsys):
    (tmp_path / 'b.csv').write_bytes(bytes(range(256)))
    for name in ('none.csv', 'b.csv'):
        code = main(['filter', str(tmp_path / name), str(tmp_path / name), '--output', 'x'])
        assert code == 1 and name in capsys.readouterr().err


def test_an_output_that_cannot_be_written_leaves_nothing(tmp_path):
    (tmp_path / 'no').touch()
    with pytest.raises(DataError, match='cannot be written'):
        filtering.write_tum(tmp_path / 'no' / 'out.tum', np.array([1]), np.zeros((1, 3)))
    assert [path.name for path in tmp_path.iterdir()] == ['no']


@pytest.mark.parametrize('kind', ['csv', 'tum'])
def test_with_truth_it_prints_how_right_it_was(tmp_path, capsys, kind):
    drive = Drive(seconds=60, rate_hz=10, every=5, start=(1.0, 2.0, 0.5), **NOISY)
    rows = np.column_stack([(drive.stamps_ns - START_NS) * 1e-9 + 1.7e9, drive.poses])
    if kind == 'tum':
        half, zero = rows[:, 3] / 2, np.zeros(len(rows))
        rows = np.column_stack([rows[:, :3], zero, zero, zero, np.sin(half), np.cos(half)])
    head = 'stamp_s,x_m,y_m,yaw_rad' if kind == 'csv' else ''
    truth, sep = tmp_path / 'truth', ',' if kind == 'csv' else ' '
    np.savetxt(truth, rows, '%.6f', sep, header=head, comments='')
    code, (stamps, poses) = run(tmp_path, drive, '--truth', str(truth))
    said = capsys.readouterr().out
    assert code == 0
    off = errors(drive, (stamps, poses)).mean()
    mean = float(said.split('error: mean ')[1].split(' m')[0])
    assert mean == pytest.approx(off, abs=2e-3)
    inside = float(said.split('regions: ')[1].split('%')[0])
    assert 70 < inside <= 100
    assert 0.6 < float(said.split('NIS ')[1].split()[0]) < 1.4


def test_covariances_are_written_beside_the_poses(tmp_path):
    _, (stamps, _) = run(tmp_path, Drive(seconds=5, **NOISY), '--initial-pose', '0', '0', '0')
    lines = (tmp_path / 'out.covariance.csv').read_text().splitlines()
    assert lines[0] == 'stamp_s,var_x,cov_xy,cov_xyaw,var_y,cov_yyaw,var_yaw'
    assert [line.split(',')[0] for line in lines[1:]] == [seconds(stamp) for stamp in stamps]
    cells = np.array([[float(cell) for cell in line.split(',')[1:]] for line in lines[1:]])
    assert cells[0, 0] == pytest.approx(0.01, rel=0.2) and np.all(cells[:, [0, 3, 5]] > 0)


def test_truth_without_heading_is_named(tmp_path, capsys):
    (tmp_path / 't.csv').write_text('stamp_s,x_m,y_m\n1,2,3\n')
    code, _ = run(tmp_path, Drive(seconds=5, **NOISY), '--truth', str(tmp_path / 't.csv'))
    assert code == 1 and 'no column yaw_rad' in capsys.readouterr().err


def test_a_log_that_is_no_file_or_never_ends_is_one_error_line(tmp_path, capsys):
    """A pipe would wait for its writer, and a device fill the memory."""
    os.mkfifo(tmp_path / 'pipe.csv')
    (tmp_path / 'positions.csv').write_text('stamp_s,x_m,y_m\n1,2,3\n')
    (tmp_path / 'wide.csv').write_text('stamp_s,v_mps,omega_radps\n1,"' + 'x' * 200_000 + '\n')
    for name in ('pipe.csv', 'wide.csv', '/dev/zero'):
        odometry = tmp_path / name
        words = [
            str(odometry),
            str(tmp_path / 'positions.csv'),
            '--output',
            str(tmp_path / 'o.tum'),
        ]
        assert main(['filter', *words]) == 1
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and f'{odometry}: cannot be read' in lines[0]
    assert not (tmp_path / 'o.tum').exists()
