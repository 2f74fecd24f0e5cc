# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The place of a texture among keyframes whose textures change linearly with the place."""

import numpy as np
import pytest

from sfa_localization.features.keyframes import normalized, spectrum
from sfa_localization.features.local_regression import Neighbors, averaged, turned
from sfa_localization.features.observation import Match

ROWS = 8
SIZES = pytest.mark.parametrize('columns', [60, 61])


def smooth(rng: np.random.Generator, columns: int) -> np.ndarray:
    """A random texture of the lowest ten frequencies, of zero mean and unit norm."""
    rough = np.fft.rfft(rng.normal(size=(ROWS, columns)))
    rough[:, 10:] = 0
    return normalized(np.fft.irfft(rough, columns).astype(np.float32))


class Scene:
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

    def found(self, place, more=0.0, places=None):
        kept, places = (
            (self.kept, self.places) if places is None else (self.keyframes(places), places)
        )
        return place_among(self.seen(place, more), kept, places, self.columns)


def place_among(image, keyframes, places, columns, channels=None, drives=None):
    channels = channels or (slice(0, keyframes.shape[1]),)
    drives = np.zeros(len(places), np.int32) if drives is None else drives
    vectors = Neighbors.vectors_of(keyframes, columns)
    among = Neighbors(vectors, places, drives, channels, columns)
    return among.find(image[None]).match()


@SIZES
def test_a_place_between_keyframes_is_found_and_a_rest_of_angle_is_no_matter_of_it(columns):
    scene = Scene(columns)
    for place in ((0.0, 0.0), (0.2, -0.3), (-0.4, 0.4)):
        found = scene.found(place)
        assert np.allclose(found.pose[:2], place, atol=0.01)
        assert abs(found.pose[2]) < 5e-3 and 0 <= found.unlike < 1e-3
        assert np.allclose([*found.shares @ scene.places, found.shares.sum()], [*found.pose[:2], 1])
    for angle in (-0.02, 0.03):
        image = turned(scene.seen((0.1, 0.2))[None], np.array([-angle]))[0]
        found = place_among(image, scene.kept, scene.places, columns)
        assert found.pose[2] == pytest.approx(angle, rel=0.1)
        assert np.allclose(found.pose[:2], (0.1, 0.2), atol=0.02)


def test_what_no_place_explains_is_unlike_and_moves_little_and_no_texture_is_finite():
    scene = Scene()
    for share in (0.5, 1.0):
        found = scene.found((0.2, 0.1), share * scene.strange)
        assert found.unlike == pytest.approx(share**2, rel=0.3)
        assert np.allclose(found.pose[:2], (0.2, 0.1), atol=0.1)
    for level in (0.0, 1.0):
        same = np.repeat(spectrum(np.full((ROWS, 60), level, np.float32))[None], 64, axis=0)
        found = place_among(same[0], same, scene.places, 60)
        assert np.isfinite(found.pose).all() and np.isfinite(found.unlike)
        assert np.abs(found.pose[:2]).max() <= 0.5


def test_keyframes_along_a_line_in_another_light_show_the_place_across_it():
    scene, place = Scene(), (0.2, 0.3)
    light = scene.strange / 2
    line = np.column_stack([np.linspace(-0.5, 0.5, 12), np.zeros(12)])
    lit, everywhere = scene.keyframes(line, light), np.concatenate([scene.places, line])
    drives = np.repeat([0, 1], [64, 12]).astype(np.int32)
    assert abs(place_among(scene.seen(place, light), lit, line, 60).pose[1]) < 0.01
    keyframes = np.concatenate([scene.kept, lit])
    found = place_among(scene.seen(place, light), keyframes, everywhere, 60, drives=drives)
    assert np.hypot(*(found.pose[:2] - place)) < 0.15


def noisy(spectra):
    return spectra + spectrum(2 * smooth(np.random.default_rng(9), 60))


@pytest.mark.parametrize('spoil', [np.negative, np.zeros_like, noisy])
def test_a_channel_that_shows_something_else_counts_little(spoil):
    """Two channels of the same scene, the second of the image spoilt."""
    scene, place = Scene(), np.array([0.3, -0.2])
    keyframes = np.concatenate([scene.kept] * 2, axis=1)
    image = np.concatenate([scene.seen(place), spoil(scene.seen(place))])
    channels = slice(0, ROWS), slice(ROWS, 2 * ROWS)
    plain = place_among(image, keyframes, scene.places, 60)
    found = place_among(image, keyframes, scene.places, 60, channels)
    assert np.hypot(*(found.pose[:2] - place)) < 0.03
    assert found.unlike < 0.3 * plain.unlike


def lit(rng, columns, share):
    """What a light adds to a texture: other things in each sector of 22.5 degrees."""
    sectors = np.repeat(rng.normal(size=(ROWS, 16)), -(-columns // 16), axis=1)[:, :columns]
    return share * normalized((sectors * rng.normal(1.0, 0.3, sectors.shape)).astype(np.float32))


@SIZES
@pytest.mark.parametrize('share', [0.1, 0.5])
def test_the_noise_is_what_light_moves_the_place_by(columns, share):
    scene, rng, place = Scene(columns), np.random.default_rng(7), np.array([0.1, -0.2])
    found = [scene.found(place, lit(rng, columns, share)) for _ in range(300)]
    errors = np.array([one.pose[:2] - place for one in found])
    noise = np.mean([one.noise for one in found], axis=0)
    assert np.allclose(noise, noise.T) and np.linalg.eigvalsh(noise)[0] > 0
    true = errors.T @ errors / len(errors)
    assert 0.6 < np.trace(noise) / np.trace(true) < 1.7


def test_a_place_far_from_keyframes_or_beside_all_is_seen_to_be():
    scene, place = Scene(), np.array([0.1, -0.2])
    usual = scene.found(place).variation
    assert scene.found(place, places=place + 4 * (scene.places - place)).variation > 3 * usual
    in_light = scene.found(place, 0.7 * scene.strange).variation
    assert in_light == pytest.approx(usual, rel=0.5)
    inside, border, outside = (scene.found((x, 0.0)).aside for x in (0.0, 0.5, 1.5))
    assert inside < 0.2 and 0.5 < border < 0.9 and outside > 0.9


@pytest.mark.parametrize('apart', [0.0, 0.4])
def test_drives_that_put_an_image_apart_make_its_place_uncertain(apart):
    """Along the axis on which they differ, and less where one of them is known to be poor."""
    left = np.zeros((ROWS, 6), np.complex64)
    noise = np.diag([0.01, 0.02])
    parts = [Match(np.array([x, 1.0, 0.0]), 0.2, 0.1, 0.0, noise, left=left) for x in (0.0, apart)]
    alike = averaged(parts, [2.0, 2.0])
    assert np.allclose(alike.pose[:2], [apart / 2, 1.0])
    assert np.allclose(alike.apart, np.diag([(apart / 2) ** 2, 0.0]))
    mostly = averaged(parts, [99.0, 1.0])
    assert np.allclose(mostly.apart, np.diag([0.0099 * apart**2, 0.0]))
    assert np.allclose(mostly.noise, noise)
