# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's own solver: momentum descent on eq. 1 to eq. 8, kept as the reference.

Eq. 6 lacks the case of the last line, which has only its second term; here it has that. The
cosine of eq. 5 is the same for a turn and its mirror image; signed turns decide afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.metric.basis import PAPER_FEATURES, Monomials, monomials
from sfa_localization.metric.map_fit import MapFit, MetricProblem, residual_variance
from sfa_localization.metric.quadratic_form import Ridge
from sfa_localization.metric.stack import Solution

ITERATIONS = 1000
"""Section 4: the descent ends at about 1000 iterations."""
LEARNING_RATE = 1e-5
"""beta of eq. 7, section 4."""
MOMENTUM = 0.95
"""gamma of eq. 7, section 4."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """theta of eq. 1: alpha (N,) rad, origins o (N, 2) m, weights W (J, 2)."""

    alpha: Array
    origins: Array
    weights: Array

    def flat(self) -> Array:
        """All in one vector (N + 2N + 2J,)."""
        return np.concatenate([self.alpha, self.origins.ravel(), self.weights.ravel()])

    @classmethod
    def of(cls, flat: Array, lines: int) -> Parameters:
        alpha, origins, weights = np.split(flat, [lines, 3 * lines])
        return cls(alpha, origins.reshape(lines, 2), weights.reshape(-1, 2))


@dataclass(frozen=True, slots=True)
class Lines:
    """M points on N lines: regressors (M, J), distances (M,), the line of each, N - 1 turns."""

    regressors: Array
    distances: Array
    line: NDArray[np.int64]
    turns: Array
    """(N - 1,) rad, NaN where unknown; empty for the cost C without turns."""

    def cost(self, theta: Parameters) -> float:
        """C of eq. 1, or C' of eq. 5 when there are turns."""
        cost = 0.5 * float((self._misfit(theta) ** 2).sum())
        if len(self.turns):
            cost += 0.5 * float(np.nansum(self._turn_misfit(theta) ** 2))
        return cost

    def gradient(self, theta: Parameters) -> Parameters:
        """By alpha: eq. 2, or eq. 6 with turns; by o: eq. 3; by W: eq. 4."""
        lines = len(theta.alpha)
        misfit = self._misfit(theta)
        predicted = self.regressors @ theta.weights - theta.origins[self.line]
        sine, cosine = np.sin(theta.alpha)[self.line], np.cos(theta.alpha)[self.line]
        lever = self.distances * (sine * predicted[:, 0] - cosine * predicted[:, 1])
        alpha: Array = np.bincount(self.line, lever, lines).astype(float)
        if len(self.turns):
            alpha = alpha + self._turn_gradient(theta)
        origins: Array = np.zeros((lines, 2))
        np.add.at(origins, self.line, misfit)
        return Parameters(alpha, origins, -self.regressors.T @ misfit)

    def _misfit(self, theta: Parameters) -> Array:
        """The vectors inside the norm of eq. 1, (M, 2)."""
        direction = np.column_stack([np.cos(theta.alpha), np.sin(theta.alpha)])[self.line]
        placed = theta.origins[self.line] + self.distances[:, None] * direction
        return np.asarray(placed - self.regressors @ theta.weights)

    def _turn_misfit(self, theta: Parameters) -> Array:
        """The terms inside the second square of eq. 5, (N - 1,)."""
        return np.asarray(np.cos(theta.alpha[:-1] - theta.alpha[1:]) - np.cos(self.turns))

    def _turn_gradient(self, theta: Parameters) -> Array:
        """What eq. 6 adds to eq. 2, (N,)."""
        step = theta.alpha[:-1] - theta.alpha[1:]
        pull = np.nan_to_num(np.sin(step) * -self._turn_misfit(theta))
        gradient = np.zeros(len(theta.alpha))
        gradient[:-1] += pull
        gradient[1:] -= pull
        return gradient


def descend(
    lines: Lines,
    start: Parameters,
    iterations: int = ITERATIONS,
    learning_rate: float = LEARNING_RATE,
    momentum: float = MOMENTUM,
) -> tuple[Parameters, Array]:
    """Momentum descent.

    By eq. 7, v_t = gamma v_{t-1} + beta dC/dtheta, and eq. 8, theta_t = theta_{t-1} - v_t.

    Returns the parameters and the cost (I,) before each iteration and after the last. Raises
    DataError when the descent diverges.
    """
    count, theta = len(start.alpha), start.flat()
    velocity, history = np.zeros_like(theta), [lines.cost(start)]
    for _ in range(iterations):
        slope = lines.gradient(Parameters.of(theta, count)).flat()
        velocity = momentum * velocity + learning_rate * slope
        theta = theta - velocity
        history.append(lines.cost(Parameters.of(theta, count)))
        if not np.isfinite(history[-1]):
            raise DataError("the paper's descent diverges on this drive: set solver: certified")
    return Parameters.of(theta, count), np.array(history)


def odometry_start(lines: Lines, starts: Array) -> Parameters:
    """The paper's start on the robot: lines (N, 3) of odometry, weights regressed on them."""
    alpha, origins = starts[:, 2], starts[:, :2]
    direction = np.column_stack([np.cos(alpha), np.sin(alpha)])[lines.line]
    placed = origins[lines.line] + lines.distances[:, None] * direction
    weights = np.linalg.lstsq(lines.regressors, placed, rcond=None)[0]
    return Parameters(np.array(alpha), np.array(origins), weights)


def learn(problem: MetricProblem) -> MapFit:
    """The fit of the descent from odometry.

    Raises DataError when the segments are not straight lines, as the paper's costs assume.
    """
    stack, links = problem.stack, problem.links
    if np.any(stack.path.imag):
        raise DataError('the paper solver needs straight lines: set segments: straight')
    count = min(problem.config.slow_features or PAPER_FEATURES, problem.features.shape[1])
    regressors = monomials(problem.features[:, :count])
    turns = np.full(stack.segments - 1, np.nan)
    turns[links.at] = links.turn_rad
    lines = Lines(regressors, stack.path.real, stack.owner, turns)
    theta, _ = descend(lines, odometry_start(lines, stack.starts))
    if _mirrored(theta.alpha, turns):
        theta = Parameters(-theta.alpha, theta.origins * [1, -1], theta.weights * [1, -1])
    return _fit(theta, regressors, count, problem)


def _mirrored(alpha: Array, turns: Array) -> bool:
    """Whether the signed turns (N - 1,) fit the mirror image better: no cosine can decide."""
    step = np.diff(alpha)
    return bool(np.nansum(np.cos(step - turns)) < np.nansum(np.cos(-step - turns)))


def _fit(theta: Parameters, regressors: Array, count: int, problem: MetricProblem) -> MapFit:
    """The result of the descent as a fit."""
    stack, terms = problem.stack, regressors.shape[1]
    basis = Monomials(np.zeros(terms - 1), np.eye(terms - 1), np.zeros(terms), count)
    ridge, bias = Ridge.of(basis, problem.features), np.zeros(stack.period[-1] + 1)
    weights = np.roll(theta.weights, -1, axis=0) @ np.array([1.0, 1.0j])
    solution = Solution(np.exp(1j * theta.alpha), theta.origins @ np.array([1.0, 1.0j]), bias)
    residuals = solution.places(stack) - ridge.expanded @ weights
    variance = residual_variance(residuals, ridge.freedom - 1.5 * stack.segments)
    fit = MapFit(problem, ridge, solution, variance, residuals, weights, problem.links)
    return replace(fit, solution=replace(solution, h=fit.form(ridge).at(bias)))
