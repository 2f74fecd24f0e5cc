# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which segments drive along earlier ones, by closures that the odometry allows.

Places can look alike: doors of a corridor, trees in rows. Odometry errs, but not without bound, and
a closure beyond that is none.

A part of the drive that is left out to check a map stands for places that were never seen. Where a
later drive follows the same track, perhaps in another light, its images would give the answer
away: a map that is learned without one segment must do without both.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.features.closures import Closures
from sfa_localization.metric.segments import Segments, assignment

Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]

_SURE_M, _DRIFT = 1.0, 0.1
"""Odometry that errs by more than this, and this part of the distance driven, is of no use: wheels
that slip err by 5 % of it."""
_SHARE = 0.5
"""Of the length of a segment that closures with an earlier one must span: a crossing track has
closures along half a meter."""


def with_closures(segments: Segments, closures: Closures) -> Segments:
    """Segments with those of the closures that their odometry allows, where it is unbroken."""
    places, driven, chain = _dead_reckoned(segments, int(closures.images.max(initial=0)) + 1)
    first, second = closures.images.T
    apart = np.abs(places[second] - places[first])
    far = apart > _SURE_M + _DRIFT * np.abs(driven[second] - driven[first])
    kept = ~(far & (chain[first] == chain[second]) & (chain[first] >= 0))
    return replace(segments, closures=Closures(closures.images[kept], closures.turn[kept]))


def _dead_reckoned(segments: Segments, count: int) -> tuple[Complex, Array, Indices]:
    """Of at least `count` images: places in the odometry frame (x + i y, m), the distance driven
    until each (m), and the unbroken stretch of odometry, -1 for an image of no segment."""
    count = max([count, *(int(s.images.max()) + 1 for s in segments)])
    places, driven, chain = np.zeros(count, complex), np.zeros(count), np.full(count, -1)
    length_m, number = 0.0, 0
    for segment in segments:
        x, y, yaw = segment.start
        places[segment.images] = complex(x, y) + np.exp(1j * yaw) * segment.path
        steps = np.abs(np.diff(segment.path, prepend=segment.path[0]))
        driven[segment.images] = length_m + np.cumsum(steps)
        chain[segment.images] = number
        # To the next one's first image; how far beyond the last of this one does not matter.
        length_m += max(float(steps.sum()), np.nan_to_num(abs(segment.displacement)))
        number += not segment.linked
    return places, driven, chain


def tracks(segments: Segments) -> Indices:
    """For each of the N segments the first segment along the same track (N,): mostly itself."""
    track = np.arange(len(segments))
    pairs = segments.closures.images
    if not len(pairs):
        return track
    count = max(int(pairs.max()), max(int(s.images.max()) for s in segments)) + 1
    owner = assignment(segments, count)
    both = owner[pairs]
    order = np.argsort(both, axis=1)
    earlier, later = np.take_along_axis(both, order, axis=1).T
    images = np.take_along_axis(pairs, order, axis=1)[:, 1]
    for n, segment in enumerate(segments):
        own = (later == n) & (earlier >= 0) & (earlier < n)
        found = int(np.bincount(earlier[own]).argmax()) if own.any() else -1
        near = np.abs(earlier[own] - found) <= 1
        path = np.abs(segment.path[np.isin(segment.images, images[own][near])])
        if len(path) and np.ptp(path) >= _SHARE * np.ptp(np.abs(segment.path)):
            track[n] = track[found]
    return track
