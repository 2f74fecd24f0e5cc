# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""All benchmarks: a table with goal and floor of each figure, which is also that of test/README.md.

`python bench_all.py [--quick] [--model FILE --drive BAG]`. Of each figure the best of three rounds
counts. The last line names the ratios that have become more than 1.5 times worse than those in
recorded.json, which are changed by hand, with a reason. Without a model one is trained. A quick run
makes one round, measures no training, and leaves the page as it is.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

Figures = dict[str, Any]

ROOT = Path(__file__).parents[2]
PAGE, RECORDED = ROOT / 'test/README.md', Path(__file__).with_name('recorded.json')
BEGIN, END = '<!-- written by make bench -->\n', '<!-- end -->\n'
ROUNDS, WORSE = 3, 1.5


class Figure(NamedTuple):
    """What a figure is, what is aimed at, and what is accepted; whether more is better."""

    words: str
    goal: float = math.nan
    floor: float = math.nan
    more: bool = False

    def better(self, one: float, other: float) -> float:
        return max(one, other) if self.more else min(one, other)


FIGURES = {
    'busy_over_one_thread': Figure(
        'every entry point beside busy processes: default threads over one', 1.1, 1.5
    ),
    'locate_over_matmul': Figure('`locate()` over its bare matrix products', 1.5, 2.0),
    'filter_over_filterpy': Figure('filter step with its health over bare filterpy', 1.6, 2.5),
    'chain_latency_p50_over_relays': Figure('nodes over three relays: median latency', 3, 5),
    'chain_latency_p99_over_relays': Figure('the same: 99th percentile', 3, 5),
    'chain_cpu_over_relays': Figure('the same: CPU at 30 images a second', 2, 3),
    'start_omnicam_node_cpu_s': Figure('CPU from exec to active: omnicam_node, s', 0.4, 0.5),
    'start_sfa_node_cpu_s': Figure('the same: sfa_node, s', 0.6, 0.7),
    'start_ekf_node_cpu_s': Figure('the same: ekf_node, s', 0.45, 0.6),
    'start_omnicam_node_mib': Figure('resident memory then: omnicam_node, MiB', 80, 100),
    'start_sfa_node_mib': Figure('the same: sfa_node, MiB', 120, 140),
    'start_ekf_node_mib': Figure('the same: ekf_node, MiB', 90, 110),
    'uml_median_ms': Figure('certified map of the size in the article, median, ms', 25, 40),
    'uml_certified_share': Figure('maps that are solved with a certificate, share', more=True),
    'train_speedup_vs_mdp': Figure(
        'stock MDP on the explicit rotations over training', 400, 300, more=True
    ),
    'train_memory_4x_over_1x': Figure('peak memory of training, 4 times the images over once'),
    'unwrap_over_remap': Figure('unwrapping over bare `cv2.remap`'),
    'bag_over_rosbags': Figure('messages of a bag per second over bare rosbags', more=True),
    'locate_ms': Figure('`locate()`, ms'),
    'filter_step_us': Figure('filter step with its health, us'),
    'chain_latency_p99_ms': Figure('the nodes, from image to pose, 99th percentile, ms'),
    'chain_cpu': Figure('the nodes at 30 images a second, share of a core'),
}


Benches = Iterator[tuple[str, Callable]]


def in_rounds(model: Path, drive: Path, quick: bool) -> Benches:
    """Modules and what to call in them, in each round."""
    yield 'bench_sfa', lambda m: m.bench_located(model, drive, 100)
    yield 'bench_filter', lambda m: m.bench_filter(rounds=5)
    yield 'bench_chain', lambda m: m.bench_chain(model, drive, 4.0)
    yield 'bench_metric', lambda m: m.bench_metric(9 if quick else 45)
    yield 'bench_panorama', lambda m: m.bench_unwrap(100)


def once(folder: Path, model: Path, drive: Path, quick: bool) -> Benches:
    """The same for those that count rounds themselves, or take minutes."""
    yield 'bench_bag', lambda m: m.bench_bag(folder, 1 if quick else 3)
    entries = ('locate', 'localizer') if quick else ('locate', 'localizer', 'evaluate', 'update')
    yield 'bench_busy', lambda m: m.bench_busy(model, drive, entries, 1 if quick else 2)
    if not quick:
        yield 'bench_sfa', lambda m: m.bench_sfa(folder, quick=True)


def flat(figures: Figures, prefix: str = '') -> dict[str, float]:
    """Numbers only; groups of figures get their name in front, not finite ones are left out."""
    numbers: dict[str, float] = {}
    for name, value in figures.items():
        if isinstance(value, dict):
            numbers |= flat(value, f'{prefix}{name}_')
        elif isinstance(value, (int, float)) and math.isfinite(value):
            numbers[re.sub(r'\W+', '_', prefix + name)] = float(f'{float(value):.5g}')
    return numbers


def measure(model: Path, drive: Path, quick: bool) -> tuple[dict[str, float], list[str]]:
    """The best of all rounds, and why figures are missing."""
    figures: dict[str, float] = {}
    missing: dict[str, str] = {}

    def add(name: str, call: Callable) -> None:
        begun_s = time.monotonic()
        try:
            found = flat(call(importlib.import_module(name)))
        except ImportError as error:
            missing[name] = str(error)
            return
        for key, value in found.items():
            better = FIGURES.get(key, Figure('')).better
            figures[key] = better(figures.get(key, value), value)
        sys.stderr.write(f'{name}: {time.monotonic() - begun_s:.0f} s\n')

    for _ in range(1 if quick else ROUNDS):
        for name, call in in_rounds(model, drive, quick):
            add(name, call)
    with tempfile.TemporaryDirectory() as folder:
        for name, call in once(Path(folder), model, drive, quick):
            add(name, call)
    return figures, [f'{name}: {reason}' for name, reason in missing.items()]


def shown(value: float) -> str:
    return f'{value:.3g}' if math.isfinite(value) else ''


def rows(figures: dict[str, float]) -> list[str]:
    """The table of the page."""
    lines = ['| what | measured | goal | at least |', '|---|---:|---:|---:|']
    return lines + [
        f'| {one.words} | {shown(figures[name])} | {shown(one.goal)} | {shown(one.floor)} |'
        for name, one in FIGURES.items()
        if name in figures
    ]


def verdict(figures: dict[str, float]) -> str:
    """Which ratios have become worse than the recorded ones."""
    worse = []
    for name, (before, _) in json.loads(RECORDED.read_text('utf-8')).items():
        if name not in figures:
            continue
        now, more = figures[name], FIGURES[name].more
        if (before / now if more else now / before) > WORSE:
            worse.append(f'{name} {now:.3g} (recorded: {before:.3g})')
    return f'more than {WORSE} times worse than recorded: {", ".join(worse) or "nothing"}'


def write(path: Path, text: str) -> None:
    """Write under a temporary name, then rename."""
    temporary = path.with_name(f'.{path.name}.tmp')
    temporary.write_text(text, 'utf-8')
    os.replace(temporary, path)


def write_page(table: list[str]) -> None:
    """Put the table on the page, between its marks."""
    head, _, rest = PAGE.read_text('utf-8').partition(BEGIN)
    _, mark, tail = rest.partition(END)
    assert mark, f'{PAGE}: lacks {BEGIN!r} and {END!r}'
    write(PAGE, head + BEGIN + '\n'.join(table) + '\n' + END + tail)


def trained(folder: str) -> Path:
    """A model of the small recording."""
    path = Path(folder) / 'model.npz'
    words = 'sfa_localization', 'train', str(ROOT / 'bags/sample'), '--output', str(path)
    subprocess.run([sys.executable, '-m', *words], check=True, stderr=subprocess.DEVNULL)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--quick', action='store_true', help='one round, without training')
    parser.add_argument('--model', type=Path, help='trained model; one is trained without it')
    parser.add_argument(
        '--drive', type=Path, default=ROOT / 'bags/sample_test', help='in its place'
    )
    parser.add_argument('--output', type=Path, default=Path('bench.json'))
    options = parser.parse_args()
    sys.path.insert(0, str(ROOT / 'test'))
    with tempfile.TemporaryDirectory() as folder:
        model = (options.model or trained(folder)).resolve()
        figures, missing = measure(model, options.drive.resolve(), options.quick)
    write(options.output, json.dumps(figures, indent=2) + '\n')
    table = rows(figures)
    sys.stdout.write('\n'.join([*table, *(f'not measured: {reason}' for reason in missing)]) + '\n')
    if not options.quick:
        write_page(table)
    sys.stdout.write(verdict(figures) + '\n')


if __name__ == '__main__':
    main()
