# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How late the camera's stamps are beside the odometry's, found from turns that both have seen.

A robot that turns shifts the columns of its panorama. The shift between neighbouring images needs
no training to be measured, and the time by which it lags behind the turns of the odometry is what
the two clocks, or the camera's exposure and transfer, differ by.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from sfa_localization.geometry import Array, wrap_angle
from sfa_localization.run import Image, Panoramas, Run

Spectrum = NDArray[np.complex64]

LONGEST_S = 3.0
"""Clocks farther apart are not recognized."""
_COLUMNS, _ROWS = 200, 10
_BATCH = 32
# Structure wider than this part of the panorama is light, not landmarks.
_WIDEST = 0.2
# Images over which what stands still in all of them (the robot, a mask) is averaged.
_STATIC_IMAGES = 64
# Neighbours farther apart in time, or turned farther, are not compared.
_APART_S, _TURN_MAX_RAD = 1.0, 2.0
# Differences beyond a few of these are mismatches of images and count no more, rad.
_SCALE_RAD, _OUTLIER = 0.05, 4.0
# A turn by less does not say how well images and odometry agree on turns, rad.
_TURN_RAD = 0.05
_COARSE_S, _FINE_S = 0.02, 0.02
# Neighbouring pairs err alike: what they say counts for half.
_CAUTION = 2.0
_STD_MAX_S = 0.03
_TURNS_MIN = 10


@dataclass(frozen=True, slots=True)
class CameraClock:
    """`delay_s` by which images are stamped later than odometry, known to `std_s`.

    Both are 0 and infinity where the drive does not show it: it needs turns under way.
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
        return round(self.delay_s * 1e9) if abs(self.delay_s) > 2 * self.std_s else 0


def camera_clock(run: Run) -> CameraClock:
    """Compare the turns between neighbouring images with those of the odometry."""
    if len(run.panoramas) < _TURNS_MIN:
        return CameraClock()
    seconds = (run.panoramas.stamps_ns - run.odometry.stamps_ns[0]) * 1e-9
    pairs = (np.diff(seconds) > 0) & (np.diff(seconds) < _APART_S)
    shifts = visual_turns(run.panoramas)
    # Columns may grow either way: the better sign is the right one.
    found = [_Comparison.of(run, seconds, sign * shifts, pairs) for sign in (1.0, -1.0)]
    costs = [comparison.coarse() for comparison in found]
    best = int(np.argmin([cost for _, cost in costs]))
    return found[best].refined(costs[best][0])


def visual_turns(panoramas: Panoramas) -> Array:
    """Shift (N - 1,) rad of the columns from each image to the next, in [-pi, pi)."""
    count, width = len(panoramas), min(panoramas.shape[1], _COLUMNS)
    sampled = np.unique(np.linspace(0, count - 1, _STATIC_IMAGES).astype(int))
    static = np.mean([_texture(panoramas.read(k, k + 1)[0]) for k in sampled], axis=0)
    spectra = _spectra(panoramas, static)
    before = next(spectra)
    shifts = []
    for after in spectra:
        shifts.append(_shift(before, after, width))
        before = after
    return np.asarray(wrap_angle(np.array(shifts) * 2 * np.pi / width))


def _spectra(panoramas: Panoramas, static: NDArray[np.float32]) -> Iterator[Spectrum]:
    for batch in panoramas.batches(_BATCH):
        for image in batch:
            yield np.fft.rfft(_texture(image) - static, axis=1).astype(np.complex64)


def _texture(image: Image) -> NDArray[np.float32]:
    """Rows and columns of logarithmic brightness, free of what changes slowly around."""
    height, width = min(image.shape[0], _ROWS), min(image.shape[1], _COLUMNS)
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.shape[2] == 3 else image[..., 0]
    small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    light = np.log1p(small.astype(np.float32))
    reach = max(int(width * _WIDEST) // 2, 1)
    wide = np.concatenate([light[:, -reach:], light, light[:, :reach]], axis=1)
    mean = cv2.blur(wide, (2 * reach + 1, 1), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(light - mean[:, reach:-reach], np.float32)


def _shift(before: Spectrum, after: Spectrum, width: int) -> float:
    """Columns by which one image must be shifted to give the other, to a part of a column."""
    score = np.fft.irfft((np.conj(before) * after).sum(0), width)
    top = int(np.argmax(score))
    left, middle, right = score[top - 1], score[top], score[(top + 1) % width]
    bend = left - 2 * middle + right
    return top + (0.5 * float((left - right) / bend) if bend < 0 else 0.0)


@dataclass(frozen=True, slots=True)
class _Comparison:
    """Turns (P,) seen between image stamps `start_s` and `stop_s`, beside the odometry's yaw."""

    turns: Array
    start_s: Array
    stop_s: Array
    odometry_s: Array
    yaw: Array

    @classmethod
    def of(cls, run: Run, seconds: Array, turns: Array, pairs: NDArray[np.bool_]) -> _Comparison:
        odometry = run.odometry
        at = (odometry.stamps_ns - odometry.stamps_ns[0]) * 1e-9
        yaw = np.unwrap(odometry.poses[:, 2])
        return cls(turns[pairs], seconds[:-1][pairs], seconds[1:][pairs], at, yaw)

    def driven(self, delay_s: float) -> Array:
        """The odometry's turns (P,) between the images, were they so late."""
        yaw = [np.interp(s - delay_s, self.odometry_s, self.yaw) for s in self._ends]
        return np.asarray(yaw[1] - yaw[0])

    @property
    def _ends(self) -> tuple[Array, Array]:
        return self.start_s, self.stop_s

    def residuals(self, delay_s: float) -> Array:
        """What is seen minus what was driven, (P,) rad."""
        return wrap_angle(self.turns - self.driven(delay_s))

    def cost(self, delay_s: float) -> float:
        """Mean absolute difference, limited for images that do not match."""
        left = np.abs(self.residuals(delay_s)) / _SCALE_RAD
        return float(np.minimum(left, _OUTLIER).mean()) if len(left) else 0.0

    def coarse(self) -> tuple[float, float]:
        """The best delay of a grid, and its cost."""
        grid = np.arange(-LONGEST_S, LONGEST_S + _COARSE_S / 2, _COARSE_S)
        costs = [self.cost(delay) for delay in grid]
        best = int(np.argmin(costs))
        return float(grid[best]), costs[best]

    def refined(self, near_s: float) -> CameraClock:
        """The delay about `near_s`, and how well the turns fix it."""
        found = minimize_scalar(
            self.cost, bounds=(near_s - _FINE_S, near_s + _FINE_S), method='bounded'
        )
        delay = float(found.x)
        driven, left = self.driven(delay), np.abs(self.residuals(delay))
        turning = (np.abs(driven) > _TURN_RAD) & (np.abs(driven) < _TURN_MAX_RAD)
        if turning.sum() < _TURNS_MIN or abs(delay) > LONGEST_S - _COARSE_S:
            return CameraClock()
        scale = max(1.4826 * float(np.median(left[turning])), 1e-3)
        fitting = left < _OUTLIER * scale
        # What a moment more of delay changes in the turns is the change of the turn rate.
        step = (self.driven(delay + _FINE_S) - self.driven(delay - _FINE_S)) / (2 * _FINE_S)
        power = float((step[fitting] ** 2).sum())
        std = _CAUTION * scale / np.sqrt(power) if power > 0 else np.inf
        agree = np.median(left[turning]) < np.median(np.abs(driven[turning])) / 2
        return CameraClock(delay, float(std)) if agree and std < _STD_MAX_S else CameraClock()
