# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Measured points as residuals of the pose graph: see measured_points.py."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from sfa_localization.data.geometry import Complex, align_complex
from sfa_localization.metric.measured_points import MeasuredPoints
from sfa_localization.metric.stack import SegmentPoses, Stack


def rows(measured: MeasuredPoints, stack: Stack) -> Complex:
    """Rows (K, 3N) whose products with [o, z, -b z] are where the drive puts the robot; 0 for
    points near no image."""
    near = stack.rows(measured.images)
    placed = measured.placed.astype(float)
    beside = stack.facing_rows(near, placed * measured.offset)
    return np.asarray((stack.place_rows(near, placed) + beside).toarray())


def ties(
    measured: MeasuredPoints, stack: Stack, before: SegmentPoses | None = None
) -> sparse.csr_array:
    """Rows (K, 3N) of the residuals of the used points over their standard deviations.

    The heading of the points turns with the mean of the segments from that at the poses
    `before`, without which there are no rows.
    """
    n = stack.segments
    used = measured.settled.used & measured.settled.turned
    if before is None or not used.any():
        return sparse.csr_array((0, 3 * n), dtype=complex)
    placed = rows(measured, stack)[used]
    points = measured.points.places[used]
    std = measured.points.std[used]
    points = points - points.mean()
    turn, _ = align_complex(points, placed @ before.coefficients(stack.period), std**-2)
    placed[:, n : 2 * n] -= np.outer(turn * points, before.z.conj() / n)
    placed = (placed - np.average(placed, axis=0, weights=std**-2)) / std[:, None]
    return sparse.csr_array(placed)
