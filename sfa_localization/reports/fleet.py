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

STATES = {page.BAD: 'refused', page.WEAK: 'weak', page.GOOD: 'good'}
"""State of a garden by the worst grade of its judgments; the worst is first."""
_COLUMNS = ('garden', 'state', 'pages', 'why',
            'tested error of the filter: mean (m)', '95 % below (m)',
            'expected error of an image (m)', 'area (m2)',
            'age of the training (days)', 'change of the error (m)')  # fmt: skip
_SCRIPT = """
<style>body { max-width: none; } th { cursor: pointer; } td { vertical-align: top; }
th:nth-child(-n+4), td:nth-child(-n+4) { text-align: left; }
td:nth-child(4) { min-width: min(20rem, 40vw); }
</style><script>
const body = document.querySelector('tbody'), rows = [...body.rows];
document.querySelector('thead').onclick = ({target}) => {
  const value = row => row.cells[target.cellIndex].textContent;
  const order = target.dataset.order = -(target.dataset.order || -1);
  rows.sort((a, b) => order * (value(a) - value(b) || value(a).localeCompare(value(b))));
  body.append(...rows);
};
document.querySelector('input').oninput = ({target}) => rows.forEach(row => {
  row.hidden = !row.textContent.toLowerCase().includes(target.value.toLowerCase());
});
</script>"""


def write_fleet_page(
    folder: Path, results: Sequence[Mapping[str, Any]], total: int, now_s: float
) -> None:
    """Write `folder`/index.html about the results that a total of gardens has, at a Unix time (s).

    Raises LocalizationError.
    """
    states = [result['state'] for result in results]
    counts = [f'{states.count(state)} {state}' for state in STATES.values()]
    head = ''.join(f'<th>{escape(title)}</th>' for title in _COLUMNS)
    body = ''.join(_row(folder, result, now_s) for result in sorted(results, key=_order))
    page.write_page(
        folder,
        f'{len(results)} of {total} gardens: {", ".join(counts)}',
        '<p><input type="search" placeholder="search" aria-label="search"></p>',
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>',
        f'<tbody>{body}</tbody></table></div>{_SCRIPT}',
    )


def _order(result: Mapping[str, Any]) -> tuple[int, float, float]:
    """The place of a garden on the page: the worst state first, then the largest tested error, and
    where nothing was tested, the largest expected one.
    """
    tested = result.get('tested', {}).get('mean_m', -1.0)
    return [*STATES].index(result['grade']), -tested, -result.get('expected_error_m', 0.0)


def _row(folder: Path, result: Mapping[str, Any], now_s: float) -> str:
    """The cells of a garden, with links to all pages in its folder."""
    name = result['garden']
    trained_s = result.get('trained_s')
    pages = sorted(file.parent.name for file in (folder / name).glob(f'*/{page.PAGE}'))
    tested = result.get('tested', {})
    numbers = [
        ('.2f', tested.get('mean_m')),
        ('.2f', tested.get('p95_m')),
        ('.2f', result.get('expected_error_m')),
        ('.0f', result.get('area_m2')),
        ('.1f', trained_s and (now_s - trained_s) / 86400),
        ('+.2f', result.get('change_m')),
    ]
    cells = [
        escape(name),
        result['state'],
        ' '.join(f'<a href="{quote(f"{name}/{at}/{page.PAGE}")}">{escape(at)}</a>' for at in pages),
        '<br>'.join(map(escape, result['sentences'])),
        *('-' if value is None else format(value, form) for form, value in numbers),
    ]
    columns = ''.join(f'<td>{cell}</td>' for cell in cells)
    return f'<tr class="{result["grade"]}">{columns}</tr>\n'
