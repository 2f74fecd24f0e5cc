# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How noisy odometry's links are, learned with the map: by what the solution shows of them.

What messages state of their noise, or data sheets, is of wheels on a good floor. Where the links of
a drive miss the certified solution by more than that, their variances grow. They miss it by less
than they err, because it follows them: a link has as much of a degree of freedom left as the
solution's own uncertainty of it is smaller than its variance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.metric.phases import angle_covariance
from sfa_localization.metric.quadratic_form import Links, QuadraticForm, Solution

Indices = NDArray[np.int64]

# Degrees of freedom of Student's distribution: wheels slip now and then, by far more than usual.
_TAIL = 4.0
# Of a run's factor and the doubts of its links in turn: far more than they need.
_STEPS = 10
# The variances that are stated or assumed count as so many links that miss by just as much: those
# of a few say little.
_PRIOR_LINKS = 10.0


def learned(stated: Links, form: QuadraticForm, solution: Solution) -> Links:
    """Links of the `stated` variances or, in each run, of larger ones that the solution shows.

    `solution` is that of `form`, whose links are the ones of the step before.
    """
    turns, moves = form.link_squares(solution.bias)
    x, n = np.concatenate([solution.o, solution.z]), len(solution.o)
    origins = np.real(form.system(solution.bias)[:n, :n])
    # Moving all origins together costs nothing: fix the mean.
    unknown_place = scipy.linalg.inv(origins + np.trace(origins) / n**2)
    unknown_turn = angle_covariance(solution.h, solution.z)
    turned, moved = np.abs(turns.roots(x)) ** 2, np.abs(moves.roots(x)) ** 2 / 2
    left_turn, left_move = (
        form.variance * _between(unknown, stated.at) for unknown in (unknown_turn, unknown_place)
    )
    links = form.links
    missed_turn = Missed(turned, left_turn, links.turn_variance, 1)
    return grown(stated, missed_turn, Missed(moved, left_move, links.displacement_variance, 2))


def grown(stated: Links, turns: Missed, moves: Missed) -> Links:
    """Links of the `stated` variances or, in each run, of larger ones by what they missed."""
    return replace(
        stated,
        turn_variance=_grown(stated.turn_variance, turns, stated.run),
        displacement_variance=_grown(stated.displacement_variance, moves, stated.run),
    )


def _between(covariance: Array, at: Indices) -> Array:
    """Variance (L,) of the differences of neighbors in a covariance (N, N)."""
    variance = np.diag(covariance)
    return np.asarray(variance[at] + variance[at + 1] - 2 * covariance[at, at + 1])


@dataclass(frozen=True, slots=True)
class Missed:
    """By how much L links miss a solution, along each of so many `axes`: `squares` (L,), what the
    solution leaves unknown of them, `left` (L,), and the variances (L,) `assumed` for it.
    """

    squares: Array
    left: Array
    assumed: Array
    axes: int


def _grown(stated: Array, missed: Missed, run: Indices) -> Array:
    """Variances (L,): those of each run as many times the `stated` ones as its links show, and
    more for single links that miss by far more (Student's distribution).

    The solution follows each link by the share of its variance that it leaves unknown. An infinite
    variance stays: such a link has no weight.
    """
    known = np.isfinite(stated)
    of = np.where(known, stated, 1.0)
    followed = np.minimum(missed.left / np.where(known, missed.assumed, np.inf), 1.0)
    freedom = np.bincount(run, known * (1.0 - followed)) + _PRIOR_LINKS
    error, miss = (missed.squares + missed.left) / of, known * missed.squares / of
    factor = np.ones(len(freedom))
    for _ in range(_STEPS):
        doubt = _doubt(error / factor[run], missed.axes)
        factor = (np.bincount(run, miss / doubt) + _PRIOR_LINKS) / freedom
        factor = np.maximum(factor, 1.0)
    return np.asarray(stated * factor[run] * _doubt(error / factor[run], missed.axes))


def _doubt(ratio: Array, axes: int) -> Array:
    """What the variance grows by of a link whose squared error along each axis is so many times it:
    1 on average where it is right."""
    return np.asarray((_TAIL + axes * ratio) / (_TAIL + axes))
