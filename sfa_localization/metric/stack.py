# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The images of all segments, and the unknown poses that put them on the map.

With p = x + i y in meters and z_n = exp(i alpha_n), image m of segment n lies at

    o_n + z_n (q_nm - b drift_nm)

with the odometry's path q_nm in the segment, d_nm of the paper on a straight line, and the yaw-rate
bias b of its period. That is linear in y = [o, z, -b z] (3N,), and so are the residuals of links of
odometry (links.py), offsets of loop closures (loops.py) and measured points (measured_points.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.metric.segments import Segments, assignment

_TRACK_SHARE = 0.5
"""Least share of a segment's length over which closures connect it with an earlier one on the same
track; on a crossing track they cover half a meter."""


@dataclass(frozen=True, slots=True)
class Stack:
    """The images of all N segments, one after the other: M rows."""

    images: Indices
    """(M,) indices of the images among all of the drives."""
    owner: Indices
    """(M,) segment of each row."""
    path: Complex
    """(M,) q: places in the frame of the segment, meters."""
    drift: Complex
    """(M,) meters per rad/s that a yaw-rate bias adds to `path`."""
    headings: Array
    """(M,) rad in the frame of the segment."""
    times_s: Array
    """(M,) seconds since the reference heading of the segment: drift of `headings`."""
    first: Indices
    """(N,) row of each segment's first image."""
    period: Indices
    """(N,) period of each segment, in which the yaw-rate bias is constant."""
    run: Indices
    """(N,) drive of each segment."""
    camera_yaw: Array
    """(N,) rad: how far the camera is turned on the robot."""
    starts: Array
    """(N, 3) odometry poses of the segments' frames."""
    track: Indices
    """(N,) the first segment along the same track."""

    @classmethod
    def of(cls, segments: Segments) -> Stack:
        sizes = [len(s.images) for s in segments]
        run = np.array([s.run for s in segments])
        return cls(
            np.concatenate([s.images for s in segments]),
            np.repeat(np.arange(len(sizes)), sizes),
            np.concatenate([s.path for s in segments]),
            np.concatenate([s.path_drift for s in segments]),
            np.concatenate([s.headings for s in segments]),
            np.concatenate([s.times_s for s in segments]),
            np.concatenate([[0], np.cumsum(sizes)[:-1]]),
            np.array([s.period for s in segments]),
            run,
            np.array(segments.mount.of(int(run.max()) + 1).yaw)[run],
            np.array([s.start for s in segments]),
            tracks(segments),
        )

    @property
    def segments(self) -> int:
        return len(self.first)

    @property
    def steps(self) -> Array:
        """(M,) m driven from the image before, 0 at the first of each segment."""
        steps = np.abs(np.diff(self.path, prepend=0.0))
        steps[self.first] = 0.0
        return np.asarray(steps)

    def corrected(self, bias: Array) -> Complex:
        """Paths (M,) without the yaw-rate bias of each period (R,)."""
        return np.asarray(self.path - bias[self.period[self.owner]] * self.drift)

    def yaws(self, poses: SegmentPoses) -> Array:
        """Headings (M,) rad of the camera, without the biases."""
        headings = self.headings - poses.bias[self.period[self.owner]] * self.times_s
        return np.asarray((np.angle(poses.z) + self.camera_yaw)[self.owner] + headings)

    def rows(self, images: Indices) -> Indices:
        """Rows of images (...) of all drives; -1 for those of no segment."""
        order = np.argsort(self.images, kind='stable')
        at = np.searchsorted(self.images, images, sorter=order)
        rows = order[np.minimum(at, len(order) - 1)]
        return np.where(self.images[rows] == images, rows, -1)

    def sums(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Sum (N, ...) of the rows (M, ...) of each segment."""
        return np.asarray(np.add.reduceat(rows, self.first, axis=0))

    def place_rows(self, rows: Indices, shares: Array) -> Any:
        """Rows (L, 3N) whose products with [o, z, -b z] are sums, by `shares`, of the places of
        images in `rows` (L,) or (L, K) of the stack."""
        n = self.segments
        owner = self.owner[rows]
        places = shares * self.path[rows]
        drift = shares * self.drift[rows]
        return self.sparse((owner, shares), (n + owner, places), (2 * n + owner, drift))

    def facing_rows(self, rows: Indices, shares: Array | Complex) -> Any:
        """The same (L, 3N) of the directions exp(i yaw) that the images face; complex shares turn
        them."""
        n = self.segments
        owner = self.owner[rows]
        facing = np.exp(1j * self.headings[rows])
        drift = 1j * self.times_s[rows] * facing
        return self.sparse((n + owner, shares * facing), (2 * n + owner, shares * drift))

    def sparse(self, *parts: tuple[Indices, Array | Complex]) -> Any:
        """Rows (L, 3N) of columns and values, (L,) or (L, K); equal columns add up."""
        columns, values = (np.column_stack(side) for side in zip(*parts, strict=True))
        rows = np.repeat(np.arange(len(columns)), columns.shape[1])
        entries = values.astype(complex).ravel(), (rows, columns.ravel())
        return sparse.csr_array(entries, shape=(len(columns), 3 * self.segments))


@dataclass(frozen=True, slots=True)
class SegmentPoses:
    """Directions z (N,), origins o (N,) m, and yaw-rate biases (R,) rad/s of the periods."""

    z: Complex
    o: Complex
    bias: Array

    def places(self, stack: Stack) -> Complex:
        """Where the segments put the images (M,), meters."""
        path = stack.corrected(self.bias)
        return np.asarray(self.o[stack.owner] + self.z[stack.owner] * path)

    def coefficients(self, period: Indices) -> Complex:
        """[o, z, -b z] (3N,)."""
        return np.concatenate([self.o, self.z, -self.bias[period] * self.z])


def tracks(segments: Segments) -> Indices:
    """For each of the N segments the first segment along the same track (N,): mostly itself.

    A held-out part represents unseen places, so all segments along one track are held out together.
    """
    track = np.arange(len(segments))
    pairs = segments.closures.images
    if not len(pairs):
        return track
    count = max(int(pairs.max()), max(int(s.images.max()) for s in segments)) + 1
    both = assignment(segments, count)[pairs]
    order = np.argsort(both, axis=1)
    earlier, later = np.take_along_axis(both, order, axis=1).T
    images = np.take_along_axis(pairs, order, axis=1)[:, 1]
    for n, segment in enumerate(segments):
        chosen = (later == n) & (earlier >= 0) & (earlier < n)
        if not chosen.any():
            continue
        first = int(np.bincount(earlier[chosen]).argmax())
        near = np.abs(earlier[chosen] - first) <= 1
        path = np.abs(segment.path[np.isin(segment.images, images[chosen][near])])
        if len(path) and np.ptp(path) >= _TRACK_SHARE * np.ptp(np.abs(segment.path)):
            track[n] = track[first]
    return track
