# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""All benchmarks: prints one table and writes bench.json, one flat object of numbers.

`python bench_all.py [--quick] [--model FILE] [--output bench.json]`. The chain of nodes is
measured where a trained model is given and rclpy is installed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

Figures = dict[str, Any]

HEADLINES = {
    'train_speedup_vs_mdp': 'training, MDP on the explicit rotation over ours',
    'train_paper_size_s': "seconds to train on the paper's 1773 panoramas",
    'train_memory_16x_over_1x': 'peak memory of training at 16 times the pictures',
    'locate_over_matmul': 'locate() over its bare matrix products',
    'locate_speedup_vs_mdp': "MDP's execution of a frame over all of locate()",
    'uml_certified_share': 'share of metric problems solved with proof',
    'uml_median_ms': 'ms to learn a map, median',
    'uml_over_supervised': 'error of the unsupervised map over a supervised one',
    'paper_solver_success_share': "share in which the paper's descent ends at the optimum",
    'unwrap_over_remap': 'unwrapping over a bare cv2.remap',
    'filter_over_filterpy': 'a filter step over bare filterpy',
    'chain_latency_p99_ms': 'ms of the chain, 99th percentile',
    'chain_cpu_share': 'share of one core that the chain takes',
    'bag_over_rosbags': 'iteration of a bag over bare rosbags',
}


def benches(folder: Path, quick: bool, model: Path | None) -> Iterator[tuple[str, Callable]]:
    """Modules and what to call in them."""
    yield 'bench_sfa', lambda m: m.bench_sfa(folder, quick, model)
    yield 'bench_metric', lambda m: m.bench_metric(20 if quick else 1000)
    yield 'bench_filter', lambda m: m.bench_filter()
    yield 'bench_bag', lambda m: m.bench_bag(folder, 3 if quick else 9)
    yield 'bench_panorama', lambda m: m.bench_unwrap()
    if model is not None:
        yield 'bench_chain', lambda m: m.bench_chain(str(model))


def flat(figures: Figures, prefix: str = '') -> dict[str, float]:
    """Numbers only; groups of figures get their name in front, not finite ones are left out."""
    numbers: dict[str, float] = {}
    for name, value in figures.items():
        if isinstance(value, dict):
            numbers |= flat(value, f'{prefix}{name}_')
        elif isinstance(value, (int, float)) and math.isfinite(value):
            numbers[re.sub(r'\W+', '_', prefix + name)] = float(f'{float(value):.5g}')
    return numbers


def measure(quick: bool, model: Path | None) -> tuple[dict[str, float], list[str]]:
    """All figures, and why some are missing."""
    figures: dict[str, float] = {}
    missing = []
    with tempfile.TemporaryDirectory() as folder:
        for name, call in benches(Path(folder), quick, model):
            sys.stderr.write(f'{name} ...\n')
            try:
                figures |= flat(call(importlib.import_module(name)))
            except ImportError as error:
                missing.append(f'{name}: {error}')
    if model is None:
        missing.append('bench_chain: no trained model (--model)')
    return figures, missing


def table(figures: dict[str, float], missing: list[str]) -> str:
    """The headline figures, then all others."""
    lines = [f'{figures[n]:>12.4g}  {n:<30} {HEADLINES[n]}' for n in HEADLINES if n in figures]
    lines += [f'{value:>12.4g}  {n}' for n, value in figures.items() if n not in HEADLINES]
    return '\n'.join([*lines, *(f'not measured: {reason}' for reason in missing)])


def write(path: Path, figures: dict[str, float]) -> None:
    """Write under a temporary name, then rename."""
    temporary = path.with_name(f'.{path.name}.tmp')
    temporary.write_text(json.dumps(figures, indent=2) + '\n')
    os.replace(temporary, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--quick', action='store_true', help='fewer pictures, problems and rounds')
    parser.add_argument('--model', type=Path, help='trained model, for locate() and the chain')
    parser.add_argument('--output', type=Path, default=Path('bench.json'))
    options = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parents[1]))
    figures, missing = measure(options.quick, options.model)
    write(options.output, figures)
    sys.stdout.write(table(figures, missing) + '\n')


if __name__ == '__main__':
    main()
