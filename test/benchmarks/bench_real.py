# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The pose filter against a plain EKF on logs of real robots: `python bench_real.py LOG...`.

A LOG is the common start of three files: LOG_odom.csv, LOG_positions.csv and LOG_truth.tum, each
of them also as .gz. The plain filter is what anyone would write first: x, y, yaw, white noise set
by hand, and a gate. It is given the true pose at the start; ours has to find it.
"""

from __future__ import annotations

import argparse
import gzip
import json
import tempfile
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from sfa_localization import __version__, filtering
from sfa_localization.data.events import IMAGE, merge_by_stamp
from sfa_localization.data.files import write_json
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import Trajectory
from sfa_localization.fusion.settings import FilterConfig

SPEED_STD, RATE_STD = 0.05, 0.35
"""White noise of a reading of the plain filter, m/s and rad/s: set by hand for small robots."""
GATE = float(chi2.ppf(0.999, 2))
SETTLED_S = 30.0
GOOD_M = 0.6
"""Positions nearer to the truth than this, in m, are good ones that no filter should reject."""
Result = tuple[list[int], list[np.ndarray], list[np.ndarray], list[tuple[int, bool]]]


def plain_ekf(odometry: filtering.Table, positions: filtering.Table, start: np.ndarray) -> Result:
    """Stamps, poses (3,), covariances (3, 3), and what became of each position."""
    x, p = start.copy(), np.diag([0.1, 0.1, 0.1]) ** 2
    before = int(odometry.stamps_ns[0])
    result: Result = [], [], [], []
    for stamp_ns, kind, i in merge_by_stamp(odometry.stamps_ns, positions.stamps_ns):
        if kind == IMAGE:
            z = positions.values[i, :2]
            s = p[:2, :2] + np.diag(positions.values[i, 2:4])
            fits = bool((z - x[:2]) @ np.linalg.solve(s, z - x[:2]) < GATE)
            if fits:
                gain = p[:, :2] @ np.linalg.inv(s)
                x, p = x + gain @ (z - x[:2]), p - gain @ p[:2]
            result[3].append((stamp_ns, fits))
            continue
        v, omega = odometry.values[i, :2]
        dt, before = (stamp_ns - before) * 1e-9, stamp_ns
        c, s = np.cos(x[2]), np.sin(x[2])
        f = np.array([[1, 0, -v * dt * s], [0, 1, v * dt * c], [0, 0, 1]])
        g = np.array([[c, 0], [s, 0], [0, 1]]) * dt
        x = x + np.array([v * dt * c, v * dt * s, omega * dt])
        p = f @ p @ f.T + g @ np.diag([SPEED_STD**2, RATE_STD**2]) @ g.T
        result[0].append(stamp_ns)
        result[1].append(x)
        result[2].append(p)
    return result


def judged(truth: Trajectory, stamps_ns: np.ndarray, poses: np.ndarray, covariances: np.ndarray,
           rejected: np.ndarray, positions: filtering.Table) -> dict[str, float]:  # fmt: skip
    """Mean error, shares inside 95 % regions after SETTLED_S, and of good positions rejected."""
    late = stamps_ns > stamps_ns[0] + SETTLED_S * 1e9
    miss = poses[late] - truth.at(stamps_ns[late])
    yaw = wrap_angle(miss[:, 2])
    solved = np.linalg.solve(covariances[late, :2, :2], miss[:, :2, None])[:, :, 0]
    off = np.hypot(*(positions.values[:, :2] - truth.at(positions.stamps_ns)[:, :2]).T)
    good = positions.stamps_ns[off < GOOD_M]
    inside = (miss[:, :2] * solved).sum(1) <= chi2.ppf(0.95, 2)
    yaw_inside = yaw**2 <= chi2.ppf(0.95, 1) * covariances[late, 2, 2]
    return {
        'error_m': round(float(np.hypot(*miss[:, :2].T).mean()), 4),
        'yaw_deg': round(float(np.degrees(np.abs(yaw)).mean()), 2),
        'xy_within_95': round(float(inside.mean()), 3),
        'yaw_within_95': round(float(yaw_inside.mean()), 3),
        'good_rejected': round(float(np.isin(good, rejected).mean()), 4),
    }


def compare(log: str) -> dict[str, dict[str, float]]:
    """Both filters on one log."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [_plain(Path(f'{log}_{end}'), Path(folder)) for end in
                 ('odom.csv', 'positions.csv', 'truth.tum')]  # fmt: skip
        odometry = filtering.read_table(paths[0], filtering.ODOMETRY)
        positions = filtering.read_table(paths[1], filtering.POSITIONS)
        truth = read_tum(paths[2])
    stamps, poses, covariances, fates = plain_ekf(
        odometry, positions, truth.at(odometry.stamps_ns[:1])[0]
    )
    rejected = np.array([stamp_ns for stamp_ns, fits in fates if not fits])
    plain = judged(truth, np.array(stamps), np.array(poses), np.array(covariances), rejected,
                   positions)  # fmt: skip
    result = filtering.run_filter(odometry, positions, FilterConfig())
    judgeable = [update for update in result.updates if np.isfinite(update.d2)]
    rejected = np.array([update.stamp_ns for update in judgeable if not update.accepted])
    ours = judged(truth, result.stamps_ns, result.poses, result.covariances, rejected, positions)
    return {'plain': plain, 'ours': ours}


def read_tum(path: Path) -> Trajectory:
    """Poses (N, 3) of `stamp x y z qx qy qz qw` lines."""
    rows = np.loadtxt(path)
    yaw = 2 * np.arctan2(rows[:, 6], rows[:, 7])
    stamps = np.round(rows[:, 0] * 1e9).astype(np.int64)
    return Trajectory(stamps, np.column_stack([rows[:, 1:3], yaw]))


def _plain(path: Path, folder: Path) -> Path:
    """The file itself, or an unpacked copy of its .gz."""
    if path.exists():
        return path
    packed = path.with_name(path.name + '.gz')
    (folder / path.name).write_bytes(gzip.decompress(packed.read_bytes()))
    return folder / path.name


def main() -> None:
    """Print a line for each log; write real.json for `study page`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('logs', nargs='+', metavar='LOG')
    parser.add_argument('--out', type=Path, default=Path('study_real'), metavar='DIR')
    arguments, cells = parser.parse_args(), []
    for log in arguments.logs:
        cells.append({'log': Path(log).name, **compare(log)})
        print(json.dumps(cells[-1]), flush=True)
    write_json(arguments.out / 'real.json', {'settings': {'version': __version__}, 'cells': cells})


if __name__ == '__main__':
    main()
