# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Select the map's basis by its evidence, and judge maps by leaving out segments of the drive."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Complex, Indices, align_complex
from sfa_localization.data.statistics import needed_factor
from sfa_localization.metric.basis import PAPER_FEATURES, Basis, Monomials, Process, spread
from sfa_localization.metric.fitted_map import place_variance, plane
from sfa_localization.metric.forecast import Forecast, ground_distances, importance, nearest_used
from sfa_localization.metric.map_fit import MapFit, MetricProblem
from sfa_localization.metric.pose_graph import cost, refined
from sfa_localization.metric.ridge import Ridge
from sfa_localization.metric.stack import Stack

INDUCING_POINTS = 1000
"""Most images that span the Gaussian process: with half as many more it is no better, and the model
file and the time of an estimate are larger."""
RIDGE = 1e-4
"""Penalty of monomials, over the mean square of an image's residual: from 0 to 1e-3, maps are as
good."""
LEFT_OUT_FOLDS = 8
"""Parts of the drive that are left out in turn."""
LEFT_OUT_LENGTH_M = 10.0
"""Longest stretch that is left out as a whole: longer gaps do not occur in a covered area."""
# Inducing points while length and noise are searched; with 300 the search ends with too much noise.
_SEARCH_POINTS = 800
# Length (in typical distances of two images) and noise (over the signal) that the search starts at.
_FIRST_HYPER = (1.0, 1e-3)
_LENGTH_BOUNDS = (0.05, 20.0)
_NOISE_BOUNDS = (1e-6, 1.0)


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Predictions of images whose segments the map was learned without, row by row."""

    errors: Complex
    """(M,) m: where the solution of all data puts an image minus where that map does."""
    variances: Array
    """(M,) of the prediction per axis, before inflation, m^2."""
    forecast: Forecast
    explained: float
    """Share of the spread of the places that the features explain."""

    @property
    def variance(self) -> float:
        """Of the position of an image that was left out, m^2 per axis."""
        return float(self.forecast.weight @ self.forecast.left_out**2) / 2

    @property
    def inflation(self) -> float:
        """Factor on the covariance of the map that makes these consistent, at least 1."""
        ratio = np.abs(self.errors) ** 2 / self.variances
        return max(needed_factor(ratio, self.forecast.weight), 1.0)


def folds(stack: Stack, seed: int) -> Indices:
    """(M,) by which part of the drive each row of the stack is left out: whole segments, in
    stretches of the drive.

    Stretches of a short drive are shorter: there are LEFT_OUT_FOLDS parts, as far as there are
    segments, and always at least two. Segments along one track are left out together. Raises
    DataError for a drive of one segment.
    """
    lengths = stack.sums(stack.steps)
    length = min(LEFT_OUT_LENGTH_M, lengths.sum() / LEFT_OUT_FOLDS)
    # The middles of the first and the last segment are at least half the drive apart.
    middles = np.cumsum(lengths) - lengths / 2
    stretch = np.floor(middles / max(length, 1e-9)).astype(int)[stack.track]
    names = np.unique(stretch)
    if len(names) < 2:
        raise DataError(
            f'{lengths.sum():.1f} m of odometry with images leave nothing to check a map with: '
            'drive farther'
        )
    parts = min(LEFT_OUT_FOLDS, len(names))
    order = np.random.default_rng(seed).permutation(len(names))
    fold = np.empty(len(names), int)
    fold[order] = np.arange(len(names)) % parts
    return np.asarray(fold[np.searchsorted(names, stretch)][stack.owner])


def leave_out(fit: MapFit) -> LeftOut:
    """Predict each fold from the others; the directions are solved again without its images.

    The left-out segments keep their odometry, so the frame stays the same; predictions are
    compared with where the solution of all data puts the images.
    """
    stack, places = fit.stack, fit.places
    errors = np.zeros(len(stack.images), complex)
    variances = np.zeros(len(stack.images))
    part = folds(stack, fit.problem.seed)
    for rows in (np.flatnonzero(part == number) for number in np.unique(part)):
        ridge, poses = fit.without(rows)
        others, expanded = poses.places(stack), fit.ridge.expanded[rows]
        turn, shift = align_complex(others, places, ridge.weights)
        errors[rows] = places[rows] - (turn * (expanded @ ridge.fitted(others)) + shift)
        spread = (ridge.whitened(expanded) ** 2).sum(0)
        variances[rows] = fit.variance * (1.0 / fit.ridge.weights[rows] + spread)
    distances, weight = on_the_ground(fit)
    drive_std = np.sqrt(place_variance(fit))
    expected = Forecast(plane(places), np.abs(errors), drive_std, weight, distances)
    spread_m2 = max(float(plane(places).var(0).sum()), 1e-12)
    explained = 1.0 - float(weight @ np.abs(errors) ** 2) / spread_m2
    return LeftOut(errors, variances, expected, explained)


def evidence(basis: Basis, now: MapFit) -> float:
    """Negative log evidence of a Gaussian process's hyper-parameters, at their best poses.

    Origins have flat priors (restricted likelihood); the signal's variance is profiled out.
    """
    ridge, noise, stack = Ridge.of(basis, now.problem.features), float(basis.ridge[0]), now.stack
    form, segments = now.form(ridge), stack.segments
    squares = now.image_variance * cost(form, refined(form, stack, now.graph.poses), stack)
    origins = now.image_variance * form[:segments, :segments].real
    points, freedom = len(ridge.expanded), len(ridge.expanded) - segments
    return (
        freedom * float(np.log(squares / noise / freedom))
        + (points - len(basis.ridge) + 1 - segments) * float(np.log(noise))
        - float(np.log(ridge.weights).sum())
        + ridge.log_determinant
        + float(np.linalg.slogdet(origins + np.trace(origins) / segments**2)[1])
    )


def on_the_ground(fit: MapFit) -> tuple[Array, Array]:
    """Distances (K,) m of the covered ground to the nearest image, and the weights (M,) by which
    images that are left out stand for it."""
    places, seed = plane(fit.places), fit.problem.seed
    distances = ground_distances(places, np.random.default_rng(seed))
    return distances, importance(nearest_used(places, folds(fit.stack, seed)), distances)


def left_out_error(basis: Basis, now: MapFit, weight: Array) -> float:
    """Mean error, m, by a weight (M,), of images left out of a regression to places that are known.

    The evidence would take neighbors that err alike for proof of little noise.
    """
    ridge, places, error = Ridge.of(basis, now.problem.features), now.places, 0.0
    part = folds(now.stack, now.problem.seed)
    for rows in (np.flatnonzero(part == number) for number in np.unique(part)):
        found = ridge.expanded[rows] @ ridge.without(rows).fitted(places)
        error += float(weight[rows] @ np.abs(places[rows] - found))
    return error


def feature_scale(features: Array, stack: Stack, count: int) -> Array:
    """Weight (count,) of each feature in the kernel: slower features count for more.

    A unit length is the typical distance of two images.
    """
    chosen = features[:, :count]
    same = stack.owner[1:] == stack.owner[:-1]
    variance, std = chosen.var(axis=0), chosen.std(axis=0)
    delta = np.mean(np.diff(chosen, axis=0)[same] ** 2, axis=0)
    delta = np.maximum(delta / np.where(variance > 0, variance, 1.0), 1e-12)
    weights = delta**-0.25
    weights /= np.sqrt(np.mean(weights**2) * count)
    return np.asarray(weights / np.where(std > 0, std, 1.0))


def choose(problem: MetricProblem, scale: Array | None = None) -> MapFit:
    """The fit of the basis that the settings name, of a Gaussian process the likeliest.

    `scale` (K,) weights the features of a Gaussian process, in which a unit length then is the
    typical distance of two images; without it their slowness does.
    """
    available, asked = problem.features.shape[1], problem.config.slow_features
    if problem.config.metric_map == 'monomials':
        count = asked or min(PAPER_FEATURES, available)
        return problem.fit(Monomials.fit(problem.features, count, RIDGE))
    if scale is None:
        scale = feature_scale(problem.features, problem.stack, asked or available)
    return _choose_process(problem, scale)


def _choose_process(problem: MetricProblem, scale: Array) -> MapFit:
    """Length and noise by the evidence, or, where places are known, by images left out; with fewer
    inducing points: they rank alike."""
    scaled = problem.features[:, : len(scale)] * scale
    points = scaled[spread(scaled, min(_SEARCH_POINTS, INDUCING_POINTS))]

    def make(length: float, noise: float) -> Process:
        return Process(scale / length, points / length, noise)

    now = problem.fit(make(*_FIRST_HYPER), None, 3)
    if problem.graph is None:
        length, noise = _descend(lambda *pair: evidence(make(*pair), now))
    else:
        weight = on_the_ground(now)[1]
        length, noise = _descend(lambda *pair: left_out_error(make(*pair), now, weight))
    basis = Process.fit(problem.features, scale / length, noise, INDUCING_POINTS)
    return problem.fit(basis, now)


def _descend(judge: Callable[[float, float], float]) -> tuple[float, float]:
    """Coordinate descent by factors, over length and noise."""
    costs: dict[tuple[float, float], float] = {}
    hyper = _FIRST_HYPER

    def cost(pair: tuple[float, float]) -> float:
        if pair not in costs:
            costs[pair] = judge(*pair)
        return costs[pair]

    for factor in (2.0, 1.4):
        while True:
            best = min(_around(hyper, factor), key=cost)
            if not cost(best) < cost(hyper):
                break
            hyper = best
    return hyper


def _around(hyper: tuple[float, float], factor: float) -> Iterator[tuple[float, float]]:
    """Neighbors of length and noise within the bounds."""
    length, noise = hyper
    for step in (factor, 1 / factor):
        if _LENGTH_BOUNDS[0] < length * step < _LENGTH_BOUNDS[1]:
            yield length * step, noise
        if _NOISE_BOUNDS[0] < noise * step**2 < _NOISE_BOUNDS[1]:
            yield length, noise * step**2
    yield hyper
