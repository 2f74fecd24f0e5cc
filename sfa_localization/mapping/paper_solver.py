# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's own solver: momentum descent on eq. 1 to eq. 8, kept as the reference.

Eq. 6 lacks the case of the last line, which has only its second term; here it has that. The
cosine of eq. 5 is the same for a turn and its mirror image; signed turns decide afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.mapping.basis import PAPER_FEATURES, Monomials, monomials
from sfa_localization.mapping.map_fit import MapFit, MetricProblem, residual_variance
from sfa_localization.mapping.ridge import Ridge
from sfa_localization.metric.pose_graph import Graph, form_of, refined
from sfa_localization.metric.stack import SegmentPoses

ITERATIONS = 1000
"""Section 4: the descent ends at about 1000 iterations."""
LEARNING_RATE = 1e-5
"""beta of eq. 7, section 4."""
MOMENTUM = 0.95
"""gamma of eq. 7, section 4."""


@dataclass(frozen=True, slots=True)
class Lines:
    """M points on N lines: regressors (M, J), distances (M,), the line of each, N - 1 turns.

    theta of eq. 1 is one vector (2 N + J,): angles alpha rad, origins o and weights W, x + i y m.
    """

    regressors: Array
    distances: Array
    line: Indices
    turns: Array
    """(N - 1,) rad, NaN where unknown; empty for the cost C without turns."""

    def parts(self, theta: Complex) -> tuple[Array, Complex, Complex]:
        """alpha (N,), o (N,) and W (J,) of theta."""
        lines = (len(theta) - self.regressors.shape[1]) // 2
        return theta[:lines].real, theta[lines : 2 * lines], theta[2 * lines :]

    def cost(self, theta: Complex) -> float:
        """C of eq. 1, or C' of eq. 5 when there are turns."""
        cost = float((np.abs(self._misfit(theta)) ** 2).sum())
        if len(self.turns):
            cost += float(np.nansum(self._turn_misfit(theta) ** 2))
        return 0.5 * cost

    def gradient(self, theta: Complex) -> Complex:
        """By alpha: eq. 2, or eq. 6 with turns; by o: eq. 3; by W: eq. 4."""
        alpha = self.parts(theta)[0]
        misfit = self._misfit(theta)
        lever = self.distances * np.imag(np.exp(-1j * alpha)[self.line] * misfit)
        by_alpha, by_x, by_y = (
            np.asarray(np.bincount(self.line, pull, len(alpha)), float)
            for pull in (lever, misfit.real, misfit.imag)
        )
        if len(self.turns):
            pull = -np.sin(alpha[:-1] - alpha[1:]) * self._turn_misfit(theta)
            by_alpha = by_alpha + np.diff(np.nan_to_num(pull), prepend=0.0, append=0.0)
        return np.concatenate([by_alpha, by_x + 1j * by_y, -self.regressors.T @ misfit])

    def _misfit(self, theta: Complex) -> Complex:
        """The vectors inside the norm of eq. 1, (M,)."""
        alpha, origins, weights = self.parts(theta)
        placed = origins[self.line] + self.distances * np.exp(1j * alpha)[self.line]
        return np.asarray(placed - self.regressors @ weights)

    def _turn_misfit(self, theta: Complex) -> Array:
        """The terms inside the second square of eq. 5, (N - 1,)."""
        alpha, _, _ = self.parts(theta)
        return np.asarray(np.cos(alpha[:-1] - alpha[1:]) - np.cos(self.turns))


def descend(
    lines: Lines,
    start: Complex,
    iterations: int = ITERATIONS,
    learning_rate: float = LEARNING_RATE,
    momentum: float = MOMENTUM,
) -> tuple[Complex, Array]:
    """Momentum descent.

    By eq. 7, v_t = gamma v_{t-1} + beta dC/dtheta, and eq. 8, theta_t = theta_{t-1} - v_t.

    Returns theta and the cost (I,) before each iteration and after the last. Raises DataError when
    the descent diverges.
    """
    theta = start
    velocity = np.zeros_like(start)
    history = [lines.cost(start)]
    for _ in range(iterations):
        velocity = momentum * velocity + learning_rate * lines.gradient(theta)
        theta = theta - velocity
        history.append(lines.cost(theta))
        if not np.isfinite(history[-1]):
            raise DataError("the paper's descent diverges on this drive: set solver: certified")
    return theta, np.array(history)


def odometry_start(lines: Lines, starts: Array) -> Complex:
    """The paper's start on the robot: lines (N, 3) of odometry, weights regressed on them."""
    origins = starts[:, 0] + 1j * starts[:, 1]
    alpha = starts[:, 2]
    placed = origins[lines.line] + lines.distances * np.exp(1j * alpha)[lines.line]
    weights = np.linalg.lstsq(lines.regressors, placed, rcond=None)[0]
    return np.concatenate([alpha, origins, weights])


def mirrored(lines: Lines, theta: Complex) -> Complex:
    """theta of the mirror image, which costs the same."""
    alpha, origins, weights = lines.parts(theta)
    return np.concatenate([-alpha, origins.conj(), weights.conj()])


def learn(problem: MetricProblem) -> MapFit:
    """The fit of the descent from odometry.

    Raises DataError when the segments are not straight lines, as the paper's costs assume.
    """
    stack = problem.stack
    links = problem.links
    if np.any(stack.path.imag):
        raise DataError('the paper solver needs straight lines: set segments: straight')
    count = min(problem.config.slow_features or PAPER_FEATURES, problem.features.shape[1])
    regressors = monomials(problem.features[:, :count])
    turns = np.full(stack.segments - 1, np.nan)
    turns[links.at] = links.turn_rad
    lines = Lines(regressors, stack.path.real, stack.owner, turns)
    theta, _ = descend(lines, odometry_start(lines, stack.starts))
    step = np.diff(lines.parts(theta)[0])
    # The cosines of eq. 5 do not tell a turn from its mirror image.
    if np.nansum(np.cos(step - turns)) < np.nansum(np.cos(-step - turns)):
        theta = mirrored(lines, theta)
    return _fit(lines, theta, count, problem)


def _fit(lines: Lines, theta: Complex, count: int, problem: MetricProblem) -> MapFit:
    """The result of the descent as a fit, with the certificate of the minimum that is near."""
    stack = problem.stack
    terms = lines.regressors.shape[1]
    basis = Monomials(np.zeros(terms - 1), np.eye(terms - 1), np.zeros(terms), count)
    ridge = Ridge.of(basis, problem.features)
    alpha, origins, weights = lines.parts(theta)
    weights = np.roll(weights, -1)
    poses = SegmentPoses(np.exp(1j * alpha), origins, np.zeros(stack.period[-1] + 1))
    residuals = poses.places(stack) - ridge.expanded @ weights
    variance = residual_variance(residuals, ridge.freedom - 1.5 * stack.segments)
    form = form_of(problem.links.ties(stack), stack) + ridge.gram(stack) / variance
    graph = replace(Graph.at(form, stack, refined(form, stack, poses)), poses=poses)
    return MapFit(problem, ridge, graph, problem.links, variance, residuals, weights, variance)
