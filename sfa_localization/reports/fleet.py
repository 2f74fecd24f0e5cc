# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The page of a fleet: a row for each garden, worst first, to sort and to search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sfa_localization.reports import page

_GRADES = {'refused': page.BAD, 'waiting': '', 'weak': page.WEAK, 'good': page.GOOD}
_COLUMNS = ('garden', 'state', 'what was found', 'expected error (m)', 'test error (m)',
            'area (m2)', 'age (days)', 'change (m)', 'work (s)')  # fmt: skip
_NOTES = (
    'Expected error: of one image, by the training. Test error: mean error of the filter on test '
    'drives. Change: of the expected error since the training before.'
)
_SCRIPT = """
<style>body { max-width: none; } th { cursor: pointer; } td { vertical-align: top; }
th:nth-child(-n+3), td:nth-child(-n+3) { text-align: left; } td:nth-child(3) { min-width: 20rem; }
</style><script>
const body = document.querySelector('tbody'), rows = [...body.rows];
document.querySelector('thead').onclick = ({target}) => {
  const value = row => row.cells[target.cellIndex].dataset.value;
  const order = target.dataset.order = -(target.dataset.order || -1);
  rows.sort((a, b) => order * (value(a) - value(b) || value(a).localeCompare(value(b))));
  body.append(...rows);
};
document.querySelector('input').oninput = ({target}) => rows.forEach(row => {
  row.hidden = !row.textContent.toLowerCase().includes(target.value.toLowerCase());
});
</script>"""


def write_fleet_page(folder: Path, results: Sequence[Mapping[str, Any]], now_s: float) -> None:
    """Write `folder`/index.html about the results of gardens at a Unix time (s).

    Raises LocalizationError.
    """
    states = [result['state'] for result in results]
    counts = ', '.join(f'{states.count(state)} {state}' for state in _GRADES if state in states)
    body = ''.join(_row(result, now_s) for result in sorted(results, key=_badness))
    head = ''.join(f'<th>{escape(title)}</th>' for title in _COLUMNS)
    page.write_page(
        folder,
        f'{len(results)} gardens: {counts}',
        f'<p>{_NOTES}</p><p><input type="search" placeholder="search" aria-label="search"></p>',
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>',
        f'<tbody>{body}</tbody></table></div>{_SCRIPT}',
    )


def _badness(result: Mapping[str, Any]) -> tuple[int, float]:
    """The place of a garden in the order of the page."""
    error_m = (result.get('model') or {}).get('expected_error_m', 0.0)
    return [*_GRADES].index(result['state']), -error_m


def _row(result: Mapping[str, Any], now_s: float) -> str:
    """The cells of a garden; `data-value` is what a column is sorted by."""
    model, tests = result.get('model') or {}, (result.get('errors_m') or {}).values()
    errors = [error for error in tests if error is not None]
    expected, previous = model.get('expected_error_m'), model.get('previous_error_m')
    numbers = (
        (expected, '.2f'),
        (max(errors, default=None), '.2f'),
        (model.get('area_m2'), '.0f'),
        ((now_s - model['trained_s']) / 86400 if model else None, '.1f'),
        (expected - previous if expected and previous else None, '+.2f'),
        (result.get('seconds'), '.0f'),
    )
    name, file, state = result['garden'], result.get('page'), result['state']
    link = f'<a href="{quote(f"{name}/{file}")}">{escape(name)}</a>' if file else escape(name)
    sentences = [f'{about}: {text}' for about, _, text in result['judgments']]
    cells = [
        (name, link),
        (state, state),
        (' '.join(sentences), '<br>'.join(map(escape, sentences))),
    ]
    cells += [('', '-') if x is None else (f'{x:.3f}', format(x, form)) for x, form in numbers]
    columns = ''.join(f'<td data-value="{escape(value)}">{text}</td>' for value, text in cells)
    return f'<tr class="{_GRADES[state]}">{columns}</tr>\n'
