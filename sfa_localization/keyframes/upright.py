# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""An image without the roll and pitch of the robot, correlated with keyframes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.camera.leveling import TILTED_RAD, leveled
from sfa_localization.data.geometry import Array, Indices
from sfa_localization.data.run import Image
from sfa_localization.keyframes.hidden import correlated_part, masked
from sfa_localization.keyframes.keyframes import Keyframes
from sfa_localization.keyframes.texture import (
    LIKE_A_PLACE,
    Spectra,
    coarse_scores,
    spectrum,
    texture,
)
from sfa_localization.keyframes.tilt import find_tilt, visible

# The coarse correlation leaves so many keyframes for the full one.
_CANDIDATES = 64
# Number of best-matching keyframes to which an image is leveled: under a tilt the first may be of
# another place.
_LEVELED = 16
# Tilts that are tried for an image that is unlike all keyframes: beyond 8 degrees even an image of
# a trained place is unlike them, and each of these tilts extends the range by 6 degrees.
_EIGHTHS = np.arange(8) * np.pi / 4
_STEEP_RAD = np.radians(8.0) * np.column_stack([np.cos(_EIGHTHS), np.sin(_EIGHTHS)])


@dataclass(frozen=True, slots=True)
class UprightImage:
    """The `panorama` (H, W, 3) that a level robot would see, computed from the original, `seen` at
    a `tilt`, roll and pitch (2,) rad.

    `spectrum` (rows, F) is that of its texture, `visible` that of the part that was seen, scaled so
    that its correlations are those of the whole. `scores` (K,) are the correlations with the
    keyframes, -inf where unknown, and `yaws` (K,) rad where they are reached.
    """

    seen: Image
    panorama: Image
    tilt: Array
    spectrum: Spectra
    visible: Spectra
    scores: NDArray[np.float32]
    yaws: NDArray[np.float32]

    @property
    def score(self) -> float:
        """The correlation with the likest keyframe."""
        return float(self.scores.max())


def upright(keyframes: Keyframes, panorama: Image) -> UprightImage:
    """A panorama (H, W, 3) uint8 BGR without the roll and pitch that maximize its correlation with
    a keyframe, among those that match it best as it is, or after a large tilt.
    """
    level = _leveled(keyframes, _compared(keyframes, panorama, np.zeros(2)))
    if level.score >= LIKE_A_PLACE:
        return level
    steep = [_compared(keyframes, panorama, tilt) for tilt in _STEEP_RAD]
    likest = _leveled(keyframes, max(steep, key=lambda image: image.score))
    return likest if likest.score > level.score else level


def without(keyframes: Keyframes, image: UprightImage, tilt: Array) -> UprightImage:
    """An image after a further roll and pitch (2,) rad are taken out, if they matter; it is
    correlated with the same keyframes.
    """
    if np.hypot(*tilt) < TILTED_RAD:
        return image
    rows = np.flatnonzero(np.isfinite(image.scores))
    return _compared(keyframes, image.seen, image.tilt + tilt, rows)


def _compared(
    keyframes: Keyframes, panorama: Image, tilt: Array, rows: Indices | None = None
) -> UprightImage:
    """A panorama (H, W, 3) that was taken with a tilt (2,) rad, correlated with some keyframes, by
    default with those that it is likest.
    """
    level = leveled(panorama, tilt, keyframes.sphere) if tilt.any() else panorama
    image = texture(level)
    whole = part = spectrum(image)
    if tilt.any() or keyframes.seen is not None:
        heights = [channel.stop - channel.start for channel in keyframes.channels]
        mask = np.concatenate(
            [visible(tilt, n, keyframes.columns, keyframes.sphere) for n in heights]
        )
        if keyframes.seen is not None:
            mask = mask & keyframes.seen
        part = correlated_part(image, mask)
    if rows is None:
        order = np.argsort(-coarse_scores(part, keyframes.coarse), kind='stable')
        rows = np.sort(order[:_CANDIDATES])
    scores, yaws = np.full((2, len(keyframes.poses)), -np.inf, np.float32)
    scores[rows], yaws[rows] = keyframes.correlated(part, rows)
    return UprightImage(panorama, level, tilt, whole, part, scores, yaws)


def _leveled(keyframes: Keyframes, image: UprightImage) -> UprightImage:
    """An image without the tilt that it has against one of its likest keyframes."""
    likest = np.argsort(-image.scores, kind='stable')[:_LEVELED]
    likest = likest[np.isfinite(image.scores[likest])]
    turn = -keyframes.sign * image.yaws[likest].astype(float)
    seen = image.spectrum if keyframes.seen is None else masked(image.spectrum, keyframes.seen)
    others = keyframes.aligned(likest)
    tilts, scores = find_tilt(
        seen, others, turn, keyframes.columns, keyframes.channels, keyframes.sphere
    )
    return without(keyframes, image, tilts[int(scores.argmax())])
