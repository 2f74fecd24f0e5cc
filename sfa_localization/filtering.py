# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Run the pose filter on a log without ROS: tables of odometry and positions in, a TUM file out."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.data.events import IMAGE, merge_by_stamp
from sfa_localization.data.files import atomic_write, read_regular
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import LARGEST_VARIANCE
from sfa_localization.data.progress import progress_over
from sfa_localization.data.rejections import listed, short_line
from sfa_localization.data.run import Stamps, Trajectory
from sfa_localization.fusion.inputs import POSITION_STD
from sfa_localization.fusion.pose_filter import PoseFilter, State, Status, Update
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.smoother import Smoother

_NS = Decimal(1_000_000_000)
_LARGEST_EXPONENT = 20  # of stamps, whose nanoseconds are below 2^62
_SECOND_NS = 1_000_000_000
LARGEST_LOG = 1 << 30
"""Bytes of a log: more than a year of odometry at 1 Hz, or three days at 100 Hz."""
_LEAST_STD_M = 1e-4
"""Of a position: no smaller one is stated in earnest."""
# Usual names of the columns, in lower case; the first is the one in the documentation.
_STAMP = ('stamp_s', 'stamp', 't', 'time', 'time_s', 'timestamp', 'timestamp_s', 'sec', 'seconds')
_STAMP_NS = ('stamp_ns', 'timestamp_ns', 't_ns', 'time_ns')
_ODOMETRY = {
    'v': ('v_mps', 'v', 'vx', 'v_x', 'speed', 'linear_x', 'velocity', 'forward_velocity'),
    'omega': ('omega_radps', 'omega', 'w', 'wz', 'omega_z', 'yaw_rate', 'angular_z',
              'angular_velocity', 'yawrate'),
    'var_v': ('var_v', 'v_var', 'v_variance', 'variance_v', 'cov_vv'),
    'var_omega': ('var_omega', 'omega_var', 'omega_variance', 'var_w', 'variance_omega'),
}  # fmt: skip
_POSITIONS = {
    'x': ('x_m', 'x', 'px', 'pos_x', 'position_x', 'east', 'easting'),
    'y': ('y_m', 'y', 'py', 'pos_y', 'position_y', 'north', 'northing'),
    'var_x': ('var_x', 'x_var', 'var_xx', 'cov_xx', 'variance_x'),
    'var_y': ('var_y', 'y_var', 'var_yy', 'cov_yy', 'variance_y'),
    'var_xy': ('var_xy', 'cov_xy', 'covariance_xy'),
    'yaw': ('yaw_rad', 'yaw', 'heading', 'heading_rad', 'theta'),
    'var_yaw': ('var_yaw', 'yaw_var', 'cov_yawyaw', 'variance_yaw'),
}

_TUM = {
    **{name: _POSITIONS[name] for name in ('x', 'y')},
    **{name: (name,) for name in ('z', 'qx', 'qy', 'qz', 'qw')},
    'yaw': _POSITIONS['yaw'],
}


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of a log in the order of time: stamps (N,) and named columns (N,), NaN where empty.

    `skipped` counts the rows that could not be used, by reason; `source` names the file.
    """

    stamps_ns: Stamps
    columns: dict[str, Array]
    skipped: Counter[str] = field(default_factory=Counter)
    source: str = 'memory'

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, slots=True)
class Filtered:
    """Poses (N, 3) at the stamps (N,) of odometry, from the start on, and counts of the rows.

    `covariances` (N, 3, 3) of [x, y, yaw]; `updates`: what became of each position, in order;
    `nis`: see PoseFilter.nis.
    """

    stamps_ns: Stamps
    poses: Array
    covariances: Array
    updates: tuple[Update, ...]
    counts: Counter[str]
    status: Status
    before_start: int
    nis: float


def read_odometry_table(path: Path | str) -> Table:
    """Read `stamp_s,v_mps,omega_radps[,var_v,var_omega]`. Raises DataError."""
    table = _read_table(Path(path), _ODOMETRY, ('v', 'omega'))
    if len(table) == 0:
        raise DataError(f'{path}: holds no rows below its header')
    return table


def read_position_table(path: Path | str) -> Table:
    """Read `stamp_s,x_m,y_m[,var_x,var_y][,var_xy][,yaw_rad,var_yaw]`. Raises DataError."""
    table = _read_table(Path(path), _POSITIONS, ('x', 'y'))
    nothing = np.full(len(table), np.nan)
    yaw, variance = (table.columns.get(name, nothing) for name in ('yaw', 'var_yaw'))
    if unsure := int(np.count_nonzero(np.isfinite(yaw) & ~(variance > 0))):
        table.skipped['(heading without var_yaw, left out)'] = unsure
    return table


def run_filter(
    odometry: Table,
    positions: Table,
    config: FilterConfig,
    progress: bool = False,
    smooth: bool = False,
) -> Filtered:
    """Fuse two tables as the live filter does, by earlier rows only; `smooth`: by all rows.

    The errors of positions are white, as those of a sensor. Raises DataError when the tables do not
    overlap.
    """
    _require_overlap(odometry, positions)
    shift, white = _shift(odometry, positions), ErrorCorrelation(share=0.0)
    fused = (Smoother if smooth else PoseFilter)(config, white)
    answers, updates = list[State | None](), list[Update]()
    feed = _feed(fused, odometry, positions, shift, updates)
    for stamp_ns in progress_over(feed, 'filter', len(odometry), 'rows', shown=progress):
        answers.append(fused.at(stamp_ns))
    states = fused.smoothed() if isinstance(fused, Smoother) else [one for one in answers if one]
    return Filtered(
        np.array([state.stamp_ns - shift for state in states], np.int64),
        np.reshape([state.pose for state in states], (-1, 3)),
        np.reshape([state.pose_covariance for state in states], (-1, 3, 3)),
        tuple(update._replace(stamp_ns=update.stamp_ns - shift) for update in updates),
        fused.counts,
        fused.status,
        answers.count(None),
        fused.nis,
    )


def _shift(odometry: Table, positions: Table) -> int:
    """What makes all stamps positive: logs may count from zero, but zero means no stamp."""
    first = min(int(table.stamps_ns[0]) for table in (odometry, positions) if len(table))
    return max(0, _SECOND_NS - first) if first <= 0 else 0


def _in_earnest(variances: Array) -> Array:
    """Variances m^2 of positions, none that is known smaller than what is stated in earnest."""
    return np.where(variances > 0, np.maximum(variances, _LEAST_STD_M**2), variances)


def write_tum(path: Path | str, stamps_ns: Stamps, poses: Array) -> None:
    """Write `stamp x y z qx qy qz qw` lines, completely or not at all. Raises DataError."""
    with atomic_write(Path(path), DataError) as file:
        for stamp_ns, (x, y, yaw) in zip(stamps_ns.tolist(), poses.tolist(), strict=True):
            turn = f'{math.sin(yaw / 2):.9f} {math.cos(yaw / 2):.9f}'
            file.write(f'{_seconds(stamp_ns)} {x:.6f} {y:.6f} 0 0 0 {turn}\n'.encode())


def write_covariances(path: Path | str, stamps_ns: Stamps, covariances: Array) -> None:
    """Write the covariances (N, 3, 3) of [x, y, yaw] as a CSV file, a row for each stamp.

    Raises DataError.
    """
    rows, columns = np.triu_indices(3)
    with atomic_write(Path(path), DataError) as file:
        file.write(b'stamp_s,var_x,cov_xy,cov_xyaw,var_y,cov_yyaw,var_yaw\n')
        for stamp_ns, matrix in zip(stamps_ns.tolist(), covariances, strict=True):
            cells = ','.join(f'{cell:.9g}' for cell in matrix[rows, columns].tolist())
            file.write(f'{_seconds(stamp_ns)},{cells}\n'.encode())


def read_truth(path: Path | str) -> Trajectory:
    """Read true poses: `stamp_s,x_m,y_m,yaw_rad`, or TUM lines of `stamp x y z qx qy qz qw`.

    Raises DataError.
    """
    table = _read_table(Path(path), _TUM, ('x', 'y'))
    columns, quaternion = table.columns, ('qx', 'qy', 'qz', 'qw')
    if len(table) == 0:
        raise DataError(f'{path}: holds no poses')
    if all(name in columns for name in quaternion):
        qx, qy, qz, qw = (columns[name] for name in quaternion)
        yaw = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy**2 + qz**2))
    elif 'yaw' in columns:
        yaw = columns['yaw']
    else:
        raise DataError(f'{path}: no column yaw_rad')
    stamps, first = np.unique(table.stamps_ns, return_index=True)
    return Trajectory(stamps, np.column_stack([columns['x'], columns['y'], yaw])[first])


def _seconds(stamp_ns: int) -> str:
    sign = '-' if stamp_ns < 0 else ''
    seconds, rest = divmod(abs(stamp_ns), _SECOND_NS)
    return f'{sign}{seconds}.{rest:09d}'


def _feed(
    fused: PoseFilter, odometry: Table, positions: Table, shift: int, updates: list[Update]
) -> Iterator[int]:
    """Feed both tables to the filter in order of time; yields each odometry stamp once fused.

    What becomes of the positions is appended to `updates`.
    """
    pending: int | None = None
    for stamp_ns, kind, i in merge_by_stamp(
        odometry.stamps_ns + shift, positions.stamps_ns + shift
    ):
        if pending is not None and stamp_ns > pending:
            yield pending
            pending = None
        if kind == IMAGE:
            updates.append(fused.add_measurement(stamp_ns, *_measurement(positions.columns, i)))
        elif not fused.add_odometry(stamp_ns, *_twist(odometry.columns, i)):
            pending = stamp_ns
    if pending is not None:
        yield pending


def _twist(columns: dict[str, Array], i: int) -> tuple[float, float, tuple[float, float]]:
    variances = _cell(columns, 'var_v', i, 0.0), _cell(columns, 'var_omega', i, 0.0)
    return float(columns['v'][i]), float(columns['omega'][i]), variances


def _measurement(columns: dict[str, Array], i: int) -> tuple[Array, Array]:
    """Position or pose and its covariance; a missing variance is 0, for unknown."""
    position = np.array([columns['x'][i], columns['y'][i]])
    x, y = _cell(columns, 'var_x', i, 0.0), _cell(columns, 'var_y', i, 0.0)
    x, y = _in_earnest(np.array([x or y, y or x])).tolist()
    xy = _cell(columns, 'var_xy', i, 0.0)
    covariance = np.array([[x, xy], [xy, y]]) if x > 0 else np.zeros((2, 2))
    yaw, yaw_variance = _cell(columns, 'yaw', i, math.nan), _cell(columns, 'var_yaw', i, 0.0)
    if not (math.isfinite(yaw) and yaw_variance > 0):
        return position, covariance
    full = np.diag([POSITION_STD**2, POSITION_STD**2, yaw_variance])
    if covariance.any():
        full[:2, :2] = covariance
    return np.append(position, yaw), full


def _cell(columns: dict[str, Array], name: str, i: int, missing: float) -> float:
    if name not in columns or not math.isfinite(columns[name][i]):
        return missing
    return float(columns[name][i])


def _require_overlap(odometry: Table, positions: Table) -> None:
    if len(positions) == 0:
        return
    spans = [(int(t.stamps_ns[0]), int(t.stamps_ns[-1])) for t in (odometry, positions)]
    if spans[0][0] > spans[1][1] or spans[1][0] > spans[0][1]:
        ranges = [f'{_seconds(a)} to {_seconds(b)} s' for a, b in spans]
        raise DataError(
            f'odometry from {odometry.source} ({ranges[0]}) and positions from {positions.source} '
            f'({ranges[1]}) have no time in common: bring both to one clock'
        )


def _read_table(path: Path, known: dict[str, tuple[str, ...]], needed: tuple[str, ...]) -> Table:
    try:
        text = read_regular(path, LARGEST_LOG).decode('utf-8-sig')
        rows = [_split(line) for line in text.splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f'{path}: cannot be read: {error}') from None
    names, start = _header(rows, known)
    if not names:
        wanted = ['stamp_s', *(known[name][0] for name in needed)]
        raise DataError(f'{path}: holds no rows; the first line must be {",".join(wanted)}')
    at = _column_indices(path, names, known, needed)
    return _table(path, rows[start:], at, needed)


def _split(line: str) -> list[str]:
    """Cells of a row, separated by comma, semicolon, tab or spaces."""
    for separator in (',', ';', '\t'):
        if separator in line:
            return [
                cell.strip().strip('"') for cell in next(csv.reader([line], delimiter=separator))
            ]
    return line.split()


def _header(rows: list[list[str]], known: dict[str, tuple[str, ...]]) -> tuple[list[str], int]:
    """Names of the columns and the first row of data; the documented order without a header."""
    for i, row in enumerate(rows):
        if _number(row[0]) is not None:
            usual = ['stamp_s', *(aliases[0] for aliases in known.values())]
            return usual[: len(row)], i
        names = [cell.lstrip('#%').strip().lower() for cell in row]
        names = names if names[0] else names[1:]
        if not row[0].startswith(('#', '%')) or set(names) & {*_STAMP, *_STAMP_NS}:
            return names, i + 1
    return [], len(rows)


def _column_indices(
    path: Path, names: list[str], known: dict[str, tuple[str, ...]], needed: tuple[str, ...]
) -> dict[str, int]:
    """Index of each known column. Raises DataError where one is missing or there twice."""
    wanted = {'stamp_s': _STAMP, 'stamp_ns': _STAMP_NS, **known}
    used = {alias for aliases in wanted.values() for alias in aliases}
    for name, count in Counter(names).items():
        if count > 1 and name in used:
            raise DataError(f'{path}: has {count} columns {name}: give each a name of its own')
    at = {}
    for name, aliases in wanted.items():
        found = next((names.index(alias) for alias in aliases if alias in names), None)
        if found is not None:
            at[name] = found
    missing = [known[name][0] for name in needed if name not in at]
    if 'stamp_s' not in at and 'stamp_ns' not in at:
        missing.insert(0, 'stamp_s')
    if missing:
        raise DataError(
            f'{path}: no column {" or ".join(missing)} among {short_line(", ".join(names))}'
        )
    return at


def _table(path: Path, rows: list[list[str]], at: dict[str, int], needed: tuple[str, ...]) -> Table:
    skipped: Counter[str] = Counter()
    stamps, numbers = [], []
    columns = [name for name in at if not name.startswith('stamp_')]
    for row in rows:
        if row[0].startswith(('#', '%')):
            continue
        stamp_ns = _stamp(row, at)
        cells = [_float(row, at[name]) for name in columns]
        if isinstance(stamp_ns, str):
            skipped[stamp_ns] += 1
        elif not all(math.isfinite(cells[columns.index(name)]) for name in needed):
            skipped['no number'] += 1
        elif reason := _impossible(dict(zip(columns, cells, strict=True))):
            skipped[reason] += 1
        else:
            stamps.append(stamp_ns)
            numbers.append(cells)
    if not stamps and skipped:
        total = sum(skipped.values())
        raise DataError(f'{path}: none of the {total} rows can be used ({listed(skipped)})')
    order = np.argsort(np.array(stamps, np.int64), kind='stable')
    if len(order) and np.any(np.diff(order) < 0):
        skipped['(rows out of order, sorted)'] = int(np.sum(np.diff(order) < 0))
    data = np.reshape(np.array(numbers, float), (-1, len(columns)))[order]
    return Table(
        np.array(stamps, np.int64)[order],
        {name: data[:, k] for k, name in enumerate(columns)},
        skipped,
        str(path),
    )


def _impossible(cells: dict[str, float]) -> str:
    """Why the variances of a row are none, or ''; 0 is that of an unknown one."""
    if any(cells[name] < 0 for name in cells if name.startswith('var_')):
        return 'negative variance'
    if any(cells.get(name, 0.0) >= LARGEST_VARIANCE for name in ('var_x', 'var_y')):
        return 'variance that means that nothing is known'
    x, y = cells.get('var_x', 0.0), cells.get('var_y', 0.0)
    if x > 0 and cells.get('var_xy', 0.0) ** 2 >= x * (y or x):
        return 'var_xy larger than var_x and var_y allow'
    return ''


def _stamp(row: list[str], at: dict[str, int]) -> int | str:
    """Exact nanoseconds, which a float cannot hold; or why the cell is no stamp."""
    name = 'stamp_ns' if 'stamp_ns' in at else 'stamp_s'
    number = _number(row[at[name]]) if at[name] < len(row) else None
    if number is None:
        return 'no stamp'
    far = f'{name} of the far future: in another unit? Columns are stamp_s or stamp_ns'
    if number.adjusted() > _LARGEST_EXPONENT:
        return far
    stamp_ns = int(number if name == 'stamp_ns' else (number * _NS).to_integral_value())
    return stamp_ns if abs(stamp_ns) < 2**62 else far


def _number(cell: str) -> Decimal | None:
    try:
        number = Decimal(cell.strip())
    except InvalidOperation:
        return None
    return number if number.is_finite() else None


def _float(row: list[str], column: int) -> float:
    number = _number(row[column]) if column < len(row) else None
    return math.nan if number is None else float(number)
