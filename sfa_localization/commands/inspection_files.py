# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Inspect several bags, and write what was found: one JSON file, two pictures per bag."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sfa_localization.bags.settings import TopicNames
from sfa_localization.data.errors import BagError
from sfa_localization.data.files import atomic_write
from sfa_localization.inspection import BagReport, InspectionConfig, inspect
from sfa_localization.reports.bag import write_contact_sheet, write_path


def inspect_bags(
    paths: Sequence[Path],
    *,
    topics: TopicNames | None = None,
    config: InspectionConfig | None = None,
    strict: bool = False,
    json_file: Path | None = None,
    folder: Path | None = None,
) -> list[BagReport]:
    """Inspect each bag; one that cannot be read has its `error` set and stops no other.

    `json_file` receives all reports, `folder` the pictures. Raises LocalizationError when those
    cannot be written.
    """
    reports = [_inspected(path, topics=topics, config=config, strict=strict) for path in paths]
    if json_file is not None:
        _write_json(reports, json_file)
    if folder is not None:
        for number, report in enumerate(reports):
            _write_pictures(report, folder, f'{number}_' if len(reports) > 1 else '')
    return reports


def _inspected(path: Path, **options: Any) -> BagReport:
    try:
        return inspect(path, **options)
    except BagError as error:
        return BagReport(str(path), error=str(error))


def _write_json(reports: Sequence[BagReport], path: Path) -> None:
    text = json.dumps({'bags': [report.as_dict() for report in reports]}, indent=2)
    with atomic_write(path, BagError, make_folder=True) as file:
        file.write(f'{text}\n'.encode())


def _write_pictures(report: BagReport, folder: Path, prefix: str) -> None:
    name = Path(report.path).stem
    seen, drive = report.images, report.drive
    if seen is not None:
        title = f'{name}: {seen.topic}, {seen.width}x{seen.height}, {seen.geometry}'
        write_contact_sheet(seen.samples, title, folder / f'{prefix}{name}_pictures.png')
    if drive is not None:
        title = f'{name}:{drive.as_text().partition(":")[2]}'
        target = folder / f'{prefix}{name}_path.png'
        write_path(drive.odometry.poses, drive.places, title.replace(', along', ',\nalong'), target)
