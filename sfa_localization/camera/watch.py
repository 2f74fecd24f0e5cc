# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which images can be believed: dark, covered, frozen and foreign ones cannot."""

from __future__ import annotations

import cv2
import numpy as np

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.data.run import Image

_STRIDE = 3


class PictureWatch:
    """Is a picture worth believing? Dark, covered, frozen and foreign ones are not."""

    def __init__(self, config: WatchConfig | None = None) -> None:
        self.config = config or WatchConfig()
        self._last: Image | None = None
        self._repeats = 0

    def judge(self, panorama: Image) -> str:
        """Why a panorama (H, W, 3) uint8, the next one, cannot be believed; '' when it can."""
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
