# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How uncertain directions, positions and the map of a fit are, and the map with its covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, RigidTransform
from sfa_localization.metric import phases
from sfa_localization.metric.map_fit import MapFit
from sfa_localization.metric.saved_map import MetricMap, Weights

Complex = NDArray[np.complex128]


# Joint changes of the segments that count: a map averages over smaller ones.
_JOINT = 24


def plane(points: Complex) -> Array:
    """Points (M, 2) of complex x + i y (M,)."""
    return np.column_stack([points.real, points.imag])


def angle_covariance(fit: MapFit) -> Array:
    """Covariance (N, N) of the directions, rad^2, relative to the rotation of the whole map."""
    if fit.problem.graph is not None:
        return fit.problem.graph.angle_covariance
    return np.asarray(fit.link_variance * phases.angle_covariance(fit.solution.h, fit.solution.z))


def place_variance(fit: MapFit) -> Array:
    """How uncertain the segments' origins and directions leave the place of each image, (M,) m^2
    over both axes, without a motion of the whole map, which is a matter of its frame."""
    stack, places, graph = fit.stack, fit.places, fit.problem.graph
    # Three are the motions of the whole map.
    origins, directions = graph.modes(_JOINT + 3) if graph else _uncertain_segments(fit)
    path = stack.corrected(fit.solution.bias)
    moved = origins[stack.owner] + directions[stack.owner] * path[:, None]
    around_center = 1j * (places - places.mean())
    turn = np.real(np.conj(around_center) @ moved) / np.sum(np.abs(around_center) ** 2)
    moved = moved - moved.mean(0) - around_center[:, None] * turn
    largest = np.linalg.eigh(np.real(moved.conj().T @ moved))[1][:, -_JOINT:]
    return np.asarray((np.abs(moved @ largest) ** 2).sum(1))


def _uncertain_segments(fit: MapFit) -> tuple[Complex, Complex]:
    """Changes of origins and directions (N, 3N each), one standard deviation a column.

    First those of the directions, which the origins follow; then of the origins along both axes.
    """
    solution = fit.solution
    form, n = fit.form(fit.ridge), fit.stack.segments
    bias = -solution.bias[form.period]
    follow = form.origins[:, :n] + form.origins[:, n:] * bias
    values, vectors = np.linalg.eigh(angle_covariance(fit))
    turned = 1j * solution.z[:, None] * (vectors * np.sqrt(np.maximum(values, 0.0)))
    values, vectors = np.linalg.eigh(form.own)
    # Moving all origins together costs nothing, and is no error of the map.
    fixed = values > 1e-9 * values[-1]
    scale = np.sqrt(fit.link_variance / np.where(fixed, values, 1.0)) * fixed
    own = vectors * scale
    origins = np.hstack([follow @ turned, own, 1j * own])
    return origins, np.hstack([turned, np.zeros((n, 2 * n))])


def places_of_points(fit: MapFit) -> tuple[Complex, Complex]:
    """Where the drive puts the robot at measured points (K,), and the covariance (K, K) per axis of
    that, without a motion of the whole map; 0 for the paper's descent."""
    anchors, solution, period = fit.problem.segments.anchors, fit.solution, fit.stack.period
    graph = fit.problem.graph
    if anchors is None:
        return np.zeros(0, complex), np.zeros((0, 0), complex)
    rows = anchors.rows(fit.stack)
    known = np.zeros((len(rows), len(rows)), complex) if graph is None else graph.covariance(rows)
    return rows @ solution.coefficients(period), known


def metric_map(fit: MapFit, frame: RigidTransform, inflation: float, common_m: float) -> MetricMap:
    """The map of a fit in the map frame, with the covariance of its weights."""
    weights = np.exp(1j * frame.yaw_rad) * fit.map_weights
    weights[-1] += frame.x_m + 1j * frame.y_m
    std = float(np.sqrt(fit.variance))
    learned = Weights(plane(weights), np.ascontiguousarray(std * fit.ridge.root.T), std)
    return MetricMap.of(fit.ridge.basis, learned, inflation, common_m)
