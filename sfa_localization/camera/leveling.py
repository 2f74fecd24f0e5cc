# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Panoramas of a tilted robot, and the same panoramas leveled.

Panoramas are leveled by the orientation of an IMU, live and from bags, or else by their content
(`keyframes/tilt.py`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from sfa_localization.camera.panorama import filled, repeated_pixels
from sfa_localization.data.geometry import Array, Indices, Mask
from sfa_localization.data.run import Image, Panoramas, Stamps
from sfa_localization.data.sphere import Sphere, rotation

TILTED_RAD = np.radians(0.7)
"""A smaller tilt is not corrected."""
NEAR_NS = 50_000_000
"""Largest distance in time of an orientation from its image; a robot that sways by 4 degrees with a
correlation time of 0.7 s tilts by one degree meanwhile."""


def leaning(roll: float, pitch: float) -> str:
    """The sentence about a camera that leans on the robot by roll and pitch, rad."""
    aside = 'right' if roll > 0 else 'left'
    along = 'forward' if pitch > 0 else 'back'
    return (
        f'the camera leans by {abs(np.degrees(roll)):.1f} degrees to the {aside} and by '
        f'{abs(np.degrees(pitch)):.1f} degrees {along}: the model levels its images'
    )


def tilted(panorama: Image, tilt: Array, sphere: Sphere) -> Image:
    """A level panorama (H, W, C) as taken by a robot with roll and pitch (2,) rad; its upper and
    lower rows are repeated beyond its edges.
    """
    return _rotated(panorama, rotation(*tilt), sphere)


def leveled(panorama: Image, tilt: Array, sphere: Sphere) -> Image:
    """The level panorama, from one (H, W, C) taken with roll and pitch (2,) rad."""
    return _rotated(panorama, rotation(*tilt).T, sphere)


def _rotated(panorama: Image, turn: Array, sphere: Sphere) -> Image:
    size = panorama.shape[:2]
    pixels = sphere.pixels(sphere.rays(*size) @ turn.T, *size).astype(np.float32)
    turned = resampled(panorama, pixels[..., 0] + 1, pixels[..., 1])
    return np.asarray(turned, panorama.dtype).reshape(panorama.shape)


def resampled(panorama: Any, columns: Any, rows: Any) -> Any:
    """Values of a panorama (H, W, C) at columns and rows (H, W) float32, counted from one column
    left of it, as it closes on itself; its upper and lower rows are repeated beyond its edges.
    """
    wrapped = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)
    return cv2.remap(wrapped, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@dataclass(frozen=True, slots=True)
class ChangedPanoramas(ABC):
    """Panoramas that are changed as they are read."""

    stamps_ns: Stamps
    panoramas: Panoramas

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.panoramas.shape

    def __len__(self) -> int:
        return len(self.panoramas)

    def read(self, start: int, stop: int) -> Image:
        return self._changed(self.panoramas.read(start, stop), start)

    def batches(self, size: int) -> Iterator[Image]:
        for k, images in enumerate(self.panoramas.batches(size)):
            yield self._changed(images, k * size)

    @abstractmethod
    def _changed(self, images: Image, start: int) -> Image:
        """The panoramas (N, H, W, 3) that begin with number `start`, changed."""


@dataclass(frozen=True, slots=True)
class MaskedPanoramas(ChangedPanoramas):
    """Panoramas whose pixels (H, W) repeat those of `repeated`."""

    repeated: Indices

    @classmethod
    def of(cls, panoramas: Panoramas, seen: Mask) -> MaskedPanoramas:
        """Panoramas of which only the pixels `seen` (H, W) are used."""
        return cls(panoramas.stamps_ns, panoramas, repeated_pixels(seen))

    def _changed(self, images: Image, start: int) -> Image:
        return filled(images, self.repeated)


@dataclass(frozen=True, slots=True)
class LeveledPanoramas(ChangedPanoramas):
    """Panoramas leveled by their `tilts` (N, 2), roll and pitch rad."""

    tilts: Array
    sphere: Sphere

    @classmethod
    def of(cls, panoramas: Panoramas, tilts: Array, sphere: Sphere) -> LeveledPanoramas:
        return cls(panoramas.stamps_ns, panoramas, tilts, sphere)

    def _changed(self, images: Image, start: int) -> Image:
        tilts = self.tilts[start : start + len(images)]
        steep = np.flatnonzero(np.hypot(*tilts.T) >= TILTED_RAD)
        images = images.copy() if len(steep) else images
        for k in steep.tolist():
            images[k] = leveled(images[k], tilts[k], self.sphere)
        return images


def tilts_at(stamps_ns: Stamps, measured_ns: Stamps, tilts: Array) -> Array:
    """Roll and pitch (M, 2) at stamps (M,), interpolated between measured ones (N, 2) at increasing
    stamps (N,); NaN where none is within NEAR_NS.
    """
    if not len(measured_ns):
        return np.full((len(stamps_ns), 2), np.nan)
    after = np.searchsorted(measured_ns, stamps_ns).clip(0, len(measured_ns) - 1)
    before = np.maximum(after - 1, 0)
    since = np.abs(measured_ns[before] - stamps_ns)
    until = np.abs(measured_ns[after] - stamps_ns)
    between = np.column_stack([np.interp(stamps_ns, measured_ns, tilt) for tilt in tilts.T])
    return np.where((np.minimum(since, until) <= NEAR_NS)[:, None], between, np.nan)
