# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Gardens of several sizes, at one density of drives: labels, errors and cost."""

from __future__ import annotations

import resource
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from page_tables import markdown
from places import distances

from sfa_localization.bags.reader import Bag
from sfa_localization.data.geometry import align
from sfa_localization.evaluation import evaluate
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import Recipe, train
from study.results import Cell, Progress, Results, StudyConfig, recorded, settings_of
from study.trials import scores_of

RESULTS = 'large.json'
AREAS = {(16.0, 18.0): 0.2, (32.0, 36.0): 0.2, (64.0, 72.0): 0.3}
"""Sides, m, and the distance between images, m."""
QUICK_AREAS = {(8.0, 8.0): 0.2}
PANORAMA = 300, 30


def judge_areas(
    out: Path, config: StudyConfig, areas: dict[tuple[float, float], float]
) -> list[Cell]:
    """The cells of the areas, by the name of the `garden`. Raises LocalizationError, also for a
    folder with anything else.
    """
    settings = settings_of(config.world, config.seed, (), PANORAMA)
    results = Results.opened(out / RESULTS, settings)
    for area, every in areas.items():
        if results.find(garden=_name(area)) is None:
            results.keep(_judge(out, config, area, every))
    return results.cells


def _name(area: tuple[float, float]) -> str:
    return f'{area[0]:g} m x {area[1]:g} m'


def table(cells: Sequence[Cell]) -> str:
    """A line for each area as Markdown."""
    head = ['area', 'images:', 'training (CPU s):', 'memory (GB):', 'labels (m):',
            'one image (m):', 'EKF (m):', 'LOCALISED:']  # fmt: skip
    rows = [
        [
            c['garden'],
            f'{c["images"]:,}',
            f'{c["training_s"]}',
            f'{c["memory_gb"]:.1f}',
            *(f'{c[name]:.3f}' for name in ('labels', 'sfa', 'ekf')),
            f'{c["localised"]:.0%}',
        ]
        for c in cells
    ]
    return markdown(head, rows)


def _judge(out: Path, config: StudyConfig, area: tuple[float, float], every: float) -> Cell:
    folder, progress = out / f'{area[0]:g}x{area[1]:g}', Progress(shown=True)
    base = SimulationConfig(
        world=config.world, seed=config.seed, area=area, images='panorama', images_every=every
    )
    training = recorded(folder / 'coverage', base, PANORAMA, progress)
    test = replace(base, trajectory='test', seed=config.seed + 1)
    bag = recorded(folder / 'test', test, PANORAMA, progress)
    started = time.process_time()
    trained = train([training], folder / 'model.npz', Recipe(), progress=True)
    seconds = time.process_time() - started
    images, places = trained.metric.images, trained.metric.poses[:, :2]
    with Bag(training) as opened:
        truth = opened.trajectory().at(trained.runs[0].panoramas.stamps_ns[images])[:, :2]
    frame = align(places, truth)
    judged = evaluate(trained.model, bag, transform=frame, progress=True)
    states = judged.counts['states_s']
    return {
        'garden': _name(area),
        'images': len(trained.runs[0].panoramas),
        'training_s': round(seconds),
        'memory_gb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        'labels': float(distances(frame.apply(places), truth).mean()),
        'localised': states.get('LOCALISED', 0.0) / sum(states.values()),
        **scores_of(judged),
    }
