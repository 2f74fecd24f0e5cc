# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Conditions of the latest images: what the light adds to them, and how wrong slow features are.

The sun shines on the same sides of all things, so that much of what it adds to an image is a
pattern over the directions, the same wherever the robot is. The residual of images, averaged over
many places, is that pattern. After the pattern is subtracted, images in another light are located
as in training. Otherwise all are displaced alike, because the pattern resembles a change of place.
"""

from __future__ import annotations

import numpy as np

from sfa_localization.keyframes.location import SCALES, Location
from sfa_localization.keyframes.regression import BORDER
from sfa_localization.keyframes.texture import Spectra

# Places over which the pattern is averaged, about ten meters of driving; the weight of the initial
# zero pattern, in places; and the spacing of places, m: a standing robot adds none.
_AVERAGED = 40
_BEFORE = 10
_SPACING_M = 0.25
# Share of the newest image in the probabilities of scales: they follow about ten images.
_NEWEST = 0.1


class Conditions:
    """`pattern` (rows, F) is the spectrum of what the light adds to the texture of an image with
    yaw 0, None before the first image; `scales` (S,) are the probabilities of `SCALES`.
    """

    def __init__(self) -> None:
        self.pattern: Spectra | None = None
        self.scales = np.full(len(SCALES), 1 / len(SCALES))
        self._places = 0
        self._last = np.full(2, np.inf)

    @property
    def slow_error_factor(self) -> float:
        """About the ratio of the errors of slow features to those in training."""
        return float(np.exp(self.scales @ np.log(SCALES) / 2))

    def add(self, location: Location) -> None:
        """Learn from an image that was located with these conditions."""
        self.scales = self.scales + _NEWEST * (location.scales - self.scales)
        place = location.pose[:2]
        fit = location.fit
        # At the border of the keyframes the residual is also due to the place.
        if fit.outward > BORDER or np.hypot(*(place - self._last)) < _SPACING_M:
            return
        self._places += 1
        self._last = place
        share = np.float32(1 / min(self._places + _BEFORE, _AVERAGED))
        before = np.zeros_like(fit.residual) if self.pattern is None else self.pattern
        # The pattern so far was subtracted from the image before the fit.
        self.pattern = before + share * fit.residual
