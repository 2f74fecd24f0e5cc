# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Unsupervised metric learning as a quadratic form in the directions of the segments.

With p = x + i y in meters and z_n = exp(i alpha_n), eq. 1 of the paper reads

    2 C = sum_n sum_m |o_n + z_n q_nm - phi(s_nm)^T w|^2,

where q_nm = d_nm on a straight line; on a curved segment it is the odometry's path. This is the
only square that reads the features. `eliminate` minimizes it over the map's weights w, which
leaves `Elimination.gram`, a quadratic form in [o, z, -b z]: the paths are corrected for the
yaw-rate bias b of each period, q_nm - b drift_nm. `QuadraticForm` adds what odometry measured from
one segment to the next, each square weighted by `variance`, that of an image's position, over its
own:

    |z_{n+1} - exp(i turn_n) z_n|^2               signed turns: the second sum of eq. 5, which
                                                  has only cosines, the same for left and right
    |o_{n+1} - o_n - z_n displacement_n|^2        displacements: not in the paper
    b^2                                           prior of the biases: not in the paper

`schur` minimizes over the origins o. What remains is z^H H z with |z_n| = 1, see phases.py. Where
eq. 2 to eq. 4 are zero, w and o are those of `Elimination.weights` and `schur`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.metric.phases import Certificate, certify, refine, synchronize
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.shared_tracks import tracks

Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]

YAW_BIAS_STD = 0.003
"""rad/s: the yaw-rate bias to expect of odometry or a gyroscope, estimated per period."""
# Newton steps on the biases: their cost is nearly quadratic, so that three are usual.
_BIAS_STEPS = 8
# rad/s: of the numerical derivative by the biases, far below any bias that matters.
_BIAS_DIFFERENCE = 1e-5


@dataclass(frozen=True, slots=True)
class Stack:
    """The images of all N segments, one after the other: M rows."""

    images: Indices
    """(M,) indices of the images among all of the drives."""
    owner: Indices
    """(M,) segment of each row."""
    path: Complex
    """(M,) q: places in the frame of the segment, meters."""
    drift: Complex
    """(M,) meters per rad/s that a yaw-rate bias adds to `path`."""
    headings: Array
    """(M,) rad in the frame of the segment."""
    times_s: Array
    """(M,) seconds since the reference heading of the segment: drift of `headings`."""
    first: Indices
    """(N,) row of each segment's first image."""
    period: Indices
    """(N,) period of each segment, in which the yaw-rate bias is constant."""
    starts: Array
    """(N, 3) odometry poses of the segments' frames."""
    track: Indices
    """(N,) the first segment along the same track: see shared_tracks.py."""

    @classmethod
    def of(cls, segments: Segments) -> Stack:
        sizes = [len(s.images) for s in segments]
        return cls(
            np.concatenate([s.images for s in segments]),
            np.repeat(np.arange(len(sizes)), sizes),
            np.concatenate([s.path for s in segments]),
            np.concatenate([s.path_drift for s in segments]),
            np.concatenate([s.headings for s in segments]),
            np.concatenate([s.times_s for s in segments]),
            np.concatenate([[0], np.cumsum(sizes)[:-1]]),
            np.array([s.period for s in segments]),
            np.array([s.start for s in segments]),
            tracks(segments),
        )

    @property
    def segments(self) -> int:
        return len(self.first)

    def corrected(self, bias: Array) -> Complex:
        """Paths (M,) without the yaw-rate bias of each period (R,)."""
        return np.asarray(self.path - bias[self.period[self.owner]] * self.drift)

    def yaws(self, angles: Array, bias: Array) -> Array:
        """Headings (M,) rad without the biases, of segments whose directions are `angles` (N,)."""
        own = self.headings - bias[self.period[self.owner]] * self.times_s
        return np.asarray(angles[self.owner] + own)

    def rows(self, images: Indices) -> Indices:
        """Rows of images (...) of the drives, -1 for those of no segment."""
        order = np.argsort(self.images, kind='stable')
        at = np.searchsorted(self.images, images, sorter=order)
        rows = order[np.minimum(at, len(order) - 1)]
        return np.where(self.images[rows] == images, rows, -1)

    def sums(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Sum (N, ...) of the rows (M, ...) of each segment."""
        return np.asarray(np.add.reduceat(rows, self.first, axis=0))


@dataclass(frozen=True, slots=True)
class Links:
    """What odometry measured from one segment to the next: L turns and displacements.

    One of infinite variance has no weight.
    """

    at: Indices
    run: Indices
    period: Indices
    turn: Array
    turn_variance: Array
    turn_time: Array
    displacement: Complex
    displacement_variance: Array
    displacement_drift: Complex

    @classmethod
    def of(cls, segments: Segments) -> Links:
        """Of all segments from which odometry leads on."""
        items = [(n, s) for n, s in enumerate(segments.items[:-1]) if s.linked]
        column: list[Any] = [np.array([getattr(s, name) for _, s in items]) for name in _MEASURED]
        at = np.array([n for n, _ in items], np.int64)
        run, period = (np.array([getattr(s, k) for _, s in items], np.int64) for k in _OWNERS)
        return cls(at, run, period, *column)

    def alike(self, other: Links, tolerance: float) -> bool:
        """Whether the variances of the same links differ by less than a part, on average."""
        pairs = (
            (self.turn_variance, other.turn_variance),
            (self.displacement_variance, other.displacement_variance),
        )
        return all(_mean_change(own, its) < tolerance for own, its in pairs)

    @property
    def used(self) -> bool:
        """Whether any turn or displacement has a weight."""
        variances = np.concatenate([self.turn_variance, self.displacement_variance])
        return bool(np.isfinite(variances).any())


def _mean_change(variances: Array, others: Array) -> float:
    """Mean relative difference of two kinds of variances (L,) where they are finite."""
    known = np.isfinite(others)
    change = variances[known] / others[known] - 1.0
    return float(np.abs(change).mean()) if known.any() else 0.0


_OWNERS = ('run', 'period')
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
    """Eq. 1 minimized over the map's weights: what remains of the features.

    `gram` (3N, 3N) is the quadratic form in [o, z, -b z]; the weights are
    w = F^-1 cross [o, z, -b z] with F = factor factor^T.
    """

    gram: Complex
    factor: Array
    cross: Array | Complex

    def weights(self, coefficients: Array | Complex) -> Complex:
        """The map's weights (m, ...) for [o, z, -b z] (3N, ...)."""
        return np.asarray(_solve(self.factor, self.cross @ coefficients))

    def leverage(self, expanded: Array) -> Array:
        """phi^T F^-1 phi (M,) of expanded features (M, m)."""
        return np.asarray((self.whitened(expanded) ** 2).sum(0))

    def whitened(self, expanded: Array) -> Array:
        """factor^-1 phi (m, M) of expanded features (M, m)."""
        return np.asarray(scipy.linalg.solve_triangular(self.factor, expanded.T, lower=True))

    @property
    def log_determinant(self) -> float:
        """Of F."""
        return 2.0 * float(np.log(np.diag(self.factor)).sum())


def eliminate(
    expanded: Array, ridge: Array, weights: Array, stack: Stack, form: bool = True
) -> Elimination:
    """Eliminate the map from features expanded to (M, m), each image with a weight (M,). Without
    the quadratic `form` its weights are for places (M,), which are known."""
    weighted = expanded * weights[:, None]
    normal = weighted.T @ expanded
    normal[np.diag_indices_from(normal)] += ridge
    factor = _cholesky(normal)
    if not form:
        return Elimination(np.zeros((0, 0), complex), factor, weighted.T)
    columns = np.column_stack([np.ones(len(weights)), stack.path, stack.drift])
    cross = np.vstack([_products(weighted, column, stack) for column in columns.T]).T
    real, imag = _whiten(factor, cross)
    mixed = real.T @ imag
    own = real.T @ real + imag.T @ imag + 1j * (mixed - mixed.T)
    return Elimination(_moments(columns, weights, stack) - own, factor, cross)


def _cholesky(matrix: Array) -> Array:
    """Lower factor; a singular matrix gets a weak ridge first."""
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


def _whiten(factor: Array, right: Complex) -> tuple[Array, Array]:
    """Real and imaginary part of factor^-1 right."""
    both = np.hstack([right.real, right.imag])
    both = scipy.linalg.solve_triangular(factor, both, lower=True, overwrite_b=True)
    real, imag = np.hsplit(both, 2)
    return np.ascontiguousarray(real), np.ascontiguousarray(imag)


def _solve(factor: Array, right: Array | Complex) -> Complex:
    real = scipy.linalg.cho_solve((factor, True), right.real)
    return np.asarray(real + 1j * scipy.linalg.cho_solve((factor, True), right.imag))


@dataclass(frozen=True, slots=True)
class Solution:
    """Directions z (N,), origins o (N,), biases (R,) rad/s of the periods; and the quadratic form
    H (N, N) of the directions, where these are not those of a sparse graph."""

    z: Complex
    o: Complex
    bias: Array
    h: Complex = field(default_factory=lambda: np.zeros((0, 0), complex))

    @property
    def certificate(self) -> Certificate:
        """Of the directions."""
        return certify(self.h, self.z)

    def places(self, stack: Stack) -> Complex:
        """Where the segments put the images (M,), meters."""
        path = stack.corrected(self.bias)
        return np.asarray(self.o[stack.owner] + self.z[stack.owner] * path)

    def coefficients(self, period: Indices) -> Complex:
        """[o, z, -b z] (3N,)."""
        return np.concatenate([self.o, self.z, -self.bias[period] * self.z])


@dataclass(frozen=True, slots=True)
class Squares:
    """The cost sum_l weight_l |sum_k values_kl x_columns_kl|^2: each square reads K unknowns."""

    columns: Indices
    """(K, L)"""
    values: Complex
    """(K, L)"""
    weight: Array
    """(L,)"""

    def roots(self, x: Complex) -> Complex:
        """What is squared (L,), at the unknowns x."""
        return np.asarray((self.values * x[self.columns]).sum(axis=0))

    def pull(self, x: Complex) -> Complex:
        """Gradient (K, L) of half the cost by the unknowns of each term."""
        return np.asarray(self.values.conj() * (self.weight * self.roots(x)))

    def add_to(self, form: Complex) -> None:
        """Add to a quadratic form in the unknowns."""
        products = self.values.conj()[:, None] * self.weight * self.values
        np.add.at(form, (self.columns[:, None], self.columns[None]), products)


@dataclass(frozen=True, slots=True)
class QuadraticForm:
    """The squares of the features and of odometry's links, for a position variance, m^2."""

    gram: Complex
    links: Links
    period: Indices
    variance: float
    bias_std: float

    def system(self, bias: Array) -> Complex:
        """The quadratic form (2N, 2N) in [o, z] at the periods' biases (R,)."""
        form = self._biased_gram(bias)
        for squares in self.link_squares(bias):
            squares.add_to(form)
        return form

    def _biased_gram(self, bias: Array) -> Complex:
        """S^T gram S (2N, 2N) with [o, z, -b z] = S [o, z], S = [[1, 0], [0, 1], [0, -b]]."""
        n = len(self.period)
        b = -bias[self.period]
        product = self.gram[:, : 2 * n].copy()
        product[:, n:] += self.gram[:, 2 * n :] * b
        form = product[: 2 * n]
        form[n:] += b[:, None] * product[2 * n :]
        return np.asarray(form)

    def link_squares(self, bias: Array) -> tuple[Squares, Squares]:
        """The turns' and the displacements' costs, of [o, z], at biases (R,) rad/s."""
        links, n, own = self.links, len(self.period), bias[self.links.period]
        at, ones = links.at, np.ones(len(links.at))
        turns = -np.exp(1j * (links.turn - own * links.turn_time))
        moves = -(links.displacement - own * links.displacement_drift)
        turned = np.array([n + at + 1, n + at]), np.array([ones, turns])
        moved = np.array([at + 1, at, n + at]), np.array([ones, -ones, moves])
        return (
            Squares(*turned, self.variance / links.turn_variance),
            Squares(*moved, self.variance / links.displacement_variance),
        )

    def slope(self, bias: Array, x: Complex) -> Array:
        """Derivative (R,) of the cost by each bias at [o, z] = x (2N,)."""
        links, n = self.links, len(self.period)
        z = x[n:]
        right = self.gram[2 * n :] @ np.concatenate([x, -bias[self.period] * z])
        own = np.bincount(self.period, np.real(-np.conj(z) * right), len(bias))
        turns, moves = self.link_squares(bias)
        turned = -1j * links.turn_time * turns.values[-1]
        for change, squares in ((turned, turns), (links.displacement_drift, moves)):
            pull = np.real(np.conj(change * z[links.at]) * squares.roots(x)) * squares.weight
            own += np.bincount(links.period, pull, len(bias))
        return np.asarray(own + self.variance * bias / self.bias_std**2)

    def solve(self, start: Complex | None, bias: Array) -> Solution:
        """The best directions, origins and biases; near `start` (N,), or globally without one."""
        h, origins = schur(self.system(bias))
        z = refine(h, start) if start is not None else synchronize(h)
        if self.bias_std > 0:
            bias, z = self._estimate_bias(bias, z)
            h, origins = schur(self.system(bias))
        z = synchronize(h, [z])
        return Solution(z, origins @ z, bias, h)

    def _refined(self, bias: Array, z: Complex) -> Complex:
        """[o, z] (2N,) at given biases, from directions nearby."""
        h, origins = schur(self.system(bias))
        z = refine(h, z)
        return np.concatenate([origins @ z, z])

    def _estimate_bias(self, bias: Array, z: Complex) -> tuple[Array, Complex]:
        """Newton on the biases; the directions follow, so the slope is that of the envelope."""
        n = len(z)
        x = self._refined(bias, z)
        curvature = self.curvature(bias, x)
        for _ in range(_BIAS_STEPS):
            step = -np.linalg.solve(curvature, self.slope(bias, x))
            step = np.clip(step, -self.bias_std, self.bias_std)
            bias = bias + step
            x = self._refined(bias, x[n:])
            if np.abs(step).max() < 1e-6 * self.bias_std:
                break
        return bias, x[n:]

    def curvature(self, bias: Array, x: Complex) -> Array:
        """Second derivative (R, R) of the least cost at given biases, where [o, z] = x (2N,).

        Origins and angles y follow the biases b: f_bb - f_by f_yy^-1 f_yb. Where that is hardly
        positive, the prior's alone.
        """
        n, units = len(self.period), np.eye(len(bias)) * _BIAS_DIFFERENCE
        pull, slope = self._pull(bias, x), self.slope(bias, x)
        bent = np.array([self.slope(bias + unit, x) - slope for unit in units])
        mixed = np.array([_by_real(self._pull(bias + unit, x) - pull, x) for unit in units])
        hessian = _real_hessian(self.system(bias), x, pull[n:])
        floor = self.variance / self.bias_std**2
        try:
            follow = scipy.linalg.solve(hessian, mixed.T, assume_a='pos')
        except np.linalg.LinAlgError:
            return np.asarray(floor * np.eye(len(bias)))
        curvature = bent / _BIAS_DIFFERENCE - mixed @ follow / _BIAS_DIFFERENCE**2
        curvature = (curvature + curvature.T) / 2
        if np.linalg.eigvalsh(curvature)[0] < floor / 2:
            return np.asarray(floor * np.eye(len(bias)))
        return np.asarray(curvature)

    def _pull(self, bias: Array, x: Complex) -> Complex:
        """system(bias) @ x (2N,), for far less work."""
        n, b = len(self.period), -bias[self.period]
        right = self.gram @ np.concatenate([x, b * x[n:]])
        pull = right[: 2 * n]
        pull[n:] += b * right[2 * n :]
        for squares in self.link_squares(bias):
            np.add.at(pull, squares.columns, squares.pull(x))
        return np.asarray(pull)


def _by_real(gradient: Complex, x: Complex) -> Array:
    """A gradient (2N,) by [o, z] = x as that (3N,) by [Re o, angles of z, Im o]."""
    n = len(x) // 2
    own = gradient[:n]
    return np.concatenate([own.real, np.imag(np.conj(x[n:]) * gradient[n:]), own.imag])


def _real_hessian(system: Complex, x: Complex, pull: Complex) -> Array:
    """Hessian (3N, 3N) of the cost by [Re o, angles of z, Im o] at [o, z] = x (2N,).

    `pull` (N,) is the gradient by z. What moves or turns all together is fixed.
    """
    n = len(pull)
    along = np.concatenate([np.ones(n), 1j * x[n:]])
    inner = np.conj(along)[:, None] * system * along
    hessian = np.block([[inner.real, -inner.imag], [inner.imag, inner.real]])[: 3 * n, : 3 * n]
    angles = np.arange(n, 2 * n)
    hessian[angles, angles] -= np.real(np.conj(x[n:]) * pull)
    none, ones = np.zeros(n), np.ones(n)
    turn = np.concatenate([-x[:n].imag, ones, x[:n].real])
    free = np.column_stack([np.r_[ones, none, none], np.r_[none, none, ones], turn])
    free = np.linalg.qr(free)[0]
    return np.asarray(hessian + np.trace(hessian) / len(hessian) * (free @ free.T))


def schur(system: Complex) -> tuple[Complex, Complex]:
    """Minimize over the origins: H (N, N), and the origins (N, N) as a linear map of z."""
    n = len(system) // 2
    own = np.real(system[:n, :n]).copy()
    level = max(float(np.trace(own)) / n, 1e-300)
    # Moving all origins together costs nothing: fix the mean.
    own += level / n
    origins = -np.asarray(_solve(_cholesky(own), system[:n, n:]))
    h = system[n:, n:] + system[n:, :n] @ origins
    return np.asarray((h + h.conj().T) / 2), origins
