# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a live camera shows the rim of its lens where it was when the lens was learned."""

from __future__ import annotations

import threading

import cv2
import numpy as np

from sfa_localization.camera.lens_guess import rim_of
from sfa_localization.camera.settings import LensCalibration
from sfa_localization.data.run import Image

_SIDE_PX = 240  # longer side of the compared images: a rim is found to 1 % of its radius
# compared images, and images between them
_SAMPLES = 12
_EVERY = 10
_DIFFERENT = 4.0  # mean difference in gray levels of images of a robot that moves
_MOVED = 0.05  # of the radius: another crop, zoom, or lens


class RimWatch:
    """Compares the rim in the first images of a robot that moves with that of a lens."""

    def __init__(self, lens: LensCalibration) -> None:
        self.problem = ''
        self.done = False
        self._lens = lens
        self._samples: list[Image] = []
        self._count = 0

    def add(self, image: Image) -> None:
        """Take the next image (H, W, 3). Once `done`, `problem` says what differs, if anything."""
        self._count += 1
        if len(self._samples) == _SAMPLES or self._count % _EVERY:
            return
        scale = _SIDE_PX / max(image.shape)
        small = np.asarray(cv2.resize(image, None, fx=scale, fy=scale), np.uint8)
        last = self._samples[-1] if self._samples else np.zeros_like(small)
        if last.shape != small.shape or cv2.absdiff(small, last).mean() < _DIFFERENT:
            return
        self._samples.append(small)
        if len(self._samples) == _SAMPLES:  # in a second; images go on meanwhile
            zoom = image.shape[1] / self._lens.image_width
            threading.Thread(target=self._judge, args=(zoom * scale,), daemon=True).start()

    def _judge(self, scale: float) -> None:
        """Set the problem, of samples `scale` times as wide as images of the lens."""
        rim = rim_of(self._samples)
        self.problem = '' if rim is None else self._moved(rim, scale)
        self.done = True

    def _moved(self, rim: tuple[float, float, float], scale: float) -> str:
        """Where a rim lies elsewhere than in training; '' if it does not."""
        lens = self._lens
        column, row, radius = ((part + 0.5) / scale - 0.5 for part in rim)
        away = abs(complex(column - lens.cx, row - lens.cy))
        if max(away, abs(radius - lens.radius_max)) < _MOVED * lens.radius_max:
            return ''
        return (
            f'the rim of the lens has its center at {column:.0f}, {row:.0f} and a radius of '
            f'{radius:.0f} px, in training {lens.cx:.0f}, {lens.cy:.0f} and '
            f'{lens.radius_max:.0f}: was its image cropped, or another lens mounted?'
        )
