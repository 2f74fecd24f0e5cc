# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The map of a fit in the map frame, and how uncertain its places and weights are.

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
from sfa_localization.mapping.map_fit import MapFit
from sfa_localization.mapping.saved_map import MetricMap
from sfa_localization.metric import point_ties
from sfa_localization.metric.pose_graph import SAMPLED
from sfa_localization.motion.dead_reckoning import summed


def plane(points: Complex) -> Array:
    """Points (M, 2) of complex x + i y (M,)."""
    return np.column_stack([points.real, points.imag])


def place_variance(fit: MapFit) -> Array:
    """Variance (M,) m^2, over both axes, of the map at each image due to the segments, relative to
    the whole map.

    The map is a regression to the places of all images: it repeats the errors that neighbors share.
    It averages out the independent errors of single images, which left-out images measure.
    """
    sample = evenly(len(fit.places), SAMPLED)
    variance = fit.graph.variance(fit.ridge.averages(sample))
    return np.interp(np.arange(len(fit.places)), sample, variance)


def places_of_points(fit: MapFit) -> tuple[Complex, Complex]:
    """Where the segments put the robot at measured points (K,), and the covariance (K, K) per axis,
    relative to the whole map."""
    measured = fit.problem.segments.points
    if measured is None:
        return np.zeros(0, complex), np.zeros((0, 0), complex)
    rows = point_ties.rows(measured, fit.stack)
    return rows @ fit.graph.poses.coefficients(fit.stack.period), fit.graph.covariance(rows)


def metric_map(fit: MapFit, frame: RigidTransform, inflation: float, common_m: float) -> MetricMap:
    """The map of a fit in the map frame, with the covariance of its weights."""
    weights = np.exp(1j * frame.yaw_rad) * fit.map_weights
    weights[-1] += frame.x_m + 1j * frame.y_m
    root = fit.ridge.root.T
    noise_m = float(np.sqrt(fit.variance))
    return MetricMap.of(fit.ridge.basis, plane(weights), root, noise_m, inflation, common_m)


def map_frame(fit: MapFit) -> RigidTransform:
    """The transform from the fit's arbitrary frame to the map frame.

    The map frame is the odometry frame at the start of the first run; with a `start_pose`, that run
    starts there. Measured points come first.
    """
    start = _start_frame(fit)
    measured = fit.problem.segments.points
    return start if measured is None else measured.frame(places_of_points(fit)[0], start)


def _start_frame(fit: MapFit) -> RigidTransform:
    """By the odometry at the start of the first run, each image weighted by how little the odometry
    can have drifted until then, or by the pose that the run is to have."""
    segments = fit.problem.segments
    stack = fit.stack
    pose = fit.problem.config.start_pose
    starts, variances = _odometry(fit)
    rows = np.flatnonzero(stack.owner < len(starts))
    x, y, yaw = starts[stack.owner[rows]].T
    driven = x + 1j * y + np.exp(1j * yaw) * stack.corrected(fit.graph.poses.bias)[rows]
    weights = 1.0 / (variances[stack.owner[rows]] + fit.variance)
    turn, shift = align_complex(fit.places[rows], driven, weights)
    frame = np.array([shift.real, shift.imag, float(np.angle(turn))])
    if pose:
        start = segments.mount.base(segments[0].start[None], 0)[0]
        frame = compose(compose(np.array(pose), invert(start)), frame)
    return RigidTransform(*frame.tolist())


def _odometry(fit: MapFit) -> tuple[Array, Array]:
    """Poses (n, 3) of the first segments by odometry without the biases, up to the first break, and
    the variances (n,) of their places."""
    links = fit.problem.links
    stack = fit.stack
    unbroken = np.cumprod(links.at == np.arange(len(links.at))).astype(bool)
    bias = fit.graph.poses.bias[stack.period[links.at]]
    turned = (links.turn_rad - bias * links.turn_time_s)[unbroken]
    moved = (links.displacement - bias * links.displacement_drift)[unbroken]
    x, y, yaw = stack.starts[0]
    yaw = yaw + summed(turned)
    place = x + 1j * y + summed(np.exp(1j * yaw[:-1]) * moved)
    by_turns = summed(links.turn_variance[unbroken])[:-1] * np.abs(moved) ** 2
    variances = summed(links.displacement_variance[unbroken] + by_turns)
    return np.column_stack([plane(place), yaw]), variances
