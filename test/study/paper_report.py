# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Tables and figures of the paper's experiments, beside the paper's own numbers.

Cells are those of `paper` and `comparisons`; errors are mean
distances in meters. A number of several seeds is their mean and standard deviation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from page_tables import markdown
from places import distances

from sfa_localization.data.geometry import Array
from sfa_localization.reports.figures import MARGIN_M, save

Cells = Sequence[Mapping[str, Any]]

PAPER: dict[str, dict[str, float]] = {
    'simulator': {
        'training_supervised': 0.13, 'training': 0.17, 'test_supervised': 0.39, 'test': 0.36,
    },
    'robot': {
        'training_supervised': 0.12, 'training': 0.17, 'test_supervised': 0.14, 'test': 0.14,
        'ekf': 0.11, 'odometry': 0.31,
    },
}  # fmt: skip
"""Section 4 and section 5.1 of the paper."""
COLUMNS = {
    'random': "paper's descent of C, random start",
    'random_long': 'same, 50,000 iterations',
    'paper': "paper's recipe, C' from odometry",
    'certified': 'same, certified optimum',
    'ours': 'ours',
}
ROWS = {
    'training_supervised': 'training lines, supervised',
    'training': 'training lines, unsupervised',
    'test_supervised': 'test, supervised',
    'test': 'test, unsupervised map',
    'image': 'test, one image with keyframes',
    'ekf': 'test, EKF',
    'gain': 'EKF against odometry',
}
_UNKNOWN = '-'


def paper_table(name: str, cells: Cells) -> str:
    """The errors of an experiment as a Markdown table: the paper's, and those of each column."""
    columns = [c for c in COLUMNS if any(c in cell['columns'] for cell in cells)]
    head = [
        f'mean error (m), {gardens(len(cells))}',
        'paper:',
        *(f'{COLUMNS[c]}:' for c in columns),
    ]
    rows = []
    for row, label in ROWS.items():
        values = [_of_paper(name, row), *(_text(row, values_of(cells, c, row)) for c in columns)]
        if any(value != _UNKNOWN for value in values):
            rows.append([label, *values])
    return markdown(head, rows)


def _of_paper(name: str, row: str) -> str:
    numbers = PAPER[name]
    if row == 'gain' and 'odometry' in numbers:
        return f'{100 * (numbers["ekf"] / numbers["odometry"] - 1):.0f}%'
    return f'{numbers[row]:.2f}' if row in numbers else _UNKNOWN


def values_of(cells: Cells, column: str, row: str) -> list[float]:
    """One number for each seed that has it."""
    values = []
    for cell in cells:
        scores = {'odometry': cell['odometry'], **cell['columns'].get(column, {})}
        if 'ekf' not in scores:
            scores.pop('odometry')
        elif row == 'gain':
            scores['gain'] = 100 * (scores['ekf'] / scores['odometry'] - 1)
        values += [scores[row]] if scores.get(row) is not None else []
    return values


def _text(row: str, values: Sequence[float]) -> str:
    if not values:
        return _UNKNOWN
    digits, unit = (0, '%') if row == 'gain' else (3, '')
    spread = f'±{np.std(values, ddof=1):.{digits}f}' if len(values) > 1 else ''
    return f'{np.mean(values):.{digits}f}{spread}{unit}'


def baselines_table(cells: Cells) -> str:
    """A line for each kind of features, a column for each world: test/supervised (m)."""
    worlds = list(dict.fromkeys(str(cell['world']) for cell in cells))
    rows = []
    for name in dict.fromkeys(str(cell['features']) for cell in cells):
        same = {str(cell['world']): cell for cell in cells if cell['features'] == name}
        pairs = [[same.get(w, {}).get(m) for m in ('test', 'test_supervised')] for w in worlds]
        rows.append([name, *('/'.join(map(number, pair)) for pair in pairs)])
    return markdown(['features, test/supervised (m)', *(f'{w}:' for w in worlds)], rows)


def ablations_table(cells: Cells) -> str:
    """A line for each variant."""
    forms = {
        'sfa': '{:.3f}', 'sfa_nees': '{:.2f}', 'ekf': '{:.3f}', 'ekf_nees': '{:.2f}',
        'heading': '{:.2f}',
    }  # fmt: skip
    rows = [
        [c['variant'], *(number(c.get(name), form) for name, form in forms.items())] for c in cells
    ]
    head = ['variant', 'one image (m):', 'ratio:', 'EKF (m):', 'ratio:', 'EKF heading (°):']
    return markdown(head, rows)


def gardens(count: int) -> str:
    """A number of gardens in words."""
    return f'{count} gardens' if count > 1 else 'one garden'


def number(value: float | None, form: str = '{:.3f}') -> str:
    """A number as text, '-' where there is none."""
    return _UNKNOWN if value is None else form.format(value)


@dataclass(frozen=True, slots=True)
class Panel:
    """Estimated places (N, 2) m beside true ones; colored by `groups` (N,), if there are any.

    Estimates that are not `aligned` are turned in a frame of their own: they are shifted to be
    seen, and their error is not named.
    """

    title: str
    truth: Array
    estimate: Array
    groups: NDArray[np.int64] | None = None
    aligned: bool = True


def panels_figure(path: Path, rows: Mapping[str, Sequence[Panel]]) -> None:
    """Draw named rows of panels, axes in meters and equal, as figures 4 to 9 of the paper."""
    columns = max(map(len, rows.values()))
    figure = Figure(figsize=(4.0 * columns, 4.3 * len(rows)), layout='constrained')
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for line, (name, panels) in zip(grid, rows.items(), strict=True):
        for axes, panel in zip(line, panels, strict=True):
            _draw(axes, panel)
        line[0].set_ylabel(f'{name}\n\ny (m)')
    save(figure, path)


def _draw(axes: Axes, panel: Panel) -> None:
    error = np.nanmean(distances(panel.estimate, panel.truth))
    axes.set_title(f'{panel.title}: {error:.3f} m' if panel.aligned else panel.title)
    away = 0.0 if panel.aligned else np.nanmean(panel.truth - panel.estimate, axis=0)
    estimate = panel.estimate + away
    if panel.groups is None:
        axes.plot(*panel.truth.T, color='0.72', linewidth=3.0, solid_capstyle='round', zorder=1)
        axes.plot(*estimate.T, color='#0072B2', linewidth=1.0)
    else:
        for number, group in enumerate(np.unique(panel.groups)):
            part, color = panel.groups == group, f'C{number % 10}'
            axes.plot(*panel.truth[part].T, color=color, linestyle='--', linewidth=0.8)
            axes.plot(*estimate[part].T, color=color, linewidth=1.2)
    points = np.concatenate([panel.truth, _bulk(estimate)])
    low, high = np.nanmin(points, axis=0) - MARGIN_M, np.nanmax(points, axis=0) + MARGIN_M
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel='x (m)', ylabel='y (m)')
    axes.set_aspect('equal')
    axes.grid(alpha=0.3)


def _bulk(places: Array) -> Array:
    """Corners (2, 2) of the places (N, 2) without the outermost percents."""
    return np.nanpercentile(places, (1.0, 99.0), axis=0)
