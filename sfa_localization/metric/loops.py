# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Offsets of loop closures as residuals beside those of odometry's links (see pose_graph.py).

An image b of segment j lies at the mixture of images a_k of segments i_k, by shares c_k of sum 1,
and is turned by t_k from each; h are the headings in the segments:

    |z_j exp(i h_b) - sum_k c_k exp(i t_k) z_ik exp(i h_ak)|^2       the turn
    |o_j + z_j q_b - sum_k c_k (o_ik + z_ik q_ak)|^2                 the place

Their variances are estimated with the map. Neighbors err alike, so that each counts for less than
one. Outliers, of places that look alike, lose their weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.data.statistics import LENGTH_TO_STD, MEDIAN_TO_STD, outlier_factor
from sfa_localization.keyframes.closures import Closures
from sfa_localization.keyframes.offsets import Offsets
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.stack import SegmentPoses, Stack
from sfa_localization.motion.dead_reckoning import summed

# Standard deviations, rad and m per axis, which grow with `Offsets.unlike`, that of closures, and
# the least factor on them.
_TURN_STD = 0.005
_PLACE_STD_M = 0.65
_ALIKE = 0.03
_CLOSURE_UNLIKE = 0.5
_LEAST = 0.2
_DRIFT_M = 1.0
_DRIFT = 0.1
"""Bound of the odometry's error: this many m plus this share of the distance driven (slipping
wheels: 5 %)."""


@dataclass(frozen=True, slots=True)
class Loops:
    """L mixtures: rows `turns` and `places` (L, 3N) whose products with [o, z, -b z] are residuals;
    the derivatives of places by the lever arm of the camera are those of `facing` (L, 3N), by slip
    those of `facing` minus `along` (L, 3N). Expected standard deviations `turn_std` rad and
    `place_std` m, (L,); `share` (L,) is one over how many neighbors err alike.
    """

    turns: Any
    places: Any
    facing: Any
    along: Any
    turn_std: Array
    place_std: Array
    share: Array

    @classmethod
    def of(cls, offsets: Offsets, stack: Stack) -> Loops:
        """Of the images of segments."""
        row = stack.rows(offsets.images)
        others = stack.rows(offsets.others)
        shares = np.where(others >= 0, offsets.shares, 0.0)
        whole = shares.sum(axis=1)
        kept = (row >= 0) & (np.abs(whole - 1.0) < _LEAST)
        shares = shares[kept] / whole[kept, None]
        unlike = offsets.unlike[kept]
        rows = _squares(row[kept], others[kept], shares, offsets.turn[kept], stack)
        place_std = _PLACE_STD_M * np.hypot(_ALIKE, unlike)
        alike = ErrorCorrelation().alike(np.cumsum(stack.steps)[row[kept]])
        return cls(*rows, _TURN_STD * (1 + unlike), place_std, 1.0 / alike)

    def ties(self, stack: Stack, before: SegmentPoses | None) -> Any:
        """Rows (2 L, 3N) of turns and places over their standard deviations, which are those of the
        residuals at the poses `before`."""
        weight = self._weights(stack, before)
        return sparse.vstack([self.turns, self.places]).multiply(weight[:, None]).tocsr()

    def by_mount(self, stack: Stack, before: SegmentPoses | None, poses: SegmentPoses) -> Complex:
        """Derivative (2 L, 4 + D) of these residuals by the mount (mount.py): by its lever arm, m,
        slip, and its yaw in each of D drives, rad."""
        y = poses.coefficients(stack.period)
        count = len(self.share)
        lever = self.facing @ y
        slip = lever - self.along @ y
        columns = np.zeros((2 * count, 5 + int(stack.run.max())), complex)
        columns[count:, :4] = np.column_stack([lever, 1j * lever, slip, 1j * slip])
        for drive in range(int(stack.run.max()) + 1):
            columns[:count, 4 + drive] = 1j * (self.turns @ (y * np.tile(stack.run == drive, 3)))
        return np.asarray(columns * self._weights(stack, before)[:, None])

    def _weights(self, stack: Stack, before: SegmentPoses | None) -> Array:
        """(2 L,) one over the standard deviations, by the residuals at the poses `before`."""
        turn_std = self.turn_std
        place_std = self.place_std
        outlier = np.ones(len(self.share))
        if before is not None and len(outlier):
            y = before.coefficients(stack.period)
            turned = np.abs(self.turns @ y) / turn_std
            missed = np.abs(self.places @ y) / place_std
            turn_factor = max(MEDIAN_TO_STD * float(np.median(turned)), _LEAST)
            place_factor = max(LENGTH_TO_STD * float(np.median(missed)), _LEAST)
            turn_std = turn_factor * turn_std
            place_std = place_factor * place_std
            squares = (turned / turn_factor) ** 2 + (missed / place_factor) ** 2
            outlier = outlier_factor(squares, 3)  # a turn and both axes of a place
        weights = np.sqrt(np.tile(self.share / outlier, 2))
        return np.asarray(weights / np.concatenate([turn_std, place_std]))


def rough_offsets(closures: Closures) -> Offsets:
    """Closures without measured offsets, taken as 0 m: accurate enough to find the neighbors of
    images.
    """
    images = closures.images
    turn = closures.turn[:, None]
    unlike = np.full(len(turn), _CLOSURE_UNLIKE)
    return Offsets(images[:, 1], images[:, :1], np.ones_like(turn), turn, unlike)


def _squares(
    row: Indices, others: Indices, shares: Array, turn: Array, stack: Stack
) -> tuple[Any, Any, Any, Any]:
    """`turns`, `places`, `facing` and `along` of a row (L,) of the stack among others (L, K)."""
    rows = np.column_stack([row, others])
    zeros = np.zeros(len(row))
    minus = np.column_stack([zeros + 1.0, -shares])
    turns = minus * np.exp(1j * (stack.headings[rows] + np.column_stack([zeros, turn])))
    n = stack.segments
    owner = stack.owner[rows]
    turned = (n + owner, turns), (2 * n + owner, 1j * stack.times_s[rows] * turns)
    places = stack.place_rows(rows, minus)
    facing = stack.facing_rows(rows, minus)
    return stack.sparse(*turned), places, facing, stack.sparse((n + owner, minus))


def with_closures(segments: Segments, closures: Closures) -> Segments:
    """Remove the closures that unbroken odometry excludes: doors of a corridor and trees in rows
    look alike.
    """
    stack = Stack.of(segments)
    owner = stack.owner
    x, y, yaw = stack.starts[stack.owner].T
    places = x + 1j * y + np.exp(1j * yaw) * stack.path
    driven = np.cumsum(stack.steps)
    # And the distance from the last image of a segment to the first one of the next.
    gaps = [np.nan_to_num(abs(s.displacement)) for s in segments] - stack.sums(stack.steps)
    driven += summed(np.maximum(gaps, 0.0))[owner]
    unbroken = np.cumsum([0, *(not segment.linked for segment in segments)])[owner]
    rows = stack.rows(closures.images)
    first, second = rows.T
    limit = _DRIFT_M + _DRIFT * np.abs(driven[second] - driven[first])
    impossible = (np.abs(places[second] - places[first]) > limit) & (rows >= 0).all(1)
    kept = ~(impossible & (unbroken[first] == unbroken[second]))
    return replace(segments, closures=Closures(closures.images[kept], closures.turn[kept]))
