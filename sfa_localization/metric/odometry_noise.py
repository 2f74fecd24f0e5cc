# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How noisy the turns of the odometry are, from the headings that the images of the drive show.

Wheels slip in turns by what no data sheet says. Where the heading of the images and that of the
odometry drift apart, one of both errs, so that the growth of their difference with time bounds the
noise of the odometry.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.run import Odometry, Stamps, YawRate
from sfa_localization.features.rotation_spread import MEDIAN_TO_STD
from sfa_localization.metric.dead_reckoning import OdometryTrack
from sfa_localization.metric.segments import ImagePoses, Segments
from sfa_localization.metric.settings import SegmentConfig

Indices = NDArray[np.int64]

LAGS_S = (2.5, 5.0, 10.0, 20.0, 40.0)
"""Times over which turns are compared: from about a segment to what a yaw-rate bias explains."""
_LATE = 1.3
"""A pair of images may be this factor farther apart in time than the lag."""
_PAIRS_MIN = 30
"""With fewer pairs of images at a lag, chance decides."""


def turn_noise(times_s: Array, residuals: Array, chains: Indices) -> float | None:
    """White noise of a yaw rate, rad per square root of s; None where too few pairs show it.

    From differences `residuals` (N,) rad of two headings at increasing times (N,) s within each of
    the `chains` (N,), along which none of both headings breaks. Outliers count little: the spread
    at each lag is that of the median.
    """
    found = []
    for lag in LAGS_S:
        first, last = _pairs(times_s, chains, lag)
        if len(first) >= _PAIRS_MIN:
            turns = wrap_angle(residuals[last] - residuals[first])
            spread = MEDIAN_TO_STD * float(np.median(np.abs(turns - np.median(turns))))
            found.append((float(np.mean(times_s[last] - times_s[first])), spread**2))
    if len(found) < 2:
        return None
    spans, variances = np.array(found).T
    # What does not grow with time is noise of the headings, not of the turns.
    slope = np.polyfit(spans, variances, 1, w=1.0 / spans)[0]
    return float(np.sqrt(max(slope, 0.0)))


def _pairs(times_s: Array, chains: Indices, lag_s: float) -> tuple[Indices, Indices]:
    """Rows of the pairs that are one lag apart in the same chain."""
    firsts, lasts = [], []
    for chain in np.unique(chains):
        rows = np.flatnonzero(chains == chain)
        own = times_s[rows]
        after = np.searchsorted(own, own + lag_s)
        ends = np.minimum(after, len(rows) - 1)
        near = (after < len(rows)) & (own[ends] - own < _LATE * lag_s)
        firsts.append(rows[near])
        lasts.append(rows[ends[near]])
    return np.concatenate(firsts), np.concatenate(lasts)


def expected_noise(segments: Segments) -> float:
    """Noise of the turns between segments that is stated or assumed, rad per square root of s."""
    rates = [s.turn_variance / s.turn_time_s for s in segments if s.linked and s.turn_time_s > 0]
    return float(np.sqrt(np.median(rates))) if rates else 0.0


def against_images(
    odometry: Odometry,
    yaw_rate: YawRate | None,
    stamps_ns: Stamps,
    seen: Sequence[float],
    config: SegmentConfig,
) -> float | None:
    """Noise of the odometry's turns by the headings `seen` (N,) rad that add up the shifts between
    neighboring images at stamps (N,); their sign may be either. No map is needed, but the errors
    of these headings add up as well: it is a bound.
    """
    track = OdometryTrack.of(odometry, config, yaw_rate)
    poses = ImagePoses.on(track, stamps_ns, {})
    shown = np.asarray(seen, float)[poses.images]
    found = [turn_noise(poses.time_s, sign * shown - poses.yaw, poses.part) for sign in (1.0, -1.0)]
    return min((noise for noise in found if noise is not None), default=None)
