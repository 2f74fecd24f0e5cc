# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Report what is in bags, and whether they are enough to train on."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from sfa_localization.bags.drives import ReadingRecipe
from sfa_localization.commands import options
from sfa_localization.data.errors import BagError
from sfa_localization.data.files import write_json
from sfa_localization.inspection import BagReport, InspectionConfig, inspect, lacks_together

WRITES = """\
findings on standard output; with --report index.html (one page for a browser) and its
  figures; with --json the findings. Exit code 1: a bag or topic cannot be read; 3: not enough to
  train on"""
NOT_ENOUGH = 3
"""Exit code where all is readable, but not enough to train on."""
EXAMPLES = """\
  inspect bags/coverage bags/test
  inspect recording_0.mcap --json bag.json --report report

JSON: {"bags": [{"path", "topics": {NAME: {"type", "count", "recorded",
"first_stamp_ns", "last_stamp_ns", "rate_hz", "largest_gap_s", "problems"}}, "problems", "lacks",
...}], "together": {"enough_to_train_on", "lacks"}}"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add bags, outputs, topics and the criteria of a sufficient drive."""
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='folders or single files')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the findings as JSON')
    parser.add_argument(
        '--report', type=Path, metavar='DIR', help='write a contact sheet and the path as PNG'
    )
    parser.add_argument('--strict', action='store_true', help='reject damaged bags')
    parser.add_argument('--config', type=Path, help='parameter file, for the camera')
    options.add_topics(parser, 'image', 'odometry', 'imu')
    options.add_settings(parser, InspectionConfig)


def run(arguments: argparse.Namespace) -> int:
    """Inspect all bags, each alone, also after an unreadable one, and all together."""
    recipe = options.recipe_of(ReadingRecipe, arguments)
    config = options.settings(InspectionConfig, arguments)
    if arguments.json:
        options.require_output(arguments.json, arguments.bags, '.json')
    options.require_report(arguments.report, arguments.json)
    reports = []
    for path in arguments.bags:
        try:
            reports.append(inspect(path, recipe=recipe, config=config, strict=arguments.strict))
        except BagError as error:
            reports.append(BagReport(str(path), error=str(error)))
    lacks = lacks_together(reports, config)
    for report in reports:
        print(report.as_text(), file=sys.stderr if report.error else sys.stdout)
    together = [f'together not enough: {lack}' for lack in lacks]
    together = (together or ['together: enough to train on']) if len(reports) > 1 else []
    print(*together, sep='\n', end='\n' if together else '')
    sys.stdout.flush()  # the findings, before an error in writing them
    if arguments.json:
        bags = [report.as_dict() for report in reports]
        all_bags = {'enough_to_train_on': not lacks, 'lacks': lacks}
        write_json(arguments.json, {'bags': bags, 'together': all_bags})
    if arguments.report:
        _write_report(arguments.report, reports, together)
    if any(report.error or any(topic.unreadable for topic in report.topics) for report in reports):
        return 1
    return NOT_ENOUGH if lacks else 0


def _write_report(folder: Path, reports: Sequence[BagReport], together: Sequence[str]) -> None:
    """Write figures of all bags, and the page that shows them, with verdicts on all together."""
    from sfa_localization.reports import page
    from sfa_localization.reports.bag import bag_sections, write_path
    from sfa_localization.reports.figures import write_contact_sheet

    page.begin_page(folder)
    sections = [page.section('Are they enough together?', page.items(together))]
    for number, report in enumerate(reports):
        stem = Path(report.path).stem
        figures = dict[Path, str]()
        file = f'{number}_{stem}' if len(reports) > 1 else stem
        if report.odometry is not None:
            target = folder / f'{file}_path.png'
            title = f'{stem}: {report.facts["drive"]}'
            write_path(
                report.odometry.poses, report.places, title.replace(', along', ',\nalong'), target
            )
            figures[target] = 'The path by odometry, with the images'
        if report.samples:
            target = folder / f'{file}_pictures.png'
            write_contact_sheet(report.samples, target)
            figures[target] = f'Images from all over the drive: {report.image_topic}'
        facts = [': '.join(fact) for fact in report.facts.items()]
        sections += bag_sections(report.as_dict(), facts, figures)
    page.write_page(folder, 'What is in the recording', *sections)
    print(f'{folder / page.PAGE}: written')
