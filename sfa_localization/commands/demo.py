# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The whole chain at work: simulate, train, run the nodes live, and compare with the truth."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sfa_localization import __version__
from sfa_localization.bags.reader import Bag
from sfa_localization.commands.demo_nodes import commands, run_live
from sfa_localization.commands.settings import DemoConfig
from sfa_localization.data.errors import LocalizationError
from sfa_localization.data.files import atomic_write
from sfa_localization.data.run import Trajectory
from sfa_localization.evaluation import (
    Evaluation,
    evaluate,
    fit_transform,
    moved,
    score,
    write_json,
)
from sfa_localization.reports.evaluation import write_report
from sfa_localization.simulation.drive import simulate
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import Trained, train

MARKER = '.sfa_localization_demo.json'


def demonstrate(out: Path, config: DemoConfig, *, progress: bool = False) -> Evaluation:
    """Simulate, train, run the nodes live; write report and results below `out`.

    Returns the comparison of what the nodes published with the truth. Bags and a training
    that an earlier demonstration with the same settings left there are used again. Raises
    LocalizationError, NodeError among them.
    """
    steps = _Steps(progress)
    _prepare(out, config)
    bags = {drive: out / drive for drive in ('coverage', 'test')}
    steps.tell('simulate two drives through a garden')
    for drive, bag in bags.items():
        _simulate(drive, bag, config, progress)
    steps.tell('train on the first, without ground truth')
    trained = train([bags['coverage']], out / 'model.npz', progress=progress, resume=True)
    steps.tell('run the three nodes live on the second')
    programs = commands(out / 'model.npz', bags['test'], config.rate)
    live = run_live(programs, out / 'logs', config)
    steps.tell('compare with the truth')
    judged, offline_m = _judged(trained, live, bags, progress)
    _write_results(out, judged, trained, bags['coverage'])
    steps.tell(f'live and offline differ by {offline_m:.3f} m on average; see {out / "report"}')
    return judged


class _Steps:
    """Tells what is being done, with the time since the start."""

    def __init__(self, shown: bool) -> None:
        self._shown = shown
        self._start = time.monotonic()

    def tell(self, text: str) -> None:
        if self._shown:
            seconds = time.monotonic() - self._start
            print(f'[{seconds:4.0f} s] {text}', file=sys.stderr)


def _prepare(out: Path, config: DemoConfig) -> None:
    """Make the folder, or clear what a demonstration with other settings left in it."""
    marker = out / MARKER
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()) and not marker.exists():
            raise LocalizationError(f'{out}: not a folder of the demo: name another one with --out')
        if marker.exists() and marker.read_text(encoding='utf-8') != _settings_of(config):
            for name in ('coverage', 'test', 'logs', 'report'):
                shutil.rmtree(out / name, ignore_errors=True)
        for name in ('model.npz', 'results.json'):
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise LocalizationError(f'{out}: cannot be written: {error.strerror}') from None
    _mark(marker, config)


def _mark(marker: Path, config: DemoConfig) -> None:
    """Note what the folder was made with."""
    with atomic_write(marker) as file:
        file.write(_settings_of(config).encode())


def _settings_of(config: DemoConfig) -> str:
    """What another demonstration must share to use the bags again."""
    return json.dumps({'version': __version__, 'world': config.world, 'seed': config.seed})


def _simulate(drive: str, bag: Path, config: DemoConfig, progress: bool) -> None:
    if bag.exists():
        return
    simulation = SimulationConfig(
        trajectory=drive, world=config.world, seed=config.seed, compression='jpeg'
    )
    simulate(simulation, bag, progress=progress)


def _judged(
    trained: Trained, live: Mapping[str, Trajectory], bags: Mapping[str, Path], progress: bool
) -> tuple[Evaluation, float]:
    """The live estimates judged as the offline ones are, and the mean distance (m) of the two."""
    offline = evaluate(trained.model, bags['test'], align_bag=bags['coverage'], progress=progress)
    with Bag(bags['coverage']) as bag:
        truth = bag.trajectory()
    seen = _seen_in_training(trained)
    transform = fit_transform(truth, seen)
    estimates = {
        **offline.estimates,
        **{name: moved(estimate, transform) for name, estimate in live.items()},
    }
    scores = {name: score(offline.truth, estimate) for name, estimate in estimates.items()}
    apart = _distance(estimates['ekf'], offline.estimates['ekf'])
    counts = {name: count for name, count in offline.counts.items() if name != 'fusion'}
    counts['published'] = {name: len(estimate) for name, estimate in live.items()}
    judged = dataclasses.replace(offline, estimates=estimates, scores=scores, counts=counts)
    return judged, apart


def _seen_in_training(trained: Trained) -> Trajectory:
    """Where the model puts the pictures that it was trained on, in the map."""
    positions, _ = trained.model.metric.predict(trained.features)
    stamps = np.concatenate([run.panoramas.stamps_ns for run in trained.runs])
    return Trajectory(stamps, np.column_stack([positions, np.full(len(stamps), np.nan)]))


def _distance(a: Trajectory, b: Trajectory) -> float:
    """Mean distance in metres at the stamps of `a` that `b` covers."""
    stamps = a.stamps_ns[b.covers(a.stamps_ns)]
    return float(np.hypot(*(a.at(stamps) - b.at(stamps))[:, :2].T).mean())


def _write_results(out: Path, judged: Evaluation, trained: Trained, coverage: Path) -> None:
    """Figures and pictures; the firing maps lie at the true places of the training pictures."""
    write_json(out / 'results.json', judged.as_dict())
    with Bag(coverage) as bag:
        truth = bag.trajectory()
    stamps = _seen_in_training(trained).stamps_ns
    shown = {name: judged.estimates[name] for name in ('odometry', 'sfa', 'ekf')}
    write_report(
        out / 'report',
        judged.truth,
        shown,
        judged.scores,
        truth.at(stamps)[:, :2],
        trained.features,
    )
