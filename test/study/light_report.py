# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Table and figure of the matrix of lights: trained in some, tested in all.

A cell is a mapping with `trained`, `light` and `season`, and the scores that
`light` gives; a score that does not exist is None or missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure

from sfa_localization.data.geometry import Array
from sfa_localization.reports.figures import save

Cells = Sequence[Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Measure:
    """A score of a cell: its `path`, its format, and its badness from 0 to 1 for the color."""

    title: str
    path: tuple[str, ...]
    text: Callable[[float], str]
    badness: Callable[[float], float]


def _percent(share: float) -> str:
    return f'{100 * share:.0f} %'


def _distance(meters: float) -> float:
    """0 to 0.1 m, 1 from 3 m on, by the logarithm."""
    return float(np.log10(max(meters, 0.1)) + 1) / 1.5


def _angle(degrees: float) -> float:
    return float(np.log10(max(degrees, 0.5) / 0.5)) / 2


MEASURES = (
    Measure('slow features alone (m)', ('slow', 'mean_m'), '{:.3f}'.format, _distance),
    Measure(
        "the paper's recipe, one training drive (m)",
        ('paper', 'mean_m'),
        '{:.3f}'.format,
        _distance,
    ),
    Measure('one image (m)', ('sfa', 'mean_m'), '{:.3f}'.format, _distance),
    Measure('EKF mean (m)', ('ekf', 'mean_m'), '{:.3f}'.format, _distance),
    Measure('EKF heading (°)', ('ekf', 'heading_deg'), '{:.2f}'.format, _angle),
    Measure('in 95 % ellipse', ('ekf', 'within_95'), _percent, lambda s: abs(s - 0.95) / 0.95),
    Measure('LOCALISED', ('localized',), _percent, lambda share: 1 - share),
    Measure('falsely LOCALISED (s)', ('false_localised_s',), '{:.1f}'.format, lambda s: s / 10),
    Measure('retrieval at true poses (m)', ('retrieval', 'mean_m'), '{:.3f}'.format, _distance),
    Measure('retrieval heading (°)', ('retrieval', 'heading_deg'), '{:.2f}'.format, _angle),
)
_COLORS = LinearSegmentedColormap.from_list('good to bad', ['#FFFFFF', '#F6D9A8', '#D55E00'])
_UNKNOWN = '-'
_LEGEND = 'tested in; rows: trained in, one drive for each light, in summer; gray: no result'


def table(cells: Cells) -> str:
    """All cells as a Markdown table, one line each."""
    titles = ['trained in', 'tested in', *(measure.title for measure in MEASURES)]
    lines = [titles, ['---'] * 2 + ['---:'] * len(MEASURES)]
    for cell in cells:
        scores = [_text(measure, _value(cell, measure)) for measure in MEASURES]
        lines.append([str(cell['trained']), _condition(cell), *scores])
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


def matrix_figure(path: Path, cells: Cells) -> None:
    """Draw the matrix of every measure: a row for each training, a column for each test."""
    rows = list(dict.fromkeys(str(cell['trained']) for cell in cells))
    columns = list(dict.fromkeys(_condition(cell) for cell in cells))
    height = 0.9 + len(MEASURES) * (0.35 + 0.32 * len(rows))
    figure = Figure(figsize=(2.2 + 0.8 * len(columns), height), layout='constrained')
    panels = figure.subplots(len(MEASURES), 1, sharex=True, squeeze=False)[:, 0]
    for axes, measure in zip(panels, MEASURES, strict=True):
        values = np.full((len(rows), len(columns)), np.nan)
        for cell in cells:
            value = _value(cell, measure)
            place = rows.index(str(cell['trained'])), columns.index(_condition(cell))
            values[place] = np.nan if value is None else value
        _draw(axes, measure, values, _COLORS)
        axes.set_yticks(range(len(rows)), rows)
    names = [name.replace(', ', ',\n') for name in columns]
    panels[-1].set_xticks(range(len(columns)), names)
    panels[-1].set_xlabel(_LEGEND)
    save(figure, path)


def _draw(axes: Axes, measure: Measure, values: Array, colors: Colormap) -> None:
    """One measure (rows, columns): numbers on colors, gray where there is none."""
    bad = [[np.nan if np.isnan(v) else measure.badness(v) for v in row] for row in values]
    axes.imshow(np.ma.masked_invalid(bad), cmap=colors, vmin=0, vmax=1, aspect='auto')
    axes.set_facecolor('0.85')
    axes.set_title(measure.title, fontsize='medium', loc='left')
    axes.tick_params(length=0)
    for (row, column), value in np.ndenumerate(values):
        text = _text(measure, None if np.isnan(value) else float(value))
        axes.text(column, row, text, ha='center', va='center', fontsize='small')


def _condition(cell: Mapping[str, Any]) -> str:
    return f'{cell["light"]}, {cell["season"]}'


def _value(cell: Mapping[str, Any], measure: Measure) -> float | None:
    value: Any = cell
    for name in measure.path:
        value = (value or {}).get(name)
    return None if value is None else float(value)


def _text(measure: Measure, value: float | None) -> str:
    return _UNKNOWN if value is None else measure.text(value)
