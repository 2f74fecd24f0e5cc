# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Compare a model with the ground truth of a drive."""

from __future__ import annotations

import argparse
import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.commands import options
from sfa_localization.data.files import write_json
from sfa_localization.data.geometry import RigidTransform
from sfa_localization.fusion.settings import FilterConfig

if TYPE_CHECKING:
    from sfa_localization.evaluation import Evaluation
    from sfa_localization.place_model import PlaceModel

logger = logging.getLogger(__name__)
WRITES = """\
tables on standard output; with --report index.html (one page for a browser) and its figures;
  with --json the grade (good, weak or bad), a sentence, and the errors"""
EXAMPLES = """\
  evaluate garden.npz bags/test --align bags/coverage
  evaluate garden.npz bags/test --align none
  evaluate garden.npz bags/test --align bags/coverage --report report --json results.json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add model, bags, topics and outputs."""
    parser.add_argument('model', type=Path, metavar='MODEL.npz')
    parser.add_argument('bag', type=Path, metavar='BAG', help='drive with ground truth')
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
    options.add_topics(parser, 'image', 'odometry', 'imu', 'ground_truth')


def run(arguments: argparse.Namespace) -> int:
    """Evaluate; print the errors, and counts of used and rejected inputs."""
    from sfa_localization import evaluation
    from sfa_localization.place_model import PlaceModel
    from sfa_localization.reports.evaluation import count_lines, judgment, tables, trust_lines

    align = arguments.align
    transform = None
    if [str(path) for path in align] == ['none']:
        align = []
        transform = RigidTransform(0.0, 0.0, 0.0)
    read = arguments.model, arguments.bag, *align, arguments.config
    if arguments.json:
        options.require_output(arguments.json, read, '.json')
    options.require_report(arguments.report, arguments.json)
    model = PlaceModel.load(arguments.model)
    options.require_same_panorama(arguments.config, model.panorama)
    if transform is not None and not model.quality.get('points'):
        logger.warning(
            '%s: its map has no measured points, so that its coordinates are its own: train with '
            '--points or --points-topic, or evaluate with --align TRAIN_BAG', arguments.model,
        )  # fmt: skip
    result = evaluation.evaluate(
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
    print(tables(result.scores), *trust_lines(result.scores), sep='\n')
    print(*count_lines(result.counts), sep='\n')
    print(f'aligned on {result.aligned_on}', *result.corrections, sep='\n')
    if arguments.report:
        _write_report(arguments, model, result)
    if arguments.json:
        grade, sentence = judgment(result.scores, result.counts)
        write_json(arguments.json, {**result.as_dict(), 'grade': grade, 'sentence': sentence})
    return 0


def _write_report(arguments: argparse.Namespace, model: PlaceModel, result: Evaluation) -> None:
    """Write figures and the page; the worst images are read from the bag again."""
    from sfa_localization.bags.drives import images_at
    from sfa_localization.reports.evaluation import worst_of, write_evaluation_page, write_report
    from sfa_localization.reports.page import PAGE, begin_page

    folder = arguments.report
    drive = (result.truth, result.estimates, result.scores)
    begin_page(folder)
    write_report(folder, *drive, result.estimates['sfa'].poses[:, :2], result.features)
    late_ns = round(result.counts.get('camera_delay_s', 0.0) * 1e9)
    worst = worst_of(result.truth, result.estimates['sfa'])
    stamps = {image: stamp + late_ns for image, stamp in worst.items()}
    recipe = options.recipe(arguments)
    recipe = replace(recipe, panorama=model.panorama, surround=model.surround)
    read = images_at(arguments.bag, stamps.values(), recipe)
    samples = {image: read[stamp] for image, stamp in stamps.items() if stamp in read}
    title = f'{arguments.model.name} on {arguments.bag.name}'
    notes = f'The map is aligned on {result.aligned_on}.', *result.corrections
    write_evaluation_page(folder, title, *drive, result.counts, samples, notes)
    print(f'{folder / PAGE}: written')
