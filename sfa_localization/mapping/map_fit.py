# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Fit a map for one basis: a regression to the places of a pose graph, or both together by eq. 1.

For the latter, poses and noise are estimated in turn, because eq. 1 is weighted against odometry:

    expand      slow features to phi(s)                            basis.py
    eliminate   the map's weights from eq. 1                       ridge.py
    solve       directions, origins and biases, certified          pose_graph.py
    noise       variance and correlation of the residuals          here
    links       variances of odometry's links                      links.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.mapping.basis import Basis
from sfa_localization.mapping.ridge import Ridge
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.metric.links import Links
from sfa_localization.metric.pose_graph import Graph, form_of, refined
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.stack import SegmentPoses, Stack

LINK_WEIGHT = 2.0
"""Factor on the weight of the odometry's links. Noise of the features contracts the map; heavier
links counteract that."""
# m^2 per axis: a start that the first round replaces.
_FIRST_VARIANCE = 0.04
# Least standard deviation of odometry paths.
_NOISE_MIN_M = 1e-3
# Rounds, and the relative change of the variance of images that ends them.
_ROUNDS = 8
_SETTLED = 0.01
# Residuals so many images apart are taken as independent.
_LAGS = 50


@dataclass(frozen=True, slots=True)
class MetricProblem:
    """Everything that metric learning is given."""

    features: Array
    """(M, K) slow features of the images of the segments."""
    segments: Segments
    stack: Stack
    links: Links
    config: MetricConfig
    seed: int = 0
    """Seed of the left-out parts, and of the points of the forecast."""
    graph: Graph | None = None
    """Without features, where offsets or points tie the drive better than features do."""

    @classmethod
    def of(
        cls, features: Array, segments: Segments, config: MetricConfig, seed: int = 0
    ) -> MetricProblem:
        """From features (N, K) of all images. Raises DataError when they are unusable."""
        stack = Stack.of(segments)
        rows = _checked_rows(np.asarray(features, float), stack, config)
        return cls(rows, segments, stack, Links.of(segments), config, seed)

    def fit(self, basis: Basis, start: MapFit | None = None, rounds: int = _ROUNDS) -> MapFit:
        """The map of a basis; by eq. 1 a near `start` saves rounds."""
        ridge = Ridge.of(basis, self.features)
        if self.graph is not None:
            return MapFit.of(self, ridge, self.graph, self.links, 0.0, ridge.freedom)
        return _alternated(self, ridge, start, rounds)


@dataclass(frozen=True, slots=True)
class MapFit:
    """A problem solved for one basis."""

    problem: MetricProblem
    ridge: Ridge
    graph: Graph
    links: Links
    """With the variances of the last round."""
    image_variance: float
    """m^2: divisor of eq. 1: `variance`, times the number of correlated images that count as one,
    times LINK_WEIGHT."""
    residuals: Complex
    """(M,) where the segments put an image minus where the map does, meters."""
    map_weights: Complex
    """(m,)"""
    variance: float
    """Of an image's residual, m^2 per axis, over its weight."""

    @classmethod
    def of(
        cls,
        problem: MetricProblem,
        ridge: Ridge,
        graph: Graph,
        links: Links,
        image_variance: float,
        freedom: float,
    ) -> MapFit:
        """The map of the places of a graph, whose residuals have so many degrees of freedom."""
        places = graph.poses.places(problem.stack)
        weights = ridge.fitted(places)
        residuals = np.asarray(places - ridge.expanded @ weights)
        variance = residual_variance(residuals * np.sqrt(ridge.weights), freedom)
        return cls(problem, ridge, graph, links, image_variance, residuals, weights, variance)

    @property
    def stack(self) -> Stack:
        return self.problem.stack

    @property
    def places(self) -> Complex:
        """Where the segments put the images (M,), meters."""
        return self.graph.poses.places(self.stack)

    def form(self, ridge: Ridge) -> Any:
        """The form of odometry and eq. 1 with another regression, and this noise."""
        return _form(self.stack, self.links, ridge.gram(self.stack), self.image_variance)

    def without(self, rows: Indices) -> tuple[Ridge, SegmentPoses]:
        """The fit without some images: its regression and its poses."""
        ridge = self.ridge.without(rows)
        if self.problem.graph is not None:
            return ridge, self.graph.poses
        return ridge, refined(self.form(ridge), self.stack, self.graph.poses)


def _form(stack: Stack, links: Links, gram: Complex, image_variance: float) -> Any:
    return form_of(links.ties(stack), stack) + gram / image_variance


def _alternated(problem: MetricProblem, ridge: Ridge, start: MapFit | None, rounds: int) -> MapFit:
    """Estimate poses and noise in turn until the noise settles."""
    stack = problem.stack
    gram = ridge.gram(problem.stack)
    poses = start.graph.poses if start else None
    links = start.links if start else problem.links
    variance = start.variance if start else _FIRST_VARIANCE
    image_variance = start.image_variance if start else LINK_WEIGHT * _FIRST_VARIANCE
    freedom = ridge.freedom - 1.5 * stack.segments
    for _ in range(rounds):
        graph = Graph.solved(_form(stack, links, gram, image_variance), stack, poses)
        fit = MapFit.of(problem, ridge, graph, links, image_variance, freedom)
        poses = graph.poses
        links = graph.learned(problem.links, links)
        steady = abs(fit.variance - variance) < _SETTLED * fit.variance
        variance = fit.variance
        image_variance = LINK_WEIGHT * variance * _correlation(fit.residuals, stack)
        if steady:
            break
    return replace(fit, links=links, image_variance=image_variance)


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
