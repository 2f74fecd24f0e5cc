# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Residuals of odometry between segments, and their variances, which are learned with the map.

    |z_{n+1} - exp(i (turn_n - b time_n)) z_n|^2   signed turns: the second sum of eq. 5, which has
                                                   only cosines, the same for left and right
    |o_{n+1} - o_n - z_n displacement_n|^2         displacements: not in the paper

each over its variance, turns to first order in the biases. Messages and data sheets state noise of
wheels on a good floor. Where residuals are larger, the variances of the drive grow. The solution
fits its links, so residuals underestimate errors: each link adds 1 minus its posterior variance
over its prior variance to the degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy import sparse

from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.data.statistics import outlier_factor
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.stack import SegmentPoses, Stack

# The factor of a run and the weights of outliers are found in turn, far more often than needed.
_STEPS = 10
# The stated variances weigh as much as this many links whose residuals agree with them.
_PRIOR_LINKS = 10.0


@dataclass(frozen=True, slots=True)
class Links:
    """L turns and displacements from segments `at` (L,) to the next, as in `Segment`."""

    at: Indices
    run: Indices
    turn_rad: Array
    turn_variance: Array
    turn_time_s: Array
    displacement: Complex
    displacement_variance: Array
    displacement_drift: Complex

    @classmethod
    def of(cls, segments: Segments) -> Links:
        """Of all segments that odometry links to the next."""
        items = [(n, s) for n, s in enumerate(segments.items[:-1]) if s.linked]
        at = np.array([n for n, _ in items], np.int64)
        run = np.array([s.run for _, s in items], np.int64)
        names = (each.name for each in fields(cls)[2:])
        columns: list[Any] = [np.array([getattr(s, name) for _, s in items]) for name in names]
        return cls(at, run, *columns)

    def rows(self, stack: Stack) -> tuple[Any, Any]:
        """Rows (L, 3N) whose products with [o, z, -b z] are the residuals of turns, and the same of
        displacements."""
        n = stack.segments
        at = self.at
        ones = np.ones(len(self.at))
        turn = -np.exp(1j * self.turn_rad)
        turns = (n + at + 1, ones), (n + at, turn), (2 * n + at, 1j * self.turn_time_s * turn)
        moved = (n + at, -self.displacement), (2 * n + at, -self.displacement_drift)
        return stack.sparse(*turns), stack.sparse((at + 1, ones), (at, -ones), *moved)

    def ties(self, stack: Stack) -> Any:
        """The same (2 L, 3N), over their standard deviations."""
        std = np.sqrt(np.concatenate([self.turn_variance, self.displacement_variance]))
        return sparse.vstack(self.rows(stack)).multiply(1 / std[:, None]).tocsr()

    def by_mount(self, stack: Stack, poses: SegmentPoses) -> Complex:
        """Derivative (2 L, 4 + D) of these residuals by the mount (mount.py): by the slip of
        base_link ahead and to the left, m per rad of a turn, alone."""
        slip = -poses.z[self.at] * (np.exp(1j * self.turn_rad) - 1)
        columns = np.zeros((2 * len(slip), 5 + int(stack.run.max())), complex)
        columns[len(slip) :, 2] = slip / np.sqrt(self.displacement_variance)
        columns[:, 3] = 1j * columns[:, 2]
        return columns

    def learned(
        self, before: Links, residuals: tuple[Array, Array], uncertain: tuple[Array, Array]
    ) -> Links:
        """These links with the variances that a solution shows, run by run; never smaller ones.

        The solution of the links `before` has squared `residuals` (L,) of turns and, per axis, of
        displacements, and its variances (L,) of these are `uncertain`.
        """
        turned = self.turn_variance, before.turn_variance, residuals[0], uncertain[0]
        moved = self.displacement_variance, before.displacement_variance, residuals[1], uncertain[1]
        return replace(
            self,
            turn_variance=_grown(*turned, self.run, 1),
            displacement_variance=_grown(*moved, self.run, 2),
        )


def _grown(
    stated: Array, assumed: Array, squares: Array, uncertain: Array, run: Indices, axes: int
) -> Array:
    """Variances (L,) per axis: the stated ones times a factor of each run, and more for single
    links with far larger residuals (Student's distribution).

    A solution with `assumed` variances has `squares` of residuals, and is `uncertain` of them.
    """
    freedom = np.bincount(run, 1.0 - np.minimum(uncertain / assumed, 1.0)) + _PRIOR_LINKS
    error = (squares + uncertain) / stated
    misfit = squares / stated
    factor = np.ones(len(freedom))
    for _ in range(_STEPS):
        outlier = outlier_factor(axes * error / factor[run], axes)
        factor = (np.bincount(run, misfit / outlier) + _PRIOR_LINKS) / freedom
        factor = np.maximum(factor, 1.0)
    return np.asarray(stated * factor[run] * outlier_factor(axes * error / factor[run], axes))
