# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The poses of all segments by least squares, with a certificate of global optimality.

Every residual is linear in y = [o, z, -b z] (see stack.py): those of odometry (links.py), of
offsets between images (loops.py), of measured points (measured_points.py), and those of eq. 1 of
the paper (ridge.py). So their sum of squares is a form y^H G y, with |z_n| = 1. G is sparse without
eq. 1, and thousands of segments take seconds.

Newton's steps minimize it from the path of the odometry. Let S be the form in x = [o, z] at the
biases found, o be best, and Lambda = diag(Re(conj(z) * (S x)_z)). If S - diag(0, Lambda) >= 0, no
other directions are better. The signs of the pivots of a sparse factor tell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.data.statistics import evenly
from sfa_localization.metric import point_ties
from sfa_localization.metric.links import Links
from sfa_localization.metric.loops import Loops
from sfa_localization.metric.mount import Mount
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.stack import SegmentPoses, Stack

CERTIFICATE_TOLERANCE = 1e-9
"""Relative to the largest entry of the form: rounding of an exact zero."""
YAW_BIAS_STD = 0.003
"""rad/s: prior of the yaw-rate bias of odometry or a gyroscope, estimated per period."""
SAMPLED = 500
"""Number of links or images whose variances are computed; the others are interpolated."""
# Poses and the weights of residuals are estimated in turn: so often that neither changes much.
_ROUNDS = 3
# Weak priors of origins (1 / m^2) and directions (1 / rad^2), for drives without links to the
# others.
_ORIGIN_PRIOR = 1e-8
_DIRECTION_PRIOR = 1e-3
# Newton's steps, halvings of a step, and the decrease of the cost that ends them.
_STEPS = 100
_HALVINGS = 20
_CONVERGED = 1e-8


@dataclass(frozen=True, slots=True)
class Certificate:
    """Proof that no other directions are better: the least pivot of S - diag(0, Lambda), over the
    largest entry of S."""

    eigenvalue: float

    @property
    def certified(self) -> bool:
        return self.eigenvalue >= -CERTIFICATE_TOLERANCE


@dataclass(frozen=True, slots=True)
class Graph:
    """The poses of N segments with R biases, whether they are proven, and the `factor` of the
    inverse of their covariance: that of [Re o, Im o, angles of z, b], P = 3 N + R."""

    stack: Stack
    poses: SegmentPoses
    certificate: Certificate
    factor: SuperLU
    mount: Mount = field(default_factory=Mount)
    """The mount estimated at these poses, one Gauss-Newton step from that of the segments."""

    @classmethod
    def of(cls, segments: Segments) -> Graph:
        """By odometry, offsets and measured points, each weighted by how well it fits."""
        stack = Stack.of(segments)
        stated = Links.of(segments)
        loops = Loops.of(segments.offsets, stack)
        links = stated
        graph = None
        for _ in range(_ROUNDS):
            links = graph.learned(stated, links) if graph else stated
            before = graph.poses if graph else None
            rows = sparse.vstack([links.ties(stack), loops.ties(stack, before)])
            tied = (
                [rows, point_ties.ties(segments.points, stack, before)]
                if segments.points
                else [rows]
            )
            form = form_of(sparse.vstack(tied), stack)
            graph = cls.solved(form, stack, before)
            # Expected information: in the observed one, outliers count.
            normal = _gauss_newton(form, graph.poses, stack.period)
            graph = replace(graph, factor=_factor(normal))
        assert graph is not None
        poses = graph.poses
        period = stack.period
        by_loops = loops.by_mount(stack, before, poses)
        by_mount = np.vstack([links.by_mount(stack, poses), by_loops])
        by_both = np.real((rows @ derivative(poses, period)).conj().T @ by_mount)
        followed = by_both.T @ graph.factor.solve(by_both)
        gradient = np.real(by_mount.conj().T @ (rows @ poses.coefficients(period)))
        information = np.real(by_mount.conj().T @ by_mount) - followed
        return replace(graph, mount=segments.mount.stepped(information, gradient))

    @classmethod
    def solved(cls, form: Any, stack: Stack, start: SegmentPoses | None = None) -> Graph:
        """The minimum of a form (3N, 3N) near a start, or near the path of the odometry; if it has
        no certificate, the minimum from the smallest eigenvector of the form, if that is better.
        """
        x, y, yaw = stack.starts.T
        zeros = np.zeros(stack.period[-1] + 1)
        start = start or SegmentPoses(np.exp(1j * yaw), x + 1j * y, zeros)
        graph = cls.at(form, stack, refined(form, stack, start))
        if graph.certificate.certified:
            return graph
        try:
            z = _spectral(_at_biases(form, graph.poses.bias, stack.period), stack.segments)
        except RuntimeError:  # no eigenvector converged
            return graph
        start = SegmentPoses(z, np.zeros_like(z), graph.poses.bias)
        other = cls.at(form, stack, refined(form, stack, start))
        return min(graph, other, key=lambda each: cost(form, each.poses, stack))

    @classmethod
    def at(cls, form: Any, stack: Stack, poses: SegmentPoses) -> Graph:
        """Of poses at a minimum, with a covariance at the biases."""
        factor, _ = _normal(form, poses, stack.period, 1e-6 * YAW_BIAS_STD)
        return cls(stack, poses, proof(form, poses, stack.period), factor)

    def covariance_times(self, columns: Array) -> Array:
        """The covariance (P, P) times columns (P, K)."""
        return np.asarray(self.factor.solve(np.ascontiguousarray(columns)))

    @property
    def angle_covariance(self) -> Array:
        """(N, N) rad^2 of the directions, relative to the rotation of all together."""
        n = self.stack.segments
        size = self.factor.shape[0]
        angles = self.covariance_times(np.eye(size, n, -2 * n))[2 * n : 3 * n]
        centered = angles - angles.mean(0)
        return np.asarray(centered - centered.mean(1)[:, None])

    def covariance(self, rows: Complex) -> Complex:
        """(K, K) m^2 per axis of places, rows (K, 3N) times y, relative to the whole map."""
        by = self._relative(rows)
        product = self.covariance_times(by.real.T) - 1j * self.covariance_times(by.imag.T)
        return np.asarray(by @ product / 2)

    def variance(self, shares: Array) -> Array:
        """(K,) m^2 over both axes, of averages of the images' places by shares (K, M) of sum 1,
        relative to the whole map."""
        return self._variance(self._relative(shares @ self._image_rows))

    @property
    def _image_rows(self) -> Any:
        count = len(self.stack.images)
        return self.stack.place_rows(np.arange(count), np.ones(count))

    def _relative(self, rows: Any) -> Complex:
        """Derivative (K, P) of places, rows (K, 3N) times y, without that of a motion of the whole
        map."""
        by_y = derivative(self.poses, self.stack.period)
        by = rows @ by_y
        by_images = self._image_rows @ by_y
        places = self.poses.places(self.stack)
        arms = places - places.mean()
        turn = np.real(-1j * (arms.conj() @ by_images)) / np.sum(np.abs(arms) ** 2)
        here = rows @ self.poses.coefficients(self.stack.period) - places.mean()
        mean = np.asarray(by_images.mean(axis=0))
        return np.asarray(sparse.csr_array(by).toarray() - mean[None] - 1j * np.outer(here, turn))

    def learned(self, stated: Links, links: Links) -> Links:
        """The stated links with the variances that these poses, of some links, show."""
        turns, moves = links.rows(self.stack)
        # A turn is the part of its complex residual that is square to its direction.
        along = sparse.diags_array(-1j * self.poses.z[links.at + 1].conj()) @ turns
        uncertain = self._sampled(along, np.real), self._sampled(moves) / 2
        y = self.poses.coefficients(self.stack.period)
        residuals = np.abs(turns @ y) ** 2, np.abs(moves @ y) ** 2 / 2
        return stated.learned(links, residuals, uncertain)

    def _sampled(self, rows: Any, part: Callable[[Complex], Any] = np.asarray) -> Array:
        """Variance (L,) of rows (L, 3N) times y, computed for a sample of rows and interpolated."""
        count = rows.shape[0]
        if not count:
            return np.zeros(0)
        sample = evenly(count, SAMPLED)
        by = (rows.tocsr()[sample] @ derivative(self.poses, self.stack.period)).toarray()
        return np.interp(np.arange(count), sample, self._variance(part(by)))

    def _variance(self, by: Complex) -> Array:
        """(K,) over both axes, of derivatives (K, P)."""
        x, y = ((self.covariance_times(axis.T).T * axis).sum(1) for axis in (by.real, by.imag))
        return np.asarray(x + y)


def graph_poses(graph: Graph, count: int) -> Array:
    """Poses (count, 3) of the camera, x m, y m, yaw rad, at the images, in a frame of their own;
    NaN for those of no segment."""
    stack = graph.stack
    places = graph.poses.places(graph.stack)
    poses = np.full((count, 3), np.nan)
    poses[stack.images] = np.column_stack([places.real, places.imag, stack.yaws(graph.poses)])
    return poses


def form_of(rows: Any, stack: Stack) -> Any:
    """G (3N, 3N) of rows (L, 3N), with the weak prior of origins."""
    n = stack.segments
    weak = sparse.diags_array(np.repeat([_ORIGIN_PRIOR, 0.0, 0.0], n))
    return sparse.csr_array(rows.conj().T @ rows + weak)


def cost(form: Any, poses: SegmentPoses, stack: Stack) -> float:
    """y^H G y, and the squares of the biases over their prior."""
    y = poses.coefficients(stack.period)
    return float(np.vdot(y, form @ y).real + np.sum((poses.bias / YAW_BIAS_STD) ** 2))


def refined(form: Any, stack: Stack, start: SegmentPoses) -> SegmentPoses:
    """The minimum near a start, by Newton's steps, halved until they descend."""
    poses = start
    n = stack.segments
    least = cost(form, start, stack)
    for _ in range(_STEPS):
        factor, gradient = _normal(form, poses, stack.period)
        step = factor.solve(-gradient)
        squares = np.abs(poses.coefficients(stack.period)) ** 2
        rounding = 1e-14 * float(form.diagonal().real @ squares)
        for halving in range(_HALVINGS):
            moved = step / 2**halving
            tried = SegmentPoses(
                poses.z * np.exp(1j * moved[2 * n : 3 * n]),
                poses.o + moved[:n] + 1j * moved[n : 2 * n],
                poses.bias + moved[3 * n :],
            )
            new = cost(form, tried, stack)
            if new <= least + rounding:
                break
        else:
            break
        poses = tried
        least = new
        if -gradient @ step < _CONVERGED:
            break
    return poses


def derivative(poses: SegmentPoses, period: Indices) -> Any:
    """Of y = [o, z, -b z] by [Re o, Im o, angles of z, b]: (3N, P)."""
    n = len(period)
    origins = sparse.eye_array(n)
    turned = sparse.diags_array(1j * poses.z)
    by_bias = sparse.csr_array((-poses.z, (np.arange(n), period)), (n, len(poses.bias)))
    drifted = sparse.diags_array(-1j * poses.bias[period] * poses.z)
    return sparse.block_array(
        [
            [origins, 1j * origins, None, None],
            [None, None, turned, None],
            [None, None, drifted, by_bias],
        ]
    ).tocsr()


def _gauss_newton(
    form: Any, poses: SegmentPoses, period: Indices, bias_std: float = YAW_BIAS_STD
) -> Any:
    """The normal equations (P, P). A rotation of all segments costs nothing: the first direction
    is held."""
    n = len(period)
    by = derivative(poses, period)
    prior = np.repeat([0.0, _DIRECTION_PRIOR, bias_std**-2], [2 * n, n, len(poses.bias)])
    prior[2 * n] = 1.0
    return (by.conj().T @ form @ by).real + sparse.diags_array(prior)


def _normal(
    form: Any, poses: SegmentPoses, period: Indices, bias_std: float = YAW_BIAS_STD
) -> tuple[SuperLU, Array]:
    """The factor of half the Hessian of the cost, or of Gauss and Newton's where that is not
    positive, and half the gradient (P,)."""
    n = len(period)
    y = poses.coefficients(period)
    pull = form @ y
    gradient = np.real(derivative(poses, period).conj().T @ pull)
    gradient[3 * n :] += poses.bias / YAW_BIAS_STD**2
    curvature = -np.real(y[n:].conj() * pull[n:]).reshape(2, n).sum(0)
    mixed = np.real(1j * poses.z.conj() * pull[2 * n :])
    angles = 2 * n + np.arange(n)
    biases = 3 * n + period
    at = np.concatenate([angles, angles, biases]), np.concatenate([angles, biases, angles])
    gauss_newton = _gauss_newton(form, poses, period, bias_std)
    values = np.concatenate([curvature, mixed, mixed])
    factor = _factor(gauss_newton + sparse.csr_array((values, at), gauss_newton.shape))
    if factor.U.diagonal().min() <= 0.0:
        factor = _factor(gauss_newton)
    return factor, gradient


def _factor(symmetric: Any) -> SuperLU:
    """Of a matrix, without exchange of rows: the signs of its pivots are its inertia."""
    options = {'SymmetricMode': True}
    return splu(
        sparse.csc_array(symmetric), 'MMD_AT_PLUS_A', diag_pivot_thresh=0.0, options=options
    )


def _at_biases(form: Any, bias: Array, period: Indices) -> Any:
    """S (2N, 2N), the form in [o, z] at the biases."""
    n = len(period)
    by_z = sparse.vstack([sparse.eye_array(n), sparse.diags_array(-bias[period])])
    y = sparse.block_diag([sparse.eye_array(n), by_z], 'csr')
    return y.T @ form @ y


def _real(hermitian: Any) -> Any:
    """The same form of real and imaginary parts."""
    real, imag = (sparse.csc_array(part) for part in (hermitian.real, hermitian.imag))
    return sparse.block_array([[real, -imag], [imag, real]])


def proof(form: Any, poses: SegmentPoses, period: Indices) -> Certificate:
    """The certificate of poses at a minimum of a form (3N, 3N)."""
    n = len(period)
    at_biases = _at_biases(form, poses.bias, period)
    pull = (at_biases @ np.concatenate([poses.o, poses.z]))[n:]
    multipliers = np.append(np.zeros(n), np.real(poses.z.conj() * pull))
    entries = np.real(at_biases.diagonal())
    scale = max(float(entries[n:].max()), 1.0)
    # A motion of all origins costs next to nothing: rounding would decide on the sign of its pivot.
    shift = np.repeat([1e-12 * entries[:n].max(), CERTIFICATE_TOLERANCE * scale], n)
    factor = _factor(_real(at_biases - sparse.diags_array(multipliers - shift)))
    return Certificate(float(factor.U.diagonal().min()) / scale)


def _spectral(form: Any, n: int) -> Complex:
    """Phases of the eigenvector of the smallest eigenvalue, of the form in z at the best o."""
    factor = _factor(_real(form + 1e-12 * form.diagonal().real.max() * sparse.eye_array(2 * n)))

    def inverse_times(z: Array) -> Array:
        right = np.zeros(4 * n)
        right[n : 2 * n], right[3 * n :] = z[:n], z[n:]
        solved = factor.solve(right)
        return np.concatenate([solved[n : 2 * n], solved[3 * n :]])

    operator = LinearOperator((2 * n, 2 * n), inverse_times, dtype=float)
    vector = eigsh(operator, 1, v0=np.ones(2 * n))[1][:, 0]
    z = vector[:n] + 1j * vector[n:]
    size = np.abs(z)
    return np.where(size > 0, z / np.where(size > 0, size, 1.0), 1.0)
