# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Compare a model with the ground truth of a drive."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.commands import options
from sfa_localization.data.files import write_json
from sfa_localization.data.geometry import RigidTransform
from sfa_localization.fusion.settings import FilterConfig

if TYPE_CHECKING:
    from sfa_localization.evaluation import Evaluation

WRITES = """\
tables on standard output; with --report index.html (one page for a browser) and its figures;
  with --json the errors"""
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
        help='drive that aligns the map with the truth; of several training drives, give each one '
        'with --align; none: compare in the coordinates of the map, as measured points gave them',
    )
    parser.add_argument('--config', type=Path, help='parameter file')
    parser.add_argument(
        '--smooth',
        action='store_true',
        help='add the filter smoothed after the drive: of use on drives that were not trained on',
    )
    parser.add_argument('--report', type=Path, metavar='DIR', help='write figures and the table')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the errors as JSON')
    options.add_topics(parser, 'image', 'odometry', 'imu', 'ground_truth')


def run(arguments: argparse.Namespace) -> int:
    """Evaluate; print the errors, and what was used and rejected."""
    from sfa_localization import evaluation
    from sfa_localization.place_model import PlaceModel
    from sfa_localization.reports.evaluation import heading_table, table, trust_lines

    none = [str(path) for path in arguments.align] == ['none']
    align = [] if none else arguments.align
    read = arguments.model, arguments.bag, *align, arguments.config
    if arguments.json:
        options.require_output(arguments.json, read, '.json')
    options.require_report(arguments.report, arguments.json)
    model = PlaceModel.load(arguments.model)
    options.require_same_panorama(arguments.config, model.panorama)
    result = evaluation.evaluate(
        model,
        arguments.bag,
        align_bags=align,
        recipe=options.recipe(arguments),
        config=options.settings(FilterConfig, arguments),
        watch=options.settings(WatchConfig, arguments),
        progress=True,
        smooth=arguments.smooth,
        transform=RigidTransform(0.0, 0.0, 0.0) if none else None,
    )
    print(table(result.scores), heading_table(result.scores), sep='\n\n')
    print(*trust_lines(result.scores), sep='\n')
    print(*_input_lines(result.counts), *_fusion_lines(result.counts), sep='\n')
    print(f'aligned on {result.aligned_on}')
    if arguments.report:
        _write_report(arguments, result)
    if arguments.json:
        write_json(arguments.json, result.as_dict())
    return 0


def _write_report(arguments: argparse.Namespace, result: Evaluation) -> None:
    """Write figures and the page, with the worst images read from the bag once more."""
    from sfa_localization.bags.drives import images_at
    from sfa_localization.reports.evaluation import worst_of, write_evaluation_page, write_report
    from sfa_localization.reports.page import PAGE, begin_page

    folder, drive = arguments.report, (result.truth, result.estimates, result.scores)
    begin_page(folder)
    write_report(folder, *drive, result.estimates['sfa'].poses[:, :2], result.features)
    late_ns = round(result.counts.get('camera_delay_s', 0.0) * 1e9)
    worst = worst_of(result.truth, result.estimates['sfa'])
    stamps = {one: stamp + late_ns for one, stamp in worst.items()}
    read = images_at(arguments.bag, stamps.values(), options.recipe(arguments))
    samples = {one: read[stamp] for one, stamp in stamps.items() if stamp in read}
    title = f'{arguments.model.name} on {arguments.bag.name}'
    write_evaluation_page(folder, title, *drive, result.counts, samples)
    print(f'{folder / PAGE}: written')


def _input_lines(counts: Mapping[str, Any]) -> list[str]:
    """Describe how much of each input was used, and why the rest was skipped."""
    lines = []
    for stream in ('images', 'odometry', 'observations'):
        skipped = sorted(counts[stream]['skipped'].items())
        reasons = ''.join(f'; {n} skipped: {reason}' for reason, n in skipped)
        lines.append(f'{stream}: {counts[stream]["used"]} used{reasons}')
    return lines


def _fusion_lines(counts: Mapping[str, Any]) -> list[str]:
    """Describe what the filter rejected, its time in each state, and the delay of the images."""
    usual = 'odometry: used', 'measurement: accepted', 'measurement: started'
    rejected = sorted((why, n) for why, n in counts['fusion'].items() if why not in usual)
    lines = [f'filter: {n} times {reason}' for reason, n in rejected]
    states = ', '.join(f'{name} {seconds:.1f} s' for name, seconds in counts['states_s'].items())
    lines.append(f'state: {states}')
    if (wrong := counts['false_localised_s']) > 0:
        lines.append(f'state: LOCALISED for {wrong:.1f} s with an error of more than a meter')
    if (delay := counts.get('camera_delay_s')) is not None:
        late = 'late' if delay > 0 else 'early'
        lines.append(f'camera: images are stamped {abs(delay):.2f} s {late}')
    return lines
