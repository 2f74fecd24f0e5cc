# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Image retrieval, the simplest baseline: the pose of the most similar training image.

Images are small, gray, of zero mean and unit norm, and correlated over all rotations of the camera.
It is given the true poses of the training images, which nothing else here has.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.run import Image
from sfa_localization.keyframes.texture import Spectra, Texture, normalized, spectrum

COLUMNS, ROWS = 150, 30


@dataclass(frozen=True, slots=True)
class ImageRetrieval:
    """Training images as `spectra` (K, rows, F) of their `columns`, and their `poses` (K, 3)."""

    spectra: Spectra
    poses: Array
    columns: int
    clockwise: bool = True

    @classmethod
    def of(cls, panoramas: Iterable[Image], poses: Array, clockwise: bool = True) -> ImageRetrieval:
        """Remember panoramas (H, W, 3) uint8 and where they were taken, x m, y m, yaw rad.

        Raises DataError for none.
        """
        small = [_likeness(panorama) for panorama in panoramas]
        if not small:
            raise DataError('no training image to retrieve')
        return cls(spectrum(np.stack(small)), poses, small[0].shape[1], clockwise)

    def locate(self, panorama: Image) -> Array:
        """The pose (3,) of the training image that correlates best with a panorama (H, W, 3),
        turned by the rotation at which it does.
        """
        curves = np.fft.irfft(
            np.einsum('krf,rf->kf', self.spectra, np.conj(spectrum(_likeness(panorama)))),
            self.columns,
            axis=1,
        )
        best, shift = np.unravel_index(int(curves.argmax()), curves.shape)
        turn = (-2 if self.clockwise else 2) * np.pi * shift / self.columns
        x, y, yaw = self.poses[best]
        return np.array([x, y, wrap_angle(yaw + turn)])


def _likeness(panorama: Image) -> Texture:
    """A panorama (H, W, 3) as a gray image of at most (ROWS, COLUMNS), zero mean, unit norm."""
    gray = cv2.cvtColor(panorama, cv2.COLOR_BGR2GRAY)
    size = min(gray.shape[1], COLUMNS), min(gray.shape[0], ROWS)
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return normalized(np.asarray(small, np.float32))
