# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Fit a map for one basis: a regression to known places, or the places with it from eq. 1.

Then solution and noise are found in turn, because odometry's links are weighted against the images:

    expand      slow features to phi(s)                          basis.py
    eliminate   the map's weights from eq. 1                quadratic_form.py
    solve       directions, origins and biases, certified        quadratic_form.py, phases.py
    noise       variance and correlation of the residuals        here
    links       variances of odometry's links                    links.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.metric.basis import Basis
from sfa_localization.metric.links import Links
from sfa_localization.metric.phases import Certificate, certify
from sfa_localization.metric.pose_graph import Graph
from sfa_localization.metric.quadratic_form import QuadraticForm, Ridge
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.settings import MetricConfig
from sfa_localization.metric.stack import Solution, Stack

LINK_WEIGHT = 2.0
"""Weight of odometry's links over that by their variances: noise of the features, which least
squares takes for noise of the place, contracts the map, and the links counteract that."""
# m^2 per axis: a start that the first round replaces.
_FIRST_VARIANCE = 0.04
# Odometry's own paths are no better than this, however well a map fits them.
_NOISE_MIN_M = 1e-3
# The variance settles to _SETTLED, its relative change, in two or three rounds; those of noisy
# links, which matter less, in some more.
_ROUNDS = 8
_SETTLED, _LINKS_SETTLED = 0.01, 0.05
# Residuals further apart than this many images are taken as independent.
_LAGS = 50


@dataclass(frozen=True, slots=True)
class MetricProblem:
    """Everything that metric learning is given: it holds the data, `fit` solves for one basis."""

    features: Array
    """(M, K) slow features of the images of the segments."""
    segments: Segments
    stack: Stack
    links: Links
    config: MetricConfig
    seed: int = 0
    """Of the parts that are left out, and of the points that the forecast draws."""
    graph: Graph | None = None
    """Its solution, where closures or points tie the drive: they know more of it than features."""

    @classmethod
    def of(
        cls, features: Array, segments: Segments, config: MetricConfig, seed: int = 0
    ) -> MetricProblem:
        """From features (N, K) of all images. Raises DataError when they are unusable."""
        stack = Stack.of(segments)
        rows = _checked_rows(np.asarray(features, float), stack, config)
        return cls(rows, segments, stack, Links.of(segments), config, seed)

    def fit(self, basis: Basis, start: MapFit | None = None, rounds: int = _ROUNDS) -> MapFit:
        """The map of a basis: a regression to the places of the graph, where there is one, else
        found with these from eq. 1; a near `start` saves rounds."""
        ridge = Ridge.of(basis, self.features)
        if self.graph is None:
            return _alternated(self, ridge, start, rounds)
        return MapFit.of(self, ridge, self.graph.solution, ridge.freedom)


@dataclass(frozen=True, slots=True)
class MapFit:
    """A problem solved for one basis."""

    problem: MetricProblem
    ridge: Ridge
    solution: Solution
    variance: float
    """Of an image's residual, m^2 per axis, over its weight."""
    residuals: Complex
    """(M,) where odometry puts an image minus where the map does, meters."""
    map_weights: Complex
    """(m,)"""
    links: Links
    """With the variances that the solution shows, see links.py."""
    correlation: float = 1.0
    """How many images count as one beside odometry's links, because residuals of neighbors are
    correlated; times LINK_WEIGHT."""

    @classmethod
    def of(cls, problem: MetricProblem, ridge: Ridge, solution: Solution, freedom: float) -> MapFit:
        """The map of a solution, which leaves residuals with so many degrees of freedom."""
        places = solution.places(problem.stack)
        weights = ridge.fitted(places)
        residuals = np.asarray(places - ridge.expanded @ weights)
        variance = residual_variance(residuals * np.sqrt(ridge.weights), freedom)
        return cls(problem, ridge, solution, variance, residuals, weights, problem.links)

    @property
    def stack(self) -> Stack:
        return self.problem.stack

    @property
    def places(self) -> Complex:
        """Where the segments put the images (M,), meters."""
        return self.solution.places(self.stack)

    @property
    def link_variance(self) -> float:
        """Variance of a position against which odometry's links are weighted, m^2."""
        return self.variance * self.correlation

    @property
    def certificate(self) -> Certificate:
        """Of the directions."""
        graph, solution = self.problem.graph, self.solution
        return graph.certificate if graph else certify(solution.h, solution.z)

    def form(self, ridge: Ridge) -> QuadraticForm:
        """The quadratic form of another regression, with this noise."""
        gram = ridge.gram(self.stack)
        return QuadraticForm.of(gram, self.links, self.stack, self.link_variance)

    def without(self, rows: Indices) -> tuple[Ridge, Solution]:
        """The regression without some images, and the solution, which the graph's does not need
        them for; with this noise and these biases."""
        ridge, now = self.ridge.without(rows), self.solution
        return ridge, now if self.problem.graph else self.form(ridge).solved(now.z, now.bias)


def _alternated(problem: MetricProblem, ridge: Ridge, start: MapFit | None, rounds: int) -> MapFit:
    """Alternate solution and noise until the noise settles."""
    stack, gram = problem.stack, ridge.gram(problem.stack)
    bias: Array = start.solution.bias if start else np.zeros(stack.period[-1] + 1)
    z = start.solution.z if start else None
    links = start.links if start else problem.links
    variance = start.variance if start else _FIRST_VARIANCE
    correlation = start.correlation if start else LINK_WEIGHT
    freedom = ridge.freedom - 1.5 * stack.segments
    for _ in range(rounds):
        form = QuadraticForm.of(gram, links, stack, variance * correlation)
        solution = form.with_biases(z, bias)
        z, bias = solution.z, solution.bias
        fit = MapFit.of(problem, ridge, solution, freedom)
        correlation = LINK_WEIGHT * _correlation(fit.residuals, stack)
        found = problem.links.learned(links, stack, solution, *form.unknown_links(solution, links))
        steady = found.alike(links, _LINKS_SETTLED)
        steady &= abs(fit.variance - variance) < _SETTLED * fit.variance
        links, variance = found, fit.variance
        if steady:
            break
    return replace(fit, links=links, correlation=correlation)


def _checked_rows(features: Array, stack: Stack, config: MetricConfig) -> Array:
    """The features (M, K) of the stack's images."""
    if features.ndim != 2 or len(features) <= stack.images.max():
        raise DataError(
            f'slow features of shape {features.shape} for images up to {stack.images.max()}: '
            'one row per image is needed'
        )
    rows = features[stack.images]
    bad = int((~np.isfinite(rows)).any(1).sum())
    if bad:
        raise DataError(f'slow features of {bad} images are not finite: train the network again')
    if np.all(rows.std(0) < 1e-9):
        raise DataError('the slow features are constant: the images of the run do not differ')
    if config.slow_features > features.shape[1]:
        raise DataError(
            f'slow_features is {config.slow_features}, but there are only {features.shape[1]}'
        )
    return rows


def residual_variance(residuals: Complex, freedom: float) -> float:
    """Variance per axis of complex residuals (M,) with so many degrees of freedom left."""
    squared = float((np.abs(residuals) ** 2).sum())
    return max(squared / (2.0 * max(freedom, 0.1 * len(residuals))), _NOISE_MIN_M**2)


def _correlation(residuals: Complex, stack: Stack) -> float:
    """Integrated autocorrelation of the residuals along the segments, at least 1."""
    power = float(np.mean(np.abs(residuals) ** 2))
    total = 1.0
    for lag in range(1, _LAGS):
        same = stack.owner[lag:] == stack.owner[:-lag]
        if power == 0.0 or same.sum() < 10:
            break
        product = np.real(np.conj(residuals[lag:][same]) * residuals[:-lag][same])
        if float(product.mean()) <= 0.0:
            break
        total += 2.0 * float(product.mean()) / power
    return total
