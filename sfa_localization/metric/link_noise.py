# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How noisy odometry's links are, learned with the map: by what the solution shows of them.

What messages state of their noise, or data sheets, is of wheels on a good floor. Where the links of
a drive miss the certified solution by more than that, their variances grow. They miss it by less
than they err, because it follows them: as many degrees of freedom are left as the solution is
surer of than they are.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.metric.phases import angle_covariance
from sfa_localization.metric.quadratic_form import Links, QuadraticForm, Solution

Indices = NDArray[np.int64]

# The variances that are stated or assumed count as so many links that miss by just as much: those
# of a few say little.
_PRIOR_LINKS = 10.0


def learned(stated: Links, form: QuadraticForm, solution: Solution) -> Links:
    """Links of the `stated` variances or, in each run, of larger ones that the solution shows.

    `solution` is that of `form`, whose links are the ones of the step before.
    """
    (turns, _), (moves, _) = form.link_rows(solution.bias)
    x, n = np.concatenate([solution.o, solution.z]), len(solution.o)
    origins = np.real(form.system(solution.bias)[:n, :n])
    # Moving all origins together costs nothing: fix the mean.
    unknown_place = scipy.linalg.inv(origins + np.trace(origins) / n**2)
    unknown_turn = angle_covariance(solution.h, solution.z)
    turned, moved = np.abs(turns @ x) ** 2, np.abs(moves @ x) ** 2 / 2
    left_turn, left_move = (
        form.variance * _between(unknown, stated.at) for unknown in (unknown_turn, unknown_place)
    )
    links, run = form.links, stated.run
    return replace(
        stated,
        turn_variance=_grown(stated.turn_variance, links.turn_variance, turned, left_turn, run),
        displacement_variance=_grown(
            stated.displacement_variance, links.displacement_variance, moved, left_move, run
        ),
    )


def _between(covariance: Array, at: Indices) -> Array:
    """Variance (L,) of the differences of neighbors in a covariance (N, N)."""
    variance = np.diag(covariance)
    return np.asarray(variance[at] + variance[at + 1] - 2 * covariance[at, at + 1])


def _grown(stated: Array, assumed: Array, missed: Array, left: Array, run: Indices) -> Array:
    """Variances (L,), those of each run as many times the stated ones as the squares `missed` show.

    Under the variances that were `assumed`, the solution leaves `left` of them unknown; that share
    of each link it follows. An infinite variance stays: such a link has no weight.
    """
    known = np.isfinite(stated)
    of = np.where(known, stated, 1.0)
    free = np.where(known, 1.0 - np.minimum(left / np.where(known, assumed, np.inf), 1.0), 0.0)
    shown = np.bincount(run, known * missed / of) + _PRIOR_LINKS
    factor = shown / (np.bincount(run, free) + _PRIOR_LINKS)
    return np.asarray(stated * np.maximum(factor, 1.0)[run])
