# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of real cameras, turned in software as by a robot that turns on the spot."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

FOLDER = Path(__file__).parent / 'cameras'
DESK_CENTER, DESK_RADII = (243.2, 136.1), (58.7, 149.3)
"""Of the mirror, in pixels."""
STEP_DEG = 25.0
"""From picture to picture."""


def desk_mirror(count, turns='mirror'):
    """Pictures (270, 480, 3) of a mirror in a housing; the `mirror` turns, or the whole `picture`.

    All have another noise.
    """
    still, rng = cv2.imread(str(FOLDER / 'desk_mirror.jpg')), np.random.default_rng(0)
    rows, columns = np.mgrid[: still.shape[0], : still.shape[1]]
    radius = np.hypot(columns - DESK_CENTER[0], rows - DESK_CENTER[1])
    mirror = (radius > DESK_RADII[0]) & (radius < DESK_RADII[1]) | (turns == 'picture')
    for index in range(count):
        turn = cv2.getRotationMatrix2D(DESK_CENTER, index * STEP_DEG, 1.0)
        turned = cv2.warpAffine(still, turn, still.shape[1::-1])
        picture = np.where(mirror[..., None], turned, still)
        yield np.clip(picture + rng.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)


def street(count):
    """Equirectangular pictures (240, 480, 3)."""
    picture = cv2.imread(str(FOLDER / 'street_equirectangular.jpg'))
    for index in range(count):
        yield np.roll(picture, round(index * STEP_DEG / 360 * picture.shape[1]), axis=1)


def ordinary(count, size=(240, 320)):
    """Pictures (H, W, 3) of an ordinary camera, of 80 degrees, in the same street."""
    height, width = size
    focal = width / 2 / np.tan(np.radians(40))
    rows, columns = (
        np.mgrid[:height, :width] + 0.5 - np.array([height, width])[:, None, None] / 2
    ) / focal
    azimuth, elevation = np.arctan(columns), np.arctan2(-rows, np.hypot(columns, 1.0))
    for picture in street(count):
        across = (azimuth / (2 * np.pi) + 0.5) * picture.shape[1]
        along = (0.5 - elevation / np.pi) * picture.shape[0]
        yield cv2.remap(
            picture, across.astype(np.float32), along.astype(np.float32), cv2.INTER_LINEAR
        )
