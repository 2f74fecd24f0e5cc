# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The kind of a camera, guessed from its images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from sfa_localization.camera.calibration import MirrorCircles, find_circles
from sfa_localization.camera.panorama import looks_like_panorama
from sfa_localization.data.errors import CameraError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image, Run
from sfa_localization.data.statistics import evenly

PANORAMA = 'panorama'
EQUIRECTANGULAR = 'equirectangular'
ORDINARY = 'ordinary camera'
MIRROR = 'mirror'
FISHEYE = 'fisheye'
DUAL_FISHEYE = 'dual fisheye'
STEREO = 'stereo pair'
# of an unrolled circle; the inner third shows the robot
_RADII = 30
_ANGLES = 400
_INNER = 10
# Views side by side correlate by 1, or 0.5 when shifted by parallax, up to a share of their width;
# opposite parts of a panorama by 0.1.
_SAME = 0.35
_PARALLAX = 0.1
_SAMPLES = 16  # images of a drive that are checked


@dataclass(frozen=True, slots=True)
class CameraKind:
    """The kind of camera of images of a size, and the `evidence` for it."""

    name: str
    evidence: str
    width: int
    height: int

    def __str__(self) -> str:
        return f'{self.width}x{self.height}, {self.name}: {self.evidence}'

    @property
    def is_panorama(self) -> bool:
        """Whether the columns of an image are azimuths."""
        return self.name in (PANORAMA, EQUIRECTANGULAR)

    @property
    def shows_turns(self) -> bool:
        """Whether a turn of the robot shifts the unrolled images."""
        return self.is_panorama or self.name in (MIRROR, FISHEYE)

    @property
    def lack(self) -> str:
        """Why it cannot be used; '' if it can."""
        if self.name not in (ORDINARY, STEREO):
            return ''
        return (
            'the images do not show all directions: an omnidirectional camera is needed (if this '
            'is one, describe it with calibration_file)'
        )


class Geometry(NamedTuple):
    """The name of a kind of camera, the evidence for it, and its circles."""

    name: str
    evidence: str
    circles: tuple[MirrorCircles, ...] = ()


def guess_geometry(samples: Sequence[Image]) -> Geometry:
    """The kind of camera of images (H, W, 3)."""
    height, width = samples[0].shape[:2]
    ratio = f'{width / height:.1f} times as wide as high'
    twice = abs(width / height - 2) < 0.02
    closes = width > height and _closes(samples)
    if not closes and _same_twice(samples):
        return Geometry(STEREO, 'the left half shows the same as the right one')
    if looks_like_panorama(height, width):
        return Geometry(PANORAMA, ratio)
    if twice:
        starts = 0, width // 2
        pair = [_circles([sample[:, at : at + height] for sample in samples]) for at in starts]
        circles = tuple(circle for circle in pair if circle)
        if len(circles) == 2:
            return Geometry(DUAL_FISHEYE, 'two circles', circles)
    elif circle := _circles(samples):
        if circle.hole is None:
            return Geometry(FISHEYE, 'a circle', (circle,))
        share = circle.hole.radius / circle.rim.radius
        evidence = f'a circle, and the camera itself in its middle, {share:.0%} as wide'
        return Geometry(MIRROR, evidence, (circle,))
    if closes:
        kind = EQUIRECTANGULAR if twice else PANORAMA
        return Geometry(kind, f'{ratio}, whose right edge continues at the left')
    return Geometry(ORDINARY, 'no circle, and the edges do not continue at the other side')


def require_single_view(runs: Sequence[Run]) -> None:
    """Raise CameraError for drives whose panoramas are two views side by side."""
    for run in runs:
        rows = evenly(len(run.panoramas), _SAMPLES).tolist()
        samples = [run.panoramas.read(row, row + 1)[0] for row in rows]
        if not _closes(samples) and _same_twice(samples):
            raise CameraError(
                f'{run.name}: the images are two views side by side, or show a place that looks '
                'alike from both: record one omnidirectional camera (train --force goes on)'
            )


def unrolled(image: Image) -> Image:
    """A circular image, unrolled so that a turn shifts its columns; others as they are."""
    height, width = image.shape[:2]
    if looks_like_panorama(height, width) or abs(width / height - 2) < 0.02:
        return image
    center = ((width - 1) / 2, (height - 1) / 2)
    reach = min(height, width) / 2
    polar = cv2.warpPolar(image, (_RADII, _ANGLES), center, reach, cv2.INTER_LINEAR)
    return np.ascontiguousarray(polar[:, _INNER:].transpose(1, 0, 2))


def _circles(samples: Sequence[Image]) -> MirrorCircles | None:
    try:
        return find_circles(samples)
    except CameraError:
        return None


def _closes(samples: Sequence[Image]) -> bool:
    """Whether the first column continues the last one, by the median differences of columns."""
    gray = np.stack([sample.mean(-1) for sample in samples])

    def change(columns: int) -> Array:
        return np.asarray(np.abs(gray - np.roll(gray, columns, axis=2)).mean((0, 1)))

    neighbors = change(1)
    opposite = change(gray.shape[2] // 2)
    return bool(neighbors[0] < np.sqrt(np.median(neighbors) * np.median(opposite)))


def _same_twice(samples: Sequence[Image]) -> bool:
    """Whether the left half shows the same as the right one."""
    edges = np.diff(np.stack([sample.mean(-1) for sample in samples]), axis=2, append=0.0)
    edges[..., -1] = 0.0
    power = np.abs(np.fft.rfft(edges, axis=2)) ** 2
    likeness = np.fft.irfft(power.sum((0, 1)), edges.shape[2])
    half = edges.shape[2] // 2
    near = likeness[half - round(_PARALLAX * half) : half + 1]
    return bool(near.max() > _SAME * likeness[0] > 0)
