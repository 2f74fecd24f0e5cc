# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The page of bags: whether they suffice, what to drive next, contents, path and images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sfa_localization.data.geometry import Array
from sfa_localization.reports import page
from sfa_localization.reports.figures import SQUARE, in_meters, save


def write_path(poses: Array, places: Array, title: str, path: Path) -> None:
    """Write the path (N, 3) of odometry and the poses (M, 3) of the images as a PNG.

    Raises LocalizationError.
    """
    figure = Figure(figsize=SQUARE, layout='constrained')
    axes = figure.add_subplot()
    axes.plot(poses[:, 0], poses[:, 1], color='0.6', linewidth=1, zorder=1)
    order = np.linspace(0, 100, len(places))
    dots = axes.scatter(places[:, 0], places[:, 1], c=order, s=5, cmap='viridis', zorder=2)
    axes.plot(*poses[0, :2], 'o', color='#D55E00', markersize=7, label='start', zorder=3)
    in_meters(axes, title, ' of the odometry')
    figure.legend(loc='outside lower center')
    figure.colorbar(dots, label='images, % of the drive', shrink=0.7)
    save(figure, path)


def bag_sections(
    report: Mapping[str, Any], facts: Sequence[str], figures: Mapping[Path, str]
) -> list[str]:
    """The sections of a page about a bag: `report` as plain values, `facts` as sentences, and
    `figures` with captions. Raises LocalizationError.
    """
    enough = report['enough_to_train_on']
    answer = 'is enough to train on.' if enough else 'is not enough to train on yet.'
    lacks = [report['error']] if report['error'] else report['lacks']
    topics = report['topics'].items()
    rows = [[name, str(t['count']), f'{t["rate_hz"]:.1f}', f'{t["largest_gap_s"]:.1f}']
            for name, t in topics]  # fmt: skip
    damage = [f'{name}: {problem}' for name, t in topics for problem in t['problems']]
    head = ('topic', 'messages', 'Hz', 'longest pause (s)')
    return [
        page.verdict(page.GOOD if enough else page.BAD, f'{Path(report["path"]).name} {answer}'),
        page.section('What do I drive or change next?', page.items(lacks)),
        page.section('What is in it?', page.items(facts), page.table(head, rows) if rows else ''),
        motion_section(report['motion']) if report['motion'] else '',
        page.section('What is damaged?', page.items([*report['problems'], *damage])),
        page.section('Path and images', *(page.figure(*item) for item in figures.items())),
        page.section('Notes', page.items(report['notes'])),
    ]


def motion_section(check: Mapping[str, Any]) -> str:
    """The section about the sources of motion, from the plain values of a `MotionCheck`."""
    rows = [[*pair.values()] for pair in check['pairs']]
    table = page.table([*check['pairs'][0]], rows) if rows else ''
    sentences = page.items([*check['wrong'], *check['corrected'], *check['notes']])
    return page.section('Do images, odometry and gyroscope agree?', sentences, table)
