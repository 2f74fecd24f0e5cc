# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What odometry measured from one segment to the next, and how noisy it is, learned with the map.

    |z_{n+1} - exp(i (turn_n - b time_n)) z_n|^2      signed turns: the second sum of eq. 5, which
                                                  has only cosines, the same for left and right
    |o_{n+1} - o_n - z_n displacement_n|^2        displacements: not in the paper

each over its variance, turns to first order in the biases. What messages state of their noise, or
data sheets, is of wheels on a good floor. Where the links of a drive miss its solution by more than
that, their variances grow. They miss it by less than they err, because it follows them: a link has
as much of a degree of freedom left as the solution's own uncertainty of it is smaller than its
variance.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy import sparse

from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.data.statistics import outlier_factor
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.stack import Solution, Stack

# Of a run's factor and the doubts of its links in turn: far more than they need.
_STEPS = 10
# The variances that are stated or assumed count as so many links that miss by just as much: those
# of a few say little.
_PRIOR_LINKS = 10.0


@dataclass(frozen=True, slots=True)
class Links:
    """L turns and displacements of segments `at` (L,), as in `Segment`; those of infinite variance
    have no weight."""

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
        """Of all segments from which odometry leads on."""
        items = [(n, s) for n, s in enumerate(segments.items[:-1]) if s.linked]
        at = np.array([n for n, _ in items], np.int64)
        run = np.array([s.run for _, s in items], np.int64)
        names = (one.name for one in fields(cls)[2:])
        column: list[Any] = [np.array([getattr(s, name) for _, s in items]) for name in names]
        return cls(at, run, *column)

    def rows(self, stack: Stack) -> tuple[Any, Any]:
        """Of the turns and of the displacements, (L, 3N) each: what is squared of [o, z, -b z]."""
        n, at, ones = stack.segments, self.at, np.ones(len(self.at))
        turn = -np.exp(1j * self.turn_rad)
        turns = (n + at + 1, ones), (n + at, turn), (2 * n + at, 1j * self.turn_time_s * turn)
        moved = (n + at, -self.displacement), (2 * n + at, -self.displacement_drift)
        return stack.sparse(*turns), stack.sparse((at + 1, ones), (at, -ones), *moved)

    def ties(self, stack: Stack) -> Any:
        """The same (2 L, 3N), over their standard deviations."""
        std = np.sqrt(np.concatenate([self.turn_variance, self.displacement_variance]))
        return sparse.vstack(self.rows(stack)).multiply(1 / std[:, None]).tocsr()

    def by_mount(self, stack: Stack, now: Solution) -> Any:
        """Derivative (2 L, 4 + D) of the same in a solution: by how far base_link slips ahead and
        to the left, m, where it turns by a radian, and by nothing else of the camera's mount."""
        slip = -now.z[self.at] * (np.exp(1j * self.turn_rad) - 1)
        columns = np.zeros((2 * len(slip), 5 + int(stack.run.max())), complex)
        known = np.isfinite(self.displacement_variance)
        weighted = np.where(known, slip, 0.0) / np.sqrt(self.displacement_variance)
        columns[len(slip) :, 2], columns[len(slip) :, 3] = weighted, 1j * weighted
        return columns

    def alike(self, other: Links, tolerance: float) -> bool:
        """Whether the variances of the same links differ by less than a part, on average."""
        for name in ('turn_variance', 'displacement_variance'):
            known = np.isfinite(its := getattr(other, name))
            change = np.abs(getattr(self, name)[known] / its[known] - 1.0)
            if len(change) and change.mean() >= tolerance:
                return False
        return True

    def learned(
        self, before: Links, stack: Stack, solution: Solution, turn_left: Array, move_left: Array
    ) -> Links:
        """Links of these variances or, in each run, of larger ones that a solution shows.

        It is that of the links `before`, and leaves the variances (L,) `turn_left` and `move_left`,
        per axis, of their turns and displacements unknown.
        """
        x = solution.coefficients(stack.period)
        turned, moved = (np.abs(rows @ x) ** 2 for rows in self.rows(stack))
        shown: dict[str, Any] = {}
        for name, squares, left, axes in (
            ('turn_variance', turned, turn_left, 1),
            ('displacement_variance', moved / 2, move_left, 2),
        ):
            variances = getattr(self, name), getattr(before, name)
            shown[name] = _grown(*variances, squares, left, self.run, axes)
        return replace(self, **shown)


def _grown(
    stated: Array, assumed: Array, squares: Array, left: Array, run: Indices, axes: int
) -> Array:
    """Variances (L,): those of each run as many times the `stated` ones as its links show, and
    more for single links that miss by far more (Student's distribution).

    Links miss a solution that `assumed` other variances along each of so many `axes` by `squares`
    (L,), and it leaves the variances `left` (L,) unknown. An infinite variance stays.
    """
    known = np.isfinite(stated)
    of = np.where(known, stated, 1.0)
    followed = np.minimum(left / assumed, 1.0)
    freedom = np.bincount(run, known * (1.0 - followed)) + _PRIOR_LINKS
    error, miss = (squares + left) / of, known * squares / of
    factor = np.ones(len(freedom))
    for _ in range(_STEPS):
        doubt = outlier_factor(axes * error / factor[run], axes)
        factor = (np.bincount(run, miss / doubt) + _PRIOR_LINKS) / freedom
        factor = np.maximum(factor, 1.0)
    return np.asarray(stated * factor[run] * outlier_factor(axes * error / factor[run], axes))
