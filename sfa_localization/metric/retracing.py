# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Segments that drive along earlier ones: a map that is learned without one must do without both.

A part of the drive that is left out stands for places that were never seen. Where a later drive
follows the same track, perhaps in another light, its images would give the answer away.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfa_localization.metric.segments import Segments, assignment

Indices = NDArray[np.int64]

_SHARE = 0.5
"""Of the length of a segment that closures with an earlier one must span: a crossing track has
closures along half a meter."""


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
        found = _most_common(earlier[own])
        near = np.abs(earlier[own] - found) <= 1
        path = np.abs(segment.path[np.isin(segment.images, images[own][near])])
        if len(path) and np.ptp(path) >= _SHARE * np.ptp(np.abs(segment.path)):
            track[n] = track[found]
    return track


def _most_common(numbers: Indices) -> int:
    return int(np.bincount(numbers).argmax()) if len(numbers) else -1
