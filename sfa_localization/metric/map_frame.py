# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Determine the map's frame: the odometry frame at the start of the first run, or an anchor.

The paper leaves it open (end of section 3.2): found solutions may be translated and rotated.
"""

from __future__ import annotations

import numpy as np

from sfa_localization.data.geometry import Array, RigidTransform, align_complex, compose, invert
from sfa_localization.metric.map_covariance import places_of_points
from sfa_localization.metric.map_fit import MapFit


def map_frame(fit: MapFit) -> RigidTransform:
    """The transform from the fit's arbitrary frame to the map frame.

    The certified track is aligned with the odometry of the first run, each image weighted by how
    little the odometry can have drifted until then: the map coincides with the odometry frame at
    the start of the run. With an anchor, the run starts at the anchor's pose in the map. Measured
    points come first.
    """
    start, anchors = _start_frame(fit), fit.problem.segments.anchors
    return start if anchors is None else anchors.frame(places_of_points(fit)[0], start)


def _start_frame(fit: MapFit) -> RigidTransform:
    """By the odometry at the start of the first run, or the pose that it is to have."""
    segments, stack, anchor = fit.problem.segments, fit.stack, fit.problem.config.anchor
    poses, variances = _odometry(fit)
    rows = np.flatnonzero(stack.owner < len(poses))
    owner = stack.owner[rows]
    path = stack.corrected(fit.solution.bias)[rows]
    driven = poses[owner, 0] + 1j * poses[owner, 1] + np.exp(1j * poses[owner, 2]) * path
    weights = 1.0 / (variances[owner] + fit.variance)
    turn, shift = align_complex(fit.places[rows], driven, weights)
    frame = RigidTransform(shift.real, shift.imag, float(np.angle(turn)))
    if not anchor:
        return frame
    to_anchor = compose(np.array(anchor), invert(segments[0].start))
    moved = compose(to_anchor, np.array([frame.x_m, frame.y_m, frame.yaw_rad]))
    return RigidTransform(*(float(value) for value in moved))


def _odometry(fit: MapFit) -> tuple[Array, Array]:
    """Poses (n, 3) of the first segments' frames in the odometry frame, and variances (n,).

    Corrected for the bias; the variances are those of the places; up to the first break.
    """
    segments = fit.problem.segments
    poses, variances = [np.asarray(segments[0].start, float)], [0.0]
    yaw_variance = place_variance = 0.0
    for segment in segments.items[:-1]:
        if not segment.linked:
            break
        bias = float(fit.solution.bias[segment.period])
        moved = segment.displacement - bias * segment.displacement_drift
        turned = segment.turn_rad - bias * segment.turn_time_s
        poses.append(compose(poses[-1], np.array([moved.real, moved.imag, turned])))
        place_variance += segment.displacement_variance + yaw_variance * abs(moved) ** 2
        yaw_variance += segment.turn_variance
        variances.append(place_variance)
    return np.array(poses), np.array(variances)
