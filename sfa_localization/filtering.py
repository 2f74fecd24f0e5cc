# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Run the pose filter on a log without ROS: tables of odometry and positions in, a TUM file out."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sfa_localization.data.errors import DataError
from sfa_localization.data.events import IMAGE, merge_by_stamp
from sfa_localization.data.files import atomic_write
from sfa_localization.data.geometry import Array, align
from sfa_localization.data.run import Stamps, Trajectory, integrate
from sfa_localization.fusion.inputs import POSITION_STD
from sfa_localization.fusion.pose_filter import PoseFilter, Status
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.smoother import Smoother

_NS = Decimal(1_000_000_000)
_SECOND_NS = 1_000_000_000
_STRETCH = 20
"""Positions that are aligned with odometry together: so few that odometry hardly drifts."""
_UNTRUE = 2.0
"""A standard deviation that is too small by more than this factor is replaced."""
_MEDIAN_OF_RAYLEIGH = 1.1774
"""Median length of a planar vector with unit variance per axis: sqrt(2 ln 2)."""
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


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of a log in the order of time: stamps (N,) and named columns (N,), NaN where empty.

    `skipped` counts the rows that could not be used, by reason.
    """

    stamps_ns: Stamps
    columns: dict[str, Array]
    skipped: Counter[str] = field(default_factory=Counter)

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, slots=True)
class Filtered:
    """Poses (N, 3) at the stamps (N,) of odometry, from the start on, and counts of the rows."""

    stamps_ns: Stamps
    poses: Array
    counts: Counter[str]
    status: Status
    before_start: int


def read_odometry_table(path: Path | str) -> Table:
    """Read `stamp_s,v_mps,omega_radps[,var_v,var_omega]`. Raises DataError."""
    table = _read_table(Path(path), _ODOMETRY, ('v', 'omega'))
    if len(table) == 0:
        raise DataError(f'{path}: holds no rows below its header')
    return table


def read_position_table(path: Path | str) -> Table:
    """Read `stamp_s,x_m,y_m[,var_x,var_y][,var_xy][,yaw_rad,var_yaw]`. Raises DataError."""
    return _read_table(Path(path), _POSITIONS, ('x', 'y'))


def run_filter(
    odometry: Table,
    positions: Table,
    config: FilterConfig,
    start: Sequence[float] | None = None,
    progress: bool = False,
    smooth: bool = False,
) -> Filtered:
    """Fuse two tables as a live filter would: each pose depends on earlier rows only, unless
    `smooth`: then on all rows.

    `start` is x m, y m, yaw rad, if known. Raises DataError when the tables do not overlap.
    """
    _require_overlap(odometry, positions)
    # Logs may count from zero, but a stamp of zero means that there is none.
    first = min(int(table.stamps_ns[0]) for table in (odometry, positions) if len(table))
    shift = _SECOND_NS - first if first <= 0 else 0
    fused = Smoother(config) if smooth else PoseFilter(config)
    if start is not None:
        fused.set_pose(int(odometry.stamps_ns[0]) + shift, start)
    stamps, poses, waiting = [], [], 0
    for stamp_ns in tqdm(_feed(fused, odometry, positions, shift), disable=not progress,
                         total=len(odometry), unit=' rows', desc='filter'):  # fmt: skip
        state = fused.at(stamp_ns)
        if state is None:
            waiting += 1
            continue
        stamps.append(stamp_ns - shift)
        poses.append(state.pose)
    if isinstance(fused, Smoother):
        smoothed = fused.smoothed()
        stamps, poses = [s.stamp_ns - shift for s in smoothed], [s.pose for s in smoothed]
    return Filtered(
        np.array(stamps, np.int64),
        np.reshape(np.array(poses), (-1, 3)),
        fused.counts,
        fused.status,
        waiting,
    )


def position_std_of(odometry: Table, positions: Table) -> float | None:
    """Standard deviation of positions: their residuals after alignment with dead reckoning.

    Each _STRETCH of them is aligned on its own; None where there are too few.
    """
    path = integrate(
        odometry.stamps_ns, np.column_stack([odometry.columns[n] for n in ('v', 'omega')])
    )
    inside = (positions.stamps_ns >= odometry.stamps_ns[0]) & (
        positions.stamps_ns <= odometry.stamps_ns[-1]
    )
    driven = Trajectory(odometry.stamps_ns, path).at(positions.stamps_ns[inside])[:, :2]
    measured = np.column_stack([positions.columns['x'], positions.columns['y']])[inside]
    residuals = []
    for start in range(0, len(measured) - _STRETCH + 1, _STRETCH):
        part = slice(start, start + _STRETCH)
        aligned = align(driven[part], measured[part]).apply(driven[part])
        residuals.append(float(np.median(np.hypot(*(measured[part] - aligned).T))))
    return float(np.median(residuals)) / _MEDIAN_OF_RAYLEIGH if residuals else None


def fitting_config(
    odometry: Table, positions: Table, config: FilterConfig
) -> tuple[FilterConfig, str]:
    """The settings for positions without variances, or with far too small ones; and what was done.

    A `measurement_factor` other than the default is the user's, and stays.
    """
    if config.measurement_factor != FilterConfig().measurement_factor:
        return config, ''
    found = position_std_of(odometry, positions) if len(positions) else None
    if found is None:
        return config, ''
    claimed = math.sqrt(_stated_variance(positions))
    if claimed == 0:
        text = f'positions have no variance: their standard deviation is taken to be {found:.2f} m'
        return replace(config, measurement_factor=(found / POSITION_STD) ** 2), text
    if found > _UNTRUE * claimed:
        text = (
            f'positions claim a standard deviation of {claimed:.2f} m, but err by {found:.2f} m: '
            'taken as such'
        )
        return replace(config, measurement_factor=(found / claimed) ** 2), text
    return config, ''


def _stated_variance(positions: Table) -> float:
    """Median of the variances in the table; 0 without any."""
    variances = positions.columns.get('var_x', np.zeros(0))
    variances = variances[np.isfinite(variances) & (variances > 0)]
    return float(np.median(variances)) if len(variances) else 0.0


def write_tum(path: Path | str, stamps_ns: Stamps, poses: Array) -> None:
    """Write `stamp x y z qx qy qz qw` lines, completely or not at all. Raises DataError."""
    with atomic_write(Path(path), DataError) as file:
        for stamp_ns, (x, y, yaw) in zip(stamps_ns.tolist(), poses.tolist(), strict=True):
            turn = f'{math.sin(yaw / 2):.9f} {math.cos(yaw / 2):.9f}'
            file.write(f'{_seconds(stamp_ns)} {x:.6f} {y:.6f} 0 0 0 {turn}\n'.encode())


def _seconds(stamp_ns: int) -> str:
    sign = '-' if stamp_ns < 0 else ''
    seconds, rest = divmod(abs(stamp_ns), _SECOND_NS)
    return f'{sign}{seconds}.{rest:09d}'


def _feed(fused: PoseFilter, odometry: Table, positions: Table, shift: int) -> Iterator[int]:
    """Feed both tables to the filter in order of time; yields each odometry stamp once fused."""
    pending: int | None = None
    for stamp_ns, kind, i in merge_by_stamp(
        odometry.stamps_ns + shift, positions.stamps_ns + shift
    ):
        if pending is not None and stamp_ns > pending:
            yield pending
            pending = None
        if kind == IMAGE:
            fused.add_measurement(stamp_ns, *_measurement(positions.columns, i))
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
    x, y = (x or y, y or x)
    xy = _cell(columns, 'var_xy', i, 0.0)
    covariance = np.array([[x, xy], [xy, y]]) if x > 0 else np.zeros((2, 2))
    yaw, yaw_variance = _cell(columns, 'yaw', i, math.nan), _cell(columns, 'var_yaw', i, 0.0)
    if not (math.isfinite(yaw) and yaw_variance > 0 and covariance.any()):
        return position, covariance
    full = np.zeros((3, 3))
    full[:2, :2], full[2, 2] = covariance, yaw_variance
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
            f'odometry ({ranges[0]}) and positions ({ranges[1]}) have no time in common: '
            'bring both to one clock'
        )


def _read_table(path: Path, known: dict[str, tuple[str, ...]], needed: tuple[str, ...]) -> Table:
    try:
        text = path.read_text(encoding='utf-8-sig')
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f'{path}: cannot be read: {error}') from None
    rows = [_split(line) for line in text.splitlines() if line.strip()]
    names, start = _header(rows, known)
    if not names:
        raise DataError(f'{path}: holds no rows; the first line must be stamp_s,{",".join(needed)}')
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
    """Index of each known column. Raises DataError when a needed one is missing."""
    wanted = {'stamp_s': _STAMP, 'stamp_ns': _STAMP_NS, **known}
    at = {}
    for name, aliases in wanted.items():
        found = next((names.index(alias) for alias in aliases if alias in names), None)
        if found is not None:
            at[name] = found
    missing = [known[name][0] for name in needed if name not in at]
    if 'stamp_s' not in at and 'stamp_ns' not in at:
        missing.insert(0, 'stamp_s')
    if missing:
        raise DataError(f'{path}: no column {" or ".join(missing)} among {", ".join(names)}')
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
        if stamp_ns is None:
            skipped['no stamp'] += 1
        elif not all(math.isfinite(cells[columns.index(name)]) for name in needed):
            skipped['no number'] += 1
        else:
            stamps.append(stamp_ns)
            numbers.append(cells)
    if not stamps and skipped:
        raise DataError(f'{path}: none of the {sum(skipped.values())} rows can be used')
    order = np.argsort(np.array(stamps, np.int64), kind='stable')
    if len(order) and np.any(np.diff(order) < 0):
        skipped['(rows out of order, sorted)'] = int(np.sum(np.diff(order) < 0))
    data = np.reshape(np.array(numbers, float), (-1, len(columns)))[order]
    return Table(
        np.array(stamps, np.int64)[order],
        {name: data[:, k] for k, name in enumerate(columns)},
        skipped,
    )


def _stamp(row: list[str], at: dict[str, int]) -> int | None:
    """Exact nanoseconds, which a float cannot hold; None where the cell is no stamp."""
    name = 'stamp_ns' if 'stamp_ns' in at else 'stamp_s'
    number = _number(row[at[name]]) if at[name] < len(row) else None
    if number is None:
        return None
    stamp_ns = int(number if name == 'stamp_ns' else (number * _NS).to_integral_value())
    return stamp_ns if abs(stamp_ns) < 2**62 else None


def _number(cell: str) -> Decimal | None:
    try:
        number = Decimal(cell.strip())
    except InvalidOperation:
        return None
    return number if number.is_finite() else None


def _float(row: list[str], column: int) -> float:
    number = _number(row[column]) if column < len(row) else None
    return math.nan if number is None else float(number)
