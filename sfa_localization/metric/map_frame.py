# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Fix the map's frame: the odometry frame at the start of the first run, or an anchor."""

from __future__ import annotations

import numpy as np

from sfa_localization.data.geometry import Array, RigidTransform, align_complex, compose, invert
from sfa_localization.metric.alternation import Fit, targets
from sfa_localization.metric.quadratic_form import Stack
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.settings import MetricConfig


def gauge(fit: Fit, segments: Segments, stack: Stack, config: MetricConfig) -> RigidTransform:
    """The transform from the fit's arbitrary frame to the map frame.

    The certified track is laid on the odometry of the first run, each picture weighted by how
    little the odometry can have drifted until then: the map coincides with the odometry frame at
    the start of the run. With an anchor, the run starts at the anchor's pose in the map.
    """
    poses, variances = _odometry(segments, fit)
    rows = np.flatnonzero(stack.owner < len(poses))
    owner = stack.owner[rows]
    path = stack.corrected(fit.solution.bias)[rows]
    driven = poses[owner, 0] + 1j * poses[owner, 1] + np.exp(1j * poses[owner, 2]) * path
    weights = 1.0 / (variances[owner] + fit.variance)
    turn, shift = align_complex(targets(fit.solution, stack)[rows], driven, weights)
    frame = RigidTransform(shift.real, shift.imag, float(np.angle(turn)))
    if not config.use_anchor:
        return frame
    start = np.array([config.anchor_x, config.anchor_y, config.anchor_yaw])
    onto = compose(start, invert(segments[0].start))
    moved = compose(onto, np.array([frame.x_m, frame.y_m, frame.yaw_rad]))
    return RigidTransform(*(float(value) for value in moved))


def _odometry(segments: Segments, fit: Fit) -> tuple[Array, Array]:
    """Poses (n, 3) of the first segments' frames in the odometry frame, and variances (n,).

    Free of the bias; the variances are those of the places; up to the odometry's first break.
    """
    bias = float(fit.solution.bias[0])
    poses, variances = [np.asarray(segments[0].start, float)], [0.0]
    yaw_variance = place_variance = 0.0
    for segment in segments.items[:-1]:
        if not segment.linked:
            break
        moved = segment.displacement - bias * segment.displacement_drift
        turned = segment.turn_rad - bias * segment.turn_time_s
        poses.append(compose(poses[-1], np.array([moved.real, moved.imag, turned])))
        place_variance += segment.displacement_variance + yaw_variance * abs(moved) ** 2
        yaw_variance += segment.turn_variance
        variances.append(place_variance)
    return np.array(poses), np.array(variances)
