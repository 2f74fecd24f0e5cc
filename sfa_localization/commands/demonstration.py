# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The steps of the command demo: simulate, train, run the nodes live, compare with the truth."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfa_localization import __version__
from sfa_localization.bags.reader import Bag
from sfa_localization.commands.live_nodes import commands, run_live
from sfa_localization.data.errors import LocalizationError
from sfa_localization.data.files import atomic_write
from sfa_localization.data.run import Trajectory
from sfa_localization.evaluation import (
    Evaluation,
    evaluate,
    moved,
    score,
    write_json,
)
from sfa_localization.reports.evaluation import write_report
from sfa_localization.simulation.drive import simulate
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import Trained, train

if TYPE_CHECKING:
    from sfa_localization.commands.demo import DemoConfig

MARKER = '.sfa_localization_demo.json'


def demonstrate(out: Path, config: DemoConfig, *, progress: bool = False) -> Evaluation:
    """Simulate, train, run the nodes live; write report and results below `out`.

    Returns the comparison of the nodes' outputs with the truth. Bags and an unfinished training of
    an earlier demonstration with the same settings are reused. Raises LocalizationError, also
    NodeError.
    """
    start = time.monotonic()

    def announce(step: str) -> None:
        if progress:
            print(f'[{time.monotonic() - start:4.0f} s] {step}', file=sys.stderr)

    prepare_folder(out, config)
    bags = {drive: out / drive for drive in ('coverage', 'test')}
    announce('simulate two drives through a garden')
    for drive, bag in bags.items():
        if not bag.exists():
            drive_config = SimulationConfig(
                trajectory=drive, world=config.world, seed=config.seed, compression='jpeg'
            )
            simulate(drive_config, bag, progress=progress)
    announce('train on the first, without ground truth')
    trained = train([bags['coverage']], out / 'model.npz', progress=progress, resume=True)
    announce('run the three nodes live on the second')
    programs = commands(out / 'model.npz', bags['test'], config.rate)
    live = run_live(
        programs, out / 'logs', on_end=lambda state: announce(f'the robot is {state or "silent"}')
    )
    announce('compare with the truth')
    result, offline_m = _compare(trained, live, bags, progress)
    _write_results(out, result, trained, bags['coverage'])
    announce(f'live and offline differ by {offline_m:.3f} m on average; see {out / "report"}')
    return result


def prepare_folder(out: Path, config: DemoConfig) -> None:
    """Create the folder, or clear the results of a demonstration with other settings."""
    marker = out / MARKER
    text = json.dumps({'version': __version__, 'world': config.world, 'seed': config.seed})
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()) and not marker.exists():
            raise LocalizationError(
                f'{out}: not a folder of the demo: choose another one with --out'
            )
        if marker.exists() and marker.read_text(encoding='utf-8') != text:
            for name in ('coverage', 'test', 'logs', 'report'):
                shutil.rmtree(out / name, ignore_errors=True)
        for name in ('model.npz', 'results.json'):
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise LocalizationError(f'{out}: cannot be written: {error.strerror}') from None
    with atomic_write(marker) as file:
        file.write(text.encode())


def _compare(
    trained: Trained, live: Mapping[str, Trajectory], bags: Mapping[str, Path], progress: bool
) -> tuple[Evaluation, float]:
    """Evaluate the live estimates; also return their mean distance (m) from the offline ones."""
    offline = evaluate(
        trained.model, bags['test'], align_bags=[bags['coverage']], progress=progress
    )
    live_in_truth = {name: moved(estimate, offline.transform) for name, estimate in live.items()}
    estimates = {**offline.estimates, **live_in_truth}
    scores = {name: score(offline.truth, estimate) for name, estimate in estimates.items()}
    counts = {name: count for name, count in offline.counts.items() if name != 'fusion'}
    counts['published'] = {name: len(estimate) for name, estimate in live.items()}
    result = dataclasses.replace(offline, estimates=estimates, scores=scores, counts=counts)
    return result, mean_distance(estimates['ekf'], offline.estimates['ekf'])


def mean_distance(a: Trajectory, b: Trajectory) -> float:
    """Mean distance in meters at the stamps of `a` that `b` covers."""
    stamps = a.stamps_ns[b.covers(a.stamps_ns)]
    return float(np.hypot(*(a.at(stamps) - b.at(stamps))[:, :2].T).mean())


def _write_results(out: Path, result: Evaluation, trained: Trained, coverage: Path) -> None:
    """Write errors and figures; firing maps are drawn at the true places of the training images."""
    write_json(out / 'results.json', result.as_dict())
    with Bag(coverage) as bag:
        truth = bag.trajectory()
    stamps = np.concatenate([run.panoramas.stamps_ns for run in trained.runs])
    places = truth.at(stamps)[:, :2]
    shown = {name: result.estimates[name] for name in ('odometry', 'sfa', 'ekf')}
    write_report(out / 'report', result.truth, shown, result.scores, places, trained.features)
