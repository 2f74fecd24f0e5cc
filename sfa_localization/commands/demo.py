# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Simulate, train, run the three nodes live, and compare with the truth."""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sfa_localization import __version__
from sfa_localization.data.errors import LocalizationError
from sfa_localization.data.files import write_bytes

if TYPE_CHECKING:
    from sfa_localization.commands.live_nodes import Live
    from sfa_localization.evaluation import Evaluation
    from sfa_localization.training import Recipe, Trained

WRITES = 'in its folder two bags, model.npz, report/ with figures, results.json, logs/'
EXAMPLES = '  demo\n  demo --world 2 --out demo_of_world_2'
MARKER = '.sfa_localization_demo.json'
DRIVES = ('coverage', 'test')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the folder and the garden."""
    parser.add_argument(
        '--out', type=Path, default=Path('demo'), metavar='DIR', help='folder to write [demo]'
    )
    parser.add_argument('--world', type=int, default=1, help='garden [1]')


def run(arguments: argparse.Namespace) -> int:
    """Run the demonstration; print the errors."""
    from sfa_localization.commands.live_nodes import commands, run_live
    from sfa_localization.reports.evaluation import tables
    from sfa_localization.simulation.drive import simulate
    from sfa_localization.simulation.settings import SimulationConfig
    from sfa_localization.training import Recipe, train

    out = arguments.out
    start = time.monotonic()
    garden = SimulationConfig(world=arguments.world, compression='jpeg')

    def announce(step: str) -> None:
        print(f'[{time.monotonic() - start:4.0f} s] {step}', file=sys.stderr)

    prepare_folder(out, arguments.world)
    announce('simulate two drives through a garden')
    for drive in DRIVES:
        if not (out / drive).exists():
            simulate(replace(garden, trajectory=drive), out / drive, progress=True)
    announce('train on the first, without ground truth')
    recipe = Recipe()
    trained = train([out / 'coverage'], out / 'model.npz', recipe, progress=True, resume=True)
    announce('run the three nodes live on the second')
    live = run_live(commands(out / 'model.npz', out / 'test'), out / 'logs')
    announce(f'the robot is {live.state or "silent"}; compare with the truth')
    result = _compare(trained, live, out, recipe)
    _write_results(out, result, trained)
    announce(f'see {out / "report"}')
    print(tables(result.scores))
    return 0


def prepare_folder(out: Path, world: int) -> None:
    """Create the folder, or continue in the folder of an earlier demo in the same garden.

    Bags and an unfinished training are kept. Raises LocalizationError.
    """
    marker = out / MARKER
    text = json.dumps({'world': world, 'version': __version__})
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()) and not (marker.exists() and marker.read_text('utf-8') == text):
            raise LocalizationError(
                f'{out}: not a folder of this demo: remove it, or choose another one with --out'
            )
        for name in ('model.npz', 'results.json'):
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise LocalizationError(f'{out}: cannot be written: {error.strerror}') from None
    write_bytes(marker, text.encode())


def _compare(trained: Trained, live: Live, out: Path, recipe: Recipe) -> Evaluation:
    """Evaluate offline, then replace the estimates by those of the live nodes."""
    from sfa_localization.evaluation import evaluate, moved, score

    offline = evaluate(
        trained.model, out / 'test', align_bags=[out / 'coverage'], recipe=recipe, progress=True
    )
    in_truth = {name: moved(getattr(live, name), offline.transform) for name in ('sfa', 'ekf')}
    estimates = {**offline.estimates, **in_truth}
    scores = {name: score(offline.truth, estimate) for name, estimate in estimates.items()}
    counts = {name: count for name, count in offline.counts.items() if name != 'fusion'}
    counts['published'] = {name: len(estimate) for name, estimate in in_truth.items()}
    return replace(offline, estimates=estimates, scores=scores, counts=counts)


def _write_results(out: Path, result: Evaluation, trained: Trained) -> None:
    """Write errors and figures, with firing maps at the places of the training images."""
    from sfa_localization.data.files import write_json
    from sfa_localization.reports.evaluation import write_evaluation_page

    write_json(out / 'results.json', result.as_dict())
    places = result.transform.apply(trained.metric.poses[:, :2])
    features = trained.features[trained.metric.images]
    title = 'The demo: what the nodes published, and the truth'
    write_evaluation_page(out / 'report', title, result, trained.model, (places, features))
