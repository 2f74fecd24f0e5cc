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
from sfa_localization.reports.evaluation import LABELS, YAW_COLUMNS
from sfa_localization.reports.evaluation import tables as scores_tables
from sfa_localization.reports.figures import save_text
from study import bags, large, light, light_report, overview, rig, year, year_report
from study import tables as paper_tables
from study.paper import RECIPES
from study.results import Cell
from study.sites import FULL, ROUTES

SUMMARY = 'put the results in these folders onto the pages'
TESTS = Path(__file__).parents[1]
README, RECORD, PAGE = (
    TESTS.parent / 'README.md',
    TESTS / 'reproduced.json',
    TESTS / 'EVALUATION.md',
)
FIGURES = TESTS / 'figures'
FILES = {
    **{f'{name}.json': name for name in paper_tables.NAMES},
    light.RESULTS: 'light', year.RESULTS: 'year', large.RESULTS: 'large', rig.RESULTS: 'rig',
    bags.RESULTS: 'bags', 'real.json': 'real', 'results.json': 'drives',
}  # fmt: skip
"""Results by their files; real.json is of benchmarks/bench_real.py, results.json of the demo."""
NAMES = (
    'world', 'seed', 'features', 'variant', 'trained', 'light', 'season', 'model', 'month',
    'garden', 'case', 'slope', 'place', 'tested', 'points', 'log', 'drive', 'estimate',
)  # fmt: skip
"""What tells the cells of a result apart."""
DRIVES = 'odometry', 'sfa', 'ekf'
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
    for name, text in tables(record['results']).items():
        write_table(name, text or UNMEASURED, PAGE)
    for name, text in figures(record['results']).items():
        write_table(name, text or UNMEASURED, PAGE)
    for page in (README, TESTS / 'README.md', PAGE):
        write_table('version', dated(record), page)
    for (page, name), text in drives(record['results'].get('drives', [])).items():
        write_table(name, text, page)
    return 0


def dated(record: Record) -> str:
    """The line with version and date."""
    return f'Version {record["version"]}, {record["date"]}.\n'


def _add(record: Record, file: Path) -> None:
    """Add the cells of a file. Those of a small garden are kept for test_reproduce_quick.py, if
    they are of the paper's experiments.
    """
    name, content = FILES[file.name], json.loads(file.read_text('utf-8'))
    if name == 'drives':
        content = _of_drive(file, content)
    settings, cells = content['settings'], content['cells']
    if settings['version'] != __version__:
        raise ConfigError(
            f'{file}: is of version {settings["version"]}, not {__version__}: repeat the study'
        )
    if name in paper_tables.NAMES and settings['area'] != list(FULL.area):
        if name in ROUTES and cells:
            columns = cells[0]['columns']
            record['quick'][name] = _rounded({c: columns[c] for c in (*RECIPES, 'ours')})
        return
    if name == 'light':
        cells = [{'world': settings['world'], **cell} for cell in cells]
    kept = {_names(cell): cell for cell in [*record['results'].get(name, []), *cells]}
    record['results'][name] = _rounded([*kept.values()])
    if name in ROUTES:
        for figure in file.parent.glob('figure_*.png'):
            _shrink(figure, FIGURES / figure.name)


def _shrink(figure: Path, target: Path) -> None:
    """Keep a figure in 256 colors."""
    with Image.open(figure) as image, atomic_write(target) as file:
        image.convert('RGB').quantize().save(file, 'PNG', optimize=True)


def _of_drive(file: Path, scores: Mapping[str, Any]) -> Record:
    """The errors of the demo, or of another drive that `evaluate --json` has judged."""
    marker, version = file.with_name(MARKER), __version__
    if marker.exists():
        version = json.loads(marker.read_text('utf-8'))['version']
    drive = 'demo' if marker.exists() else 'recordings'
    columns = 'mean', 'median', 'p95', 'rmse', 'max', 'n', 'yaw_deg'
    cells = [
        {'drive': drive, 'estimate': name, **{column: scores[name][column] for column in columns}}
        for name in DRIVES
    ]
    return {'settings': {'version': version}, 'cells': cells}


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
    one_garden = [c for c in results.get('light', []) if c['world'] == overview.WORLD]
    made = {
        **{name: partial(paper_tables.table, name) for name in paper_tables.NAMES},
        'year': year_report.table, 'large': large.table, 'bags': bags.table, 'real': real_table,
    }  # fmt: skip
    texts = {
        name: table(results[name]) if results.get(name) else '' for name, table in made.items()
    }
    rigs = results.get('rig', [])
    return {
        **texts,
        'light': light_report.table(one_garden) if one_garden else '',
        'gardens': light_report.gardens_table(results['light']) if one_garden else '',
        'camera': rig.camera_table(rigs) if rigs else '',
        'ground': rig.ground_table(rigs) if rigs else '',
    }


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


def drives(cells: Sequence[Cell]) -> dict[tuple[Path, str], str]:
    """The table of the demo for the README, and that of all drives for test/README.md."""
    demo = {c['estimate']: c for c in cells if c['drive'] == 'demo'}
    if not demo:
        return {}
    rows = [
        [
            f'{c["drive"]}: {LABELS[c["estimate"]]}',
            *(f'{c[column]:.3f}' for column in ('mean', 'median', 'p95', 'max')),
            *(f'{c["yaw_deg"][column]:.2f}' for column in YAW_COLUMNS),
        ]
        for c in cells
    ]
    head = ['drive, estimate', 'position: mean:', 'median:', 'p95:', 'max (m):', 'heading: mean:',
            'median:', 'p95 (°):']  # fmt: skip
    return {
        (README, 'demo'): scores_tables(demo).partition('\n\n')[0] + '\n',
        (TESTS / 'README.md', 'accuracy'): markdown(head, rows),
    }


def real_table(cells: Sequence[Cell]) -> str:
    """The filter beside a plain EKF on each log."""
    head = ['log', 'plain EKF (m):', '`filter` (m):', 'in the 95 % ellipse, plain / `filter`:',
            'heading within 95 %, plain / `filter`:', 'good positions rejected:']  # fmt: skip
    rows = []
    for cell in cells:
        pair = cell['plain'], cell['ours']
        inside = (
            ' / '.join(f'{part[name]:.0%}' for part in pair)
            for name in ('xy_within_95', 'yaw_within_95')
        )
        errors = (f'{part["error_m"]:.3f}' for part in pair)
        rows.append([cell['log'], *errors, *inside, f'{pair[1]["good_rejected"]:.1%}'])
    return markdown(head, rows)
