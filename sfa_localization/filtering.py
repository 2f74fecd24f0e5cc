# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Run the pose filter on a log without ROS: tables of odometry and positions in, a TUM file out."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from decimal import Decimal
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.data.files import atomic_write, read_text
from sfa_localization.data.geometry import Array
from sfa_localization.data.progress import progress_over
from sfa_localization.data.rejections import short_line
from sfa_localization.data.run import Odometry, Stamps, Trajectory
from sfa_localization.fusion.inputs import POSITION_STD
from sfa_localization.fusion.pose_filter import PoseFilter, State, Status, Update
from sfa_localization.fusion.replay import FilterTrack, replay
from sfa_localization.fusion.settings import FilterConfig

SECOND_NS = 1_000_000_000
LARGEST_LOG = 1 << 30
"""Bytes of a log: more than a year of odometry at 1 Hz, or three days at 100 Hz."""
ODOMETRY = ('stamp_s', 'v_mps', 'omega_radps', 'var_v', 'var_omega')
POSITIONS = ('stamp_s', 'x_m', 'y_m', 'var_x', 'var_y', 'var_xy', 'yaw_rad', 'var_yaw')
"""Columns of the two logs; without a header they are in this order."""
_SEPARATOR = re.compile(r'\s*[,;]\s*|\s+')


class Table(NamedTuple):
    """Rows of a log in the order of time: stamps (N,), other columns (N, K) with NaN where empty.

    `skipped` are the numbers of the lines that could not be used; `source` names the file.
    """

    stamps_ns: Stamps
    values: Array
    skipped: tuple[int, ...] = ()
    source: str = 'memory'


class Filtered(NamedTuple):
    """Poses (N, 3) at the stamps (N,) of odometry, from the start on.

    `covariances` (N, 3, 3) of [x, y, yaw]; `updates`: what became of each position, in order.
    """

    stamps_ns: Stamps
    poses: Array
    covariances: Array
    updates: tuple[Update, ...]
    counts: Counter[str]
    status: Status


def read_table(path: Path | str, names: Sequence[str]) -> Table:
    """Read a log of the columns `names`, of which the first three are needed.

    Cells are separated by commas or spaces. A line above them may name the columns in any order;
    the time may be `stamp_ns`. Lines that begin with # are comments. Raises DataError.
    """
    lines = map(str.strip, read_text(path, LARGEST_LOG, DataError).splitlines())
    numbered = enumerate(lines, 1)
    rows = {n: _SEPARATOR.split(line) for n, line in numbered if line and line[0] != '#'}
    header = _header(rows) or list(names)
    stamp, scale = ('stamp_ns', 1) if 'stamp_ns' in header else (names[0], SECOND_NS)
    for name in (stamp, *names[1:3]):
        if name not in header:
            raise DataError(f'{path}: no column {name} among {short_line(", ".join(header))}')
    at = [header.index(name) if name in header else len(header) for name in (stamp, *names[1:])]
    read = {number: _read(row, at, scale) for number, row in rows.items()}
    used = {number: cells for number, cells in read.items() if cells}
    if not used:
        wanted = f'{stamp}, {names[1]} and {names[2]}'
        raise DataError(f'{path}: none of its {len(rows)} rows has {wanted}, in these units')
    stamps, values = zip(*sorted(used.values(), key=itemgetter(0)), strict=True)
    skipped = tuple(number for number in rows if number not in used)
    return Table(np.array(stamps, np.int64), np.array(values), skipped, str(path))


def _header(rows: dict[int, list[str]]) -> list[str]:
    """The names of columns in the first of the rows, which is taken out; none where it is data."""
    first = next(iter(rows), 0)
    if not rows or not math.isnan(_number(rows[first], 0)):
        return []
    return [cell.strip('"') for cell in rows.pop(first)]


def _read(row: list[str], columns: Sequence[int], scale: int) -> tuple[int, list[float]] | None:
    """The stamp and the other cells of a row, None where one of the first three is missing.

    The stamp is exact, which a float cannot be, and of these centuries.
    """
    cells = [_number(row, column) for column in columns[1:]]
    try:
        stamp_ns = int(Decimal(row[columns[0]]) * scale)
    except (ArithmeticError, ValueError, IndexError):
        return None
    usable = abs(stamp_ns) < 2**62 and math.isfinite(cells[0] + cells[1])
    return (stamp_ns, cells) if usable else None


def _number(row: list[str], column: int) -> float:
    try:
        return float(row[column])
    except (ValueError, IndexError):
        return math.nan


def run_filter(
    odometry: Table, positions: Table, config: FilterConfig, progress: bool = False
) -> Filtered:
    """Fuse tables of ODOMETRY and POSITIONS as the live filter does, by earlier rows only.

    The errors of positions are white, as those of a sensor. Raises DataError when the tables do not
    overlap.
    """
    shift = _shift(odometry, positions)
    fused = PoseFilter(config, ErrorCorrelation(share=0.0))
    twists = np.nan_to_num(odometry.values)
    no_poses = np.full((len(twists), 3), np.nan)
    driven = Odometry(odometry.stamps_ns + shift, no_poses, twists[:, :2], twists[:, 2:])
    rows = positions.stamps_ns + shift, map(_Position.of, positions.values)
    steps = replay(fused, driven, *rows)
    total = len(twists) + len(positions.values)
    moved_ns = None
    states = dict[int, State]()
    updates = list[Update]()
    for stamp_ns, _, update in progress_over(steps, 'filter', total, 'rows', visible=progress):
        if update is not None:
            updates.append(update._replace(stamp_ns=update.stamp_ns - shift))
        else:
            moved_ns = stamp_ns
        if stamp_ns == moved_ns and (state := fused.at(stamp_ns)):
            states[stamp_ns] = state
    track = FilterTrack.of([*states.values()])
    stamps_ns = track.poses.stamps_ns - shift
    estimates = (stamps_ns, track.poses.poses, track.covariances)
    return Filtered(*estimates, tuple(updates), fused.counts, fused.status)


def _shift(odometry: Table, positions: Table) -> int:
    """What to add to stamps, ns: logs may count from zero, but to the filter zero means no stamp.

    Raises DataError when the tables do not overlap.
    """
    (a, b), (c, d) = ((int(t.stamps_ns[0]), int(t.stamps_ns[-1])) for t in (odometry, positions))
    if a > d or c > b:
        raise DataError(
            f'odometry from {odometry.source} ({_seconds(a)} to {_seconds(b)} s) and positions '
            f'from {positions.source} ({_seconds(c)} to {_seconds(d)} s) have no time in common: '
            'bring both to one clock'
        )
    return max(0, SECOND_NS - min(a, c))


class _Position(NamedTuple):
    """A position (2,) or pose (3,) with its covariance; logs hold no turns of images."""

    pose: Array
    covariance: Array
    turned: float = math.nan

    @classmethod
    def of(cls, row: Array) -> _Position:
        """From a row (7,); an empty or zero variance is unknown."""
        x, y, var_x, var_y, xy, yaw, var_yaw = np.nan_to_num(row).tolist()
        has_variance = bool(var_x or var_y)
        covariance = np.array([[var_x or var_y, xy], [xy, var_y or var_x]]) * has_variance
        if not (var_yaw > 0 and math.isfinite(row[5])):
            return cls(np.array([x, y]), covariance)
        full = np.diag([POSITION_STD**2, POSITION_STD**2, var_yaw])
        if has_variance:
            full[:2, :2] = covariance
        return cls(np.array([x, y, yaw]), full)


def write(filtered: Filtered, path: Path, beside: Path) -> None:
    """Write lines of `stamp x y z qx qy qz qw`, and beside them covariances. Raises DataError."""
    with atomic_write(path, DataError) as poses, atomic_write(beside, DataError) as spreads:
        spreads.write(b'stamp_s,var_x,cov_xy,cov_xyaw,var_y,cov_yyaw,var_yaw\n')
        rows = zip(filtered.stamps_ns, filtered.poses, filtered.covariances, strict=True)
        for stamp_ns, pose, matrix in rows:
            cells = ','.join(f'{cell:.9g}' for cell in matrix[np.triu_indices(3)])
            poses.write(_tum_line(stamp_ns, pose))
            spreads.write(f'{_seconds(int(stamp_ns))},{cells}\n'.encode())


def write_trajectory(trajectory: Trajectory, path: Path) -> None:
    """Write lines of `stamp x y z qx qy qz qw`, 0 for an unknown heading. Raises DataError."""
    with atomic_write(path, DataError) as file:
        for stamp_ns, pose in zip(trajectory.stamps_ns, trajectory.poses, strict=True):
            file.write(_tum_line(stamp_ns, np.nan_to_num(pose)))


def _tum_line(stamp_ns: int, pose: Array) -> bytes:
    x, y, yaw = pose.tolist()
    turn = f'{math.sin(yaw / 2):.9f} {math.cos(yaw / 2):.9f}'
    return f'{_seconds(int(stamp_ns))} {x:.6f} {y:.6f} 0 0 0 {turn}\n'.encode()


def _seconds(stamp_ns: int) -> str:
    seconds, rest = divmod(abs(stamp_ns), SECOND_NS)
    return f'{"-" if stamp_ns < 0 else ""}{seconds}.{rest:09d}'
