# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Unsupervised metric learning: metres from slow features and odometry, without ground truth.

The certified solver finds, and proves, the global optimum of the paper's problem; the paper's own
descent is in ``paper_solver``. Complex numbers are x + i y in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sfa_localization import paper_solver
from sfa_localization.config import MetricConfig
from sfa_localization.elimination import Links, Stack, schur
from sfa_localization.errors import DataError
from sfa_localization.fitting import Fit, problem_of, targets
from sfa_localization.gauge import gauge
from sfa_localization.geometry import Array, RigidTransform, align_complex, wrap_angle
from sfa_localization.hyperparameters import LeftOut, choose, leave_out
from sfa_localization.phases import Certificate, certify, refine
from sfa_localization.regression import MetricMap
from sfa_localization.segments import Segments
from sfa_localization.sufficiency import (
    Diagnostics,
    angle_covariance,
    check,
    check_amount,
    diagnose,
)

Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]

# Directions that sway together, kept for the covariance of a position.
_SWAYS = 12


@dataclass(frozen=True, slots=True)
class Consistency:
    """How honest the covariance is on left-out segments, after inflation."""

    within_half: float
    """Share of errors inside the 50 % ellipse."""
    within_95: float
    """Share of errors inside the 95 % ellipse."""
    nees: float
    """Mean normalized squared error; 2 is ideal."""


@dataclass(frozen=True, slots=True)
class MetricResult:
    """What was learnt: N segments, M pictures in them, R runs. All in the map frame."""

    map: MetricMap
    angles: Array
    """(N,) rad: direction of each segment's frame."""
    origins: Array
    """(N, 2) m: each segment's first picture."""
    angle_covariance: Array
    """(N, N) rad^2."""
    yaw_bias: Array
    """(R,) rad/s: what each run's odometry turned too fast."""
    certificate: Certificate
    """Of the directions; the paper's descent seldom arrives close enough to have one."""
    images: Indices
    """(M,) pictures of the segments, in order."""
    residuals: Array
    """(M, 2) m: where the segments put a picture minus where the map does."""
    noise_m: float
    left_out: Array
    """(M, 2) m: as `residuals`, but the map had not seen the picture's stretch of the drive."""
    left_out_variance: Array
    """(M,) m^2 per axis: what the map claimed for `left_out`, with its inflation."""
    left_out_rigid_m: float
    """Mean left-out error once each left-out segment is moved rigidly onto its predictions."""
    consistency: Consistency
    diagnostics: Diagnostics
    history: Array
    """(I,) cost at each iteration of the paper's descent; empty for the certified solver."""

    @property
    def left_out_error_m(self) -> float:
        """Mean error of a map at stretches of the drive that it was learnt without.

        The distance to where the whole drive, certified, puts the stretch; needs no ground truth.
        """
        return float(np.hypot(*self.left_out.T).mean())


def learn(features: Array, segments: Segments, config: MetricConfig) -> MetricResult:
    """Learn metres from slow features (N, K), one row per picture of the run, and segments.

    Raises DataError when the features are unusable, when the drive cannot fix a map (the message
    says what to drive instead), or when optimality is not proven and the config demands it.
    """
    stack = Stack.of(segments)
    rows = _rows(features, stack, config)
    check_amount(stack)
    links = Links.of(segments, config.use_turns, config.use_displacements)
    history = np.zeros(0)
    if config.solver == 'paper':
        whole, history = paper_solver.learn(rows, stack, links, config)
    else:
        whole = choose(rows, stack, links, config)
    diagnostics = diagnose(whole, stack)
    _check_certificate(whole, config)
    check(diagnostics, config)
    left = leave_out(whole, stack, config)
    return _result(whole, left, segments, stack, diagnostics, history, config)


def _rows(features: Array, stack: Stack, config: MetricConfig) -> Array:
    """The features (M, K) of the stack's pictures, checked."""
    features = np.asarray(features, float)
    if features.ndim != 2 or len(features) <= stack.images.max():
        raise DataError(
            f'slow features of shape {features.shape} for pictures up to {stack.images.max()}: '
            'one row per picture is needed'
        )
    rows = features[stack.images]
    bad = int((~np.isfinite(rows)).any(1).sum())
    if bad:
        raise DataError(f'slow features of {bad} pictures are not finite: train the network again')
    if np.all(rows.std(0) < 1e-9):
        raise DataError('the slow features are constant: the pictures of the run do not differ')
    if config.slow_features > features.shape[1]:
        raise DataError(
            f'slow_features is {config.slow_features}, but there are only {features.shape[1]}'
        )
    return rows


def _check_certificate(whole: Fit, config: MetricConfig) -> None:
    """Refuse unproven directions; of the paper's descent, those that end by a wrong minimum."""
    solution, certificate = whole.solution, whole.solution.certificate
    if config.solver == 'paper':
        certificate = certify(solution.h, refine(solution.h, solution.z))
    if certificate.certified or not config.require_certificate:
        return
    found = f'(certificate {certificate.eigenvalue:.1e})'
    if config.solver == 'paper':
        raise DataError(f'the descent ended by a wrong minimum {found}: set solver: certified')
    raise DataError(
        f'the best directions found are not proven best {found}: the odometry contradicts the '
        'pictures; drive more, or accept the risk with require_certificate: false'
    )


def _result(
    whole: Fit,
    left: LeftOut,
    segments: Segments,
    stack: Stack,
    diagnostics: Diagnostics,
    history: Array,
    config: MetricConfig,
) -> MetricResult:
    frame = gauge(whole, segments, stack, config)
    turn = np.exp(1j * frame.yaw_rad)
    inflation = _inflation(left)
    places = whole.solution.o * turn + frame.x_m + 1j * frame.y_m
    return MetricResult(
        map=_map(whole, stack, frame, inflation),
        angles=wrap_angle(np.angle(whole.solution.z) + frame.yaw_rad),
        origins=_plane(places),
        angle_covariance=angle_covariance(whole),
        yaw_bias=whole.solution.bias,
        certificate=whole.solution.certificate,
        images=stack.images,
        residuals=_plane(whole.residuals * turn),
        noise_m=float(np.sqrt(whole.variance)),
        left_out=_plane(left.errors * turn),
        left_out_variance=left.variances * inflation,
        left_out_rigid_m=_rigid_error(left, whole, stack),
        consistency=_consistency(left, inflation),
        diagnostics=diagnostics,
        history=history,
    )


def _plane(values: Complex) -> Array:
    return np.column_stack([values.real, values.imag])


def _inflation(left: LeftOut) -> float:
    """Factor, at least 1, on the predicted variances, by the left-out errors.

    Half of these then fall inside the 50 % ellipse, and 95 % inside the 95 % ellipse.
    """
    ratio = np.abs(left.errors) ** 2 / left.variances
    # The squared distance of two normal axes is exponential: quantile q at -2 log(1 - q).
    factors = [np.quantile(ratio, q) / (-2.0 * np.log(1.0 - q)) for q in (0.5, 0.95)]
    return float(max(*factors, 1.0))


def _consistency(left: LeftOut, inflation: float) -> Consistency:
    ratio = np.abs(left.errors) ** 2 / (left.variances * inflation)
    inside = [float(np.mean(ratio <= -2.0 * np.log(1.0 - q))) for q in (0.5, 0.95)]
    return Consistency(inside[0], inside[1], float(ratio.mean()))


def _rigid_error(left: LeftOut, whole: Fit, stack: Stack) -> float:
    """Mean error left when each segment's own path is laid on its predictions."""
    path = stack.corrected(whole.solution.bias)
    predicted = targets(whole.solution, stack) - left.errors
    remaining = np.zeros(len(path))
    for n in range(stack.segments):
        rows = stack.owner == n
        turn, shift = align_complex(path[rows], predicted[rows])
        remaining[rows] = np.abs(turn * path[rows] + shift - predicted[rows])
    return float(remaining.mean())


def _map(whole: Fit, stack: Stack, frame: RigidTransform, inflation: float) -> MetricMap:
    """The map in its frame, with the spread of its weights and the sway of the directions."""
    turn = np.exp(1j * frame.yaw_rad)
    weights = turn * whole.map_weights
    weights[-1] += frame.x_m + 1j * frame.y_m
    factor = whole.elimination.factor
    inverse = scipy.linalg.solve_triangular(factor, np.eye(len(factor)), lower=True)
    spread = np.sqrt(whole.variance) * inverse.T
    sway = turn * _sway(whole, stack)
    return MetricMap(
        basis=whole.basis,
        weights=_plane(weights),
        spread=np.ascontiguousarray(spread),
        sway=np.stack([sway.real, sway.imag], axis=-1),
        noise_m=float(np.sqrt(whole.variance)),
        inflation=inflation,
    )


def _sway(whole: Fit, stack: Stack) -> Complex:
    """The weights' change (m, r) per standard deviation of the r loosest joint directions."""
    solution = whole.solution
    origins = schur(problem_of(whole, stack).system(solution.bias))[1]
    values, vectors = np.linalg.eigh(angle_covariance(whole))
    keep = min(_SWAYS, stack.segments - 1)
    loose = vectors[:, -keep:] * np.sqrt(np.maximum(values[-keep:], 0.0))
    turned = 1j * solution.z[:, None] * loose
    bias = solution.bias[stack.run][:, None]
    sway = whole.elimination.weights(np.vstack([origins @ turned, turned, -bias * turned]))
    # Moving the whole map is the gauge's matter: hold its middle still.
    middle = whole.expanded.mean(0) @ sway
    sway[-1] -= middle
    return np.asarray(sway)


def positions(result: MetricResult, segments: Segments) -> tuple[Indices, Array]:
    """Pictures (M,) of the segments, and where the certified solution puts them (M, 2) m."""
    stack = Stack.of(segments)
    path = stack.corrected(result.yaw_bias) * np.exp(1j * result.angles[stack.owner])
    return stack.images, result.origins[stack.owner] + _plane(path)


def headings(result: MetricResult, segments: Segments) -> tuple[Indices, Array]:
    """Pictures (M,) of the segments, and the robot's yaw (M,) rad in the map frame."""
    stack = Stack.of(segments)
    times = np.concatenate([s.times_s for s in segments])
    own = stack.headings - result.yaw_bias[stack.run[stack.owner]] * times
    return stack.images, wrap_angle(result.angles[stack.owner] + own)


def with_frame(result: MetricResult, frame: RigidTransform) -> MetricResult:
    """The same result in another frame: `frame` maps this map's coordinates to the new ones."""
    turn = np.exp(1j * frame.yaw_rad)

    def turned(points: Array) -> Array:
        return _plane((points[:, 0] + 1j * points[:, 1]) * turn)

    return replace(
        result,
        map=result.map.moved(frame),
        angles=wrap_angle(result.angles + frame.yaw_rad),
        origins=frame.apply(result.origins),
        residuals=turned(result.residuals),
        left_out=turned(result.left_out),
    )
