# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of a training by day that is tested in all lights and seasons, and of several gardens.

A cell is a mapping with `trained`, `light` and `season`, and the scores that `light` gives; a score
that does not exist is None or missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from page_tables import markdown

from study.paper_report import number

Cells = Sequence[Mapping[str, Any]]


MEASURES = {
    "the paper's recipe (m):": ('paper', 'mean_m'),
    'slow features alone (m):': ('slow', 'mean_m'),
    'one image (m):': ('sfa', 'mean_m'),
    'EKF (m):': ('ekf', 'mean_m'),
    'inside:': ('ekf', 'within_95'),
    'LOCALISED and wrong (s):': ('false_localised_s',),
}
"""Scores of a cell by their path."""


def table(cells: Cells) -> str:
    """The cells of one garden as a Markdown table, a line for each."""
    rows = [
        [condition(cell), *(number(value_of(cell, *path)) for path in MEASURES.values())]
        for cell in by_day(cells)
    ]
    return markdown(['tested in', *MEASURES], rows)


def by_day(cells: Cells) -> Cells:
    """The cells of the training by day."""
    return [cell for cell in cells if cell['trained'] == 'day']


def gardens_table(cells: Cells) -> str:
    """The range of the gardens `world` for each condition, trained by day."""
    rows = []
    for name in dict.fromkeys(map(condition, by_day(cells))):
        same = [cell for cell in by_day(cells) if condition(cell) == name]
        errors = [value_of(cell, 'ekf', 'mean_m') for cell in same]
        inside = [value_of(cell, 'ekf', 'within_95') for cell in same]
        texts = _range(errors, '{:.3f}'), _range(inside, '{:.0%}')
        rows.append([name, str(len(same)), *texts])
    return markdown(['tested in', 'gardens:', 'EKF (m):', 'inside:'], rows)


def _range(values: Sequence[float | None], form: str) -> str:
    finite = [value for value in values if value is not None]
    return f'{form.format(min(finite))} to {form.format(max(finite))}' if finite else '-'


def condition(cell: Mapping[str, Any]) -> str:
    """Light and season of the test."""
    return f'{cell["light"]}, {cell["season"]}'


def value_of(cell: Mapping[str, Any], *path: str) -> float | None:
    """The score of a cell at a path of names."""
    value: Any = cell
    for name in path:
        value = (value or {}).get(name)
    return None if value is None else float(value)
