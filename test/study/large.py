# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Gardens of several sizes, at one density of drives: labels, errors, confirmation and cost."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from page_tables import markdown

from sfa_localization.bags.drives import as_live
from sfa_localization.bags.reader import Bag
from sfa_localization.data.events import ODOMETRY, merge_by_stamp
from sfa_localization.data.geometry import Array, RigidTransform, align
from sfa_localization.data.run import Run, Trajectory
from sfa_localization.evaluation import moved, observed, score
from sfa_localization.fusion.pose_filter import Level
from sfa_localization.keyframes.observation import Observation
from sfa_localization.localizer import Localizer
from sfa_localization.observer import Observer
from sfa_localization.place_model import PlaceModel
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import Recipe, train
from study.results import Cell, Progress, Results, StudyConfig, recorded, settings_of

RESULTS = 'large.json'
AREAS = {(16.0, 18.0): 0.2, (32.0, 36.0): 0.2, (64.0, 72.0): 0.3}
"""Sides, m, and the distance between images, m."""
QUICK_AREAS = {(8.0, 8.0): 0.2}
PANORAMA = 300, 30
KIDNAPPINGS, RIGHT_M = 6, 0.6
"""Number of kidnappings along the test drive, and the largest error of a recovered estimate."""


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
    head = ['area', 'images; segments:', 'training (CPU s), memory (GB):', 'labels (m):',
            'one image (m):', 'EKF, mean / p95 (m):', 'LOCALISED:', 'back after (s):']  # fmt: skip
    rows = [
        [
            c['garden'],
            f'{c["images"]:,}; {c["segments"]:,}',
            f'{c["training_s"]}; {c["memory_gb"]:.1f}',
            *(f'{c[name]:.3f}' for name in ('labels', 'sfa')),
            f'{c["ekf"]:.3f} / {c["ekf_p95"]:.3f}',
            f'{c["localised"]:.0%}',
            f'{min(c["back_s"]):.1f} to {max(c["back_s"]):.1f}',
        ]
        for c in cells
    ]
    return markdown(head, rows)


def _judge(out: Path, config: StudyConfig, area: tuple[float, float], every: float) -> Cell:
    folder = out / f'{area[0]:g}x{area[1]:g}'
    base = SimulationConfig(world=config.world, area=area, images='panorama', images_every=every)
    bags = [
        recorded(
            folder / route,
            replace(base, trajectory=route, seed=config.seed + n),
            PANORAMA,
            Progress(shown=True),
        )
        for n, route in enumerate(('coverage', 'test'))
    ]
    started = time.process_time()
    trained = train(bags[:1], folder / 'model.npz', Recipe(), progress=True)
    seconds = time.process_time() - started
    images, places = trained.metric.images, trained.metric.poses[:, :2]
    with Bag(bags[0]) as bag:
        truth = bag.trajectory().at(trained.runs[0].panoramas.stamps_ns[images])[:, :2]
    frame = align(places, truth)
    model, recipe = trained.model, as_live(Recipe(), trained.model.panorama)
    run, seen = observed(bags[1], Observer(model), recipe, progress=True)
    usable = [image for image in seen if not image.problem]
    stamps = np.array([image.stamp_ns for image in usable])
    single = Trajectory(stamps, np.array([image.pose for image in usable]))
    path, sure = _fused(model, run, seen)
    ekf = score(run.ground_truth, moved(path, frame))
    back = list(_recoveries(model, run, seen, frame))
    return {
        'garden': _name(area),
        'images': len(trained.runs[0].panoramas),
        'segments': len(trained.segments),
        'training_s': round(seconds),
        'memory_gb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        'labels': float(np.hypot(*(frame.apply(places) - truth).T).mean()),
        'sfa': score(run.ground_truth, moved(single, frame))['mean'],
        'ekf': ekf['mean'],
        'ekf_p95': ekf['p95'],
        'localised': float(sure.mean()),
        'back_s': back,
    }


def _fused(
    model: PlaceModel, run: Run, seen: Sequence[Observation], at_ns: int = 0, ahead_ns: int = 0
) -> tuple[Trajectory, Array]:
    """The filter's path at the images, and whether it was LOCALISED; at `at_ns` the robot is moved
    to where it was `ahead_ns` later.
    """
    localizer, states, odometry = Localizer(model), [], run.odometry
    for stamp_ns, kind, i in merge_by_stamp(odometry.stamps_ns, [o.stamp_ns for o in seen]):
        if at_ns <= stamp_ns < at_ns + ahead_ns:
            continue
        now_ns = stamp_ns - (ahead_ns if stamp_ns >= at_ns else 0)
        if kind == ODOMETRY:
            localizer.add_odometry(now_ns, *odometry.twists[i])
            continue
        localizer.add_observation(replace(seen[i], stamp_ns=now_ns))
        if localizer.state is not None:
            sure = localizer.status.level is Level.LOCALISED
            states.append((stamp_ns, localizer.state.pose, sure))
    stamps, poses, sure = map(np.array, zip(*states, strict=True))
    return Trajectory(stamps, poses), sure


def _recoveries(
    model: PlaceModel, run: Run, seen: Sequence[Observation], frame: RigidTransform
) -> Iterator[float]:
    """Seconds after each kidnapping until the estimate is LOCALISED and right; else infinite."""
    start, end = run.odometry.stamps_ns[[0, -1]].tolist()
    for k in range(KIDNAPPINGS):
        at_ns, ahead_ns = round(start + (end - start) * (0.2 + 0.05 * k)), (end - start) * 2 // 5
        path, sure = _fused(model, run, seen, at_ns, ahead_ns)
        errors = moved(path, frame).poses[:, :2] - run.ground_truth.at(path.stamps_ns)[:, :2]
        back = sure & (np.hypot(*errors.T) < RIGHT_M) & (path.stamps_ns >= at_ns + ahead_ns)
        seconds = (path.stamps_ns[back] - at_ns - ahead_ns) * 1e-9
        yield float(seconds.min(initial=np.inf))
