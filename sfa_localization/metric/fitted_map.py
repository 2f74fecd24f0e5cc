# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The map of a fit in the map frame, and how uncertain its directions, places and weights are.

The paper leaves the frame open (end of section 3.2): found solutions may be translated and rotated.
Here it is the odometry frame at the start of the first run, or given by `start_pose` or points.
"""

from __future__ import annotations

import numpy as np

from sfa_localization.data.geometry import (
    Array,
    Complex,
    RigidTransform,
    align_complex,
    compose,
    invert,
)
from sfa_localization.data.statistics import evenly
from sfa_localization.metric import phases
from sfa_localization.metric.dead_reckoning import summed
from sfa_localization.metric.map_fit import MapFit
from sfa_localization.metric.pose_graph import SHOWN
from sfa_localization.metric.saved_map import MetricMap


def plane(points: Complex) -> Array:
    """Points (M, 2) of complex x + i y (M,)."""
    return np.column_stack([points.real, points.imag])


def angle_covariance(fit: MapFit) -> Array:
    """Covariance (N, N) of the directions, rad^2, relative to the rotation of the whole map."""
    if fit.problem.graph is not None:
        return fit.problem.graph.angle_covariance
    return np.asarray(fit.link_variance * phases.angle_covariance(fit.solution.h, fit.solution.z))


def place_variance(fit: MapFit) -> Array:
    """How uncertain the segments leave the map at the place of each image, (M,) m^2 over both axes,
    without a motion of the whole map, which is a matter of its frame.

    The map is a regression to the places of all images: it repeats the errors that neighbors have
    in common. What a stretch errs alone it averages out; images that are left out show that.
    """
    shown = evenly(len(fit.places), SHOWN)
    repeated = fit.ridge.averages(shown)
    graph = fit.problem.graph
    variance = graph.variance(repeated) if graph else _variance(fit, repeated)
    return np.interp(np.arange(len(fit.places)), shown, variance)


def _variance(fit: MapFit, shares: Array) -> Array:
    """Of the sums of the images' places by shares (K, M), without a graph: (K,) m^2."""
    stack, places = fit.stack, fit.places
    origins, directions = _uncertain_segments(fit)
    path = stack.corrected(fit.solution.bias)
    moved = origins[stack.owner] + directions[stack.owner] * path[:, None]
    around_center = 1j * (places - places.mean())
    turn = np.real(np.conj(around_center) @ moved) / np.sum(np.abs(around_center) ** 2)
    moved = moved - moved.mean(0) - around_center[:, None] * turn
    return np.asarray((np.abs(shares @ moved) ** 2).sum(1))


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
    measured, solution, period = fit.problem.segments.points, fit.solution, fit.stack.period
    graph = fit.problem.graph
    if measured is None:
        return np.zeros(0, complex), np.zeros((0, 0), complex)
    rows = measured.rows(fit.stack)
    known = np.zeros((len(rows), len(rows)), complex) if graph is None else graph.covariance(rows)
    return rows @ solution.coefficients(period), known


def metric_map(fit: MapFit, frame: RigidTransform, inflation: float, common_m: float) -> MetricMap:
    """The map of a fit in the map frame, with the covariance of its weights."""
    weights = np.exp(1j * frame.yaw_rad) * fit.map_weights
    weights[-1] += frame.x_m + 1j * frame.y_m
    root, noise_m = fit.ridge.root.T, float(np.sqrt(fit.variance))
    return MetricMap.of(fit.ridge.basis, plane(weights), root, noise_m, inflation, common_m)


def map_frame(fit: MapFit) -> RigidTransform:
    """The transform from the fit's arbitrary frame to the map frame.

    The certified track is aligned with the odometry of the first run, each image weighted by how
    little the odometry can have drifted until then: the map coincides with the odometry frame at
    the start of the run. With a `start_pose`, the run starts there. Measured points come first.
    """
    start, measured = _start_frame(fit), fit.problem.segments.points
    return start if measured is None else measured.frame(places_of_points(fit)[0], start)


def _start_frame(fit: MapFit) -> RigidTransform:
    """By the odometry at the start of the first run, or the pose that it is to have."""
    segments, stack, pose = fit.problem.segments, fit.stack, fit.problem.config.start_pose
    starts, variances = _odometry(fit)
    rows = np.flatnonzero(stack.owner < len(starts))
    x, y, yaw = starts[stack.owner[rows]].T
    driven = x + 1j * y + np.exp(1j * yaw) * stack.corrected(fit.solution.bias)[rows]
    weights = 1.0 / (variances[stack.owner[rows]] + fit.variance)
    turn, shift = align_complex(fit.places[rows], driven, weights)
    frame = RigidTransform(shift.real, shift.imag, float(np.angle(turn)))
    if not pose:
        return frame
    start = segments.mount.base(segments[0].start[None], 0)[0]
    to_pose = compose(np.array(pose), invert(start))
    moved = compose(to_pose, np.array([frame.x_m, frame.y_m, frame.yaw_rad]))
    return RigidTransform(*(float(value) for value in moved))


def _odometry(fit: MapFit) -> tuple[Array, Array]:
    """Poses (n, 3) of the first segments' frames in the odometry frame, and variances (n,).

    Corrected for the bias; the variances are those of the places; up to the first break.
    """
    links, stack = fit.problem.links, fit.stack
    unbroken = np.cumprod(links.at == np.arange(len(links.at))).astype(bool)
    bias = fit.solution.bias[stack.period[links.at]]
    turned = (links.turn_rad - bias * links.turn_time_s)[unbroken]
    moved = (links.displacement - bias * links.displacement_drift)[unbroken]
    x, y, yaw = stack.starts[0]
    yaw = yaw + summed(turned)
    place = x + 1j * y + summed(np.exp(1j * yaw[:-1]) * moved)
    turned_variance = summed(links.turn_variance[unbroken])[:-1] * np.abs(moved) ** 2
    variances = summed(links.displacement_variance[unbroken] + turned_variance)
    return np.column_stack([plane(place), yaw]), variances
