# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Unsupervised metric learning as a quadratic form in the segments' directions.

Picture m of segment n lies at o_n + z_n q_nm, and the map says Phi w. Least squares over the
weights w and then over the origins o leaves z^H H z: the complex form of the paper's equation 1,
with signed turns and odometry's displacements between segments as further squares.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.metric.phases import Certificate, refine, synchronize
from sfa_localization.metric.segments import Segments

Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]

_BIAS_STEPS = 8


@dataclass(frozen=True, slots=True)
class Stack:
    """The pictures of all N segments, one after the other: M rows."""

    images: Indices
    owner: Indices
    path: Complex
    drift: Complex
    headings: Array
    first: Indices
    """(N,) row of each segment's first picture."""
    run: Indices
    """(N,) run of each segment."""
    starts: Array
    """(N, 3) odometry poses of the segments' frames."""

    @classmethod
    def of(cls, segments: Segments) -> Stack:
        sizes = [len(s.images) for s in segments]
        return cls(
            np.concatenate([s.images for s in segments]),
            np.repeat(np.arange(len(sizes)), sizes),
            np.concatenate([s.path for s in segments]),
            np.concatenate([s.path_drift for s in segments]),
            np.concatenate([s.headings for s in segments]),
            np.concatenate([[0], np.cumsum(sizes)[:-1]]),
            np.array([s.run for s in segments]),
            np.array([s.start for s in segments]),
        )

    @property
    def segments(self) -> int:
        return len(self.first)

    def corrected(self, bias: Array) -> Complex:
        """Paths (M,) without the yaw-rate bias of each run (R,)."""
        return np.asarray(self.path - bias[self.run[self.owner]] * self.drift)

    def sums(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Sum (N, ...) of the rows (M, ...) of each segment."""
        return np.asarray(np.add.reduceat(rows, self.first, axis=0))


@dataclass(frozen=True, slots=True)
class Links:
    """What odometry says from one segment to the next: L measured turns and displacements."""

    at: Indices
    run: Indices
    turn: Array
    turn_variance: Array
    turn_time: Array
    displacement: Complex
    displacement_variance: Array
    displacement_drift: Complex
    turn_trust: Array
    displacement_trust: Array

    @classmethod
    def of(cls, segments: Segments, turns: bool, displacements: bool) -> Links:
        """All that are known; trust 0 where not to be used."""
        items = [(n, s) for n, s in enumerate(segments.items[:-1]) if s.linked]
        column: list[Any] = [np.array([getattr(s, name) for _, s in items]) for name in _MEASURED]
        at = np.array([n for n, _ in items], np.int64)
        run = np.array([s.run for _, s in items], np.int64)
        trust = [np.full(len(at), float(used)) for used in (turns, displacements)]
        return cls(at, run, *column, *trust)

    def trusted(self, turn: Array, displacement: Array) -> Links:
        """The same links with other weights (L,)."""
        return replace(self, turn_trust=turn, displacement_trust=displacement)


_MEASURED = (
    'turn_rad',
    'turn_variance',
    'turn_time_s',
    'displacement',
    'displacement_variance',
    'displacement_drift',
)


@dataclass(frozen=True, slots=True)
class Elimination:
    """Least squares over the map's weights: what is left of the features.

    `gram` (3N, 3N) is the quadratic form in [o, z, -b z]; the weights are
    w = F^-1 cross [o, z, -b z] with F = factor factor^T.
    """

    gram: Complex
    factor: Array
    cross: Complex

    def weights(self, coefficients: Complex) -> Complex:
        """The map's weights (m, ...) for [o, z, -b z] (3N, ...)."""
        return np.asarray(_solve(self.factor, self.cross @ coefficients))

    def leverage(self, expanded: Array) -> Array:
        """phi^T F^-1 phi (M,) of expanded features (M, m)."""
        return np.asarray((self.halved(expanded) ** 2).sum(0))

    def halved(self, expanded: Array) -> Array:
        """factor^-1 phi (m, M) of expanded features (M, m)."""
        return np.asarray(scipy.linalg.solve_triangular(self.factor, expanded.T, lower=True))

    @property
    def log_determinant(self) -> float:
        """Of F."""
        return 2.0 * float(np.log(np.diag(self.factor)).sum())


def eliminate(expanded: Array, ridge: Array, weights: Array, stack: Stack) -> Elimination:
    """Eliminate the map from features expanded to (M, m), each picture with a weight (M,)."""
    weighted = expanded * weights[:, None]
    normal = weighted.T @ expanded
    normal[np.diag_indices_from(normal)] += ridge
    factor = _cholesky(normal)
    columns = np.column_stack([np.ones(len(weights)), stack.path, stack.drift])
    cross = np.vstack([_products(weighted, column, stack) for column in columns.T]).T
    half = _halve(factor, cross)
    gram = _moments(columns, weights, stack) - half.conj().T @ half
    return Elimination((gram + gram.conj().T) / 2, factor, cross)


def _cholesky(matrix: Array) -> Array:
    """Lower factor; what nothing holds is held weakly, and only then."""
    try:
        return np.asarray(scipy.linalg.cholesky(matrix, lower=True))
    except np.linalg.LinAlgError:
        held = matrix + 1e-12 * max(np.trace(matrix), 1e-300) / len(matrix) * np.eye(len(matrix))
        return np.asarray(scipy.linalg.cholesky(held, lower=True))


def _products(weighted: Array, column: Complex, stack: Stack) -> Complex:
    """Sums (N, m) of rows times a complex column, real arithmetic throughout."""
    real = stack.sums(weighted * column.real[:, None])
    if not np.any(column.imag):
        return np.asarray(real, complex)
    return np.asarray(real + 1j * stack.sums(weighted * column.imag[:, None]))


def _moments(columns: Complex, weights: Array, stack: Stack) -> Complex:
    """Block-diagonal second moments (3N, 3N) of [1, path, drift] within each segment."""
    n = stack.segments
    blocks = stack.sums(columns.conj()[:, :, None] * columns[:, None, :] * weights[:, None, None])
    moments = np.zeros((3, n, 3, n), complex)
    at = np.arange(n)
    moments[:, at, :, at] = blocks
    return moments.reshape(3 * n, 3 * n)


def _halve(factor: Array, right: Complex) -> Complex:
    """factor^-1 right, for complex right."""
    both = np.hstack([right.real, right.imag])
    both = scipy.linalg.solve_triangular(factor, both, lower=True, overwrite_b=True)
    n = right.shape[1]
    return np.asarray(both[:, :n] + 1j * both[:, n:])


def _solve(factor: Array, right: Complex) -> Complex:
    real = scipy.linalg.cho_solve((factor, True), right.real)
    return np.asarray(real + 1j * scipy.linalg.cho_solve((factor, True), right.imag))


@dataclass(frozen=True, slots=True)
class Solution:
    """Directions z (N,), origins o (N,), yaw-rate bias (R,) of each run, and their certificate."""

    z: Complex
    o: Complex
    bias: Array
    certificate: Certificate
    h: Complex
    cost: float

    def coefficients(self, run: Indices) -> Complex:
        """[o, z, -b z] (3N,)."""
        return np.concatenate([self.o, self.z, -self.bias[run] * self.z])


@dataclass(frozen=True, slots=True)
class Problem:
    """The features' quadratic form and odometry's links, at a point variance."""

    gram: Complex
    links: Links
    run: Indices
    variance: float
    bias_std: float

    def system(self, bias: Array) -> Complex:
        """The quadratic form (2N, 2N) in [o, z] at the runs' biases (R,)."""
        own = self._tied(self.gram, bias, bias)
        for rows, weight in self._links(bias):
            own = own + rows.conj().T @ (weight[:, None] * rows)
        return np.asarray(own)

    def reduced(self, bias: Array) -> Complex:
        """H (N, N): the quadratic form in z alone."""
        return schur(self.system(bias))[0]

    def _tied(self, gram: Complex, left: Array, right: Array) -> Complex:
        """S(left)^T gram S(right), S = [[1, 0], [0, 1], [0, -b]]."""
        n = len(self.run)
        a, b = -left[self.run], -right[self.run]
        tied = gram[:, : 2 * n].copy()
        tied[:, n:] += gram[:, 2 * n :] * b
        own = tied[: 2 * n]
        own[n:] += a[:, None] * tied[2 * n :]
        return np.asarray(own)

    def _links(self, bias: Array) -> list[tuple[Complex, Array]]:
        """Rows (L, 2N) whose weighted squares are the turns' and the displacements' costs."""
        links, n, at = self.links, len(self.run), np.arange(len(self.links.at))
        turns, moves = np.zeros((2, len(at), 2 * n), complex)
        own = bias[links.run]
        turns[at, n + links.at + 1] = 1.0
        turns[at, n + links.at] = -np.exp(1j * (links.turn - own * links.turn_time))
        moves[at, links.at + 1] = 1.0
        moves[at, links.at] = -1.0
        moves[at, n + links.at] = -(links.displacement - own * links.displacement_drift)
        turn_weight = self.variance * links.turn_trust / links.turn_variance
        move_weight = self.variance * links.displacement_trust / links.displacement_variance
        return [(turns, turn_weight), (moves, move_weight)]

    def slope(self, bias: Array, x: Complex) -> Array:
        """Derivative (R,) of the cost by each bias at [o, z] = x (2N,)."""
        links, n = self.links, len(self.run)
        z = x[n:]
        right = self.gram[2 * n :] @ np.concatenate([x, -bias[self.run] * z])
        own = np.bincount(self.run, np.real(-np.conj(z) * right), len(bias))
        (turns, turn_weight), (moves, move_weight) = self._links(bias)
        turned = -1j * links.turn_time * turns[np.arange(len(links.at)), n + links.at]
        for change, rows, weight in (
            (turned, turns, turn_weight),
            (links.displacement_drift, moves, move_weight),
        ):
            pull = np.real(np.conj(change * z[links.at]) * (rows @ x)) * weight
            own += np.bincount(links.run, pull, len(bias))
        return np.asarray(own + self.variance * bias / self.bias_std**2)

    def solve(self, start: Complex | None, bias: Array) -> Solution:
        """The best directions, origins and biases; from `start` (N,), or from everywhere."""
        h, origins = schur(self.system(bias))
        z = refine(h, start) if start is not None else synchronize(h)[0]
        if self.bias_std > 0:
            bias, z = self._debias(bias, z)
            h, origins = schur(self.system(bias))
        z, certificate = synchronize(h, [z])
        cost = float(np.real(np.vdot(z, h @ z))) / 2
        return Solution(z, origins @ z, bias, certificate, h, cost)

    def _settle(self, bias: Array, z: Complex) -> tuple[Complex, Array]:
        """Directions at given biases, and the slope of the cost by the biases."""
        h, origins = schur(self.system(bias))
        z = refine(h, z)
        return z, self.slope(bias, np.concatenate([origins @ z, z]))

    def _debias(self, bias: Array, z: Complex) -> tuple[Array, Complex]:
        """Newton on the biases, with the directions following (the envelope's slope is exact)."""
        runs, small = len(bias), 1e-5
        z, slope = self._settle(bias, z)
        columns = [self._settle(bias + small * unit, z)[1] - slope for unit in np.eye(runs)]
        curvature = np.column_stack(columns) / small
        floor = self.variance / self.bias_std**2 * np.eye(runs)
        curvature = (curvature + curvature.T) / 2
        if np.linalg.eigvalsh(curvature)[0] < floor[0, 0] / 2:
            curvature = floor
        for _ in range(_BIAS_STEPS):
            step = -np.linalg.solve(curvature, slope)
            step = np.clip(step, -self.bias_std, self.bias_std)
            bias = bias + step
            z, slope = self._settle(bias, z)
            if np.abs(step).max() < 1e-9 * self.bias_std:
                break
        return bias, z


def schur(system: Complex) -> tuple[Complex, Complex]:
    """Eliminate the origins: H (N, N), and the origins (N, N) as a linear map of z."""
    n = len(system) // 2
    own = np.real(system[:n, :n]).copy()
    level = max(float(np.trace(own)) / n, 1e-300)
    # Moving everything together costs nothing: pin the mean.
    own += level / n
    origins = -np.asarray(_solve(_cholesky(own), system[:n, n:]))
    h = system[n:, n:] + system[n:, :n] @ origins
    return np.asarray((h + h.conj().T) / 2), origins
