# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What odometry, loop closures and measured points alone say of all drives, with a certificate.

The least squares of links.py, loops.py and measured_points.py in [o, z, -b z] (see stack.py),
without features: each square reads few segments, so that Gauss and Newton's normal equations are
sparse, and a drive of thousands of segments takes seconds. With multipliers
Lambda = diag(Re(conj(z) * (S x)_z)), S the quadratic form at the biases and x = [o, z] where o is
best, S - diag(0, Lambda) >= 0 proves the directions optimal, as H - Lambda >= 0 does in phases.py:
H is what S leaves of z. A sparse factor shows it by the signs of its pivots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

from sfa_localization.data.geometry import Array, Complex
from sfa_localization.data.statistics import evenly
from sfa_localization.metric.links import Links
from sfa_localization.metric.loops import Loops, loops_of
from sfa_localization.metric.measured_points import MeasuredPoints
from sfa_localization.metric.mount import Mount
from sfa_localization.metric.phases import CERTIFICATE_TOLERANCE, Certificate, unit
from sfa_localization.metric.quadratic_form import YAW_BIAS_STD
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.stack import Solution, Stack

# Of the solution and the weights that it shows, in turn: as settled as its use needs.
_ROUNDS = 3
# Weight of the distance from the middle beside closures, 1 / m^2: drives that nothing ties stay.
_STAY = 1e-6
# The same of directions, 1 / rad^2.
_UNTIED = 1e-3
# Far more than Gauss and Newton need from odometry's own path.
_STEPS, _HALVED, _CONVERGED = 50, 20, 1e-9
# Columns that are solved for at a time: memory.
_AT_ONCE = 256
SHOWN = 500
"""Links, or images, of which is found how well the others tell them: neighbors are told alike."""


@dataclass(frozen=True, slots=True)
class Graph:
    """The `solution` of N segments with R biases, whether it is proven, and what that leaves
    unknown: `factor` is that of the normal equations of [Re o, Im o, angles of z, b]."""

    stack: Stack
    solution: Solution
    certificate: Certificate
    factor: SuperLU
    mount: Mount = field(default_factory=Mount)
    """Where the camera sits by this solution, a step from where the segments' camera does."""

    @classmethod
    def of(cls, segments: Segments) -> Graph:
        """Of segments with closures, offsets and points; loops and links as noisy as they show."""
        stack, stated = Stack.of(segments), Links.of(segments)
        loops = loops_of(segments.closures, segments.offsets, stack)
        given: list[Loops | MeasuredPoints] = [*loops]
        given += [segments.points] if segments.points else []
        stay = stack.sparse((np.arange(stack.segments), np.full(stack.segments, np.sqrt(_STAY))))
        graph, links = None, stated
        for _ in range(_ROUNDS):
            if graph:
                links = stated.learned(links, stack, graph.solution, *graph._unknown_links(links))
            before = graph.solution if graph else None
            ties = [one.ties(stack, before) for one in given]
            rows = sparse.csr_array(sparse.vstack([links.ties(stack), *ties, stay]))
            graph = _solved(rows, stack, before)
        assert graph is not None
        return replace(graph, mount=graph._mount(segments.mount, links, loops, before))

    def _mount(
        self, mount: Mount, links: Links, loops: Sequence[Loops], before: Solution | None
    ) -> Mount:
        """The mount of the segments a step on, by links and loops that are weighed alike."""
        stack, solution = self.stack, self.solution
        rows = sparse.vstack([links.ties(stack), *(one.ties(stack, before) for one in loops)])
        missed = rows @ solution.coefficients(stack.period)
        shown = [one.by_mount(stack, before, solution) for one in loops]
        by_mount = np.vstack([links.by_mount(stack, solution), *shown])
        by = by_unknowns(rows, solution, stack.period)
        by_rest = np.real(by.conj().T @ by_mount)
        return mount.stepped(missed, by_mount, by_rest, self.unknown)

    def unknown(self, columns: Array) -> Array:
        """The covariance of [Re o, Im o, angles of z, b] (P, P) times columns (P, K)."""
        found = np.empty(columns.shape)
        for k in range(0, columns.shape[1], _AT_ONCE):
            part = np.ascontiguousarray(columns[:, k : k + _AT_ONCE])
            found[:, k : k + _AT_ONCE] = self.factor.solve(part)
        return found

    @property
    def angle_covariance(self) -> Array:
        """(N, N) rad^2 of the directions, without a rotation of all together."""
        n, size = self.stack.segments, self.factor.shape[0]
        own = self.unknown(np.eye(size, n, -2 * n))[2 * n : 3 * n]
        apart = own - own.mean(0)
        return np.asarray(apart - apart.mean(1)[:, None])

    def covariance(self, rows: Complex) -> Complex:
        """Per axis (K, K) of rows (K, 3N) times [o, z, -b z], without a motion of the whole map."""
        moved = self._moved(rows)
        unknown = self.unknown(moved.real.T) - 1j * self.unknown(moved.imag.T)
        return np.asarray(moved @ unknown / 2)

    def variance(self, shares: Array) -> Array:
        """Of sums of the images' places by shares (K, M) of sum 1, (K,) m^2 over both axes, without
        a motion of the whole map."""
        rows = self.stack.place_rows(np.arange(shares.shape[1]), np.ones(shares.shape[1]))
        return self._variance(self._moved(shares @ rows))

    def _moved(self, rows: Any) -> Complex:
        """Derivative (K, P) of rows (K, 3N) times [o, z, -b z] by [Re o, Im o, angles of z, b],
        without that of a motion of the whole map."""
        stack, solution = self.stack, self.solution
        images = stack.place_rows(np.arange(len(stack.images)), np.ones(len(stack.images)))
        own, whole = (by_unknowns(one, solution, stack.period) for one in (rows, images))
        places = solution.places(stack)
        around = places - places.mean()
        mean = np.asarray(whole.mean(axis=0))
        turn = np.real(-1j * (around.conj() @ whole)) / np.sum(np.abs(around) ** 2)
        here = rows @ solution.coefficients(stack.period) - places.mean()
        return np.asarray(sparse.csr_array(own).toarray() - mean[None] - 1j * np.outer(here, turn))

    def _unknown_links(self, links: Links) -> tuple[Array, Array]:
        """Variances (L,) that the solution leaves of turns and, per axis, displacements."""
        turns, moves = links.rows(self.stack)
        # Along the turn: of its complex square the other part is none of the angles'.
        along = sparse.diags_array(-1j * self.solution.z[links.at + 1].conj()) @ turns
        return self._left(along, np.real), self._left(moves) / 2

    def _left(self, rows: Any, part: Callable[[Complex], Any] = np.asarray) -> Array:
        """Variance (L,) that the solution leaves of a part of rows (L, 3N) times [o, z, -b z]: of
        some rows, and as those nearby of the others."""
        shown, count = evenly(rows.shape[0], SHOWN), rows.shape[0]
        by = part(by_unknowns(rows[shown], self.solution, self.stack.period).toarray())
        return np.interp(np.arange(count), shown, self._variance(by)) if count else np.zeros(0)

    def _variance(self, by: Complex) -> Array:
        """Of derivatives (K, P): (K,), that of the real and of the imaginary part together."""
        parts = [(self.unknown(one.T).T * one).sum(axis=1) for one in (by.real, by.imag)]
        return np.asarray(parts[0] + parts[1])


def graph_poses(graph: Graph, count: int) -> Array:
    """Poses (count, 3) of the camera, x m, y m, yaw rad, at the images, in a frame of their own;
    NaN for those of no segment."""
    stack, solution = graph.stack, graph.solution
    poses, places = np.full((count, 3), np.nan), solution.places(stack)
    yaws = stack.yaws(solution)
    poses[stack.images] = np.column_stack([places.real, places.imag, yaws])
    return poses


def by_unknowns(rows: Any, now: Solution, period: NDArray[np.int64]) -> Any:
    """Derivative (L, P) of rows (L, 3N) times [o, z, -b z] by [Re o, Im o, angles of z, b]."""
    rows, n = sparse.csr_array(rows), len(now.z)
    own, by_bias = rows[:, :n], rows[:, 2 * n :] * now.z[None]
    turned = (rows[:, n : 2 * n] - rows[:, 2 * n :] * now.bias[period][None]) * (1j * now.z)[None]
    periods = sparse.csr_array((np.ones(n), (np.arange(n), period)), (n, len(now.bias)))
    return sparse.hstack([own, 1j * own, turned, -by_bias @ periods]).tocsr()


def _solved(rows: Any, stack: Stack, before: Solution | None) -> Graph:
    """The least squares of rows (L, 3N), from the solution before or from odometry's own path; from
    the smallest eigenvector where that is not proven to be the best."""
    x, y, yaw = stack.starts.T
    start = before or Solution(np.exp(1j * yaw), x + 1j * y, np.zeros(stack.period[-1] + 1))
    graph = _refined(rows, stack, start)
    if graph.certificate.certified:
        return graph
    try:
        z = _spectral(_form(rows, graph.solution.bias, stack.period), stack.segments)
    except RuntimeError:  # no vector was found: what there is stays, unproven
        return graph
    other = _refined(rows, stack, Solution(z, np.zeros_like(z), graph.solution.bias))
    return min(graph, other, key=lambda one: _cost(rows, one.solution, stack))


def _refined(rows: Any, stack: Stack, start: Solution) -> Graph:
    """Gauss and Newton's steps, halved until they are a descent."""
    now, n, period, cost = start, stack.segments, stack.period, _cost(rows, start, stack)
    for _ in range(_STEPS):
        factor, slope = _normal(rows, now, period)
        step, size, new = factor.solve(-slope), 1.0, np.inf
        for _ in range(_HALVED):
            moved = size * step
            tried = Solution(
                now.z * np.exp(1j * moved[2 * n : 3 * n]),
                now.o + moved[:n] + 1j * moved[n : 2 * n],
                now.bias + moved[3 * n :],
            )
            if (new := _cost(rows, tried, stack)) <= cost * (1 + 1e-12):
                break
            size /= 2
        else:
            break
        now, cost = tried, new
        if np.abs(step[2 * n :]).max() < _CONVERGED:
            break
    return Graph(stack, now, proof(rows, now, period), factor)


def _cost(rows: Any, solution: Solution, stack: Stack) -> float:
    missed = rows @ solution.coefficients(stack.period)
    return float(np.sum(np.abs(missed) ** 2) + np.sum((solution.bias / YAW_BIAS_STD) ** 2))


def _normal(rows: Any, now: Solution, period: NDArray[np.int64]) -> tuple[SuperLU, Array]:
    """The factor of the normal equations, and half the gradient of the cost (P,).

    Turning all together costs nothing: the first direction is held, for this step, and any that
    nothing ties to the others is known to be unknown.
    """
    n, by = len(now.z), by_unknowns(rows, now, period)
    own = np.concatenate([np.zeros(3 * n), np.full(len(now.bias), YAW_BIAS_STD**-2)])
    slope = np.real(by.conj().T @ (rows @ now.coefficients(period)))
    slope += own * np.concatenate([np.zeros(3 * n), now.bias])
    own[2 * n : 3 * n] = _UNTIED
    own[2 * n] = 1.0
    return _factor((by.conj().T @ by).real + sparse.diags_array(own)), slope


def _factor(symmetric: Any) -> SuperLU:
    """Of a sparse matrix, without exchanging rows: the signs of its pivots are its own."""
    options = {'SymmetricMode': True}
    return splu(symmetric.tocsc(), 'MMD_AT_PLUS_A', diag_pivot_thresh=0.0, options=options)


def _form(rows: Any, bias: Array, period: NDArray[np.int64]) -> Any:
    """S (2N, 2N) at the biases."""
    n = len(period)
    turned = rows[:, n : 2 * n] - rows[:, 2 * n :] * bias[period][None]
    both = sparse.hstack([rows[:, :n], turned]).tocsr()
    return (both.conj().T @ both).tocsr()


def _real(hermitian: Any) -> Any:
    """The same form of real and imaginary parts."""
    real, imag = hermitian.real, hermitian.imag
    return sparse.block_array([[real, -imag], [imag, real]]).tocsc()


def proof(rows: Any, now: Solution, period: NDArray[np.int64]) -> Certificate:
    """The least pivot of S - diag(0, Lambda), over the largest entry: it is positive where all
    eigenvalues are."""
    n, form = len(period), _form(rows, now.bias, period)
    pull = (form @ np.concatenate([now.o, now.z]))[n:]
    least = np.concatenate([np.zeros(n), np.real(now.z.conj() * pull)])
    scale = max(float(np.real(form.diagonal()[n:]).max()), 1.0)
    shift = np.concatenate([np.zeros(n), np.full(n, CERTIFICATE_TOLERANCE * scale)])
    factor = _factor(_real(form - sparse.diags_array(least - shift)))
    return Certificate(float(factor.U.diagonal().min()) / scale)


def _spectral(form: Any, n: int) -> Complex:
    """Phases of the smallest eigenvector of H: of what the inverse of the form has for z."""
    factor = _factor(_real(form + 1e-12 * form.diagonal().real.max() * sparse.eye_array(2 * n)))

    def apply(z: Array) -> Array:
        right = np.zeros(4 * n)
        right[n : 2 * n], right[3 * n :] = z[:n], z[n:]
        found = factor.solve(right)
        return np.concatenate([found[n : 2 * n], found[3 * n :]])

    operator = LinearOperator((2 * n, 2 * n), apply, dtype=float)
    vector = eigsh(operator, 1, v0=np.ones(2 * n))[1][:, 0]
    return unit(vector[:n] + 1j * vector[n:])
