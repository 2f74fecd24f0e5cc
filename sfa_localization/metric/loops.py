# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures as squares beside those of odometry's links (see quadratic_form.py).

Image a of segment i and image b of segment j are of one place, with a known turn between them:

    |z_j exp(i h_b) - exp(i turn) z_i exp(i h_a)|^2       the turn, h the headings in the segments
    |o_j + z_j q_b - o_i - z_i q_a|^2                     the place, to their distance

How well they hold is estimated with the map. A few may be wrong: places can look alike. What does
not fit loses its weight (Cauchy's), so that the form stays quadratic and its solution certified.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from sfa_localization.data.geometry import Array
from sfa_localization.features.closures import Closures
from sfa_localization.features.rotation_spread import LENGTH_TO_STD, MEDIAN_TO_STD
from sfa_localization.metric.quadratic_form import Solution, Stack

Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]

# Standard deviations before anything is known, and the least: rad, and m per axis.
_FIRST_TURN_STD, _LEAST_TURN_STD = 0.01, 0.002
_FIRST_PLACE_STD_M, _LEAST_PLACE_STD_M = 0.3, 0.05
# Residual, in standard deviations, at which a closure counts half.
_HALF = 2.4


@dataclass(frozen=True, slots=True)
class Loops:
    """L closures: `rows` (L, 2) of the stack, the `turn` (L,) rad from the first to the second,
    and `share` (L,), one over how many closures tie the same two segments.
    """

    rows: Indices
    turn: Array
    share: Array

    @classmethod
    def of(cls, closures: Closures, stack: Stack) -> Loops:
        """Those between the images of two segments."""
        order = np.argsort(stack.images, kind='stable')
        at = np.searchsorted(stack.images, closures.images, sorter=order)
        rows = order[np.minimum(at, len(order) - 1)]
        kept = (stack.images[rows] == closures.images).all(1)
        kept &= stack.owner[rows[:, 0]] != stack.owner[rows[:, 1]]
        rows, turn = rows[kept], closures.turn[kept]
        _, same, count = np.unique(
            stack.owner[rows], axis=0, return_inverse=True, return_counts=True
        )
        return cls(rows, turn, 1.0 / count[same.reshape(-1)])

    def form(self, stack: Stack, before: Solution | None) -> Complex:
        """The quadratic form (3N, 3N) in [o, z, -b z], weighted by the closures' variances: by
        their residuals in the solution `before`."""
        turns, moves = self._rows(stack)
        turn_weight, move_weight = self._weights(turns, moves, stack, before)
        weight = np.sqrt(np.concatenate([turn_weight, move_weight]))
        rows = sparse.vstack([turns, moves]).multiply(weight[:, None]).tocsr()
        return np.asarray((rows.conj().T @ rows).toarray())

    def _rows(self, stack: Stack) -> tuple[sparse.sparray, sparse.sparray]:
        """Rows (L, 3N) whose squares are the turns' and the places' costs; turns to first order
        in the biases."""
        n, count = stack.segments, len(self.turn)
        (i, j), (a, b) = stack.owner[self.rows].T, self.rows.T
        at_first = np.exp(1j * (stack.headings[a] + self.turn))
        at_second = np.exp(1j * stack.headings[b])
        drifts = 1j * stack.times_s[b] * at_second, 1j * stack.times_s[a] * at_first
        turned = [(n + j, at_second), (n + i, -at_first), (2 * n + j, drifts[0])]
        turned.append((2 * n + i, -drifts[1]))
        moved = [(j, np.ones(count)), (i, -np.ones(count))]
        moved += [(n + j, stack.path[b]), (n + i, -stack.path[a])]
        moved += [(2 * n + j, stack.drift[b]), (2 * n + i, -stack.drift[a])]
        return _sparse(turned, (count, 3 * n)), _sparse(moved, (count, 3 * n))

    def _weights(
        self,
        turns: sparse.sparray,
        moves: sparse.sparray,
        stack: Stack,
        before: Solution | None,
    ) -> tuple[Array, Array]:
        """Of the turns and of the places (L,), 1 / rad^2 and 1 / m^2."""
        if before is None:
            return self.share / _FIRST_TURN_STD**2, self.share / _FIRST_PLACE_STD_M**2
        x = before.coefficients(stack.period)
        turned, apart = np.abs(turns @ x), np.abs(moves @ x)
        turn_std = max(MEDIAN_TO_STD * _median(turned), _LEAST_TURN_STD)
        place_std = max(LENGTH_TO_STD * _median(apart), _LEAST_PLACE_STD_M)
        doubt = 1.0 + (turned / (_HALF * turn_std)) ** 2 + (apart / (_HALF * place_std)) ** 2 / 2
        return self.share / doubt / turn_std**2, self.share / doubt / place_std**2


def _sparse(parts: list[tuple[Indices, Any]], shape: tuple[int, int]) -> sparse.sparray:
    """A matrix of so many rows from (columns, values) of one entry per row each."""
    rows = np.tile(np.arange(shape[0]), len(parts))
    columns, values = (np.concatenate(list(side)) for side in zip(*parts, strict=True))
    return sparse.csr_array((values.astype(complex), (rows, columns)), shape=shape)


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else 0.0
