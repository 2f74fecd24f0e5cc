# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The odometry's turns and those that images show, as one: loop closures say how good each is.

Wheels that slip err in turns by tens of degrees a minute, where the shifts of neighboring images
err by one; of trees near and far they err more than any wheel. A loop closure measures what the
robot turned since it was at the place before, however long ago, so that the errors of both sources
need not be assumed. Their mean is weighted by the inverse of their variances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.run import Stamps
from sfa_localization.features.closures import Closures
from sfa_localization.features.rotation_spread import MEDIAN_TO_STD
from sfa_localization.metric.dead_reckoning import (
    OdometryTrack,
    TurnCorrection,
    seconds_since_start,
)

Indices = NDArray[np.int64]

CLOSURES_MIN = 30
"""With fewer in the drives, chance decides which source is better."""
BETTER = 2.0
"""Images are used where the noise of their turns is smaller by this factor: others change little,
and their errors are not as white as those of good odometry."""
# rad per square root of s: closures, exact to a fraction of a degree, show no smaller noise.
_LEAST_NOISE = 1e-4


@dataclass(frozen=True, slots=True)
class Headings:
    """Two headings of one drive at its N images, rad, unwrapped: by the odometry's `track`, and
    by the sum of the shifts between images, `seen`, whose sign may be either.
    """

    stamps_ns: Stamps
    time_s: Array
    track: Array
    seen: Array

    @classmethod
    def of(cls, track: OdometryTrack, stamps_ns: Stamps, seen: Sequence[float]) -> Headings:
        """At stamps (N,) by the clock of the odometry; `seen` (N,) rad."""
        times = (stamps_ns - track.stamps_ns[0]) * 1e-9
        own = np.interp(times, seconds_since_start(track.stamps_ns), track.yaw)
        return cls(stamps_ns, times, own, np.unwrap(np.asarray(seen, float)))

    def correction(self, sign: float, share: float, noise: float) -> TurnCorrection:
        """What to add to the track's yaw, that the images have this share of the mean."""
        # Shifts are known to whole turns: between neighboring images both differ by less than half.
        apart = np.unwrap(sign * self.seen - self.track)
        return TurnCorrection(self.stamps_ns, share * (apart - apart[0]), noise)


def corrections(drives: Sequence[Headings], closures: Closures) -> list[TurnCorrection] | None:
    """Of each drive; None where the closures do not show that its images turn better.

    The images of drive k follow those of the drives before in the indices of the closures.
    """
    errors, time_s = _errors(drives, closures)
    if len(time_s) < CLOSURES_MIN:
        return None
    noise = MEDIAN_TO_STD * np.median(np.abs(errors) / np.sqrt(time_s), axis=1)
    odometry, same, opposite = np.maximum(noise, _LEAST_NOISE).tolist()
    sign, images = min((1.0, same), (-1.0, opposite), key=lambda pair: pair[1])
    if BETTER * images > odometry:
        return None
    total = odometry**2 + images**2
    share, left = odometry**2 / total, odometry * images / np.sqrt(total)
    return [drive.correction(sign, share, left) for drive in drives]


def _errors(drives: Sequence[Headings], closures: Closures) -> tuple[Array, Array]:
    """By how much odometry, images, and images of the other sign miss the turn (3, L) rad of each
    closure of a drive with itself, and its time (L,) s.
    """
    missed, times, start = [np.zeros((3, 0))], [np.zeros(0)], 0
    for drive in drives:
        own = closures.images - start
        inside = ((own >= 0) & (own < len(drive.time_s))).all(1)
        first, last = own[inside].T
        start += len(drive.time_s)
        turned = [h[last] - h[first] for h in (drive.track, drive.seen, -drive.seen)]
        elapsed = np.abs(drive.time_s[last] - drive.time_s[first])
        missed.append(np.asarray(wrap_angle(np.array(turned) - closures.turn[inside])))
        times.append(np.maximum(elapsed, 1.0))
    return np.concatenate(missed, axis=1), np.concatenate(times)
