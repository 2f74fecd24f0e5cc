# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Select the basis of the map, and judge maps at parts of the drive that they were learned
without."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Complex, Indices, align_complex
from sfa_localization.data.statistics import needed_factor
from sfa_localization.mapping.basis import PAPER_FEATURES, Basis, Monomials, Process, spread
from sfa_localization.mapping.fitted_map import place_variance, plane
from sfa_localization.mapping.forecast import Forecast, ground_distances, importance, nearest_used
from sfa_localization.mapping.map_fit import MapFit, MetricProblem
from sfa_localization.mapping.ridge import Ridge
from sfa_localization.metric.pose_graph import cost, refined
from sfa_localization.metric.stack import Stack

INDUCING_POINTS = 1000
"""Most images that span the Gaussian process: with half as many more it is no better."""
RIDGE = 1e-4
"""Penalty of monomials, over the mean square of an image's residual: up to 1e-3, maps are as
good."""
HELD_OUT_FOLDS = 8
"""Parts of the drive that are held out in turn."""
HELD_OUT_LENGTH_M = 10.0
"""Longest stretch that is held out as a whole: a covered area has no longer gaps."""
# Inducing points of the search: with 300 it ends with too much noise.
_SEARCH_POINTS = 800
# Start and bounds of length (in typical distances of two images) and noise (over the signal).
_FIRST_HYPER = (1.0, 1e-3)
_BOUNDS = ((0.05, 20.0), (1e-6, 1.0))


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Predictions of M images by maps that were learned without their part of the drive."""

    errors: Complex
    """(M,) m: where the segments put an image minus where that map does."""
    variances: Array
    """(M,) m^2, of the prediction per axis, before inflation."""
    forecast: Forecast
    explained: float
    """Share of the spread of the places that the features explain."""

    @property
    def variance(self) -> float:
        """m^2 per axis, of the prediction of an image that was held out."""
        return float(self.forecast.weight @ self.forecast.held_out**2) / 2

    @property
    def inflation(self) -> float:
        """Multiply the map's covariance by this to make its errors consistent; at least 1."""
        ratio = np.abs(self.errors) ** 2 / self.variances
        return max(needed_factor(ratio, self.forecast.weight), 1.0)


def folds(stack: Stack, seed: int) -> Indices:
    """(M,) the part of the drive in which each row of the stack is held out: whole segments, in
    stretches of the drive.

    Stretches of a short drive are shorter: there are HELD_OUT_FOLDS parts, as far as there are
    segments, and at least two. Segments along one track are held out together. Raises DataError for
    a drive of one segment.
    """
    lengths = stack.sums(stack.steps)
    length = min(HELD_OUT_LENGTH_M, lengths.sum() / HELD_OUT_FOLDS)
    # The middles of the first and the last segment are at least half the drive apart.
    middles = np.cumsum(lengths) - lengths / 2
    stretch = np.floor(middles / max(length, 1e-9)).astype(int)[stack.track]
    names, number = np.unique(stretch, return_inverse=True)
    if len(names) < 2:
        raise DataError(
            f'{lengths.sum():.1f} m of odometry with images leave nothing to check a map with: '
            'drive farther'
        )
    order = np.random.default_rng(seed).permutation(len(names))
    part = np.empty(len(names), int)
    part[order] = np.arange(len(names)) % min(HELD_OUT_FOLDS, len(names))
    return np.asarray(part[number][stack.owner])


def _parts(fit: MapFit) -> Iterator[Indices]:
    """The rows of each part."""
    part = folds(fit.stack, fit.problem.seed)
    return (np.flatnonzero(part == number) for number in np.unique(part))


def hold_out(fit: MapFit) -> HeldOut:
    """Predict each part of the drive from the others; eq. 1 is solved again without its images.

    The segments of the part keep their odometry, which keeps the frame. Predictions are compared
    with the places by all data.
    """
    stack = fit.stack
    places = fit.places
    errors = np.zeros(len(places), complex)
    variances = np.zeros(len(places))
    for rows in _parts(fit):
        ridge, poses = fit.without(rows)
        others = poses.places(stack)
        expanded = fit.ridge.expanded[rows]
        turn, shift = align_complex(others, places, ridge.weights)
        errors[rows] = places[rows] - (turn * (expanded @ ridge.fitted(others)) + shift)
        by_weights = (ridge.whitened(expanded) ** 2).sum(0)
        variances[rows] = fit.variance * (1.0 / fit.ridge.weights[rows] + by_weights)
    nearest, distances, weight = on_the_ground(fit)
    drive_std = np.sqrt(place_variance(fit))
    forecast = Forecast(plane(places), np.abs(errors), drive_std, weight, distances, nearest)
    spread_m2 = max(float(plane(places).var(0).sum()), 1e-12)
    explained = 1.0 - float(weight @ np.abs(errors) ** 2) / spread_m2
    return HeldOut(errors, variances, forecast, explained)


def evidence(basis: Basis, now: MapFit) -> float:
    """Negative log evidence of a Gaussian process's hyper-parameters, at their best poses.

    Origins have flat priors (restricted likelihood); the signal's variance is profiled out.
    """
    ridge = Ridge.of(basis, now.problem.features)
    noise = float(basis.ridge[0])
    stack = now.stack
    form = now.form(ridge)
    segments = stack.segments
    squares = now.image_variance * cost(form, refined(form, stack, now.graph.poses), stack)
    origins = now.image_variance * form[:segments, :segments].real
    points = len(ridge.expanded)
    freedom = len(ridge.expanded) - segments
    return (
        freedom * float(np.log(squares / noise / freedom))
        + (points - len(basis.ridge) + 1 - segments) * float(np.log(noise))
        - float(np.log(ridge.weights).sum())
        + ridge.log_determinant
        + float(np.linalg.slogdet(origins + np.trace(origins) / segments**2)[1])
    )


def on_the_ground(fit: MapFit) -> tuple[Array, Array, Array]:
    """Distances (M,) m of held-out images to the nearest of the others, those (K,) m of the covered
    ground to the nearest image, and the weights (M,) by which held-out images represent it."""
    places = plane(fit.places)
    seed = fit.problem.seed
    distances = ground_distances(places, np.random.default_rng(seed))
    nearest = nearest_used(places, folds(fit.stack, seed))
    return nearest, distances, importance(nearest, distances)


def held_out_error(basis: Basis, now: MapFit, weight: Array) -> float:
    """Mean error, m, by a weight (M,), of held-out images in a regression to the places of now.

    The evidence would mistake correlated errors of neighbors for low noise.
    """
    ridge = Ridge.of(basis, now.problem.features)
    places = now.places
    return sum(
        float(weight[rows] @ np.abs(places[rows] - predicted))
        for rows in _parts(now)
        for predicted in [ridge.expanded[rows] @ ridge.without(rows).fitted(places)]
    )


def feature_scale(features: Array, stack: Stack, count: int) -> Array:
    """Weight (count,) of each feature in the kernel, larger for slower ones; a unit length is the
    typical distance of two images."""
    chosen = features[:, :count]
    same = stack.owner[1:] == stack.owner[:-1]
    variance = chosen.var(axis=0)
    std = chosen.std(axis=0)
    delta = np.mean(np.diff(chosen, axis=0)[same] ** 2, axis=0)
    delta = np.maximum(delta / np.where(variance > 0, variance, 1.0), 1e-12)
    weights = delta**-0.25
    weights /= np.sqrt(np.mean(weights**2) * count)
    return np.asarray(weights / np.where(std > 0, std, 1.0))


def choose(problem: MetricProblem, scale: Array | None = None) -> MapFit:
    """The fit of the basis in the settings; a Gaussian process has the length and noise of the best
    evidence or, where a graph gives the places, of the least error of held-out images.

    `scale` (K,) weights the features of a Gaussian process; without it, their slowness does.
    """
    available = problem.features.shape[1]
    asked = problem.config.slow_features
    if problem.config.metric_map == 'monomials':
        count = asked or min(PAPER_FEATURES, available)
        return problem.fit(Monomials.fit(problem.features, count, RIDGE))
    if scale is None:
        scale = feature_scale(problem.features, problem.stack, asked or available)
    # Length and noise, with fewer inducing points.
    scaled = problem.features[:, : len(scale)] * scale
    points = scaled[spread(scaled, min(_SEARCH_POINTS, INDUCING_POINTS))]

    def make(length: float, noise: float) -> Process:
        return Process(scale / length, points / length, noise)

    now = problem.fit(make(*_FIRST_HYPER), None, 3)
    if problem.graph is None:
        length, noise = _searched(lambda *pair: evidence(make(*pair), now))
    else:
        weight = on_the_ground(now)[2]
        length, noise = _searched(lambda *pair: held_out_error(make(*pair), now, weight))
    basis = Process.fit(problem.features, scale / length, noise, INDUCING_POINTS)
    return problem.fit(basis, now)


def _searched(judge: Callable[[float, float], float]) -> tuple[float, float]:
    """Length and noise by coordinate descent in factors of 2, then 1.4."""
    cost = cache(judge)
    best = _FIRST_HYPER
    for factor in (2.0, 1.4):
        while True:
            length, noise = best
            steps = [(length * factor, noise), (length / factor, noise)]
            steps += [(length, noise * factor**2), (length, noise / factor**2)]
            inside = [
                (length, noise)
                for length, noise in steps
                if _BOUNDS[0][0] < length < _BOUNDS[0][1] and _BOUNDS[1][0] < noise < _BOUNDS[1][1]
            ]
            better = min(inside, key=lambda hyper: cost(*hyper))
            if not cost(*better) < cost(*best):
                break
            best = better
    return best
