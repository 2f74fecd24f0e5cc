# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The place of a texture among keyframes whose textures change linearly with the place."""

import numpy as np
import pytest

from sfa_localization.keyframes.regression import regress
from sfa_localization.keyframes.texture import normalized, spectrum, turned

ROWS = 8
SIZES = pytest.mark.parametrize('columns', [60, 61])


def smooth(rng, columns):
    """A random texture of the lowest ten frequencies, of zero mean and unit norm."""
    rough = np.fft.rfft(rng.normal(size=(ROWS, columns)))
    rough[:, 10:] = 0
    return normalized(np.fft.irfft(rough, columns).astype(np.float32))


class KeyframeSquare:
    """Keyframes at `places` (64, 2) m on a square of 1 m, whose textures change linearly with the
    place, and a texture `strange` that has nothing to do with it.
    """

    def __init__(self, columns=60):
        rng, self.columns = np.random.default_rng(4), columns
        self.base, self.along_x, self.along_y = (smooth(rng, columns) for _ in range(3))
        basis = np.stack([self.base, self.along_x, self.along_y]).reshape(3, -1)
        strange = smooth(rng, columns).ravel()
        strange -= np.linalg.lstsq(basis.T, strange, rcond=None)[0] @ basis
        self.places = rng.uniform(-0.5, 0.5, (64, 2))
        self.strange = normalized(strange.reshape(self.base.shape))
        self.kept = self.keyframes(self.places)

    def seen(self, place, more=0.0):
        """Spectrum of the texture at a place (2,) m."""
        x, y = place
        texture = self.base + 0.3 * x * self.along_x + 0.3 * y * self.along_y
        return spectrum(normalized(texture + more))

    def keyframes(self, places, more=0.0):
        return np.stack([self.seen(place, more) for place in places])

    def fit(self, place, more=0.0):
        return fit_among(self.seen(place, more), self.kept, self.places, self.columns)


def fit_among(image, keyframes, places, columns, channels=None):
    """The fit of a spectrum (rows, F) on which roll and pitch have no effect."""
    channels = channels or (slice(0, keyframes.shape[1]),)
    by_turn = (image * 1j * np.arange(image.shape[1])).astype(np.complex64)
    changes = np.stack([image, 0 * image, 0 * image, by_turn])
    return regress(changes, keyframes, places, np.zeros(len(places), np.int32), channels, columns)


@SIZES
@pytest.mark.parametrize('place', [(0.2, -0.3), (-0.4, 0.4)])
def test_a_place_between_keyframes_is_measured_whatever_the_rest_of_the_angle(columns, place):
    scene = KeyframeSquare(columns)
    fit = scene.fit(place)
    assert np.allclose(fit.place, place, atol=0.01)
    assert np.abs(fit.changes).max() < 5e-3 and 0 <= fit.unlike < 1e-3
    assert np.allclose([*fit.shares @ scene.places, fit.shares.sum()], [*fit.place, 1])
    image = turned(scene.seen(place)[None], np.array([0.03]))[0]
    fit = fit_among(image, scene.kept, scene.places, columns)
    assert fit.changes == pytest.approx([0.0, 0.0, 0.03], abs=3e-3)
    assert np.allclose(fit.place, place, atol=0.02)


def test_what_no_place_explains_is_unlike_and_moves_little():
    scene = KeyframeSquare()
    for share in (0.5, 1.0):
        fit = scene.fit((0.2, 0.1), share * scene.strange)
        assert fit.unlike == pytest.approx(share**2, rel=0.3)
        assert np.allclose(fit.place, (0.2, 0.1), atol=0.1)


NOISE = spectrum(2 * smooth(np.random.default_rng(9), 60))


@pytest.mark.parametrize('spoil', [np.negative, lambda image: image + NOISE])
def test_a_channel_that_shows_something_else_counts_little(spoil):
    """Two channels of the same scene, the second of the image spoilt."""
    scene, place = KeyframeSquare(), np.array([0.3, -0.2])
    keyframes = np.concatenate([scene.kept] * 2, axis=1)
    image = np.concatenate([scene.seen(place), spoil(scene.seen(place))])
    channels = slice(0, ROWS), slice(ROWS, 2 * ROWS)
    plain = fit_among(image, keyframes, scene.places, 60)
    fit = fit_among(image, keyframes, scene.places, 60, channels)
    assert np.hypot(*(fit.place - place)) < 0.03
    assert fit.unlike < 0.3 * plain.unlike
