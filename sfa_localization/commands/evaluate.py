# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Compare a model with the ground truth of a drive."""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.commands import options
from sfa_localization.data.errors import DataError
from sfa_localization.data.files import read_text, write_json
from sfa_localization.data.geometry import RigidTransform
from sfa_localization.data.plain_yaml import LONGEST
from sfa_localization.fusion.settings import FilterConfig

if TYPE_CHECKING:
    from sfa_localization.evaluation import Evaluation
    from sfa_localization.place_model import PlaceModel

logger = logging.getLogger(__name__)
NOT_ALIGNED = 'none'
"""In place of training drives: compare in the coordinates of the map."""
WRITES = """\
tables on standard output; with --report index.html, a page of plots to click, and the script
  that draws them without a network; with --json the grade (good, weak or bad), a sentence, the
  errors, and their curves; with --tum paths for evo;
  with --bag what the nodes would publish, as a bag for RViz and Foxglove"""
EXAMPLES = """\
  evaluate garden.npz bags/test --align bags/coverage
  evaluate garden.npz bags/test --align none
  evaluate garden.npz bags/test --align bags/coverage --report report --json results.json
  evaluate garden.npz bags/test --align bags/coverage --bag replay
  evaluate before.json after.json --report report"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add model, bags, topics and outputs."""
    parser.add_argument('model', type=Path, metavar='MODEL.npz', help='or results, as JSON')
    parser.add_argument(
        'bag', type=Path, metavar='BAG', help='drive with ground truth; or other results, as JSON'
    )
    parser.add_argument(
        '--align',
        type=Path,
        action='append',
        default=[],
        metavar='TRAIN_BAG',
        help='training drive on which the map is aligned with the truth; may be repeated; none: '
        'compare in the coordinates of the map, which come from measured points',
    )
    parser.add_argument('--config', type=Path, help='parameter file')
    parser.add_argument(
        '--smooth',
        action='store_true',
        help='add the estimates of the filter, smoothed after the drive',
    )
    parser.add_argument('--report', type=Path, metavar='DIR', help='write figures and the table')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the errors as JSON')
    parser.add_argument(
        '--tum', type=Path, metavar='DIR', help='write truth and estimates in the format of TUM'
    )
    parser.add_argument(
        '--bag',
        dest='replay',
        type=Path,
        metavar='NEW_BAG',
        help='write what the nodes would publish on the drive, and the truth, as a bag',
    )
    options.add_topics(parser, 'image', 'odometry', 'imu', 'ground_truth')


def run(arguments: argparse.Namespace) -> int:
    """Evaluate a model on a drive, or print two results of this side by side."""
    if arguments.model.suffix == arguments.bag.suffix == '.json':
        _compare(arguments)
    else:
        _evaluate(arguments)
    return 0


def _evaluate(arguments: argparse.Namespace) -> None:
    """Print the errors, and counts of used and rejected inputs; then write files."""
    from sfa_localization.place_model import PlaceModel
    from sfa_localization.reports.evaluation import count_lines, tables, trust_lines

    _require_outputs(arguments)
    model = PlaceModel.load(arguments.model)
    options.require_same_panorama(arguments.config, model.panorama)
    with options.noticed() as warnings:
        result = _judged(arguments, model)
    print(tables(result.scores), *trust_lines(result.scores), sep='\n')
    print(*count_lines(result.counts), sep='\n')
    print(f'aligned on {result.aligned_on}', *result.corrections, sep='\n')
    _write_files(arguments, model, result, warnings)


def _require_outputs(arguments: argparse.Namespace) -> None:
    """Raise LocalizationError for outputs that cannot be written, before the work."""
    from sfa_localization.bags.writer import require_new_bag

    if arguments.json:
        read = arguments.model, arguments.bag, *arguments.align, arguments.config
        options.require_output(arguments.json, read, '.json')
    options.require_report(arguments.report, arguments.json)
    if arguments.replay:
        require_new_bag(arguments.replay)


def _judged(arguments: argparse.Namespace, model: PlaceModel) -> Evaluation:
    """Evaluate a model on the drive, in the coordinates that --align names."""
    from sfa_localization.evaluation import evaluate

    align = arguments.align
    transform = None
    if [str(path) for path in align] == [NOT_ALIGNED]:
        align = []
        transform = RigidTransform(0.0, 0.0, 0.0)
        if not model.quality.get('points'):
            logger.warning(
                '%s: its map has no measured points, so that its coordinates are its own: train '
                'with --points or --points-topic, or evaluate with --align TRAIN_BAG',
                arguments.model,
            )
    return evaluate(
        model,
        arguments.bag,
        align_bags=align,
        recipe=options.recipe(arguments),
        config=options.settings(FilterConfig, arguments),
        watch=options.settings(WatchConfig, arguments),
        progress=True,
        smooth=arguments.smooth,
        transform=transform,
    )


def _write_files(
    arguments: argparse.Namespace, model: PlaceModel, result: Evaluation, warnings: Sequence[str]
) -> None:
    """Write what was asked for."""
    from sfa_localization.commands.replay_bag import write_replay
    from sfa_localization.filtering import write_trajectory
    from sfa_localization.reports.evaluation import judgment
    from sfa_localization.reports.plots import curves_of

    if arguments.json:
        grade, sentence = judgment(result.scores, result.counts)
        verdict = {'grade': grade, 'sentence': sentence}
        curves = curves_of(result.truth, result.estimates)
        write_json(arguments.json, {**result.as_dict(), **verdict, 'curves': curves})
    for name, path in {'truth': result.truth, **result.estimates}.items() if arguments.tum else ():
        write_trajectory(path, arguments.tum / f'{name}.tum')
    if arguments.report:
        _write_report(arguments, model, result, warnings)
    if arguments.replay:
        write_replay(arguments.replay, result, model.ground)
        print(f'{arguments.replay}: written')


def _write_report(
    arguments: argparse.Namespace, model: PlaceModel, result: Evaluation, warnings: Sequence[str]
) -> None:
    """Write figures and the page."""
    from sfa_localization.reports.evaluation import write_evaluation_page
    from sfa_localization.reports.page import PAGE, begin_page

    folder = arguments.report
    begin_page(folder)
    title = f'{arguments.model.name} on {arguments.bag.name}'
    features = result.estimates['sfa'].poses[:, :2], result.features
    notes = f'The map is aligned on {result.aligned_on}.', *result.corrections, *warnings
    write_evaluation_page(folder, title, result, model, features, notes)
    print(f'{folder / PAGE}: written')


def _compare(arguments: argparse.Namespace) -> None:
    """Print two results side by side. Raises DataError."""
    from sfa_localization.reports.comparison import comparison_text, write_comparison_page
    from sfa_localization.reports.page import PAGE, begin_page

    files = arguments.model, arguments.bag
    options.require_report(arguments.report, None)
    results = [_results(file) for file in files]
    print(comparison_text(*results))
    if folder := arguments.report:
        begin_page(folder)
        write_comparison_page(folder, [file.name for file in files], results)
        print(f'{folder / PAGE}: written')


def _results(file: Path) -> dict[str, Any]:
    """What `evaluate --json` has written. Raises DataError."""
    from sfa_localization.reports.fleet import STATES

    try:
        results = dict(json.loads(read_text(file, LONGEST, DataError)))
        means = [results[name]['mean'] for name in ('odometry', 'ekf')]
    except (ValueError, TypeError, KeyError):
        means = []
    if not means or 'sentence' not in results or results.get('grade') not in STATES:
        raise DataError(f'{file}: holds no results: write them by evaluate --json')
    return results
