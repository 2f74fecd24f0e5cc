# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Metric learning on random problems of the paper's sizes, beside the paper's own descent.

Ten random lines, eighteen lines of a grid, and ninety pieces of a curved drive, in turn; features
are the paper's 45 monomials of eight smooth functions of the place, with noise. Run
`python bench_metric.py [PROBLEMS]`.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from metric_worlds import Drive, criss_cross, drive, garden_features, grid, meander

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import align
from sfa_localization.metric.basis import Monomials, monomials
from sfa_localization.metric.drive_check import check, diagnose
from sfa_localization.metric.map_fit import MapFit, MetricProblem
from sfa_localization.metric.paper_solver import Lines, descend, odometry_start
from sfa_localization.metric.segments import Segments, cut
from sfa_localization.metric.settings import MetricConfig, SegmentConfig

NOISE = {'bias': 1e-3, 'yaw_noise': 0.01, 'speed_noise': 0.03}
# The paper's eight features and no ridge; the yaw-rate bias has no place in its costs.
CONFIG = MetricConfig(metric_map='monomials', slow_features=8)
# The descent has succeeded when it ends this close to the global minimum of its own cost.
SUCCESS = 1.1
# Section 4 of the paper: a garden of 16 m x 18 m.
HALF_AREA_M = np.array([8.0, 9.0])
KINDS = ('random', 'grid', 'pieces')


@dataclass
class Problem:
    """One random problem: a drive, its segments, and features of all its pictures."""

    run: Drive
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
        features = garden_features(run.poses[:, :2], noise=0.05, count=8, seed=seed, world=seed)
        return cls(run, segments, features)


def certified(trial: Problem) -> dict[str, float]:
    """Solve one problem; its certificate, time, and error beside regression on ground truth."""
    problem = MetricProblem.of(trial.features, trial.segments, CONFIG)
    started = time.perf_counter()
    result = problem.fit(Monomials.fit(problem.features, 8, 0.0))
    seconds = time.perf_counter() - started
    truth = trial.run.poses[problem.stack.images, :2]
    expanded = result.ridge.expanded
    found = expanded @ result.map_weights
    own = np.column_stack([found.real, found.imag])
    weights = np.linalg.lstsq(expanded, truth, rcond=None)[0]
    return {
        'certified': result.graph.certificate.certified,
        'ms': 1e3 * seconds,
        'uml': error(align(own, truth).apply(own), truth),
        'supervised': error(expanded @ weights, truth),
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


def descents(trial: Problem, seed: int, iterations: int) -> dict[str, float]:
    """Cost of the paper's descent over the least that its own cost can be, by start.

    The least is that of equation 1 at certified angles, found from those with turns.
    """
    unused = {'turn_variance': np.inf, 'displacement_variance': np.inf}
    alone = tuple(replace(segment, **unused) for segment in trial.segments)
    problem = MetricProblem.of(trial.features, replace(trial.segments, items=alone), CONFIG)
    basis = Monomials.fit(problem.features, 8, 0.0)
    known = MetricProblem.of(trial.features, trial.segments, CONFIG).fit(basis)
    fit, stack = problem.fit(basis, known), problem.stack
    best = fit.graph.poses.coefficients(stack.period)
    least = np.vdot(best, fit.ridge.gram(stack) @ best).real / 2
    regressors = monomials(problem.features)
    lines = Lines(regressors, stack.path.real, stack.owner, np.zeros(0))
    starts = {
        'random': random_start(lines, seed),
        'odometry': odometry_start(lines, stack.starts),
    }
    return {
        name: descend(lines, start, iterations)[1][-1] / least for name, start in starts.items()
    }


def random_start(lines: Lines, seed: int) -> np.ndarray:
    """The paper's start in its simulator: everything uniform."""
    rng = np.random.default_rng(seed)
    count = int(lines.line[-1]) + 1
    alpha = rng.uniform(0.0, 2.0 * np.pi, count)
    origins = rng.uniform(-HALF_AREA_M, HALF_AREA_M, (count, 2)) @ [1, 1j]
    weights = rng.uniform(-1.0, 1.0, (lines.regressors.shape[1], 2)) @ [1, 1j]
    return np.concatenate([alpha, origins, weights])


def bench_metric(problems: int = 1000) -> dict[str, object]:
    """Medians by kind; the descent, thousands of times slower, on the first problems only."""
    rows: dict[str, list[dict[str, float]]] = {kind: [] for kind in KINDS}
    ratios: dict[str, list[float]] = {}
    for seed in range(problems):
        kind = KINDS[seed % len(KINDS)]
        trial = Problem.of(kind, seed)
        rows[kind].append(certified(trial))
        if kind == 'random' and seed < 20 * len(KINDS):
            for start, ratio in descents(trial, seed, 1000).items():
                ratios.setdefault(start, []).append(ratio)
    names = ('segments', 'ms', 'uml', 'supervised')
    every = [row for group in rows.values() for row in group if row['sufficient']]
    return {
        'uml_certified_share': float(np.mean([row['certified'] for row in every])),
        'uml_median_ms': float(np.median([row['ms'] for row in every])),
        'uml_over_supervised': float(np.median([r['uml'] / r['supervised'] for r in every])),
        'by_kind': {
            kind: {name: float(np.median([row[name] for row in group])) for name in names}
            for kind, group in rows.items()
            if group
        },
        'paper_solver_success_share': float(np.mean(np.array(ratios['random']) < SUCCESS)),
        'paper_cost_over_least': {name: float(np.median(r)) for name, r in ratios.items()},
    }


if __name__ == '__main__':
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    print(json.dumps(bench_metric(count), indent=2))
