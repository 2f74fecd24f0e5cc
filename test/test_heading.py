# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The visual compass: exactly equivariant, honest about what it cannot know."""

from functools import cache

import numpy as np
import pytest
from cylinder_worlds import place, visit

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.features.image_features import harmonics
from sfa_localization.features.observation import UNKNOWN_YAW_VARIANCE
from sfa_localization.metric import compass_training
from sfa_localization.metric.compass_training import CompassFit, fit_compass


@pytest.fixture(autouse=True)
def few_inducing_images(monkeypatch):
    """Fewer than there are images, so that they matter."""
    monkeypatch.setattr(compass_training, 'INDUCING_IMAGES', 80)


@cache
def scene(count: int = 240, seed: int = 0):
    """Features, harmonics and yaw of pictures along a smooth path, columns clockwise."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, count)[:, None]
    features = np.sin(2 * np.pi * t * np.array([1, 2, 3]) + np.array([0, 1, 2]))
    mix = rng.normal(size=(3, 12, 2)) @ np.array([1, 1j])
    own = features @ mix + 3 * (rng.normal(size=12) + 1j * rng.normal(size=12))
    yaw = wrap_angle(np.cumsum(rng.normal(0, 0.2, count)))
    noise = rng.normal(0, 0.05, (count, 12, 2)) @ np.array([1, 1j])
    return features, own * np.exp(-1j * yaw)[:, None] + noise, yaw


def fitted(yaw=None, harmonic=None, sign=-1.0) -> CompassFit:
    features, own, true = scene()
    yaw = true if yaw is None else yaw
    harmonic = own if harmonic is None else harmonic
    return fit_compass(features, harmonic, yaw, np.arange(len(yaw)) // 20 % 6, sign)


def test_harmonics_by_hand():
    maps = np.zeros((1, 1, 4, 2), np.float32)
    maps[0, 0, :, 0] = [1, 0, -1, 0]
    maps[0, 0, :, 1] = [0, 1, 0, 0]
    assert np.allclose(harmonics(maps), [[2, -1j]])


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_headings_are_learnt_with_their_variance_whichever_way_columns_grow(sign):
    features, harmonic, yaw = scene()
    fit = fitted(sign * yaw, harmonic, -sign)
    told, variance = fit.compass.predict(features, harmonic)
    assert np.degrees(np.abs(fit.error).mean()) < 2
    assert np.degrees(np.abs(wrap_angle(told - sign * yaw)).max()) < 5
    assert (variance > 0).all() and (variance <= UNKNOWN_YAW_VARIANCE).all()
    assert 0.9 <= (np.abs(fit.error) < 1.96 * fit.std).mean() <= 1.0  # on left-out pictures
    assert np.median(fit.std) < np.radians(10)


@pytest.mark.parametrize('turn', [0.1, -2.5])
def test_turning_is_exact_and_contrast_does_not_matter(turn):
    features, harmonic, _ = scene()
    compass = fitted().compass
    yaw, variance = compass.predict(features, harmonic)
    turned, same = compass.predict(features, harmonic * np.exp(-1j * turn))
    assert np.abs(wrap_angle(turned - yaw - turn)).max() < 1e-4
    assert np.allclose(same, variance, rtol=1e-3)
    faint, same = compass.predict(features, 0.1 * harmonic)
    assert np.abs(wrap_angle(faint - yaw)).max() < 1e-5
    assert np.allclose(same, variance, rtol=1e-3)


def test_ambiguous_scenes_are_unsure():
    """Every picture with two opposite headings: the compass must not pretend to know."""
    features, harmonic, yaw = scene()
    both = fit_compass(
        np.repeat(features, 2, axis=0),
        np.repeat(harmonic, 2, axis=0),
        np.stack([yaw, yaw + np.pi], 1).ravel(),
        np.arange(2 * len(yaw)) // 40 % 6,
        -1.0,
    )
    _, variance = both.compass.predict(features, harmonic)
    assert np.sqrt(np.median(variance)) > np.radians(60)


def test_foreign_pictures_and_unknown_places_are_unsure():
    features, harmonic, _ = scene()
    compass = fitted().compass
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(*harmonic.shape, 2)) @ np.array([1, 1j])
    known, lost = (compass.predict(features, h)[1] for h in (harmonic, noise))
    assert np.median(lost) > 10 * np.median(known)
    assert compass.predict(features + 100, harmonic)[1].min() > 0.5 * UNKNOWN_YAW_VARIANCE


def test_symmetric_panoramas_raise_the_variance():
    """Scenes that look alike in several directions have no first harmonic to tell them by."""
    pictures, model = visit().panoramas.read(0, 43), place().model
    turned = np.roll(pictures, pictures.shape[2] // 2, axis=2)
    symmetric = np.mean([pictures, turned], axis=0).round().astype(np.uint8)
    known, lost = (
        np.median([e.covariance[2, 2] for e in model.locate_all(p)]) for p in (pictures, symmetric)
    )
    assert lost > 20 * known
    assert np.sqrt(lost) > np.radians(30)


@pytest.mark.parametrize(('count', 'folds'), [(19, 6), (0, 6), (100, 1)])
def test_too_few_labels_are_refused(count, folds):
    features, harmonic, yaw = (part[:count] for part in scene())
    with pytest.raises(DataError, match='too few to learn a compass'):
        fit_compass(features, harmonic, yaw, np.arange(count) % folds, -1.0)
