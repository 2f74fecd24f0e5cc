# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""An image without the roll and pitch of the robot, correlated with keyframes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfa_localization.camera.leveling import TILTED_RAD, leveled
from sfa_localization.data.geometry import Array, Indices
from sfa_localization.data.run import Image
from sfa_localization.keyframes.correlation import LIKE_A_PLACE, coarse_scores, least
from sfa_localization.keyframes.keyframes import Keyframes
from sfa_localization.keyframes.texture import Spectra, spectrum, texture
from sfa_localization.keyframes.tilt import find_tilt, visible

# How many keyframes the coarse correlation leaves for the full one.
_CANDIDATES = 64
# The likest keyframes to which an image is leveled: with a tilt the first may be another place.
_LEVELED = 16
# Tilts that are tried for an image that is unlike all keyframes: beyond 8 degrees it is, even of a
# known place, and each of these makes it like them up to 6 degrees on.
_STEEP_RAD = math.radians(8.0) * np.array(
    [(math.cos(angle), math.sin(angle)) for angle in np.arange(8) * math.pi / 4]
)


@dataclass(frozen=True, slots=True)
class UprightImage:
    """The `panorama` (H, W, 3) that a level robot would see, by the one that was `seen` with a
    `tilt`, roll and pitch (2,) rad.

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
    """A panorama (H, W, 3) uint8 BGR without the roll and pitch that make it likest one of the
    keyframes that it is likest anyway, or would be with a large tilt.
    """
    level = _leveled(keyframes, _compared(keyframes, panorama, np.zeros(2)))
    if level.score >= LIKE_A_PLACE:
        return level
    steep = [_compared(keyframes, panorama, tilt) for tilt in _STEEP_RAD]
    likest = _leveled(keyframes, max(steep, key=lambda image: image.score))
    return likest if likest.score > level.score else level


def without(keyframes: Keyframes, image: UprightImage, tilt: Array) -> UprightImage:
    """An image after a roll and pitch (2,) rad more are taken out, if they matter; the same
    keyframes are correlated.
    """
    if np.hypot(*tilt) < TILTED_RAD:
        return image
    level = _seen(keyframes, image.seen, image.tilt + tilt)
    return correlated(keyframes, level, np.flatnonzero(np.isfinite(image.scores)))


def correlated(keyframes: Keyframes, image: UprightImage, rows: Indices) -> UprightImage:
    """An image with the correlations of some keyframes more."""
    rows = rows[np.isneginf(image.scores[rows])]
    scores, yaws = image.scores.copy(), image.yaws.copy()
    scores[rows], yaws[rows] = (of[0] for of in keyframes.correlated(image.visible[None], rows))
    return replace(image, scores=scores, yaws=yaws)


def _seen(keyframes: Keyframes, panorama: Image, tilt: Array) -> UprightImage:
    """A panorama (H, W, 3) that was taken with a tilt (2,) rad, compared with no keyframe."""
    if not tilt.any():
        whole = spectrum(texture(panorama))
        return UprightImage(panorama, panorama, tilt, whole, whole, *keyframes.unmatched())
    sphere, columns = keyframes.sphere, keyframes.columns
    level = leveled(panorama, tilt, sphere)
    image = texture(level)
    rows = [part.stop - part.start for part in keyframes.channels]
    mask = np.concatenate([visible(tilt, n, columns, sphere) for n in rows])
    part = image * mask
    # What was not seen would count as unlike.
    part /= np.float32(max(float(np.linalg.norm(part)), 1e-6) * math.sqrt(mask.mean()))
    spectra = spectrum(image), spectrum(part)
    return UprightImage(panorama, level, tilt, *spectra, *keyframes.unmatched())


def _compared(keyframes: Keyframes, panorama: Image, tilt: Array) -> UprightImage:
    """The same, correlated with the keyframes that it is likest."""
    image = _seen(keyframes, panorama, tilt)
    scores = coarse_scores(image.visible[None], keyframes.coarse)[0]
    return correlated(keyframes, image, np.sort(least(-scores, _CANDIDATES)))


def _leveled(keyframes: Keyframes, image: UprightImage) -> UprightImage:
    """An image without the tilt that it has against one of its likest keyframes."""
    likely = np.flatnonzero(np.isfinite(image.scores))
    likely = likely[least(-image.scores[likely], _LEVELED)]
    level, turn = keyframes.aligned(likely), -keyframes.sign * image.yaws[likely]
    others = level, turn.astype(float), keyframes.columns, keyframes.channels, keyframes.sphere
    tilts, scores = find_tilt(image.spectrum, *others)
    return without(keyframes, image, tilts[int(scores.argmax())])
