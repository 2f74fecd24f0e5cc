# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What another light adds to all images of a drive, and how unlike the keyframes it makes them.

The sun shines on the same sides of all things, so that much of what it adds to an image is a
pattern over the directions, the same wherever the robot is. What no place explains of the images,
averaged over many places, is that pattern: without it, images of another light lie where those of
the training did; with it, all are moved alike, by what of it looks like another place.

An image may be unlike because no keyframe is near, and then its place is uncertain by as much; or
because the light is another one, which is nearly the same for all images of some minutes, and
moves places little. The keyframes around it say how unlike the first would make it; beside all of
them they cannot, and nothing is learned there. Nor do they know of places that are farther than
they seem: what is suddenly much more unlike than the light of before is rather that.
"""

from __future__ import annotations

import math

import numpy as np

from sfa_localization.data.geometry import Array
from sfa_localization.features.observation import Match, MatchNoise, Spectra

# Standard deviations of the logarithm: at the start, of its change from image to image, and of what
# one image shows of it, which those around it repeat.
_START, _CHANGE, _SHOWN = 0.3, 0.005, 0.1
_REPEATED = 10
# An image that is so many standard deviations more unlike than expected counts half.
_SUDDEN = 2.0
# No light makes images more unlike than this: 1, as much as what they have in common.
_MOST = math.log(2.0)
# Places over which the pattern is averaged, about ten meters of driving; as many as how many its
# absence counts at the start; and how far they are apart, m: a robot that stands learns nothing.
_AVERAGED, _BEFORE, _SPACING_M = 40, 10, 0.25


class OtherLight:
    """A Kalman filter of the logarithm of 1 + `unlike`: unlikeness by place and by light multiply.

    Images that vary with the place say less of the light. Without any, it is that of the keyframes.
    `pattern` (rows, F), the spectrum of what it adds to the texture of an image with yaw 0, is None
    before any is known.
    """

    def __init__(self) -> None:
        self.pattern: Spectra | None = None
        self._places, self._last = 0, np.full(2, np.inf)
        self._logarithm, self._variance = 0.0, _START**2

    @property
    def unlike(self) -> float:
        """How unlike, see `Match`, images at the places of keyframes are now at least, to one
        standard deviation; never negative.
        """
        return math.expm1(max(self._logarithm - math.sqrt(self._variance), 0.0))

    def add(self, match: Match, noise: MatchNoise) -> None:
        """Learn from an image of a known place, matched without the `pattern` known so far."""
        if match.at_border:
            return
        by_place = math.log1p(noise.expected_unlike(match.variation))
        shown = min(max(math.log1p(match.unlike) - by_place, -_MOST), _MOST)
        self._variance += _CHANGE**2
        error, scatter = shown - self._logarithm, _SHOWN**2 + by_place**2
        doubt = 1 + max(error, 0.0) ** 2 / (_SUDDEN**2 * (self._variance + scatter))
        gain = self._variance / (self._variance + _REPEATED * scatter * doubt)
        self._logarithm += gain * error
        self._variance *= 1 - gain
        if match.left is not None:
            self._add_pattern(match.left, match.pose[:2], 1 / doubt)

    def _add_pattern(self, left: Spectra, place: Array, weight: float) -> None:
        """Learn from what is left (rows, F) of an image at a place (2,) m."""
        if np.hypot(*(place - self._last)) < _SPACING_M:
            return
        self._places, self._last = self._places + 1, place
        share = np.float32(weight / min(self._places + _BEFORE, _AVERAGED))
        before = np.zeros_like(left) if self.pattern is None else self.pattern
        self.pattern = before + share * left
