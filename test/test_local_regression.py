# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The place of a texture among keyframes whose textures change linearly with the place."""

import numpy as np
import pytest

from sfa_localization.features import local_regression
from sfa_localization.features.keyframes import normalized, spectrum
from sfa_localization.features.local_regression import averaged, turned, weights
from sfa_localization.features.observation import Match

ROWS = 8
SIZES = pytest.mark.parametrize('columns', [60, 61])


def smooth(rng: np.random.Generator, columns: int) -> np.ndarray:
    """A random texture of the lowest ten frequencies, of zero mean and unit norm."""
    rough = np.fft.rfft(rng.normal(size=(ROWS, columns)))
    rough[:, 10:] = 0
    return normalized(np.fft.irfft(rough, columns).astype(np.float32))


def scene(columns: int):
    """Spectrum of the texture at a place (2,) m, places (64, 2) m on a square of 1 m, and a texture
    that has nothing to do with the place.
    """
    rng = np.random.default_rng(4)
    base, along_x, along_y = (smooth(rng, columns) for _ in range(3))

    def seen(place, more=0.0):
        x, y = place
        return spectrum(normalized(base + 0.3 * x * along_x + 0.3 * y * along_y + more))

    basis = np.stack([base, along_x, along_y]).reshape(3, -1)
    strange = smooth(rng, columns).ravel()
    strange -= np.linalg.lstsq(basis.T, strange, rcond=None)[0] @ basis
    return seen, rng.uniform(-0.5, 0.5, (64, 2)), normalized(strange.reshape(base.shape))


def place_among(image, keyframes, places, columns, *more, **others):
    held = keyframes * weights(keyframes.shape[-1], columns)
    return local_regression.place_among(image, held, places, columns, *more, **others)


@SIZES
@pytest.mark.parametrize('place', [(0.0, 0.0), (0.2, -0.3), (-0.4, 0.4)])
def test_a_place_between_keyframes_is_found(columns, place):
    seen, places, _ = scene(columns)
    keyframes = np.stack([seen(p) for p in places])
    found = place_among(seen(place), keyframes, places, columns)
    assert np.allclose(found.pose[:2], place, atol=0.01)
    assert abs(found.pose[2]) < 5e-3 and 0 <= found.unlike < 1e-3
    assert np.allclose([*found.shares @ places, found.shares.sum()], [*found.pose[:2], 1.0])


@SIZES
@pytest.mark.parametrize('angle', [-0.02, 0.03])
def test_a_rest_of_angle_is_seen_and_is_no_matter_of_the_place(columns, angle):
    seen, places, _ = scene(columns)
    keyframes = np.stack([seen(p) for p in places])
    image = turned(seen((0.1, 0.2))[None], np.array([-angle]))[0]
    found = place_among(image, keyframes, places, columns)
    assert found.pose[2] == pytest.approx(angle, rel=0.1)
    assert np.allclose(found.pose[:2], (0.1, 0.2), atol=0.02)


@pytest.mark.parametrize('share', [0.5, 1.0])
def test_what_no_place_explains_is_unlike_and_moves_little(share):
    seen, places, strange = scene(60)
    keyframes = np.stack([seen(p) for p in places])
    found = place_among(seen((0.2, 0.1), share * strange), keyframes, places, 60)
    assert found.unlike == pytest.approx(share**2, rel=0.3)
    assert np.allclose(found.pose[:2], (0.2, 0.1), atol=0.1)


def test_keyframes_along_a_line_in_another_light_show_the_place_across_it():
    seen, places, strange = scene(60)
    strange = strange / 2
    line = np.column_stack([np.linspace(-0.5, 0.5, 12), np.zeros(12)])
    keyframes = np.stack([*(seen(p) for p in places), *(seen(p, strange) for p in line)])
    everywhere, place = np.concatenate([places, line]), (0.2, 0.3)
    drives = np.repeat([0, 1], [64, 12]).astype(np.int32)
    alone = place_among(seen(place, strange), keyframes[64:], line, 60)
    assert abs(alone.pose[1]) < 0.01
    found = place_among(seen(place, strange), keyframes, everywhere, 60, drives=drives)
    assert np.hypot(*(found.pose[:2] - place)) < 0.15


@pytest.mark.parametrize('texture', [np.zeros((ROWS, 60)), np.ones((ROWS, 60))])
def test_textures_that_are_all_the_same_give_a_finite_place(texture):
    _, places, _ = scene(60)
    keyframes = np.repeat(spectrum(texture.astype(np.float32))[None], 64, axis=0)
    found = place_among(keyframes[0], keyframes, places, 60)
    assert np.isfinite(found.pose).all() and np.isfinite(found.unlike)
    assert np.abs(found.pose[:2]).max() <= 0.5


def doubled(spoil):
    """Two channels of the same scene, the second of the image spoilt: its place and what is found
    with and without a word about channels.
    """
    columns, place = 60, (0.3, -0.2)
    seen, places, _ = scene(columns)
    keyframes = np.stack([np.concatenate([seen(p), seen(p)]) for p in places])
    image = np.concatenate([seen(place), spoil(seen(place))])
    channels = slice(ROWS), slice(ROWS, 2 * ROWS)
    plain = place_among(image, keyframes, places, columns)
    return np.array(place), plain, place_among(image, keyframes, places, columns, channels)


def noisy(spectra):
    noise = smooth(np.random.default_rng(9), 60)
    return spectra + spectrum(2 * noise)


@pytest.mark.parametrize('spoil', [np.negative, np.zeros_like, noisy])
def test_a_channel_that_shows_something_else_counts_little(spoil):
    place, plain, found = doubled(spoil)
    assert np.hypot(*(found.pose[:2] - place)) < 0.03
    assert found.unlike < 0.3 * plain.unlike


def lit(rng, columns, share):
    """What a light adds to a texture: other things in each sector of 22.5 degrees."""
    sectors = np.repeat(rng.normal(size=(ROWS, 16)), -(-columns // 16), axis=1)[:, :columns]
    return share * normalized((sectors * rng.normal(1.0, 0.3, sectors.shape)).astype(np.float32))


@SIZES
@pytest.mark.parametrize('share', [0.1, 0.5])
def test_the_noise_is_what_light_moves_the_place_by(columns, share):
    seen, places, _ = scene(columns)
    keyframes = np.stack([seen(p) for p in places])
    rng, place = np.random.default_rng(7), np.array([0.1, -0.2])
    found = [
        place_among(seen(place, lit(rng, columns, share)), keyframes, places, columns)
        for _ in range(300)
    ]
    errors = np.array([one.pose[:2] - place for one in found])
    noise = np.mean([one.noise for one in found], axis=0)
    assert np.allclose(noise, noise.T) and np.linalg.eigvalsh(noise)[0] > 0
    true = errors.T @ errors / len(errors)
    assert 0.6 < np.trace(noise) / np.trace(true) < 1.7


def test_keyframes_vary_more_where_none_is_near_and_not_in_another_light():
    seen, places, strange = scene(60)
    place = np.array([0.1, -0.2])
    far = place + 4 * (places - place)

    def variation(at, more=0.0):
        keyframes = np.stack([seen(p) for p in at])
        return place_among(seen(place, more), keyframes, at, 60).variation

    assert variation(far) > 3 * variation(places)
    assert variation(places, 0.7 * strange) == pytest.approx(variation(places), rel=0.5)


def test_a_place_beside_all_keyframes_is_seen_to_be():
    seen, places, _ = scene(60)
    keyframes = np.stack([seen(p) for p in places])
    inside, border, outside = (
        place_among(seen(at), keyframes, places, 60).aside
        for at in ((0.0, 0.0), (0.5, 0.0), (1.5, 0.0))
    )
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
