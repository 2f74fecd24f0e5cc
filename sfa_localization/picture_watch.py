# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Is a panorama worth believing? Dark, covered, frozen and foreign pictures are not."""

from __future__ import annotations

import cv2
import numpy as np

from sfa_localization.config import SfaNodeConfig
from sfa_localization.geometry import Array
from sfa_localization.run import Image

UNKNOWN_VARIANCE = 1e6
"""Variance, m^2, of the position that an unusable picture tells: the filter leaves it out."""
_STRIDE = 3


class PictureWatch:
    """Judges pictures in the order in which they came."""

    def __init__(self, config: SfaNodeConfig) -> None:
        self.config = config
        self._last: Image | None = None
        self._repeats = 0

    def judge(self, panorama: Image) -> str:
        """Why a panorama (H, W, 3) uint8 cannot be believed; '' when it can."""
        sample = panorama[::_STRIDE, ::_STRIDE]
        equal = self._last is not None and np.array_equal(sample, self._last)
        self._repeats = self._repeats + 1 if equal else 0
        if not equal:
            self._last = sample.copy()
        mean, deviation = cv2.meanStdDev(sample)
        if float(mean.mean()) < self.config.dark_level:
            return 'picture is dark'
        if float(deviation.mean()) < self.config.flat_level:
            return 'picture is covered: it shows nothing'
        if self._repeats + 1 >= self.config.frozen_pictures:
            return 'camera is frozen: it repeats its picture'
        return ''

    def judge_novelty(self, novelty: float) -> str:
        """Why a picture of this novelty cannot be believed; '' when it can."""
        if not novelty <= self.config.novelty_unusable:
            return 'picture is unlike any of training'
        return ''


def unusable_covariance() -> Array:
    """Covariance (3, 3) of [x, y, yaw] of a picture that tells nothing."""
    return np.diag([UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, np.pi**2 / 3])
