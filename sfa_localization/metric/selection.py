# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Choose the map's hyper-parameters by its evidence and by leaving out whole segments."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, align_complex
from sfa_localization.metric.alternation import Fit, fit, targets
from sfa_localization.metric.expansions import Basis, Monomials, Process, spread
from sfa_localization.metric.phases import phase_cost, refine
from sfa_localization.metric.quadratic_form import Links, Problem, Stack, eliminate, schur
from sfa_localization.metric.settings import MetricConfig

Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]

_COUNTS = {'gp': (8, 12, 16, 24, 32), 'monomials': (3, 4, 5, 6, 8, 10, 12)}
_RIDGES = (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
# The search, and the choice, work on fewer inducing points than the map they are for.
_SEARCH_POINTS = 300
_SCORE_POINTS = 700
_FLOOR_M = 1e-12


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Predictions of pictures whose segments the map has not seen, in the order of the stack."""

    errors: Complex
    """(M,) where the whole drive puts a picture minus where the map without it does, metres."""
    variances: Array
    """(M,) of the prediction per axis, before inflation, m^2."""

    @property
    def ratio(self) -> Array:
        """(M,) squared errors over both axes, over the variances of one."""
        return np.asarray(np.abs(self.errors) ** 2 / self.variances)

    @property
    def typical_m(self) -> float:
        """Geometric mean: what a choice is made by, for a few lost pictures rule the mean."""
        return float(np.exp(np.log(np.abs(self.errors) + _FLOOR_M).mean()))


def folds(stack: Stack, config: MetricConfig) -> list[Indices]:
    """Rows of the stack left out in turn: whole segments, in stretches of the drive.

    Stretches of a short drive are shorter: there are as many parts as are asked for, as far as
    there are segments, and always at least two. Raises DataError for a drive of one segment.
    """
    steps = np.abs(np.diff(stack.path, prepend=0)) * (np.diff(stack.owner, prepend=-1) == 0)
    lengths = np.bincount(stack.owner, steps)
    length = min(config.left_out_length, lengths.sum() / config.left_out_folds)
    # The middles of the first and the last segment are at least half the drive apart.
    middles = np.cumsum(lengths) - lengths / 2
    stretch = np.floor(middles / max(length, 1e-9)).astype(int)
    names = np.unique(stretch)
    if len(names) < 2:
        raise DataError(
            f'{lengths.sum():.1f} m of odometry with images leave nothing to check a map with: '
            'drive farther'
        )
    parts = min(config.left_out_folds, len(names))
    order = np.random.default_rng(config.metric_seed).permutation(len(names))
    fold = np.empty(len(names), int)
    fold[order] = np.arange(len(names)) % parts
    part = fold[np.searchsorted(names, stretch)][stack.owner]
    return [np.flatnonzero(part == k) for k in range(parts)]


def part_of(stack: Stack, config: MetricConfig) -> Indices:
    """(M,) which of the folds each row of the stack is in."""
    part = np.empty(len(stack.images), np.int64)
    for number, rows in enumerate(folds(stack, config)):
        part[rows] = number
    return part


def leave_out(whole: Fit, stack: Stack, config: MetricConfig) -> LeftOut:
    """Predict each fold from the others; the directions are found again without its pictures.

    The left-out segments keep their odometry, so the frame stays the same; what is predicted is
    compared with where the whole drive puts them.
    """
    errors = np.zeros(len(stack.images), complex)
    variances = np.zeros(len(stack.images))
    truth = targets(whole.solution, stack)
    missing = 1.0 + whole.basis.missing(whole.expanded)
    for rows in folds(stack, config):
        weights = whole.weights.copy()
        weights[rows] = 0.0
        elimination = eliminate(whole.expanded, whole.basis.ridge, weights, stack)
        problem = Problem(
            elimination.gram, whole.links, stack.run, whole.variance * whole.correlation, 0.0
        )
        solution = problem.solve(whole.solution.z, whole.solution.bias)
        coefficients = elimination.weights(solution.coefficients(stack.run))
        left = whole.expanded[rows]
        used = weights > 0
        turn, shift = align_complex(targets(solution, stack)[used], truth[used])
        errors[rows] = truth[rows] - (turn * (left @ coefficients) + shift)
        variances[rows] = whole.variance * (missing[rows] + elimination.leverage(left))
    return LeftOut(errors, variances)


def evidence(basis: Basis, features: Array, stack: Stack, links: Links, now: Fit) -> float:
    """Negative log evidence of a Gaussian process's hyper-parameters, at their best directions.

    Origins have flat priors (restricted likelihood); the signal's variance is profiled out.
    """
    expanded = basis.expand(features)
    weights = now.point_weights / (1.0 + basis.missing(expanded))
    noise = float(basis.ridge[0])
    elimination = eliminate(expanded, basis.ridge, weights, stack)
    variance = now.variance * now.correlation
    system = Problem(elimination.gram, links, stack.run, variance, 0.0).system(now.solution.bias)
    h = schur(system)[0]
    cost = 2.0 * phase_cost(h, refine(h, now.solution.z))
    points, segments = len(expanded), stack.segments
    own = np.real(system[:segments, :segments])
    own = own + np.trace(own) / segments**2
    freedom = points - segments
    return (
        freedom * float(np.log(cost / noise / freedom))
        + (points - len(basis.ridge) + 1 - segments) * float(np.log(noise))
        - float(np.log(weights).sum())
        + elimination.log_determinant
        + float(np.linalg.slogdet(own)[1])
    )


def slowness(features: Array, stack: Stack) -> Array:
    """Mean squared change (K,) of each standardized feature between neighbouring pictures."""
    same = stack.owner[1:] == stack.owner[:-1]
    change = np.mean(np.diff(features, axis=0)[same] ** 2, axis=0)
    spreads = features.var(axis=0)
    return np.asarray(change / np.where(spreads > 0, spreads, 1.0))


def feature_scale(features: Array, stack: Stack, count: int) -> Array:
    """Weight (count,) of each feature in the kernel: slower features count for more.

    A unit length is the typical distance of two pictures.
    """
    chosen = features[:, :count]
    change = np.maximum(slowness(chosen, stack), 1e-12)
    weights = change**-0.25
    weights /= np.sqrt(np.mean(weights**2) * count)
    spreads = chosen.std(axis=0)
    return np.asarray(weights / np.where(spreads > 0, spreads, 1.0))


def choose(features: Array, stack: Stack, links: Links, config: MetricConfig) -> Fit:
    """The map's basis, fitted: settings of 0 (or -1) are chosen, the others obeyed."""
    if config.metric_map == 'monomials':
        return _choose_monomials(features, stack, links, config)
    return _choose_process(features, stack, links, config)


def _counts(features: Array, config: MetricConfig) -> list[int]:
    available = features.shape[1]
    if config.slow_features:
        return [min(config.slow_features, available)]
    return [k for k in _COUNTS[config.metric_map] if k < available] + [available]


def _choose_monomials(features: Array, stack: Stack, links: Links, config: MetricConfig) -> Fit:
    """Count and ridge with the smallest left-out error."""
    ridges = _RIDGES if config.ridge < 0 else (config.ridge,)
    best: tuple[float, Fit] | None = None
    for count in _counts(features, config):
        if 1 + count + count * (count + 1) // 2 > len(features) / 2 and best is not None:
            break
        for ridge in ridges:
            basis = Monomials.fit(features, count, ridge)
            whole = fit(basis, features, stack, links, config, best[1] if best else None, 3)
            error = leave_out(whole, stack, config).typical_m
            if best is None or error < best[0]:
                best = error, whole
    assert best is not None
    return fit(best[1].basis, features, stack, links, config, best[1])


def _choose_process(features: Array, stack: Stack, links: Links, config: MetricConfig) -> Fit:
    """Length and noise by the evidence, the count of features by what is left out."""
    best: tuple[float, Fit, tuple[float, float]] | None = None
    knobs = config.gp_length or 1.0, config.gp_noise or 1e-3
    for count in _counts(features, config):
        now, knobs = _searched(count, knobs, features, stack, links, best and best[1], config)
        error = leave_out(now, stack, config).typical_m
        if best is None or error < best[0]:
            best = error, now, knobs
    assert best is not None
    _, now, (length, noise) = best
    scale = feature_scale(features, stack, now.basis.features) / length
    basis = Process.fit(features, scale, noise, config.inducing_points)
    return fit(basis, features, stack, links, config, now)


def _searched(
    count: int,
    knobs: tuple[float, float],
    features: Array,
    stack: Stack,
    links: Links,
    start: Fit | None,
    config: MetricConfig,
) -> tuple[Fit, tuple[float, float]]:
    """The process over `count` features at its best length and noise, and these."""
    scale = feature_scale(features, stack, count)
    chosen = spread(features[:, :count] * scale, _SEARCH_POINTS)
    points = features[chosen, :count] * scale

    def make(length: float, noise: float) -> Process:
        return Process.at(points / length, scale / length, noise)

    now = fit(make(*knobs), features, stack, links, config, start, 3)
    length, noise = _descend(make, knobs, features, stack, links, now, config)
    size = min(_SCORE_POINTS, config.inducing_points)
    basis = Process.fit(features, scale / length, noise, size)
    return fit(basis, features, stack, links, config, now, 2), (length, noise)


def _descend(
    make: Callable[[float, float], Process],
    knobs: tuple[float, float],
    features: Array,
    stack: Stack,
    links: Links,
    now: Fit,
    config: MetricConfig,
) -> tuple[float, float]:
    """Coordinate descent of the evidence by factors, over length and noise."""
    values: dict[tuple[float, float], float] = {}

    def value(pair: tuple[float, float]) -> float:
        if pair not in values:
            values[pair] = evidence(make(*pair), features, stack, links, now)
        return values[pair]

    for factor in (2.0, 1.4):
        while True:
            best = min(_around(knobs, factor, config), key=value)
            if not value(best) < value(knobs):
                break
            knobs = best
    return knobs


def _around(
    knobs: tuple[float, float], factor: float, config: MetricConfig
) -> Iterator[tuple[float, float]]:
    """Neighbours of length and noise within sane bounds."""
    length, noise = knobs
    for step in (factor, 1 / factor):
        if not config.gp_length and 0.05 < length * step < 20.0:
            yield length * step, noise
        if not config.gp_noise and 1e-6 < noise * step**2 < 1.0:
            yield length, noise * step**2
    yield knobs
