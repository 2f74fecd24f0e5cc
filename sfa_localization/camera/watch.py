# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which images can be used: dark, covered, repeated and novel ones cannot."""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.data.geometry import Mask
from sfa_localization.data.run import Image

DARK_LEVEL = 8.0
"""Gray levels: an image with a lower mean is too dark to distinguish places."""
FLAT_LEVEL = 3.0
"""Gray levels: an image with a lower standard deviation is covered, and shows only noise."""
FROZEN_IMAGES = 5
"""Equal images in a row of a frozen camera; a late driver may send fewer."""
FROZEN_S = 5.0
"""Seconds of equal images after which a camera is reopened."""
EXPLAINED_WARNING = 0.4
"""Below this explained share an image is used with a warning; half-covered images have 0.15 to
0.5."""
DROWNED_WARNING = 10 / 360
"""An image with a larger share of drowned columns is used with a warning; images in sun, clouds or
low sun have none."""
_WHITE = 250.0  # gray levels, of all channels
_DROWNED = 0.7  # of a column is white; in the glare of a low sun, from 0.5 to 0.8 images err alike
_STRIDE = 3  # every third pixel along each axis is compared


def frozen(repeats: int, count: int) -> str:
    """A sentence if so many of the images repeat the one before that the camera was frozen."""
    if repeats < (1 - 1 / FROZEN_IMAGES) * count or not repeats:
        return ''
    return (
        f'{repeats} of {count} images repeat the one before: the camera was frozen; restart its '
        'driver, and record again'
    )


def drowned_columns(panorama: Image) -> Mask:
    """Which columns (W,) of a panorama (H, W, 3) uint8 are drowned in light: almost all white."""
    return np.asarray(
        cv2.inRange(panorama, (_WHITE,) * 3, (255.0,) * 3).mean(axis=0) >= 255 * _DROWNED
    )


def drowned_text(share: float) -> str:
    """A sentence about the share of drowned columns."""
    return f'light drowns {360 * share:.0f} degrees of the view'


class FrozenWatch:
    """How often, and for how long, a camera has repeated its last image."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.repeats = 0
        self._clock = clock
        self._last: Image | None = None
        self._since_s = 0.0

    def add(self, image: Image) -> bool:
        """Take the next image (H, W, 3) uint8; True when it differs from the last one."""
        sample = image[::_STRIDE, ::_STRIDE]
        if self._last is not None and np.array_equal(sample, self._last):
            self.repeats += 1
            return False
        self._last, self._since_s, self.repeats = sample.copy(), self._clock(), 0
        return True

    def frozen_for_s(self) -> float:
        """Seconds since the last new image, once it has been repeated for FROZEN_S; else 0."""
        seconds = self._clock() - self._since_s if self.repeats > 1 else 0.0
        return seconds if seconds > FROZEN_S else 0.0


class ImageWatch:
    """Judges panoramas in the order in which they were taken."""

    def __init__(self, config: WatchConfig | None = None) -> None:
        self.config = config or WatchConfig()
        self._frozen = FrozenWatch()

    def judge(self, panorama: Image) -> str:
        """Why the next panorama (H, W, 3) uint8 cannot be used; '' when it can."""
        self._frozen.add(panorama)
        mean, std = cv2.meanStdDev(panorama[::_STRIDE, ::_STRIDE])
        if float(mean.mean()) < DARK_LEVEL:
            return 'image is dark'
        if float(std.mean()) < FLAT_LEVEL:
            return 'image is covered: it shows nothing'
        if self._frozen.repeats + 1 >= FROZEN_IMAGES:
            return 'camera is frozen: it repeats its image'
        return 'image repeats the one before' if self.repeats else ''

    @property
    def repeats(self) -> bool:
        """Whether the last image repeats one, but not for so long that the camera is frozen."""
        return 0 < self._frozen.repeats < FROZEN_IMAGES - 1

    def judge_place(self, explained: float) -> str:
        """Why an image with this explained share cannot be used; '' if it can."""
        familiar = explained >= self.config.least_explained
        return '' if familiar else 'image is unlike all training images'
