# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Signatures without slowness: they do not depend on heading or exposure, and keep most power."""

import numpy as np
import pytest
from test_reproduce import panoramas

from sfa_localization.data.errors import DataError
from sfa_localization.features.signatures import (
    DIMENSIONS,
    FourierSignature,
    TurnedComponents,
    row_harmonics,
)

KINDS = (FourierSignature, TurnedComponents)
# As wide as the largest image of a signature, so that a turn is by whole columns.
IMAGES = panoramas(40)[:, :, 25:175]


def fitted(kind, images=IMAGES):
    return kind.fit(lambda: np.split(images, [16, 30]))


@pytest.mark.parametrize('kind', KINDS)
def test_they_depend_neither_on_heading_nor_on_exposure(kind):
    signature = fitted(kind)
    features = signature.features(IMAGES)
    assert features.shape == (40, DIMENSIONS)
    turned = signature.features(np.roll(IMAGES, 37, axis=2))
    darker = signature.features(np.rint(0.5 * IMAGES + 10).astype(np.uint8))
    spread = features.std()
    assert np.abs(turned - features).max() < 1e-9 * spread
    assert np.abs(darker - features).max() < 0.05 * spread
    others = np.abs(features - np.roll(features, 1, axis=0)).max(1)
    assert others.min() > 0.1 * spread


@pytest.mark.parametrize('kind', KINDS)
def test_batches_make_no_difference(kind):
    whole = kind.fit(lambda: [IMAGES]).features(IMAGES)
    assert np.allclose(np.abs(whole), np.abs(fitted(kind).features(IMAGES)), atol=1e-9)


@pytest.mark.parametrize('kind', KINDS)
def test_one_image_is_too_few(kind):
    with pytest.raises(DataError, match='two images'):
        kind.fit(lambda: [IMAGES[:1]])


def test_signatures_are_decorrelated_and_strongest_first():
    features = fitted(FourierSignature).features(IMAGES)
    covariance = np.cov(features.T)
    assert np.allclose(covariance, np.diag(np.diag(covariance)), atol=1e-9 * covariance.max())
    assert np.all(np.diff(np.diag(covariance)) <= 1e-12)


def test_the_first_component_is_that_of_all_rotated_images():
    """An odd number of columns: then every harmonic but the mean has two directions."""
    images = panoramas(40, 2)[:, ::5, ::20][:, :, :9]
    components = fitted(TurnedComponents, images)
    power = (components.features(images) ** 2).mean(0)
    columns = images.shape[2]
    mine = columns * np.where(components.harmonic > 0, power / 2, power)
    small = images - images.mean((1, 2), keepdims=True)
    small = small / small.std((1, 2), keepdims=True)
    views = np.concatenate([np.roll(small, turn, axis=2) for turn in range(columns)])
    flat = views.reshape(len(views), -1)
    explicit = np.linalg.eigvalsh(flat.T @ flat / len(flat))
    assert mine.max() == pytest.approx(explicit[-1], rel=1e-9)


def test_harmonics_hold_the_power_of_the_image():
    image = panoramas(1)[0][:, :25]
    waves = row_harmonics(image)
    assert (np.abs(waves) ** 2).sum() / 20 == pytest.approx(3.0, rel=1e-6)
