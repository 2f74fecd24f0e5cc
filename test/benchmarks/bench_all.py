# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Speed and memory of this version beside those of the last release, as a table of test/README.md.

`python bench_all.py [--quick] [--release COMMIT]`: checks the last release out, measures both
versions in turn, and removes the checkout. The best of three rounds counts; a quick run makes a
short one, and leaves the page as it is.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

from page_tables import markdown, write_table

BENCHES, ROOT = Path(__file__).parent, Path(__file__).parents[2]
RELEASE = 'c72db33'
"""The commit of the last release."""
SAMPLE_M = 78.0
"""Length of the drive in bags/sample."""


class Figure(NamedTuple):
    """A figure of which less is better. The goal is a `ratio` to that of the last release, or to
    another figure `beside` it, or else a value, `most`.
    """

    words: str
    ratio: float = 1.5
    most: float = math.nan
    beside: str = ''


FIGURES = {
    'locate_ms': Figure('`locate()` of one image, ms', 0.8),
    'filter_step_us': Figure('filter step, us', 1.2),
    'latency_p50_ms': Figure('from image to pose at 30 Hz, median, ms'),
    'latency_p99_ms': Figure('from image to pose at 30 Hz, 99th percentile, ms', 0.85),
    'cpu_10_hz': Figure('the three nodes at 10 images a second, share of a core'),
    'cpu_30_hz': Figure('the three nodes at 30 images a second, share of a core', 0.8),
    'composed_cpu_30_hz': Figure('the same in one process', 0.55, beside='cpu_30_hz'),
    'cameras_over_mirror': Figure(
        'four cameras of 640 x 480 (JPEG) at 10 Hz, share of a core over that of one mirror',
        most=1.5,
    ),
    'cameras_latency_p99_ms': Figure('from their images to the pose, 99th percentile, ms'),
    'launch_s': Figure('until three nodes that start at once are active, s', most=3.0),
    'active_s': Figure('CPU time of the slowest of them, s', most=1.2),
    'memory_mib': Figure('memory of the largest of them, MiB', most=170.0),
    'composed_all_mib': Figure('memory of one process with all, MiB', most=200.0),
    'train_s': Figure('training on 100 m of driving, s', 0.7),
}


@contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """Check a version out into a folder, and remove it afterwards."""
    git = ['git', '-C', str(ROOT), 'worktree']
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / 'release'
        subprocess.run([*git, 'add', '--quiet', '--detach', folder, commit], check=True)
        try:
            yield folder
        finally:
            subprocess.run([*git, 'remove', '--force', folder], check=True)


def run(package: Path, *words: object) -> str:
    """Run Python with the package of a folder; return what it prints."""
    environment = {**os.environ, 'PYTHONPATH': str(package)}
    command = [sys.executable, *map(str, words)]
    return subprocess.run(
        command, check=True, stdout=subprocess.PIPE, text=True, cwd=package, env=environment
    ).stdout


def measure(package: Path, seconds: float) -> dict[str, float]:
    """Return the figures of the package in a folder, of one round."""
    bag = ROOT / 'bags/sample_test'
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / 'model.npz'
        start = time.perf_counter()
        run(package, '-m', 'sfa_localization', 'train', ROOT / 'bags/sample', '--output', model)
        train_s = (time.perf_counter() - start) * 100 / SAMPLE_M
        core = json.loads(run(package, BENCHES / 'bench_core.py', model, bag))
        chain = run(ROOT, BENCHES / 'bench_chain.py', package, model, bag, seconds)
        return {'train_s': train_s, **core, **json.loads(chain)}


def best(rounds: list[dict[str, float]]) -> dict[str, float]:
    """Return the least of each figure; NaN for one that was never measured."""
    measured = {name: [figures[name] for figures in rounds if name in figures] for name in FIGURES}
    return {name: min(values, default=math.nan) for name, values in measured.items()}


def ratio(name: str, now: dict[str, float], release: dict[str, float]) -> float:
    """Return a figure over that of the last release; NaN where it has none."""
    return now[name] / release[FIGURES[name].beside or name]


def table(now: dict[str, float], release: dict[str, float]) -> str:
    """Return the table of the page; what was not measured is blank."""
    rows = []
    for name, figure in FIGURES.items():
        goal = f'{figure.ratio} times' if math.isnan(figure.most) else f'{figure.most}'
        values = now[name], release[name], ratio(name, now, release)
        rows.append([figure.words, *('' if math.isnan(v) else f'{v:.3g}' for v in values), goal])
    return markdown(['what', 'this version:', 'last release:', 'ratio:', 'goal:'], rows)


def missed(now: dict[str, float], release: dict[str, float]) -> list[str]:
    """Return the words of the figures that are above their goal."""
    return [
        figure.words
        for name, figure in FIGURES.items()
        if now[name] > figure.most
        or (math.isnan(figure.most) and ratio(name, now, release) > figure.ratio)
    ]


def main() -> int:
    """Print the table, and write it on the page; return 1 if a goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--quick', action='store_true', help='one short round; write nothing')
    parser.add_argument('--release', default=RELEASE, help='tag or commit of the last release')
    options = parser.parse_args()
    rounds, seconds = (1, 3.0) if options.quick else (3, 8.0)
    with checkout(options.release) as folder:
        measured = [[measure(each, seconds) for each in (folder, ROOT)] for _ in range(rounds)]
    release, now = (best(list(each)) for each in zip(*measured, strict=True))
    above = missed(now, release)
    verdict = f'Above the goal: {"; ".join(above) or "nothing"}.'
    print(table(now, release), verdict, sep='\n')
    if not options.quick:
        write_table('bench', f'{table(now, release)}\n{verdict}\n')
    return bool(above)


if __name__ == '__main__':
    sys.exit(main())
