# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Report what is in bags, and whether they are enough to train on."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from sfa_localization.bags.settings import TopicNames
from sfa_localization.commands.options import (
    add_settings,
    add_topics,
    require_output,
    require_report,
    settings,
)
from sfa_localization.data.errors import BagError
from sfa_localization.data.files import atomic_write
from sfa_localization.inspection import BagReport, InspectionConfig, inspect

WRITES = """\
findings on standard output; with --report index.html (one page for a browser) and its
  figures; with --json the findings"""
EXAMPLES = """\
  inspect bags/coverage bags/test
  inspect recording_0.mcap --json bag.json --report report

JSON: {"bags": [{"path", "topics": {NAME: {"type", "count", "recorded",
"first_stamp_ns", "last_stamp_ns", "rate_hz", "largest_gap_s", "problems"}}, "problems", "lacks",
...}]}"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add bags, outputs, topics and the criteria of a sufficient drive."""
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='folders or single files')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the findings as JSON')
    parser.add_argument(
        '--report', type=Path, metavar='DIR', help='write a contact sheet and the path as PNG'
    )
    parser.add_argument('--strict', action='store_true', help='reject damaged bags')
    add_topics(parser, 'image', 'odometry')
    add_settings(parser, InspectionConfig)


def run(arguments: argparse.Namespace) -> int:
    """Inspect all bags; an unreadable one is reported and does not stop the others."""
    topics, config = settings(TopicNames, arguments), settings(InspectionConfig, arguments)
    if arguments.json:
        require_output(arguments.json, arguments.bags, '.json')
    require_report(arguments.report, arguments.json)
    reports = []
    for path in arguments.bags:
        try:
            reports.append(inspect(path, topics=topics, config=config, strict=arguments.strict))
        except BagError as error:
            reports.append(BagReport(str(path), error=str(error)))
    if arguments.json:
        write_json(arguments.json, reports)
    if arguments.report:
        _write_report(arguments.report, reports)
    for report in reports:
        print(report.as_text(), file=sys.stderr if report.error else sys.stdout)
    return 1 if any(map(_unreadable, reports)) else 0


def _unreadable(report: BagReport) -> bool:
    """Whether a bag, or all that a topic of it recorded, cannot be read."""
    return bool(report.error) or any(topic.unreadable for topic in report.topics)


def write_json(path: Path, reports: Sequence[BagReport]) -> None:
    """Write all reports to one file. Raises BagError when that is not possible."""
    text = json.dumps({'bags': [report.as_dict() for report in reports]}, indent=2)
    with atomic_write(path, BagError) as file:
        file.write(f'{text}\n'.encode())


def _write_report(folder: Path, reports: Sequence[BagReport]) -> None:
    """Write figures and the page of all bags."""
    from sfa_localization.reports.page import begin_page

    begin_page(folder)
    for number, report in enumerate(reports):
        prefix = f'{number}_' if len(reports) > 1 else ''
        _write_figures(report, folder, prefix)
    _write_page(folder, reports)


def _write_page(folder: Path, reports: Sequence[BagReport]) -> None:
    """Write the page of all bags, with the figures that `_write_figures` made."""
    from sfa_localization.reports.bag import bag_sections
    from sfa_localization.reports.page import PAGE, write_page

    sections = []
    for number, report in enumerate(reports):
        prefix = f'{number}_' if len(reports) > 1 else ''
        name = f'{prefix}{Path(report.path).stem}'
        shown = {}
        if report.drive is not None:
            shown[folder / f'{name}_path.png'] = 'The path by odometry, with the images'
        if report.images is not None:
            shown[folder / f'{name}_pictures.png'] = 'Images from all over the drive'
        sections += bag_sections(report.as_dict(), _facts(report), shown)
    write_page(folder, 'What is in the recording', *sections)
    print(f'{folder / PAGE}: written')


def _facts(report: BagReport) -> list[str]:
    """Camera, drive and clocks, in words."""
    images, drive = report.images, report.drive
    camera = [f'{images.width}x{images.height}, {images.geometry}'] if images else []
    clock = [f'clocks: {drive.clock_text()}'] if drive and drive.clock_text() else []
    return [*camera, *([drive.path_text().strip()] if drive else []), *clock]


def _write_figures(report: BagReport, folder: Path, prefix: str) -> None:
    from sfa_localization.reports.bag import write_path
    from sfa_localization.reports.figures import write_contact_sheet

    name = Path(report.path).stem
    images, drive = report.images, report.drive
    if images is not None:
        title = f'{name}: {images.topic}, {images.width}x{images.height}, {images.geometry}'
        write_contact_sheet(images.samples, title, folder / f'{prefix}{name}_pictures.png')
    if drive is not None:
        title = f'{name}:{drive.path_text().partition(":")[2]}'
        target = folder / f'{prefix}{name}_path.png'
        write_path(drive.odometry.poses, drive.places, title.replace(', along', ',\nalong'), target)
