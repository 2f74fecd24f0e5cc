# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Speed and memory of this version beside those of the last release, as a table of test/README.md.

`python bench_all.py [--quick] [--release FOLDER]`: a checkout of the last release in FOLDER is
measured in the same run. Without one the table shows its figures in recorded.json, which bench.json
replaces at a release. The best of three rounds counts; a quick run makes a short one, and
leaves the page as it is.
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
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

from page_tables import markdown, write_table

BENCHES, ROOT = Path(__file__).parent, Path(__file__).parents[2]
RECORDED, MEASURED = BENCHES / 'recorded.json', Path('bench.json')
SAMPLE_M = 78.0
"""Length of the drive in bags/sample."""


class Figure(NamedTuple):
    """A figure of which less is better: allowed is `most`, else `factor` times the last release."""

    words: str
    factor: float = 1.5
    most: float = math.nan

    def allowed(self, release: float) -> float:
        return self.factor * release if math.isnan(self.most) else self.most


FIGURES = {
    'locate_ms': Figure('`locate()` of one image, ms'),
    'filter_step_us': Figure('filter step, us', factor=3.0),
    'latency_p50_ms': Figure('from image to pose at 30 Hz, median, ms'),
    'latency_p99_ms': Figure('from image to pose at 30 Hz, 99th percentile, ms'),
    'cpu_10_hz': Figure('the three nodes at 10 images a second, share of a core'),
    'cpu_30_hz': Figure('the three nodes at 30 images a second, share of a core'),
    'cameras_over_mirror': Figure(
        'four cameras of 640 x 480 (JPEG) at 10 Hz, share of a core over that of one mirror',
        most=1.5,
    ),
    'cameras_latency_p99_ms': Figure('from their images to the pose, 99th percentile, ms'),
    'active_s': Figure('CPU time until the slowest node is active, s', most=1.2),
    'memory_mib': Figure('memory of the largest node then, MiB', most=170.0),
    'train_s': Figure('training on 100 m of driving, s'),
}


def run(package: Path, *words: object) -> str:
    """Run Python with the package of a folder; return what it prints."""
    environment = {**os.environ, 'PYTHONPATH': str(package)}
    command = [sys.executable, *map(str, words)]
    return subprocess.run(
        command, check=True, stdout=subprocess.PIPE, text=True, cwd=package, env=environment
    ).stdout


def measure(package: Path, rounds: int, seconds: float) -> dict[str, float]:
    """Return the figures of the package in a folder, the best of all rounds."""
    results = []
    with tempfile.TemporaryDirectory() as folder:
        model, bag = Path(folder) / 'model.npz', ROOT / 'bags/sample_test'
        start = time.perf_counter()
        run(package, '-m', 'sfa_localization', 'train', ROOT / 'bags/sample', '--output', model)
        train_s = (time.perf_counter() - start) * 100 / SAMPLE_M
        for _ in range(rounds):
            results.append(json.loads(run(package, BENCHES / 'bench_core.py', model, bag)))
            results.append(
                json.loads(run(package, BENCHES / 'bench_chain.py', model, bag, seconds))
            )
    results.append({'train_s': train_s})
    measured = {name for result in results for name in result}
    return {
        name: min(result[name] for result in results if name in result)
        for name in FIGURES
        if name in measured
    }


def table(now: dict[str, float], release: dict[str, float]) -> str:
    """Return the table of the page; figures that were not measured are blank."""
    rows = []
    for name, figure in FIGURES.items():
        before = release.get(name, math.nan)
        values = now.get(name, math.nan), before, figure.allowed(before)
        rows.append([figure.words, *('' if math.isnan(v) else f'{v:.3g}' for v in values)])
    return markdown(['what', 'this version:', 'last release:', 'allowed:'], rows)


def exceeded(now: dict[str, float], release: dict[str, float]) -> list[str]:
    """Return the words of the figures that are above what is allowed."""
    return [
        figure.words
        for name, figure in FIGURES.items()
        if now[name] > figure.allowed(release.get(name, math.nan))
    ]


def main() -> int:
    """Print the table, and write it on the page; return 1 if a figure is above what is allowed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--quick', action='store_true', help='one short round; write nothing')
    parser.add_argument('--release', type=Path, help='a checkout of the last release')
    options = parser.parse_args()
    rounds, seconds = (1, 3.0) if options.quick else (3, 8.0)
    release = json.loads(RECORDED.read_text('utf-8'))
    if options.release:
        release = measure(options.release.resolve(), rounds, seconds)
    now = measure(ROOT, rounds, seconds)
    above = exceeded(now, release)
    verdict = f'More than allowed: {"; ".join(above) or "nothing"}.'
    print(table(now, release), verdict, sep='\n')
    if not options.quick:
        MEASURED.write_text(json.dumps(now, indent=2) + '\n', 'utf-8')
        write_table('bench', f'{table(now, release)}\n{verdict}\n')
    return bool(above)


if __name__ == '__main__':
    sys.exit(main())
