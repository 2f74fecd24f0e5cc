# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Fit a map for one basis: alternate between the global solution and the noise of its residuals.

    expand      slow features to phi(s)                          basis.py
    eliminate   the map's weights from eq. 1                quadratic_form.py
    solve       directions, origins and biases, certified        quadratic_form.py, phases.py
    noise       variance and correlation of the residuals        here
    links       variances of odometry's links                    link_noise.py

The noise matters because odometry's links are weighted against the images.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.metric.basis import Basis, expand, missing
from sfa_localization.metric.link_noise import learned
from sfa_localization.metric.phases import Certificate
from sfa_localization.metric.pose_graph import Graph
from sfa_localization.metric.quadratic_form import (
    YAW_BIAS_STD,
    Elimination,
    Links,
    QuadraticForm,
    Solution,
    Stack,
    eliminate,
)
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.settings import MetricConfig

Complex = NDArray[np.complex128]

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
        """Alternate solution and noise until the noise settles; a near `start` saves rounds.

        With a graph the map is a regression to its places.
        """
        expanded = expand(basis, self.features)
        noise_ratio = 1.0 + missing(basis, expanded)
        solution = start.solution if start else None
        variance = start.variance if start else _FIRST_VARIANCE
        correlation = start.correlation if start else LINK_WEIGHT
        links = start.links if start else self.links
        elimination = self.eliminated(basis, expanded, 1.0 / noise_ratio)
        freedom = _freedom(elimination, basis, len(expanded))
        if self.graph is not None:
            solution = self.graph.solution
            weights, residuals = self.fitted(elimination, expanded, solution)
            variance = residual_variance(residuals * np.sqrt(1.0 / noise_ratio), freedom)
            rounds = 0
        else:
            freedom -= 1.5 * self.stack.segments
        for _ in range(rounds):
            form = self.form(elimination, links, variance * correlation, YAW_BIAS_STD)
            bias = solution.bias if solution else np.zeros(self.stack.period[-1] + 1)
            solution = form.solve(solution.z if solution else None, bias)
            links, links_before = learned(self.links, form, solution), links
            weights, residuals = self.fitted(elimination, expanded, solution)
            before = variance
            correlation = LINK_WEIGHT * _correlation(residuals, self.stack)
            variance = residual_variance(residuals * np.sqrt(1.0 / noise_ratio), freedom)
            steady = links.alike(links_before, _LINKS_SETTLED)
            if steady and abs(variance - before) < _SETTLED * variance:
                break
        assert solution is not None
        return MapFit(
            self, basis, expanded, noise_ratio, variance, correlation, links,
            elimination, solution, residuals, weights,
        )  # fmt: skip

    def eliminated(self, basis: Basis, expanded: Array, weights: Array) -> Elimination:
        """The map eliminated from expanded features (M, m) with weights (M,)."""
        return eliminate(expanded, basis.ridge, weights, self.stack, form=self.graph is None)

    def weights(self, elimination: Elimination, solution: Solution) -> Complex:
        """The map's weights (m,) for a solution."""
        if self.graph is not None:
            places = solution.places(self.stack)
            real, imag = (elimination.weights(part).real for part in (places.real, places.imag))
            return np.asarray(real + 1j * imag)
        return elimination.weights(solution.coefficients(self.stack.period))

    def fitted(
        self, elimination: Elimination, expanded: Array, solution: Solution
    ) -> tuple[Complex, Complex]:
        """The same, and the residuals (M,)."""
        weights = self.weights(elimination, solution)
        predicted = expanded @ weights.real + 1j * (expanded @ weights.imag)
        return weights, np.asarray(solution.places(self.stack) - predicted)

    def form(
        self,
        elimination: Elimination,
        links: Links,
        variance: float,
        bias_std: float,
    ) -> QuadraticForm:
        """The quadratic form of the map and links, for the variance m^2 of a position; with a
        `bias_std` of 0 the biases stay what they are.
        """
        return QuadraticForm(elimination.gram, links, self.stack.period, variance, bias_std)


@dataclass(frozen=True, slots=True)
class MapFit:
    """A problem solved for one basis."""

    problem: MetricProblem
    basis: Basis
    expanded: Array
    """(M, m)"""
    noise_ratio: Array
    """(M,) variance of each residual over `variance`: at least 1, more where inducing points are
    missing."""
    variance: float
    """Of an image's residual, m^2 per axis."""
    correlation: float
    """How many images count as one beside odometry's links, because residuals of neighbors are
    correlated; times LINK_WEIGHT."""
    links: Links
    """With the variances that the solution shows, see link_noise.py."""
    elimination: Elimination
    solution: Solution
    residuals: Complex
    """(M,) where odometry puts an image minus where the map does, meters."""
    map_weights: Complex
    """(m,)"""

    @property
    def stack(self) -> Stack:
        return self.problem.stack

    @property
    def weights(self) -> Array:
        """(M,) of each image in the least squares."""
        return 1.0 / self.noise_ratio

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
        graph = self.problem.graph
        return self.solution.certificate if graph is None else graph.certificate

    def solved(self, elimination: Elimination) -> Solution:
        """The solution after another elimination, with this noise."""
        if self.problem.graph is not None:
            return self.solution
        return self.form(elimination).solve(self.solution.z, self.solution.bias)

    def form(self, elimination: Elimination) -> QuadraticForm:
        """The quadratic form after another elimination, with this noise and these biases."""
        noise = self.links, self.link_variance
        return self.problem.form(elimination, *noise, bias_std=0.0)


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


def _freedom(elimination: Elimination, basis: Basis, count: int) -> float:
    """Degrees of freedom that a map leaves to M residuals."""
    inverse = scipy.linalg.solve_triangular(
        elimination.factor, np.eye(len(elimination.factor)), lower=True
    )
    used = len(basis.ridge) - float(basis.ridge @ (inverse**2).sum(0))
    return count - used


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
