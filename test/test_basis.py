# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Maps from slow features to meters: monomials, the Gaussian process, and their saved form."""

import numpy as np
import pytest

from sfa_localization.data.errors import DataError
from sfa_localization.mapping.basis import (
    Monomials,
    Process,
    expand,
    matern,
    missing,
    monomials,
)
from sfa_localization.mapping.saved_map import MetricMap

RNG = np.random.default_rng(0)
FEATURES = RNG.standard_normal((80, 6))


def test_monomials_span_every_quadratic_function():
    # By hand: 1, a, b, a^2, a b, b^2. Eight features make the paper's 45.
    assert monomials(np.array([[2.0, 3.0]])).tolist() == [[1, 2, 3, 4, 6, 9]]
    assert monomials(np.zeros((3, 8))).shape == (3, 45)
    terms = expand(Monomials.fit(FEATURES, 4, 0.0), FEATURES)
    target = 3 + FEATURES[:, 0] - 2 * FEATURES[:, 1] * FEATURES[:, 3] + FEATURES[:, 2] ** 2
    weights = np.linalg.lstsq(terms, target, rcond=None)[0]
    assert np.allclose(terms @ weights, target, atol=1e-12)
    assert np.allclose(terms.T @ terms, 80 * np.eye(15), atol=1e-9)


def test_the_ridge_is_that_of_standardized_monomials():
    ridge, target = 0.3, FEATURES[:, 0] ** 2 + 0.1 * FEATURES[:, 1]
    basis = Monomials.fit(FEATURES, 2, ridge)
    terms = expand(basis, FEATURES)
    weights = np.linalg.solve(terms.T @ terms + np.diag(basis.ridge), terms.T @ target)
    plain = monomials(FEATURES[:, :2])[:, 1:]
    plain = (plain - plain.mean(0)) / plain.std(0)
    direct = np.linalg.solve(
        plain.T @ plain + ridge * 80 * np.eye(5), plain.T @ (target - target.mean())
    )
    assert np.allclose(terms @ weights, plain @ direct + target.mean(), atol=1e-10)


def test_all_points_inducing_make_the_exact_process():
    scale, noise = np.full(3, 0.5), 0.01
    basis = Process.fit(FEATURES, scale, noise, 1000)
    target = np.sin(FEATURES[:, 0])
    terms = expand(basis, FEATURES)[:, :-1]
    weights = np.linalg.solve(terms.T @ terms + noise * np.eye(80), terms.T @ target)
    scaled = FEATURES[:, :3] * scale
    # By hand, at distance 2: (1 + 2 sqrt 5 + 20 / 3) exp(-2 sqrt 5).
    assert matern(np.zeros((1, 1)), np.full((1, 1), 2.0))[0, 0] == pytest.approx(0.13866, abs=1e-4)
    unseen = RNG.standard_normal((20, 6))
    cross = matern(unseen[:, :3] * scale, scaled)
    exact = cross @ np.linalg.solve(matern(scaled, scaled) + noise * np.eye(80), target)
    assert np.allclose(expand(basis, unseen)[:, :-1] @ weights, exact, atol=1e-5)


NOISE_M = 0.05
BASES = {
    'monomials': Monomials.fit(FEATURES, 3, 1e-3),
    'gp': Process.fit(FEATURES, np.full(3, 0.2), 1e-4, 60),
}


@pytest.mark.parametrize('basis', BASES.values(), ids=BASES)
def test_the_map_is_the_regression_in_closed_form_also_when_it_was_saved(basis):
    """By weights as of a regression, so that a variance is a small difference of large numbers."""
    terms, rng = expand(basis, FEATURES), np.random.default_rng(1)
    root = np.linalg.inv(np.linalg.cholesky(terms.T @ terms + np.diag(basis.ridge))).T
    mean = rng.standard_normal((len(root), 2))
    metric_map = MetricMap.of(basis, mean, root, NOISE_M, 2.0, 0.1)
    variance = NOISE_M**2 * (((terms @ root) ** 2).sum(1) + 1.0 + missing(basis, terms))
    positions, covariances = metric_map.predict(FEATURES)
    assert np.allclose(positions, terms @ mean, atol=1e-6)
    expected = (2.0 * variance + 0.1**2)[:, None, None] * np.eye(2)
    assert np.allclose(covariances, expected, rtol=0.01)
    assert np.linalg.eigvalsh(covariances).min() >= 2.0 * NOISE_M**2 * (1 - 1e-9)
    again = MetricMap.from_arrays(metric_map.to_arrays())
    for a, b in zip((positions, covariances), again.predict(FEATURES), strict=True):
        assert np.allclose(a, b, rtol=1e-9)
    position, covariance = metric_map.predict(FEATURES[7])
    assert np.allclose(position[0], positions[7], atol=1e-9)
    assert np.allclose(covariance[0], covariances[7], rtol=1e-3)
    with pytest.raises(DataError, match='reads 3 slow features, not 2'):
        metric_map.predict(FEATURES[:, :2])
