# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Measured points, from a file and from a topic, and the stops of a drive that files name."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.files import read_text
from sfa_localization.data.geometry import relative
from sfa_localization.data.run import POINT_STD_M, Odometry, Points, Run, Stamps
from sfa_localization.metric.segments import IMAGE_STEP_MIN_M, IMAGE_TURN_MIN_RAD

STOP_S = 2.0
"""A robot that stands for so long has stopped."""
MOST = 100
"""Points that are used of a topic: neighboring errors of a receiver are correlated."""
LARGEST_FILE = 1 << 20
_USAGE = 'lines are "stamp_s, x_m, y_m" or "stop, number, x_m, y_m", then perhaps std_m, above 0'


def stops(odometry: Odometry) -> Stamps:
    """First and last stamp (S, 2) of each time the robot stood for STOP_S or longer."""
    stamps = odometry.stamps_ns
    track = odometry.trajectory
    later = stamps + round(STOP_S * 1e9)
    if len(stamps) < 2:
        return np.zeros((0, 2), np.int64)
    moved = np.abs(relative(odometry.poses, track.at(later)))
    stands = (np.hypot(*moved[:, :2].T) < IMAGE_STEP_MIN_M) & (moved[:, 2] < IMAGE_TURN_MIN_RAD)
    stands &= later <= stamps[-1]
    change = np.flatnonzero(np.diff(stands, prepend=False, append=False))
    return np.column_stack([stamps[change[::2]], later[change[1::2] - 1]])


def points_of(runs: Sequence[Run], path: str) -> Points | None:
    """The points of a file, and of the topics of the runs. Raises DataError for a bad file."""
    rows = read_points(Path(path), [run.odometry for run in runs]).rows() if path else []
    by_topic = [row for run in runs if run.points is not None for row in run.points.rows()]
    rows += by_topic[:: len(by_topic) // MOST + 1]
    return Points.of(rows) if rows else None


def read_points(path: Path, drives: Sequence[Odometry]) -> Points:
    """Read a file of points, whose stops are those of the first of the drives.

    Raises DataError that names the line, also for a stamp outside of the drives.
    """
    stood = stops(drives[0]).mean(axis=1).astype(np.int64).tolist()
    spans = [(int(drive.stamps_ns[0]), int(drive.stamps_ns[-1])) for drive in drives]
    rows = []
    for line, stop, stamp_ns, place, std in list(_lines(path)):  # a wrong form is told first
        if stop is not None and not 0 < stop <= len(stood):
            raise DataError(
                f'{path}: line {line}: no stop {stop}: the first drive stands {len(stood)} times '
                f'for {STOP_S:g} s; inspect lists them'
            )
        name = f'stop {stop}' if stop else f'point of {stamp_ns * 1e-9:.10g} s'
        stamp_ns = stood[stop - 1] if stop else stamp_ns
        if not any(first <= stamp_ns <= last for first, last in spans):
            times = ', '.join(f'{a * 1e-9:.1f} to {b * 1e-9:.1f} s' for a, b in spans)
            raise DataError(
                f'{path}: line {line}: {name}: outside of the drives ({times}): give the stamp, or '
                '"stop, number, ..." as inspect numbers them'
            )
        rows.append((name, stamp_ns, place, std, 0j))
    if not rows:
        raise DataError(f'{path}: holds no points: {_USAGE}')
    return Points.of(rows)


def _lines(path: Path) -> Iterator[tuple[int, int | None, int, complex, float]]:
    """Number, stop or None, stamp, place and standard deviation of each line with a point."""
    for number, line in enumerate(read_text(path, LARGEST_FILE, DataError).splitlines(), 1):
        cells = re.split(r'\s*[,;]\s*|\s+', line.partition('#')[0].strip())
        if cells == [''] or cells[0] == 'stamp_s':
            continue
        wrong = DataError(f'{path}: line {number}: {line.strip()!r} is no point: {_USAGE}')
        try:
            stop = int(cells.pop(1)) if cells[0].lower() == 'stop' else None
            stamp_ns = 0 if stop is not None else int(Decimal(cells[0]) * 10**9)
            x, y, std = map(float, [*cells[1:], str(POINT_STD_M)][:3])
        except (ArithmeticError, ValueError, IndexError):
            raise wrong from None
        if not (math.isfinite(x + y) and 0 < std < math.inf and len(cells) <= 4):
            raise wrong
        yield number, stop, stamp_ns, complex(x, y), std
