# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Put the results of studies onto the pages: numbers, tables, figures, version and date.

PYTHONPATH=.:test python -m study page study_paper study_light demo

The cells of the folders, of a demo too, are added to test/reproduced.json, in place of those with
the same names. From there all tables and figures are made anew.
"""

from __future__ import annotations

import argparse
import datetime
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from page_tables import markdown, write_table
from PIL import Image

from sfa_localization import __version__
from sfa_localization.commands.demo import MARKER
from sfa_localization.data.errors import ConfigError
from sfa_localization.data.files import atomic_write
from sfa_localization.reports.evaluation import tables as tables_of
from sfa_localization.reports.figures import save_text
from study import bags, cameras, large, light, light_report, overview, rig, year, year_report
from study import tables as paper_tables
from study.paper import RECIPES
from study.results import Cell
from study.sites import FULL, ROUTES

SUMMARY = 'put the results in these folders onto the pages'
TESTS = Path(__file__).parents[1]
RECORD, FIGURES = TESTS / 'reproduced.json', TESTS / 'figures'
FILES = {
    **{f'{name}.json': name for name in paper_tables.NAMES},
    light.RESULTS: 'light', year.RESULTS: 'year', large.RESULTS: 'large', rig.RESULTS: 'rig',
    cameras.RESULTS: 'cameras', bags.RESULTS: 'bags', 'real.json': 'real', MARKER: 'demo',
}  # fmt: skip
"""Results by their files; real.json is of benchmarks/bench_real.py."""
NAMES = (
    'world', 'seed', 'features', 'variant', 'trained', 'light', 'season', 'model', 'month',
    'garden', 'case', 'slope', 'place', 'tested', 'log',
)  # fmt: skip
"""What tells the cells of a result apart."""
PICTURES = {
    'simulator': {
        'Figure 4': 'figure_4', 'Figure 5': 'figure_5', 'Figure 6': 'figure_6',
        'Figure 1d': 'figure_1d_simulator',
    },
    'robot': {'Figure 7': 'figure_7', 'Figure 8': 'figure_8', 'Figure 9': 'figure_9'},
}  # fmt: skip
"""Of the paper's experiments, below their tables."""
UNMEASURED = 'Not measured with this version yet.\n'
Record = dict[str, Any]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the folders."""
    parser.description, parser.formatter_class = __doc__, argparse.RawDescriptionHelpFormatter
    parser.set_defaults(run=lambda arguments: update(arguments.folders))
    parser.add_argument('folders', nargs='*', type=Path, metavar='FOLDER')


def update(folders: Sequence[Path]) -> int:
    """Add the cells of the folders to the record, and write the pages. Raises ConfigError for a
    folder without results, or with those of another version.
    """
    record = json.loads(RECORD.read_text('utf-8'))
    for folder in folders:
        files = [file for name in FILES for file in sorted(folder.rglob(name))]
        if not files:
            raise ConfigError(f'{folder}: holds no results: name the folder of a study or the demo')
        for file in files:
            _add(record, file)
    if folders:
        record |= {'version': __version__, 'date': datetime.date.today().isoformat()}
        save_text(RECORD, _text(record))
    for name, text in (tables(record['results']) | figures(record['results'])).items():
        write_table(name, text or UNMEASURED)
    write_table('version', dated(record))
    if demo := record['results'].get('demo'):
        write_table('demo', tables_of(demo[0]).partition('\n\n')[0] + '\n')
    return 0


def dated(record: Record) -> str:
    """The line with version and date."""
    return f'Version {record["version"]}, {record["date"]}.\n'


def _add(record: Record, file: Path) -> None:
    """Add the cells of a file. Those of a small garden are kept for test_reproduce_quick.py, if
    they are of the paper's experiments.
    """
    name, (settings, cells) = FILES[file.name], _read(file)
    if settings['version'] != __version__:
        raise ConfigError(
            f'{file}: is of version {settings["version"]}, not {__version__}: repeat the study'
        )
    if name in paper_tables.NAMES and settings['area'] != list(FULL.area):
        if name in ROUTES and cells:
            columns = cells[0]['columns']
            record['quick'][name] = _rounded({c: columns[c] for c in (*RECIPES, 'ours')})
        return
    kept = {_names(cell): cell for cell in [*record['results'].get(name, []), *cells]}
    record['results'][name] = _rounded([*kept.values()])
    if name in ROUTES:
        for figure in file.parent.glob('figure_*.png'):
            _shrink(figure, FIGURES / figure.name)


def _shrink(figure: Path, target: Path) -> None:
    """Keep a figure in 256 colors."""
    with Image.open(figure) as image, atomic_write(target) as file:
        image.convert('RGB').quantize().save(file, 'PNG', optimize=True)


def _read(file: Path) -> tuple[Record, list[Cell]]:
    """Settings and cells of a study, or of the demo: its cell has the rows of its table."""
    try:
        content = json.loads(file.read_text('utf-8'))
        if file.name != MARKER:
            return dict(content['settings']), list(content['cells'])
        scores = json.loads(file.with_name('results.json').read_text('utf-8'))
        return content, [{name: scores[name] for name in ('odometry', 'sfa', 'ekf')}]
    except (OSError, ValueError, LookupError, TypeError):
        raise ConfigError(f'{file}: not the results of a study or a complete demo') from None


def _names(cell: Cell) -> tuple[Any, ...]:
    return tuple(cell.get(name) for name in NAMES)


def _rounded(value: Any) -> Any:
    """JSON with numbers of four digits."""
    if isinstance(value, float):
        return float(f'{value:.4g}')
    if isinstance(value, dict):
        return {name: _rounded(part) for name, part in value.items()}
    return [*map(_rounded, value)] if isinstance(value, list) else value


def _text(record: Record) -> str:
    """JSON with a line for each cell."""
    parts = [
        f'{json.dumps(name)}: {json.dumps(record[name])}' for name in ('version', 'date', 'quick')
    ]
    results = [
        f'{json.dumps(name)}: [\n{_lines(map(json.dumps, cells))}\n]'
        for name, cells in record['results'].items()
    ]
    parts.append(f'"results": {{\n{_lines(results)}\n}}')
    return f'{{\n{_lines(parts)}\n}}\n'


def _lines(parts: Iterable[str]) -> str:
    return ',\n'.join(parts)


def tables(results: Mapping[str, Sequence[Cell]]) -> dict[str, str]:
    """The tables of the page by their names, '' where there are no cells."""
    makers = {
        **{name: partial(paper_tables.table, name) for name in paper_tables.NAMES},
        'light': light_report.table, 'rig': rig.table,
        'cameras': cameras.table, 'year': year_report.table,
        'large': large.table, 'bags': bags.table, 'real': real_table,
    }  # fmt: skip
    texts = {
        name: make(results[name]) if results.get(name) else '' for name, make in makers.items()
    }
    for name in PICTURES.keys() & {name for name, text in texts.items() if text}:
        pictures = (f'![{title}](figures/{file}.png)\n' for title, file in PICTURES[name].items())
        texts[name] += '\n' + ''.join(pictures)
    return texts


def figures(results: Mapping[str, Sequence[Cell]]) -> dict[str, str]:
    """Draw the figures for a reader in a hurry; return their places on the page."""
    texts = {}
    for name, (needed, panels) in overview.FIGURES.items():
        texts[f'figure {name}'] = ''
        if all(results.get(result) for result in needed):
            drawn, sentence = panels(results)
            overview.draw(FIGURES / f'{name}.png', drawn)
            texts[f'figure {name}'] = f'![{name}](figures/{name}.png)\n\n{sentence}\n'
    return texts


def real_table(cells: Sequence[Cell]) -> str:
    """The plain EKF and the filter on each log."""
    rows = []
    for cell in cells:
        pair = cell['plain'], cell['ours']
        scores = [(f'{one["error_m"]:.3f}', f'{one["xy_within_95"]:.0%}') for one in pair]
        rows.append([cell['log'], *scores[0], *scores[1]])
    return markdown(['log', 'plain EKF (m):', 'inside:', '`filter` (m):', 'inside:'], rows)
