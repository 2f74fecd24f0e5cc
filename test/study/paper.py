# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The studies `simulator` and `robot`: the paper's two experiments.

Each seed has a garden and drives of its own, of the paper's sizes. One network serves all columns
of the table; they differ in how meters are learned from what it outputs.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from places import as_complex

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Complex, RigidTransform, align
from sfa_localization.data.run import Trajectory
from sfa_localization.evaluation import evaluate, odometry_from_start
from sfa_localization.mapping.basis import PAPER_FEATURES, monomials
from sfa_localization.mapping.learning import MetricResult, learn_metric
from sfa_localization.mapping.paper_solver import Lines, descend
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.metric.segments import Segments, assignment
from sfa_localization.metric.stack import Stack
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.figures import firing_maps_figure
from study import paper_report as report
from study.results import Cell, Results
from study.sites import Site
from study.trials import (
    MONOMIALS,
    STRAIGHT,
    Study,
    Trial,
    mean_distance,
    mean_error,
    slow_of,
    true_start,
    turned_of,
)

RECIPES = {'paper': replace(MONOMIALS, solver='paper'), 'certified': MONOMIALS}
"""Section 4: C' from odometry, by the paper's descent; and the optimum of the same problem."""
SNAPSHOTS = {0: '', 500: '', 1000: 'random', 50_000: 'random_long'}
"""Iterations of the descent that figure 4 shows, and the columns of the table that they fill: the
paper's count, and about what the descent needs in the simulated gardens."""
Paths = tuple[Trial, Trajectory, Trajectory]
"""A map's estimates, and the paths by its single images and by the filter."""


def experiment(site: Site, results: Results, name: str, seed: int, figures: Path | None) -> None:
    """Add the cell of one seed: for each column of the table its errors in m, or its `problem`.

    Figures in the style of the paper's go to the folder `figures`. Raises LocalizationError.
    """
    study = site.study()
    model = site.model(study)
    features = study.features(slow_of(model.network))
    columns: dict[str, Cell] = {}
    paths: dict[str, Paths] = {}
    for column, config in RECIPES.items():
        site.progress.say(f'{name}, seed {seed}: {column}')
        columns[column], made = _by_recipe(study, features, config)
        paths |= {column: made} if made else {}
    site.progress.say(f'{name}, seed {seed}: ours')
    columns['ours'], paths['ours'] = _ours(site, study, model)
    descent: list[report.Panel] = []
    if name == 'simulator':
        descent = _random_start(study, features, seed, columns)
    if figures is not None:
        if descent:
            firing_maps_figure(figures / f'figure_1d_{name}.png', study.places, features[0])
            report.panels_figure(figures / 'figure_4.png', {"paper's descent": descent})
        _figures(figures, name, study, paths)
    drift = mean_distance(odometry_from_start(study.truth, study.test), study.truth)
    counts = [len(run.panoramas) for run in (*study.training, study.test)]
    results.keep({'seed': seed, 'images': counts, 'odometry': drift, 'columns': columns})


def _by_recipe(
    study: Study, features: tuple[Array, Array], config: MetricConfig
) -> tuple[Cell, Paths | None]:
    """Errors of the map of slow features (N, K) and (T, K), learned from the straight lines."""
    segments = study.segments(STRAIGHT, only_last=True)
    rows = study.laid_on(STRAIGHT)
    try:
        result = learn_metric(features[0], segments, config)
    except DataError as error:
        return {'problem': str(error)}, None
    trial = Trial.of(study, result.map, features, rows, rows)
    fused = trial.fused(_correlation(result, segments))
    single = Trajectory(study.test_truth.stamps_ns, flat(trial.laid[1]))
    ekf = mean_distance(fused, study.truth)
    cell = {**trial.errors(), 'ekf': ekf, 'lines': len(segments), 'points': len(rows)}
    return cell, (trial, single, fused)


def _correlation(result: MetricResult, segments: Segments) -> ErrorCorrelation:
    """The correlation of errors of left-out images along straight lines."""
    stack = Stack.of(segments)
    way_m = np.cumsum(stack.steps)
    return ErrorCorrelation.fit(result.held_out, result.held_out_variance, way_m, stack.owner)


def flat(places: Array) -> Array:
    """Places (T, 2) as poses (T, 3) of unknown heading."""
    return np.column_stack([places, np.full(len(places), np.nan)])


def _ours(site: Site, study: Study, model: PlaceModel) -> tuple[Cell, Paths]:
    """Errors of the finest map, of one image as the node publishes it, and of the filter."""
    fitted = np.concatenate([segment.images for segment in study.segments(SegmentConfig())])
    rows = study.laid_on(STRAIGHT)
    trial = Trial.of(study, model.metric, study.features(turned_of(model)), rows, fitted)
    judged = evaluate(
        model, site.test, recipe=site.recipe, transform=trial.transform,
        config=true_start(study.test, trial.transform),
    )  # fmt: skip
    sfa, ekf = judged.scores['sfa'], judged.scores['ekf']
    scores = {'image': sfa['mean'], 'scaled': sfa['similarity']['mean'], 'ekf': ekf['mean']}
    cell = {**trial.errors(), **scores, 'points': len(fitted)}
    return cell, (trial, judged.estimates['sfa'], judged.estimates['ekf'])


def _random_start(
    study: Study, features: tuple[Array, Array], seed: int, columns: dict[str, Cell]
) -> list[report.Panel]:
    """Training lines by the paper's descent of C from random parameters, as its simulator
    experiment has it; adds its columns. Only the frame is fitted, or its mirror image, which C
    admits.
    """
    segments = study.segments(STRAIGHT, only_last=True)
    stack, size = Stack.of(segments), np.ptp(study.places, axis=0)
    training, test = (monomials(part[:, :PAPER_FEATURES]) for part in features)
    training, truth = training[stack.images], study.places[stack.images]
    lines = Lines(training, stack.path.real, stack.owner, np.zeros(0))
    start = random_parameters(len(segments), training.shape[1], size, seed)
    panels = []
    for iterations, column in SNAPSHOTS.items():
        try:
            learned = lines.parts(descend(lines, start, iterations)[0])[2]
        except DataError as error:
            columns |= {column: {'problem': str(error)}} if column else {}
            continue
        weights = np.column_stack([learned.real, learned.imag])
        side, transform = _nearest_frame(training @ weights, truth)
        trained, tested = (transform.apply(t @ weights * [1, side]) for t in (training, test))
        places = study.test_truth.poses[:, :2]
        cell = {'training': mean_error(trained, truth), 'test': mean_error(tested, places)}
        columns |= {column: cell} if column else {}
        panels.append(report.Panel(f'iteration {iterations}', truth, trained, stack.owner))
    return panels


def random_parameters(lines: int, terms: int, size: Array, seed: int) -> Complex:
    """The start of the simulator experiment: angles in [0, 2 pi), origins in an area of `size`
    (2,) m about 0, weights in [-1, 1].
    """
    rng = np.random.default_rng(seed)
    alpha, weights = rng.uniform(0, 2 * np.pi, lines), rng.uniform(-1, 1, (terms, 2))
    origins = rng.uniform(-size / 2, size / 2, (lines, 2))
    return np.concatenate([alpha, as_complex(origins), as_complex(weights)])


def _nearest_frame(places: Array, truth: Array) -> tuple[float, RigidTransform]:
    """-1 if the mirror image of places (M, 2) fits the truth better, else 1; and its alignment."""
    made = [(side, align(places * [1, side], truth)) for side in (1.0, -1.0)]
    return min(made, key=lambda k: mean_error(k[1].apply(places * [1, k[0]]), truth))


def _figures(folder: Path, name: str, study: Study, paths: dict[str, Paths]) -> None:
    """Figures 5 and 6, or 7 to 9: a row for the paper's recipe, and one for this package."""
    numbers = {'simulator': (5, 6), 'robot': (7, 8)}[name]
    rows = {"paper's recipe": paths.get('paper') or paths.get('certified'), 'ours': paths['ours']}
    chosen = {row: made for row, made in rows.items() if made is not None}
    owner = assignment(study.segments(STRAIGHT, only_last=True), len(study.places))
    for part, number in enumerate(numbers):
        panels = {row: _panels(trial, part, owner) for row, (trial, *_) in chosen.items()}
        report.panels_figure(folder / f'figure_{number}.png', panels)
    if name == 'robot':
        panels = {row: _fusion_panels(study, *made[1:]) for row, made in chosen.items()}
        report.panels_figure(folder / 'figure_9.png', panels)


def _panels(trial: Trial, part: int, owner: NDArray[np.int64]) -> list[report.Panel]:
    """Panels of the training drive (part 0) or the test drive (1): supervised, raw, aligned."""
    truth, groups = trial.truth[part], None if part else owner[trial.rows]
    return [
        report.Panel('supervised', truth, trial.supervised[part], groups),
        report.Panel('unsupervised', truth, trial.raw[part], groups, aligned=False),
        report.Panel('unsupervised, aligned', truth, trial.laid[part], groups),
    ]


def _fusion_panels(study: Study, single: Trajectory, fused: Trajectory) -> list[report.Panel]:
    """Figure 9: single images, odometry from the true start, and the filter."""
    truth = study.truth
    odometry = odometry_from_start(truth, study.test)
    named = {'SFA': single, 'odometry': odometry, 'EKF': fused}
    return [
        report.Panel(title, truth.at(path.stamps_ns)[:, :2], path.poses[:, :2])
        for title, path in named.items()
    ]
