# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Fit directions, origins and a map of given expansion; noise and weights found on the way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.metric.expansions import Basis
from sfa_localization.metric.quadratic_form import (
    Elimination,
    Links,
    Problem,
    Solution,
    Stack,
    eliminate,
)
from sfa_localization.metric.settings import MetricConfig

Complex = NDArray[np.complex128]

# Odometry's own paths are no better than this, however well a map fits them.
_NOISE_MIN_M = 1e-3
_ROUNDS = 6
# Residuals further apart than this many pictures are taken as independent.
_LAGS = 50
# Student's t with this many degrees of freedom stands for pictures that mislead.
_FREEDOM = 4.0


@dataclass(frozen=True, slots=True)
class Fit:
    """Everything that a drive fixes, for one expansion of the features."""

    basis: Basis
    expanded: Array
    """(M, m)"""
    point_weights: Array
    """(M,) the robust weight of each picture."""
    links: Links
    variance: float
    """Of a picture's residual, m^2 per axis."""
    elimination: Elimination
    solution: Solution
    correlation: float
    """How many pictures count as one beside odometry's links: residuals of neighbours go together,
    and noise of the features, which least squares takes for noise of the place, contracts the map;
    the link weight makes up for that."""
    residuals: Complex
    """(M,) where odometry puts a picture minus where the map does."""
    map_weights: Complex
    """(m,)"""

    @property
    def weights(self) -> Array:
        """(M,) of each picture in the least squares."""
        return self.point_weights / (1.0 + self.basis.missing(self.expanded))


def fit(
    basis: Basis,
    features: Array,
    stack: Stack,
    links: Links,
    config: MetricConfig,
    start: Fit | None = None,
    rounds: int = _ROUNDS,
) -> Fit:
    """Alternate the global solution and the noise it leaves; (M, K) features of the stack."""
    expanded = basis.expand(features)
    missing = 1.0 + basis.missing(expanded)
    trust = np.ones(len(expanded)) if start is None else start.point_weights
    variance = 0.04 if start is None else start.variance
    correlation = config.link_weight if start is None else start.correlation
    links = links if start is None else start.links
    solution = None if start is None else start.solution
    for _ in range(max(rounds, 1)):
        elimination = eliminate(expanded, basis.ridge, trust / missing, stack)
        solution = _solve(elimination, links, stack, variance * correlation, config, solution)
        weights = elimination.weights(solution.coefficients(stack.run))
        residuals = targets(solution, stack) - _product(expanded, weights)
        before = variance
        correlation = config.link_weight * _correlation(residuals, stack)
        variance = _variance(elimination, basis, trust / missing, residuals, stack)
        if config.robust:
            trust = _point_trust(residuals, variance * missing)
            links = _link_trust(links, solution, config)
        if abs(variance - before) < 0.01 * variance:
            break
    assert solution is not None
    return Fit(
        basis,
        expanded,
        trust,
        links,
        variance,
        elimination,
        solution,
        correlation,
        residuals,
        weights,
    )


def _solve(
    elimination: Elimination,
    links: Links,
    stack: Stack,
    variance: float,
    config: MetricConfig,
    before: Solution | None,
) -> Solution:
    problem = Problem(elimination.gram, links, stack.run, variance, config.yaw_bias_std)
    bias = np.zeros(stack.run[-1] + 1) if before is None else before.bias
    return _unmirrored(problem.solve(None if before is None else before.z, bias), links)


def _unmirrored(solution: Solution, links: Links) -> Solution:
    """Where the cost cannot tell the map from its mirror image, let the turns' signs decide."""
    if np.abs(solution.h.imag).max() > 1e-9 * np.abs(solution.h).max():
        return solution
    turned = solution.z[links.at + 1] * np.conj(solution.z[links.at])
    if np.cos(np.angle(turned) - links.turn).sum() >= np.cos(np.angle(turned) + links.turn).sum():
        return solution
    return replace(solution, z=np.conj(solution.z), o=np.conj(solution.o))


def problem_of(fit: Fit, stack: Stack) -> Problem:
    """The quadratic form that a fit minimizes, at its biases."""
    variance = fit.variance * fit.correlation
    return Problem(fit.elimination.gram, fit.links, stack.run, variance, 0.0)


def _product(expanded: Array, weights: Complex) -> Complex:
    return np.asarray(expanded @ weights.real + 1j * (expanded @ weights.imag))


def targets(solution: Solution, stack: Stack) -> Complex:
    """Where the segments put the pictures (M,)."""
    path = stack.corrected(solution.bias)
    return np.asarray(solution.o[stack.owner] + solution.z[stack.owner] * path)


def _variance(
    elimination: Elimination, basis: Basis, weights: Array, residuals: Complex, stack: Stack
) -> float:
    """Of a residual per axis, corrected for the freedom of map, origins and directions."""
    inverse = scipy.linalg.solve_triangular(
        elimination.factor, np.eye(len(elimination.factor)), lower=True
    )
    used = len(basis.ridge) - float(basis.ridge @ (inverse**2).sum(0))
    freedom = float(len(residuals)) - used - 1.5 * stack.segments
    return residual_variance(residuals * np.sqrt(weights), freedom)


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


def _point_trust(residuals: Complex, variance: Array) -> Array:
    return np.asarray((_FREEDOM + 2.0) / (_FREEDOM + np.abs(residuals) ** 2 / variance))


def _link_trust(links: Links, solution: Solution, config: MetricConfig) -> Links:
    """Weights of Student's t for turns and displacements that contradict the map."""
    own, at = solution.bias[links.run], links.at
    turned = np.angle(solution.z[at + 1] * np.conj(solution.z[at]))
    off = wrap_angle(turned - (links.turn - own * links.turn_time))
    moved = links.displacement - own * links.displacement_drift
    gone = np.abs(solution.o[at + 1] - solution.o[at] - solution.z[at] * moved)
    turn = (_FREEDOM + 1.0) / (_FREEDOM + off**2 / links.turn_variance)
    move = (_FREEDOM + 2.0) / (_FREEDOM + gone**2 / links.displacement_variance)
    return replace(
        links,
        turn_trust=turn * config.use_turns,
        displacement_trust=move * config.use_displacements,
    )
