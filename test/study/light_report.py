# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Table of a training by day that is tested in all lights and seasons, in one or more gardens.

A cell is a mapping with `world`, `light` and `season`, and the scores that `light` gives; a score
that does not exist is None or missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from page_tables import markdown

from study.paper_report import gardens, number

Cells = Sequence[Mapping[str, Any]]

MEASURES = {
    "paper's recipe (m):": ('paper', 'mean_m'),
    'slow features alone (m):': ('slow', 'mean_m'),
    'one image (m):': ('sfa', 'mean_m'),
    'EKF (m):': ('ekf', 'mean_m'),
}
"""Scores of a cell by their path."""


def table(cells: Cells) -> str:
    """A line for each condition as Markdown: the mean scores of all gardens `world`, and the range
    of the filter's errors in them.
    """
    rows = []
    for name in dict.fromkeys(map(condition, cells)):
        means = [number(mean_of(cells, name, *path)) for path in MEASURES.values()]
        inside = mean_of(cells, name, 'ekf', 'within_95')
        errors = values_of(cells, name, 'ekf', 'mean_m')
        extent = f'{min(errors):.3f}-{max(errors):.3f}' if errors else '-'
        rows.append([name, *means, '-' if inside is None else f'{inside:.0%}', extent])
    worlds = gardens(len({cell['world'] for cell in cells}))
    return markdown(['tested in', *MEASURES, 'inside:', f'EKF in {worlds} (m):'], rows)


def mean_of(cells: Cells, name: str, *path: str) -> float | None:
    """The mean score of all gardens in a condition; None where no cell has one."""
    values = values_of(cells, name, *path)
    return float(np.mean(values)) if values else None


def values_of(cells: Cells, name: str, *path: str) -> list[float]:
    """The scores in a condition."""
    scores = (value_of(cell, *path) for cell in cells if condition(cell) == name)
    return [score for score in scores if score is not None]


def condition(cell: Mapping[str, Any]) -> str:
    """Light and season of the test."""
    return f'{cell["light"]}, {cell["season"]}'


def value_of(cell: Mapping[str, Any], *path: str) -> float | None:
    """The score of a cell at a path of names."""
    value: Any = cell
    for name in path:
        value = (value or {}).get(name)
    return None if value is None else float(value)
