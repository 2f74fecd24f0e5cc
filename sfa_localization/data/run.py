# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Data of one recorded drive, shared by all rooms. Time is integer nanoseconds."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Indices, Mask, compose, relative, wrap_angle

Stamps = NDArray[np.int64]
Image = NDArray[np.uint8]
Origin = tuple[float, float]
"""Latitude and longitude, degrees, of x = y = 0 where places are those of a satellite receiver."""
POINT_STD_M = 0.02
"""Standard deviation of a point without one: a robot was put on a mark by eye."""
BATCH = 16
"""Images that are read and processed together."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses at stamps: `stamps_ns` (N,) increasing, `poses` (N, 3) as x m, y m, yaw rad."""

    stamps_ns: Stamps
    poses: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def covers(self, stamps_ns: Stamps, tolerance_ns: int = 0) -> NDArray[np.bool_]:
        """Mask (M,) of the stamps between the first and the last pose, and in no gap.

        A stamp is covered when both neighboring poses lie within `tolerance_ns` (0: any gap).
        """
        if len(self) == 0:
            return np.zeros(len(stamps_ns), bool)
        before = np.searchsorted(self.stamps_ns, stamps_ns, side='right') - 1
        after = np.searchsorted(self.stamps_ns, stamps_ns, side='left')
        inside = (before >= 0) & (after < len(self))
        before, after = np.clip([before, after], 0, len(self) - 1)
        since = stamps_ns - self.stamps_ns[before]
        until = self.stamps_ns[after] - stamps_ns
        return np.asarray(
            inside & ((tolerance_ns <= 0) | (np.maximum(since, until) <= tolerance_ns))
        )

    def at(self, stamps_ns: Stamps) -> Array:
        """Poses (M, 3) interpolated along constant twist between neighbors; clamped outside."""
        if len(self) == 1:
            return np.repeat(self.poses, len(stamps_ns), axis=0)
        i = np.clip(np.searchsorted(self.stamps_ns, stamps_ns, 'right') - 1, 0, len(self) - 2)
        span = np.maximum(self.stamps_ns[i + 1] - self.stamps_ns[i], 1)
        t = np.clip((stamps_ns - self.stamps_ns[i]) / span, 0.0, 1.0)
        return _along(self.poses[i], self.poses[i + 1], t)


def _along(start: Array, end: Array, t: Array) -> Array:
    """Poses at a fraction t (M,) of the arc from start to end, both (M, 3).

    The chord of an arc of turn a has the bearing a / 2, and sin(a / 2) / (a / 2) of its length.
    """
    step = relative(start, end)
    half = step[:, 2] / 2
    chord = t * np.hypot(*step[:, :2].T) * np.sinc(t * half / np.pi) / np.sinc(half / np.pi)
    bearing = np.arctan2(step[:, 1], step[:, 0]) - half + t * half
    return compose(
        start, np.stack([chord * np.cos(bearing), chord * np.sin(bearing), 2 * t * half], -1)
    )


@dataclass(frozen=True, slots=True)
class Odometry:
    """Wheel odometry: poses in the odom frame and the twist that moved them.

    `stamps_ns` (N,), `poses` (N, 3), `twists` (N, 2) as v m/s, omega rad/s; `variances` (N, 2) of
    v and omega as in the messages, 0 where unknown. A twist is the mean since the previous
    message, as drivers of wheel encoders publish it; the first twist is not used. `part` (N,)
    numbers the unbroken parts, by default a single one: the motion between two parts is unknown.
    """

    stamps_ns: Stamps
    poses: Array
    twists: Array
    variances: Array
    part: Indices = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        if len(self.part) == 0:
            object.__setattr__(self, 'part', np.zeros(len(self.stamps_ns), np.int64))

    @property
    def trajectory(self) -> Trajectory:
        return Trajectory(self.stamps_ns, self.poses)


@dataclass(frozen=True, slots=True)
class YawRate:
    """A gyroscope about the vertical: `stamps_ns` (N,), `omega` (N,) rad/s, `variance` (N,)."""

    stamps_ns: Stamps
    omega: Array
    variance: Array


PointRow = tuple[str, int, complex, float, complex]


@dataclass(frozen=True, slots=True)
class Points:
    """Measured positions in the frame of the map: `names` (K,), `stamps_ns` (K,), `places` (K,)
    x + i y m, `std` (K,) m along each axis. They are those of an antenna that is `lever` (K,)
    ahead + i left of base_link, m.
    """

    names: tuple[str, ...]
    stamps_ns: Stamps
    places: NDArray[np.complex128]
    std: Array
    lever: NDArray[np.complex128]

    @classmethod
    def of(cls, rows: Sequence[PointRow]) -> Points:
        """From the rows of `rows`."""
        names, stamps, *columns = zip(*rows, strict=True)
        places, std, lever = map(np.array, columns)
        return cls(names, np.array(stamps, np.int64), places, std, lever)

    def __len__(self) -> int:
        return len(self.names)

    def rows(self) -> list[PointRow]:
        """Name, stamp, place, standard deviation and lever of each."""
        columns = self.stamps_ns, self.places, self.std, self.lever
        return list(zip(self.names, *(column.tolist() for column in columns), strict=True))


@dataclass(frozen=True, slots=True)
class Count:
    """Messages of a stream: the number used, and the number skipped for each reason."""

    used: int = 0
    skipped: dict[str, int] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        return {'used': self.used, 'skipped': dict(self.skipped)}


class Panoramas(Protocol):
    """The images of a run, read from disk in batches: stamps (N,), and the shape (H, W, C) of each,
    BGR uint8. Those of a Run are dataclasses.
    """

    @property
    def stamps_ns(self) -> Stamps: ...

    @property
    def shape(self) -> tuple[int, int, int]: ...

    def __len__(self) -> int: ...

    def read(self, start: int, stop: int) -> Image:
        """Panoramas start .. stop - 1 as a (stop - start, H, W, C) uint8 array."""

    def batches(self, size: int) -> Iterator[Image]:
        """Panoramas in order as (<= size, H, W, C) uint8 arrays."""


@dataclass(frozen=True, slots=True)
class PanoramaArray:
    """Panoramas in an array, `images` (N, H, W, C) uint8, or in a `file` that the array maps."""

    stamps_ns: Stamps
    images: Image
    file: IO[bytes] | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        return tuple(self.images.shape[1:])  # type: ignore[return-value]

    def __len__(self) -> int:
        return len(self.images)

    def read(self, start: int, stop: int) -> Image:
        if self.file is None:
            return np.asarray(self.images[start:stop])
        # Mapped pages would count as memory that grows with the bag; preadv is safe in threads,
        # and reads at most 2 GiB.
        images = np.empty((max(min(stop, len(self)) - start, 0), *self.shape), np.uint8)
        rest = memoryview(images.reshape(-1))
        offset = start * int(np.prod(self.shape))
        while rest and (read := os.preadv(self.file.fileno(), [rest], offset)):
            rest = rest[read:]
            offset = offset + read
        return images

    def batches(self, size: int) -> Iterator[Image]:
        for start in range(0, len(self), size):
            yield self.read(start, min(start + size, len(self)))


@dataclass(frozen=True, slots=True)
class Run:
    """One drive: images, odometry, measured points and, for evaluation only, the ground truth.

    `counts` holds the used and skipped messages per stream ('images', 'odometry', ...); `camera`
    is the lever arm of the camera, ahead + i left of base_link, m, if the bag contains it. Places
    of a satellite receiver count from the `origin`. Where the robot hides its view, panoramas show
    what is `seen` (H, W). `lacking` (N) says of each panorama which of several cameras it has
    lacked for too long, and why; '' if none.
    """

    name: str
    panoramas: Panoramas
    odometry: Odometry
    yaw_rate: YawRate | None = None
    ground_truth: Trajectory | None = None
    points: Points | None = None
    counts: dict[str, Count] = field(default_factory=dict)
    camera: complex | None = None
    origin: Origin | None = None
    seen: Mask | None = None
    lacking: tuple[str, ...] = ()


def integrate(stamps_ns: Stamps, twists: Array, start: Array | None = None) -> Array:
    """Dead reckoning: poses (N, 3) from twists (N, 2), each constant since the previous stamp."""
    way, turn = twists[1:].T * np.diff(stamps_ns) * 1e-9
    chord = way * np.sinc(turn / 2 / np.pi)
    steps = np.column_stack([chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn])
    return chained(np.zeros(3) if start is None else start, steps)


def chained(start: Array, steps: Array) -> Array:
    """Poses (N, 3) from a pose (3,) on by steps (N - 1, 3), each seen from the pose before."""
    yaw = np.concatenate([start[2:], start[2] + np.cumsum(steps[:, 2])])
    place = np.cumsum((steps[:, 0] + 1j * steps[:, 1]) * np.exp(1j * yaw[:-1]))
    place = start[0] + 1j * start[1] + np.concatenate([[0.0], place])
    return np.column_stack([place.real, place.imag, wrap_angle(yaw)])


def differences(stamps_ns: Stamps, poses: Array) -> Array:
    """Twists (N, 2) that lead to each pose (N, 3) from the previous; the first is repeated."""
    if len(poses) < 2:
        return np.zeros((len(poses), 2))
    step = relative(poses[:-1], poses[1:])
    seconds = np.diff(stamps_ns) * 1e-9
    arc = np.hypot(step[:, 0], step[:, 1]) / np.sinc(step[:, 2] / 2 / np.pi)
    bearing = np.arctan2(step[:, 1], step[:, 0]) - step[:, 2] / 2
    twists = np.stack([arc * np.sign(np.cos(bearing)), step[:, 2]], -1) / seconds[:, None]
    return np.concatenate([twists[:1], twists])
