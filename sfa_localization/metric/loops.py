# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures as squares beside those of odometry's links (see pose_graph.py).

An image b of segment j lies at the mixture of images a_k of segments i_k, by shares c_k of sum 1,
and is turned by t_k from each; h are the headings in the segments:

    |z_j exp(i h_b) - sum_k c_k exp(i t_k) z_ik exp(i h_ak)|^2       the turn
    |o_j + z_j q_b - sum_k c_k (o_ik + z_ik q_ak)|^2                 the place

Offsets (keyframes/offsets.py) are such mixtures; closures, of which the distance is unknown, tie
two images with c = 1 where there are none. How well they hold is estimated with the map; neighbors
err alike, and count for as many as they are worth. A few may be wrong: places can look alike. What
does not fit loses its weight, so that the form stays quadratic and its solution certified.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import Array, Indices
from sfa_localization.data.statistics import LENGTH_TO_STD, MEDIAN_TO_STD, outlier_factor
from sfa_localization.keyframes.closures import Closures
from sfa_localization.keyframes.offsets import Offsets
from sfa_localization.metric.dead_reckoning import summed
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.stack import Solution, Stack

# Standard deviations that are expected, rad and m per axis: they grow with `Offsets.unlike`, which
# closures do not know; and the least part of them that the map may show.
_TURN_STD, _PLACE_STD_M, _ALIKE, _UNKNOWN = 0.005, 0.65, 0.03, 0.5
_LEAST = 0.2
_SURE_M, _DRIFT = 1.0, 0.1
"""Odometry that errs by more than this, and this part of the distance driven, is of no use: wheels
that slip err by 5 % of it."""


@dataclass(frozen=True, slots=True)
class Loops:
    """L mixtures: what is squared of the turns, `turns`, and of the places, `places`, (L, 3N) each,
    of [o, z, -b z]. By how much the latter grow with the camera's place on the robot is `facing`
    (L, 3N); less the directions of the segments, `along` (L, 3N), it is that with slip. Expected
    standard deviations `turn_std` rad and `place_std` m, (L,), and `share` (L,), one over how many
    of the errors along the drive are alike.
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
        """Those of images of segments; others count for nothing."""
        row, others = stack.rows(offsets.images), stack.rows(offsets.others)
        shares = np.where(others >= 0, offsets.shares, 0.0)
        whole = shares.sum(axis=1)
        kept = (row >= 0) & (np.abs(whole - 1.0) < _LEAST)
        shares, unlike = shares[kept] / whole[kept, None], offsets.unlike[kept]
        rows = _squares(row[kept], others[kept], shares, offsets.turn[kept], stack)
        place_std = _PLACE_STD_M * np.hypot(_ALIKE, unlike)
        alike = ErrorCorrelation().alike(np.cumsum(stack.steps)[row[kept]])
        return cls(*rows, _TURN_STD * (1 + unlike), place_std, 1.0 / alike)

    @classmethod
    def of_closures(cls, closures: Closures, stack: Stack, tied: Indices) -> Loops:
        """Those between the images of two segments, unless offsets have `tied` both."""
        owner = np.where((rows := stack.rows(closures.images)) < 0, -1, stack.owner[rows])
        kept = (rows >= 0).all(1) & (owner[:, 0] != owner[:, 1]) & ~np.isin(owner, tied).all(1)
        images, turn = closures.images[kept], closures.turn[kept, None]
        one, unknown = np.ones_like(turn), np.full(len(turn), _UNKNOWN)
        return cls.of(Offsets(images[:, 1], images[:, :1], one, turn, unknown), stack)

    def ties(self, stack: Stack, before: Solution | None) -> Any:
        """What is squared (2 L, 3N) of [o, z, -b z], over its standard deviation: by the residuals
        in the solution `before`."""
        weight = self._weights(stack, before)
        return sparse.vstack([self.turns, self.places]).multiply(weight[:, None]).tocsr()

    def by_mount(self, stack: Stack, before: Solution | None, now: Solution) -> Any:
        """Derivative (2 L, 4 + D) of what is squared in the solution `now`: by the place of the
        camera ahead and to the left, m, by slip, and by its yaw in each of D drives, rad."""
        x, weight = now.coefficients(stack.period), self._weights(stack, before)
        ahead, none = self.facing @ x, np.zeros(len(self.share))
        slip = ahead - self.along @ x
        columns = [
            np.concatenate([none, each * axis]) for each in (ahead, slip) for axis in (1, 1j)
        ]
        for drive in range(int(stack.run.max()) + 1):
            turned = 1j * (self.turns @ (x * np.tile(stack.run == drive, 3)))
            columns.append(np.concatenate([turned, none]))
        return np.column_stack(columns) * weight[:, None]

    def _weights(self, stack: Stack, before: Solution | None) -> Array:
        """(2 L,) one over the standard deviations, by the residuals in the solution `before`."""
        turn_std, place_std, doubt = self.turn_std, self.place_std, np.ones(len(self.share))
        if before is not None and len(doubt):
            x = before.coefficients(stack.period)
            turned = np.abs(self.turns @ x) / turn_std
            apart = np.abs(self.places @ x) / place_std
            turn_part = max(MEDIAN_TO_STD * float(np.median(turned)), _LEAST)
            place_part = max(LENGTH_TO_STD * float(np.median(apart)), _LEAST)
            turn_std, place_std = turn_part * turn_std, place_part * place_std
            squares = (turned / turn_part) ** 2 + (apart / place_part) ** 2
            doubt = outlier_factor(squares, 3)  # a turn and both axes of a place
        shares = np.sqrt(np.tile(self.share / doubt, 2))
        return np.asarray(shares / np.concatenate([turn_std, place_std]))


def loops_of(closures: Closures, offsets: Offsets, stack: Stack) -> tuple[Loops, Loops]:
    """Offsets, and closures where there are none."""
    tied = stack.owner[np.isin(stack.images, offsets.images)]
    return Loops.of(offsets, stack), Loops.of_closures(closures, stack, tied)


def _squares(
    row: Indices, others: Indices, shares: Array, turn: Array, stack: Stack
) -> tuple[Any, Any, Any, Any]:
    """Of the turns, of the places, and of the headings of images and of segments in the latter,
    (L, 3N), of rows (L,) of the stack among others (L, K); turns to first order in the biases."""
    rows, none = np.column_stack([row, others]), np.zeros(len(row))
    minus = np.column_stack([none + 1.0, -shares])
    turns = minus * np.exp(1j * (stack.headings[rows] + np.column_stack([none, turn])))
    n, owner = stack.segments, stack.owner[rows]
    turned = (n + owner, turns), (2 * n + owner, 1j * stack.times_s[rows] * turns)
    places, facing = stack.place_rows(rows, minus), stack.facing_rows(rows, minus)
    return stack.sparse(*turned), places, facing, stack.sparse((n + owner, minus))


def with_closures(segments: Segments, closures: Closures) -> Segments:
    """Segments with those of the closures that their odometry allows, where it is unbroken.

    Places can look alike: doors of a corridor, trees in rows. Odometry errs, but not without bound.
    """
    stack = Stack.of(segments)
    owner, (x, y, yaw) = stack.owner, stack.starts[stack.owner].T
    places, driven = x + 1j * y + np.exp(1j * yaw) * stack.path, np.cumsum(stack.steps)
    # To the next one's first image; how far beyond the last of this one does not matter.
    beyond = [np.nan_to_num(abs(s.displacement)) for s in segments] - stack.sums(stack.steps)
    driven += summed(np.maximum(beyond, 0.0))[owner]
    chain = np.cumsum([0, *(not one.linked for one in segments)])[owner]
    rows = stack.rows(closures.images)
    first, second = rows.T
    apart, way = np.abs(places[second] - places[first]), np.abs(driven[second] - driven[first])
    far = (apart > _SURE_M + _DRIFT * way) & (chain[first] == chain[second]) & (rows >= 0).all(1)
    return replace(segments, closures=Closures(closures.images[~far], closures.turn[~far]))
