# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A stand-in for a trained model that reads pose and novelty off the picture's first row."""

import dataclasses
import math

import numpy as np

from sfa_localization.config import PanoramaConfig
from sfa_localization.correlation import ErrorCorrelation
from sfa_localization.place_model import Estimate

SIZE = PanoramaConfig(width=64, height=16)
STEP_M = 0.05
UNLIKE_DEFAULT = ErrorCorrelation(0.5, 2.0)


def panorama(pose=(0.0, 0.0, 0.0), seed=0, novelty=0.5, level=120, spread=40):
    """A picture (H, W, 3) of random dots that says where it was taken, to within STEP_M."""
    noise = np.random.default_rng(seed).normal(level, spread, (SIZE.height, SIZE.width, 3))
    image = np.clip(noise, 0, 255).astype(np.uint8)
    x, y = (round(value / STEP_M) for value in pose[:2])
    yaw = round(pose[2] % (2 * math.pi) / (2 * math.pi) * 65535)
    image[0, 0] = x % 256, x // 256, y % 256
    image[0, 1] = y // 256, yaw % 256, yaw // 256
    image[0, 2] = round(10 * novelty)
    return image


@dataclasses.dataclass
class PictureReader:
    """Reads what `panorama` wrote; positions are positive."""

    panorama: PanoramaConfig = SIZE
    has_heading: bool = True
    error_correlation: ErrorCorrelation = UNLIKE_DEFAULT

    def locate(self, image):
        a, b, novelty = image[0, :3].astype(int)
        position = np.array([a[0] + 256 * a[1], a[2] + 256 * b[0]]) * STEP_M
        yaw = math.remainder((b[1] + 256 * b[2]) / 65535 * 2 * math.pi, 2 * math.pi)
        # As a model does, it is less sure of pictures that are somewhat new.
        spread = np.diag([0.02, 0.03, 0.002]) * max(novelty[0] / 10, 1.0) ** 2
        yaw = yaw if self.has_heading else math.nan
        return Estimate(np.append(position, yaw), position, yaw, spread, novelty[0] / 10)

    def locate_all(self, images):
        return [self.locate(image) for image in images]
