# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Two evaluations side by side: before and after an update, or two models on one drive."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sfa_localization.reports import page
from sfa_localization.reports.evaluation import LABELS, LOOKS, markdown, number
from sfa_localization.reports.plots import Line, linked_plots

Results = Mapping[str, Any]
"""What `evaluate --json` writes."""
MEASURES = ('mean', 'p95', 'max')
COLUMNS = tuple(f'{name} {which}' for name in MEASURES for which in (1, 2))
COLORS = {'sfa': '#56B4E9', 'ekf': '#0072B2'}, {'sfa': '#F0C05A', 'ekf': '#D55E00'}
"""Of the first result and of the second: blue and orange."""
HEAD = ('position error (m)', *COLUMNS)


def comparison_rows(first: Results, second: Results) -> list[list[str]]:
    """Cells of a table with the columns HEAD: a row for each estimate that both have."""
    names = [name for name in LABELS if name in first and name in second]
    both = [(name, first[name], second[name]) for name in names]
    return [
        [LABELS[name], *(number(row[m], m) for m in MEASURES for row in (one, other))]
        for name, one, other in both
    ]


def comparison_text(first: Results, second: Results) -> str:
    """The table for a terminal, and both sentences."""
    sentences = [f'1: {first["sentence"]}', f'2: {second["sentence"]}']
    return '\n'.join([markdown(HEAD, comparison_rows(first, second)), '', *sentences])


def write_comparison_page(folder: Path, names: Sequence[str], results: Sequence[Results]) -> None:
    """Write `folder`/index.html about two results, by their names. Raises LocalizationError."""
    verdicts = [
        page.verdict(result['grade'], f'{row}, {name}: {result["sentence"]}')
        for row, name, result in zip((1, 2), names, results, strict=True)
    ]
    table = page.table(HEAD, comparison_rows(*results))
    title = f'1: {names[0]}, 2: {names[1]}'
    page.write_page(
        folder,
        title,
        *verdicts,
        page.section('How far off?', table),
        page.section('Where?', *_plots(folder, names, results)),
    )


def _plots(folder: Path, names: Sequence[str], results: Sequence[Results]) -> Iterator[str]:
    """The paths and errors of the filter and of single images, if the results hold them."""
    curves = [result.get('curves', {}) for result in results]
    lines = [
        Line(f'{name}: {LABELS[estimate]}', of_run[estimate], color, 'solid', LOOKS[estimate][2])
        for name, of_run, colors in zip(names, curves, COLORS, strict=True)
        for estimate, color in colors.items()
        if estimate in of_run
    ]
    if lines and 'truth' in curves[0]:
        yield '<p>Click a point: both plots mark that moment.</p>'
        yield linked_plots(folder, curves[0]['truth'], lines)
