# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Table of a year: errors by month of a frozen, an updated and a retrained model.

A cell is a mapping with `model`, `month`, `light` and `season`, and the scores that
`year` gives; a score that does not exist is None or missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Cells = Sequence[Mapping[str, Any]]
MEASURES = {
    'ekf_m': ('EKF mean (m)', '{:.3f}'),
    'sfa_m': ('one image (m)', '{:.3f}'),
    'false_localised_s': ('falsely LOCALISED (s)', '{:.1f}'),
}


def table(cells: Cells) -> str:
    """A line for each month as Markdown: every measure of every model, and their means."""
    models = _models(cells)
    titles = [f'{title}, {model}' for title, _ in MEASURES.values() for model in models]
    lines = [['month', 'light, season', *titles], ['---'] * 2 + ['---:'] * len(titles)]
    for month in _months(cells):
        by_model = {cell['model']: cell for cell in cells if cell['month'] == month}
        first = next(iter(by_model.values()))
        texts = [_text(name, by_model.get(m, {}).get(name)) for name in MEASURES for m in models]
        lines.append([month, f'{first["light"]}, {first["season"]}', *texts])
    means = [_text(name, _mean(cells, name, m)) for name in MEASURES for m in models]
    lines.append(['mean', '', *means])
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


def _months(cells: Cells) -> list[str]:
    return list(dict.fromkeys(str(cell['month']) for cell in cells))


def _models(cells: Cells) -> list[str]:
    return list(dict.fromkeys(str(cell['model']) for cell in cells))


def _mean(cells: Cells, name: str, model: str) -> float | None:
    """The mean of a measure for a model that was judged in every month."""
    values = [c[name] for c in cells if c['model'] == model and c.get(name) is not None]
    return sum(values) / len(values) if len(values) == len(_months(cells)) else None


def _text(name: str, value: float | None) -> str:
    return '-' if value is None else MEASURES[name][1].format(value)
