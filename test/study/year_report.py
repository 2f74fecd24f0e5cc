# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Table and figure of a year: errors by month of a frozen, an updated and a retrained model.

A cell is a mapping with `model`, `month`, `light` and `season`, and the scores that
`year` gives; a score that does not exist is None or missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sfa_localization.reports.figures import save

Cells = Sequence[Mapping[str, Any]]
MEASURES = {
    'ekf_m': ('EKF mean (m)', '{:.3f}'),
    'sfa_m': ('one image (m)', '{:.3f}'),
    'false_localised_s': ('falsely LOCALISED (s)', '{:.1f}'),
}
# Of an axis, so that small noise does not fill it.
_LEAST_TOP = {'ekf_m': 0.1, 'sfa_m': 0.1, 'false_localised_s': 1.0}
_STYLES = {'frozen': ('o', '#D55E00'), 'updated': ('s', '#0072B2'), 'retrained': ('D', '#009E73')}


def table(cells: Cells) -> str:
    """A line for each month as Markdown: every measure of every model, and their means."""
    models = _models(cells)
    titles = [f'{title}, {model}' for title, _ in MEASURES.values() for model in models]
    lines = [['month', 'light, season', *titles], ['---'] * 2 + ['---:'] * len(titles)]
    for month in _months(cells):
        own = {cell['model']: cell for cell in cells if cell['month'] == month}
        first = next(iter(own.values()))
        texts = [_text(name, own.get(m, {}).get(name)) for name in MEASURES for m in models]
        lines.append([month, f'{first["light"]}, {first["season"]}', *texts])
    means = [_text(name, _mean(cells, name, m)) for name in MEASURES for m in models]
    lines.append(['mean', '', *means])
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


def year_figure(path: Path, cells: Cells) -> None:
    """Draw every measure by month, a line for each model."""
    figure = Figure(figsize=(9, 8), layout='constrained')
    panels = figure.subplots(len(MEASURES), 1, sharex=True)
    for axes, (name, (title, _)) in zip(panels, MEASURES.items(), strict=True):
        _draw(axes, cells, name)
        axes.set_ylabel(title)
        axes.set_ylim(bottom=0, top=max(axes.get_ylim()[1], _LEAST_TOP[name]))
        axes.grid(axis='y', alpha=0.3)
    panels[0].legend()
    months = {cell['month']: cell for cell in cells}
    names = [f'{month[:3]}\n{one["light"]}\n{one["season"]}' for month, one in months.items()]
    panels[-1].set_xticks(range(len(names)), names, fontsize='small')
    save(figure, path)


def _draw(axes: Axes, cells: Cells, name: str) -> None:
    """A line for each model, open at months in which it was not judged."""
    for model in _models(cells):
        own = {c['month']: c.get(name) for c in cells if c['model'] == model}
        known = [own.get(month) for month in _months(cells)]
        values = [float('nan') if value is None else value for value in known]
        marker, color = _STYLES.get(model, ('x', '0.3'))
        axes.plot(values, marker=marker, color=color, label=model)


def _months(cells: Cells) -> list[str]:
    return list(dict.fromkeys(str(cell['month']) for cell in cells))


def _models(cells: Cells) -> list[str]:
    return list(dict.fromkeys(str(cell['model']) for cell in cells))


def _mean(cells: Cells, name: str, model: str) -> float | None:
    """Of a model that was judged in every month: other months are easier or harder."""
    known = [c[name] for c in cells if c['model'] == model and c.get(name) is not None]
    return sum(known) / len(known) if len(known) == len(_months(cells)) else None


def _text(name: str, value: float | None) -> str:
    return '-' if value is None else MEASURES[name][1].format(value)
