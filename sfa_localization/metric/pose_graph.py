# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where odometry and loop closures alone put the images of all drives."""

from __future__ import annotations

import numpy as np

from sfa_localization.data.geometry import Array
from sfa_localization.metric.link_noise import learned
from sfa_localization.metric.loops import loops_of
from sfa_localization.metric.map_covariance import plane
from sfa_localization.metric.map_fit import YAW_BIAS_STD
from sfa_localization.metric.quadratic_form import Links, QuadraticForm, Stack
from sfa_localization.metric.segments import Segments

# Of the solution and the weights that it shows, in turn: as settled as its use needs.
_ROUNDS = 3
# Weight of the distance from the middle beside closures, 1 / m^2: drives that nothing ties stay.
_STAY = 1e-6


def graph_poses(segments: Segments, count: int) -> Array:
    """Poses (count, 3) of the images, x m, y m, yaw rad, in a frame of their own; NaN for those of
    no segment."""
    stack, stated = Stack.of(segments), Links.of(segments)
    loops = loops_of(segments.closures, segments.offsets, stack)
    stay = np.diag(np.repeat([_STAY, 0.0, 0.0], stack.segments)).astype(complex)
    links, solution, bias = stated, None, np.zeros(stack.period[-1] + 1)
    for _ in range(_ROUNDS):
        gram = stay + np.sum([one.form(stack, solution) for one in loops], axis=0)
        form = QuadraticForm(gram, links, stack.period, 1.0, YAW_BIAS_STD)
        solution = form.solve(solution.z if solution else None, bias)
        links, bias = learned(stated, form, solution), solution.bias
    assert solution is not None
    poses = np.full((count, 3), np.nan)
    yaw = stack.headings - bias[stack.period[stack.owner]] * stack.times_s
    poses[stack.images, 2] = np.angle(solution.z)[stack.owner] + yaw
    poses[stack.images, :2] = plane(solution.places(stack))
    return poses
