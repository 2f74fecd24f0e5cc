# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The keyframe that an image is likest to, and both as they are compared, for people to see."""

from __future__ import annotations

from typing import NamedTuple

from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image
from sfa_localization.keyframes.keyframes import Keyframes
from sfa_localization.keyframes.texture import columns_of, picture, turned
from sfa_localization.keyframes.upright import upright


class Likest(NamedTuple):
    """The keyframe with the highest `correlation` with an image: its number `row`, and the `pose`
    (3,) [x m, y m, yaw rad] of the camera in the map; pictures (rows, columns, 3) uint8 BGR of the
    image and of the keyframe, turned to the heading of the image.
    """

    row: int
    correlation: float
    pose: Array
    image: Image
    keyframe: Image


def likest(keyframes: Keyframes, panorama: Image) -> Likest:
    """The keyframe that a panorama (H, W, 3) uint8 BGR is likest to."""
    image = upright(keyframes, panorama)
    row = int(image.scores.argmax())
    spectrum = turned(keyframes.aligned([row])[0], -keyframes.sign * image.yaws[row])
    pictures = [
        picture(columns_of(one, keyframes.columns), keyframes.channels)
        for one in (image.spectrum, spectrum)
    ]
    return Likest(row, image.score, keyframes.poses[row], *pictures)
