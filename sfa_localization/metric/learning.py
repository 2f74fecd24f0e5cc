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

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, RigidTransform, align_complex, wrap_angle
from sfa_localization.features.agreement import needed_factor, share_within
from sfa_localization.metric import paper_solver
from sfa_localization.metric.alternation import Fit, problem_of, targets
from sfa_localization.metric.expansions import MetricMap
from sfa_localization.metric.forecast import Forecast, forecast, nearest_used
from sfa_localization.metric.map_frame import gauge
from sfa_localization.metric.phases import Certificate, certify, refine
from sfa_localization.metric.quadratic_form import Links, Stack, schur
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.selection import LeftOut, choose, leave_out, part_of
from sfa_localization.metric.settings import MetricConfig
from sfa_localization.metric.sufficiency import (
    Diagnostics,
    angle_covariance,
    check,
    check_amount,
    diagnose,
)

Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]

# Ways in which the drive's positions sway together, kept for the covariance of a position.
_SWAYS = 24


@dataclass(frozen=True, slots=True)
class Consistency:
    """How honest the covariance is on left-out segments, after inflation, by their weights."""

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
    left_out_weight: Array
    """(M,) of sum 1: how much each of `left_out` says of paths between the trained ones, by how
    far the nearest image was that the map had seen."""
    left_out_rigid_m: float
    """Mean left-out error once each left-out segment is moved rigidly onto its predictions."""
    forecast: Forecast
    """Errors to expect on paths between the trained ones."""
    consistency: Consistency
    diagnostics: Diagnostics
    history: Array
    """(I,) cost at each iteration of the paper's descent; empty for the certified solver."""

    @property
    def left_out_error_m(self) -> float:
        """Mean error of a map at stretches of the drive that it was learnt without.

        The distance to where the whole drive, certified, puts the stretch; needs no ground truth.
        Most stretches lie beyond the rest: `forecast` says what to expect between them.
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
    return _result(whole, segments, stack, diagnostics, history, config)


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
    segments: Segments,
    stack: Stack,
    diagnostics: Diagnostics,
    history: Array,
    config: MetricConfig,
) -> MetricResult:
    left = leave_out(whole, stack, config)
    sway = _sway(whole, stack)
    swayed = (np.abs(whole.expanded @ sway) ** 2).sum(1)
    expected = forecast(whole, stack, swayed, np.random.default_rng(config.metric_seed))
    places = targets(whole.solution, stack)
    weight = expected.importance(nearest_used(_plane(places), part_of(stack, config)))
    inflation = _inflation(left, weight)
    frame = gauge(whole, segments, stack, config)
    turn = np.exp(1j * frame.yaw_rad)
    origins = whole.solution.o * turn + frame.x_m + 1j * frame.y_m
    return MetricResult(
        map=_map(whole, turn * sway, frame, inflation),
        angles=wrap_angle(np.angle(whole.solution.z) + frame.yaw_rad),
        origins=_plane(origins),
        angle_covariance=angle_covariance(whole),
        yaw_bias=whole.solution.bias,
        certificate=whole.solution.certificate,
        images=stack.images,
        residuals=_plane(whole.residuals * turn),
        noise_m=float(np.sqrt(whole.variance)),
        left_out=_plane(left.errors * turn),
        left_out_variance=left.variances * inflation,
        left_out_weight=weight,
        left_out_rigid_m=_rigid_error(left, whole, stack),
        forecast=expected.moved(frame),
        consistency=_consistency(left, inflation, weight),
        diagnostics=diagnostics,
        history=history,
    )


def _plane(values: Complex) -> Array:
    return np.column_stack([values.real, values.imag])


def _inflation(left: LeftOut, weight: Array) -> float:
    """Factor, at least 1, on the predicted variances, by the left-out errors.

    Half of these, by weight (M,), then fall inside the 50 % ellipse, and 95 % inside the 95 %
    ellipse.
    """
    return max(needed_factor(left.ratio, 2, weight), 1.0)


def _consistency(left: LeftOut, inflation: float, weight: Array) -> Consistency:
    ratio = left.ratio / inflation
    inside = [share_within(ratio, 2, share, weight) for share in (0.5, 0.95)]
    return Consistency(inside[0], inside[1], float(np.average(ratio, weights=weight)))


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


def _map(whole: Fit, sway: Complex, frame: RigidTransform, inflation: float) -> MetricMap:
    """The map in its frame, with the spread of its weights and the sway of the positions."""
    weights = np.exp(1j * frame.yaw_rad) * whole.map_weights
    weights[-1] += frame.x_m + 1j * frame.y_m
    factor = whole.elimination.factor
    inverse = scipy.linalg.solve_triangular(factor, np.eye(len(factor)), lower=True)
    spread = np.sqrt(whole.variance) * inverse.T
    return MetricMap(
        basis=whole.basis,
        weights=_plane(weights),
        spread=np.ascontiguousarray(spread),
        sway=np.stack([sway.real, sway.imag], axis=-1),
        noise_m=float(np.sqrt(whole.variance)),
        inflation=inflation,
    )


def _sway(whole: Fit, stack: Stack) -> Complex:
    """The map weights' change (m, r) per standard deviation of the r loosest joint changes of
    the segments' origins and directions, without moving the whole map, which is the gauge's
    matter."""
    origins, directions = _loose(whole, stack)
    path = stack.corrected(whole.solution.bias)
    moved = origins[stack.owner] + directions[stack.owner] * path[:, None]
    places = targets(whole.solution, stack)
    round_middle = 1j * (places - places.mean())
    turn = np.real(np.conj(round_middle) @ moved) / np.sum(np.abs(round_middle) ** 2)
    moved = moved - moved.mean(0) - round_middle[:, None] * turn
    values, vectors = np.linalg.eigh(np.real(moved.conj().T @ moved))
    keep = vectors[:, np.argsort(values)[::-1][:_SWAYS]]
    bias = whole.solution.bias[stack.run][:, None]
    directions = directions @ keep
    changes = np.vstack([origins @ keep, directions, -bias * directions])
    sway = whole.elimination.weights(changes) - 1j * np.outer(whole.map_weights, turn @ keep)
    sway[-1] -= whole.expanded.mean(0) @ sway
    return np.asarray(sway)


def _loose(whole: Fit, stack: Stack) -> tuple[Complex, Complex]:
    """Changes of origins and directions (N, 3N each), one standard deviation a column.

    The directions', with the origins following; then the origins' own, along both axes.
    """
    solution = whole.solution
    system = problem_of(whole, stack).system(solution.bias)
    follow = schur(system)[1]
    values, vectors = np.linalg.eigh(angle_covariance(whole))
    turned = 1j * solution.z[:, None] * (vectors * np.sqrt(np.maximum(values, 0.0)))
    n = stack.segments
    values, vectors = np.linalg.eigh(np.real(system[:n, :n]))
    # Moving all together costs nothing, and is no error of the map.
    held = values > 1e-9 * values[-1]
    scale = np.sqrt(whole.variance * whole.correlation / np.where(held, values, 1.0)) * held
    own = vectors * scale
    origins = np.hstack([follow @ turned, own, 1j * own])
    return origins, np.hstack([turned, np.zeros((n, 2 * n))])


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
        forecast=result.forecast.moved(frame),
    )
