# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Train on some bags, and test on others; a table of all bags that were tested.

PYTHONPATH=.:test python -m study bags --place 'path traced, garden 1' --training garden1/coverage \
    --test garden1/test

With measured points the errors are those in their coordinates.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Sequence
from pathlib import Path

from page_tables import markdown

from sfa_localization import __version__
from sfa_localization.data.geometry import RigidTransform
from sfa_localization.evaluation import evaluate
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.figures import save_text
from sfa_localization.training import Recipe, train
from study.results import Cell, Results
from study.trials import scores_of

SUMMARY = 'train on some bags, and test on others'
RESULTS = 'bags.json'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the place, its bags, and the folder, which keeps the table."""
    parser.description, parser.formatter_class = __doc__, argparse.RawDescriptionHelpFormatter
    parser.set_defaults(run=run)
    parser.add_argument('--place', required=True, help='after the kind of its images')
    parser.add_argument('--training', nargs='+', type=Path, required=True, metavar='BAG')
    parser.add_argument('--test', nargs='+', type=Path, required=True, metavar='BAG')
    parser.add_argument('--points', default='', metavar='FILE', help='as of train --points')
    parser.add_argument('--out', type=Path, default=Path('study_bags'), metavar='DIR')


def run(arguments: argparse.Namespace) -> int:
    """Judge the test bags that are missing; print the table. Raises LocalizationError."""
    out, bags, points = arguments.out, arguments.training, arguments.points
    results = Results.opened(out / RESULTS, {'version': __version__})
    trained = ' + '.join(bag.name for bag in bags) + (', measured points' if points else '')
    names = {'place': arguments.place, 'trained': trained}
    missing = [b for b in arguments.test if results.find(**names, tested=b.name) is None]
    if missing:
        words = ' '.join([*map(str, bags), points])
        path = out / f'model_{zlib.crc32(words.encode()):08x}.npz'
        if not path.exists():
            recipe = Recipe(metric=MetricConfig(points=points))
            train(bags, path, recipe, progress=True, resume=True)
        model, transform = PlaceModel.load(path), None
        if points:
            transform = RigidTransform(0.0, 0.0, 0.0)
        for bag in missing:
            align = () if transform else bags
            judged = evaluate(model, bag, align_bags=align, transform=transform, progress=True)
            transform = judged.transform
            results.keep({**names, 'tested': bag.name, **scores_of(judged)})
    text = table(results.cells)
    save_text(out / 'bags.md', text)
    print(text, end='')
    return 0


def table(cells: Sequence[Cell]) -> str:
    """A line for each cell as Markdown."""
    head = ['images, place', 'tested on', 'one image (m):', 'EKF (m):', 'inside:']
    rows = [
        [
            *(cell[name] for name in ('place', 'tested')),
            *(f'{cell[name]:.3f}' for name in ('sfa', 'ekf')),
            f'{cell["ekf_within"]:.0%}',
        ]
        for cell in cells
    ]
    return markdown(head, rows)
