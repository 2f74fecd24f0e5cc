# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Turns seen in panoramas, and the delay of the camera's stamps that they give away.

A robot that turns shifts the columns of its panorama. The shift between neighbouring images can be
measured without any map or training, and the time by which it lags behind the turns of the
odometry is what the two clocks, or exposure and transfer, differ by.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.events import ODOMETRY, in_order
from sfa_localization.geometry import Array, wrap_angle
from sfa_localization.run import BATCH, Image, Odometry, Panoramas, Run

Texture = NDArray[np.float32]

LONGEST_S = 2.5
"""Clocks farther apart are not recognized."""
_COLUMNS, _ROWS = 200, 10
# Structure wider than this part of the panorama is light, not landmarks.
_WIDEST = 0.2
# What every image shows alike (the robot, a mask) is the mean of so many that differ so much.
_STATIC_MIN, _STATIC_MAX, _DIFFERENT = 8, 64, 0.95
# Contrast beyond a factor e, as at the edge of a mask, counts no more.
_CONTRAST = np.float32(1.0)


class VisualGyro:
    """Heading from the shift of neighbouring panoramas: fed with images in order, it adds up.

    `sign` is 1 where columns grow clockwise seen from above, -1 where counter-clockwise.
    """

    def __init__(self, clockwise: bool = True) -> None:
        self._sign = 1.0 if clockwise else -1.0
        self._before: Texture | None = None
        self._static: Texture | None = None
        self._last_static: Texture | None = None
        self._statics = 0
        self.yaw_rad = 0.0

    def add(self, image: Image) -> float:
        """The heading (rad, wrapped, from the first image on) after a panorama (H, W, C) uint8."""
        texture = _texture(image)
        if self._before is None or self._before.shape != texture.shape:
            self._before, self._static, self._statics = texture, np.zeros_like(texture), 0
            self._last_static = texture
            return self.yaw_rad
        before, after = self._before, texture
        if self._static is not None and self._statics >= _STATIC_MIN:
            before, after = before - self._static, after - self._static
        shift = _shift(before, after)
        self._learn_static(texture)
        self._before = texture
        turn = self._sign * shift * 2 * np.pi / texture.shape[1]
        self.yaw_rad = float(wrap_angle(self.yaw_rad + turn))
        return self.yaw_rad

    def _learn_static(self, texture: Texture) -> None:
        """Average images that differ: a standing robot's surroundings are not a part of it."""
        assert self._last_static is not None and self._static is not None
        if _likeness(texture, self._last_static) > _DIFFERENT:
            return
        self._last_static, self._statics = texture, min(self._statics + 1, _STATIC_MAX)
        self._static += (texture - self._static) / np.float32(self._statics)


def _texture(image: Image) -> Texture:
    """Rows and columns of logarithmic brightness, free of what changes slowly around."""
    height, width = min(image.shape[0], _ROWS), min(image.shape[1], _COLUMNS)
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.shape[2] == 3 else image[..., 0]
    small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    light = np.log1p(small.astype(np.float32))
    reach = max(int(width * _WIDEST) // 2, 1)
    wide = np.concatenate([light[:, -reach:], light, light[:, :reach]], axis=1)
    mean = cv2.blur(wide, (2 * reach + 1, 1), borderType=cv2.BORDER_REPLICATE)
    return np.clip(light - mean[:, reach:-reach], -_CONTRAST, _CONTRAST)


def _likeness(a: Texture, b: Texture) -> float:
    """Correlation of two textures."""
    power = float((a * a).sum()) * float((b * b).sum())
    return float((a * b).sum()) / np.sqrt(power) if power > 0 else 1.0


def _shift(before: Texture, after: Texture) -> float:
    """Columns by which one texture must be shifted to give the other, to a part of a column."""
    width = before.shape[1]
    product = np.conj(np.fft.rfft(before, axis=1)) * np.fft.rfft(after, axis=1)
    score = np.fft.irfft(product.sum(0), width)
    top = int(np.argmax(score))
    left, middle, right = score[top - 1], score[top], score[(top + 1) % width]
    bend = left - 2 * middle + right
    return top + (0.5 * float((left - right) / bend) if bend < 0 else 0.0)


@dataclass(frozen=True, slots=True)
class CameraClock:
    """`delay_s` by which images are stamped later than odometry, known to `std_s`.

    0 and infinity where the drive does not show it: it takes turns that begin and end.
    """

    delay_s: float = 0.0
    std_s: float = np.inf

    @property
    def known(self) -> bool:
        """Whether the drive shows the delay at all."""
        return bool(np.isfinite(self.std_s))

    @property
    def delay_ns(self) -> int:
        """What to take off the images' stamps: 0 for a delay that may well be none."""
        return round(self.delay_s * 1e9) if abs(self.delay_s) > _SIGNIFICANT * self.std_s else 0


_SIGNIFICANT = 2.0
_STEP_S = 0.02
_GRID = np.arange(-round(LONGEST_S / _STEP_S), round(LONGEST_S / _STEP_S) + 1) * _STEP_S
# Images farther apart in time are not compared, nor such with a pause of the odometry between.
_APART_NS, _PAUSE_NS = 1_000_000_000, 500_000_000
_WINDOW_NS = round(LONGEST_S * 1e9) + 100_000_000
# Differences beyond a few of these are mismatches of images and count no more, rad.
_SCALE_RAD, _OUTLIER = 0.05, 4.0
# A turn by less does not say how well images and odometry agree on turns, rad.
_TURN_RAD = 0.05
_TURNS_MIN = 10
# Neighbouring pairs err alike: what they say counts for half.
_CAUTION = 2.0
_SCALE_MIN_RAD = 1e-3
_STD_MAX_S = 0.03


class CameraClockFinder:
    """Compares the turns between images with those of the odometry, as both come in.

    `memory` is the number of image pairs after which an old one counts little; clocks drift.
    """

    def __init__(self, memory: float = np.inf) -> None:
        self._keep = 1.0 - 1.0 / memory
        self._stamps: deque[int] = deque()
        self._yaws: deque[float] = deque()
        self._pauses: deque[int] = deque()
        self._last: tuple[int, float] | None = None
        self._pairs: deque[tuple[int, int, float]] = deque()
        # By the sign of the columns and the delay: cost, its curvature, and of the pairs with
        # turns their number, their size and their differences.
        self._cost, self._power, self._turns, self._size, self._left = np.zeros((5, 2, len(_GRID)))
        self.clock = CameraClock()

    def add_odometry(self, stamp_ns: int, omega: float) -> None:
        """Take a turn rate rad/s, held since the message before; stale stamps are passed over."""
        if self._stamps:
            gap = stamp_ns - self._stamps[-1]
            if gap <= 0:
                return
            if gap > _PAUSE_NS:
                self._pauses.append(stamp_ns)
        yaw = self._yaws[-1] + omega * gap * 1e-9 if self._yaws else 0.0
        self._stamps.append(stamp_ns)
        self._yaws.append(yaw)
        while self._pairs and self._pairs[0][1] + _WINDOW_NS <= stamp_ns:
            self._compare(*self._pairs.popleft())
        oldest = (self._pairs[0][0] if self._pairs else stamp_ns - _APART_NS) - _WINDOW_NS
        while len(self._stamps) > 2 and self._stamps[1] < oldest - _WINDOW_NS:
            self._stamps.popleft()
            self._yaws.popleft()

    def add_heading(self, stamp_ns: int, yaw_rad: float) -> None:
        """Take the heading that a `VisualGyro` has added up at an image's stamp."""
        if self._last is not None and 0 < stamp_ns - self._last[0] < _APART_NS:
            turn = float(wrap_angle(yaw_rad - self._last[1]))
            self._pairs.append((self._last[0], stamp_ns, turn))
        self._last = stamp_ns, yaw_rad

    def _compare(self, start_ns: int, stop_ns: int, turn: float) -> None:
        """Add a pair of images to all sums, once odometry surrounds it by any delay."""
        first, last = start_ns - _WINDOW_NS, stop_ns + _WINDOW_NS
        while self._pauses and self._pauses[0] < first:
            self._pauses.popleft()
        if first < self._stamps[0] or (self._pauses and self._pauses[0] <= last):
            return
        at = (np.array(self._stamps, np.int64) - start_ns) * 1e-9
        yaw = np.array(self._yaws)
        span = (stop_ns - start_ns) * 1e-9
        driven = np.interp(span - _GRID, at, yaw) - np.interp(-_GRID, at, yaw)
        left = np.abs(wrap_angle(np.array([[turn], [-turn]]) - driven)) / _SCALE_RAD
        fits, turning = left < _OUTLIER, np.abs(driven) > _TURN_RAD
        for total, new in (
            (self._cost, np.minimum(left, _OUTLIER)),
            # A moment more of delay changes the turn by the change of the turn rate.
            (self._power, fits * np.gradient(driven, _STEP_S) ** 2),
            (self._turns, turning),
            (self._size, turning * np.abs(driven)),
            (self._left, turning * np.minimum(left, _OUTLIER) * _SCALE_RAD),
        ):
            total *= self._keep
            total += new
        self.clock = self._found()

    def _found(self) -> CameraClock:
        """The delay of the least cost, unless it lies at the border or the turns do not fix it."""
        side, best = np.unravel_index(int(np.argmin(self._cost)), self._cost.shape)
        turns, size, left = (a[side, best] for a in (self._turns, self._size, self._left))
        # Columns may grow either way: the better sign is the right one.
        if turns < _TURNS_MIN or left > size / 2 or not 0 < best < len(_GRID) - 1:
            return CameraClock()
        scale = max(left / turns / _MEAN_OF_NORMAL, _SCALE_MIN_RAD)
        power = float(self._power[side, best])
        std = _CAUTION * scale / np.sqrt(power) if power > 0 else np.inf
        if std > _STD_MAX_S:
            return CameraClock()
        below, least, above = self._cost[side, best - 1 : best + 2]
        # Two slopes meet in the minimum of a sum of absolute values.
        steepest = max(below - least, above - least)
        part = (below - above) / (2 * steepest) if steepest > 0 else 0.0
        return CameraClock(float(_GRID[best] + part * _STEP_S), float(std))


_MEAN_OF_NORMAL = 0.798


def camera_clock(run: Run) -> CameraClock:
    """The delay of a recorded run's camera, from all of its turns."""
    finder = CameraClockFinder()
    odometry, seen = run.odometry, headings(run.panoramas)
    rates = _turn_rates(odometry).tolist()
    for stamp_ns, kind, i in in_order(odometry.stamps_ns, run.panoramas.stamps_ns):
        if kind == ODOMETRY:
            finder.add_odometry(stamp_ns, rates[i])
        else:
            finder.add_heading(stamp_ns, next(seen))
    return finder.clock


def _turn_rates(odometry: Odometry) -> Array:
    """The poses' own turn rates (N,): also where messages hold no twist."""
    turned = np.diff(np.unwrap(odometry.poses[:, 2]))
    seconds = np.maximum(np.diff(odometry.stamps_ns) * 1e-9, 1e-9)
    return np.concatenate([[0.0], turned / seconds])


def headings(panoramas: Panoramas, clockwise: bool = True) -> Iterator[float]:
    """The headings rad, one for each panorama, that a `VisualGyro` adds up."""
    gyro = VisualGyro(clockwise)
    for batch in panoramas.batches(BATCH):
        for image in batch:
            yield gyro.add(image)
