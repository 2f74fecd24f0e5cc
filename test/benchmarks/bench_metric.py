# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Share of random maps that are solved with a certificate: `python bench_metric.py [PROBLEMS]`.

Ten random lines, eighteen lines of a grid, and ninety pieces of a curved drive, in turn; features
are the paper's 45 monomials of eight smooth functions of the place, with noise.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from metric_worlds import DriveWithTruth, criss_cross, drive, garden_features, grid, meander

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import align
from sfa_localization.mapping.basis import Monomials
from sfa_localization.mapping.drive_check import check, diagnose
from sfa_localization.mapping.map_fit import MapFit, MetricProblem
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.metric.segments import Segments, cut
from sfa_localization.motion.settings import SegmentConfig

NOISE = {'bias': 1e-3, 'yaw_noise': 0.01, 'speed_noise': 0.03}
# The paper's eight features and no ridge; the yaw-rate bias has no place in its costs.
CONFIG = MetricConfig(metric_map='monomials', slow_features=8)
KINDS = ('random', 'grid', 'pieces')


@dataclass
class Problem:
    """One random problem: a drive, its segments, and features of all its pictures."""

    run: DriveWithTruth
    segments: Segments
    features: np.ndarray

    @classmethod
    def of(cls, kind: str, seed: int) -> Problem:
        """Lines at random, lines of a grid, or pieces of any drive."""
        twists, start = {
            'random': lambda: criss_cross(10, seed=seed),
            'grid': lambda: (grid(13.0, 1.5, 9), (-6.5, -6.5, 0.0)),
            'pieces': lambda: meander(230.0, seed=seed),
        }[kind]()
        run = drive(twists, start=start, seed=seed, **NOISE)
        cutter = SegmentConfig(segments='any' if kind == 'pieces' else 'straight')
        segments = cut(run.odometry, run.stamps_ns, cutter)
        features = garden_features(run.poses, noise=0.05, count=8, seed=seed, world=seed)
        return cls(run, segments, features)


def certified(trial: Problem) -> dict[str, float]:
    """Solve one problem; its certificate, time, and error beside regression on ground truth."""
    problem = MetricProblem.of(trial.features, trial.segments, CONFIG)
    started = time.perf_counter()
    result = problem.fit(Monomials.fit(problem.features, 8, 0.0))
    seconds = time.perf_counter() - started
    truth = trial.run.poses[problem.stack.images, :2]
    expanded = result.ridge.expanded
    mapped = expanded @ result.map_weights
    positions = np.column_stack([mapped.real, mapped.imag])
    weights = np.linalg.lstsq(expanded, truth, rcond=None)[0]
    return {
        'certified': result.graph.certificate.certified,
        'ms': 1e3 * seconds,
        'map_m': error(align(positions, truth).apply(positions), truth),
        'supervised_m': error(expanded @ weights, truth),
        'segments': problem.stack.segments,
        'sufficient': sufficient(result),
    }


def sufficient(result: MapFit) -> bool:
    """Whether the diagnostics call the data sufficient."""
    try:
        check(diagnose(result))
    except DataError:
        return False
    return True


def error(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.hypot(*(a - b).T).mean())


def bench_metric(problems: int = 1000) -> dict[str, object]:
    """Return the share of certified maps among those with sufficient data, and medians by kind."""
    rows: dict[str, list[dict[str, float]]] = {kind: [] for kind in KINDS}
    for seed in range(problems):
        kind = KINDS[seed % len(KINDS)]
        rows[kind].append(certified(Problem.of(kind, seed)))
    names = ('segments', 'ms', 'map_m', 'supervised_m')
    sufficient_rows = [row for group in rows.values() for row in group if row['sufficient']]
    return {
        'certified_share': float(np.mean([row['certified'] for row in sufficient_rows])),
        'by_kind': {
            kind: {name: float(np.median([row[name] for row in group])) for name in names}
            for kind, group in rows.items()
            if group
        },
    }


if __name__ == '__main__':
    print(json.dumps(bench_metric(int(sys.argv[1]) if sys.argv[1:] else 1000), indent=2))
