# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Maps from slow features to meters: monomials, the Gaussian process, and their saved form."""

import numpy as np
import pytest

from sfa_localization.data.errors import DataError, ModelError
from sfa_localization.metric.basis import (
    Monomials,
    Process,
    expand,
    matern,
    missing,
    monomials,
)
from sfa_localization.metric.saved_map import MetricMap

RNG = np.random.default_rng(0)
FEATURES = RNG.standard_normal((80, 6))


def test_eight_features_make_the_papers_45_monomials():
    assert monomials(np.zeros((3, 8))).shape == (3, 45)
    # By hand: 1, a, b, a^2, a b, b^2.
    assert monomials(np.array([[2.0, 3.0]])).tolist() == [[1, 2, 3, 4, 6, 9]]


def test_monomials_span_every_quadratic_function():
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


def test_the_kernel_is_positive_and_normalized():
    kernel = matern(FEATURES, FEATURES)
    assert np.allclose(np.diag(kernel), 1.0, atol=1e-7)
    assert np.linalg.eigvalsh(kernel)[0] > 0
    # By hand, at distance 2: (1 + 2 sqrt 5 + 20 / 3) exp(-2 sqrt 5).
    assert matern(np.zeros((1, 1)), np.full((1, 1), 2.0))[0, 0] == pytest.approx(0.13866, abs=1e-4)


def test_all_points_inducing_make_the_exact_process():
    scale, noise = np.full(3, 0.5), 0.01
    basis = Process.fit(FEATURES, scale, noise, 1000)
    target = np.sin(FEATURES[:, 0])
    terms = expand(basis, FEATURES)[:, :-1]
    weights = np.linalg.solve(terms.T @ terms + noise * np.eye(80), terms.T @ target)
    scaled = FEATURES[:, :3] * scale
    unseen = RNG.standard_normal((20, 6))
    cross = matern(unseen[:, :3] * scale, scaled)
    exact = cross @ np.linalg.solve(matern(scaled, scaled) + noise * np.eye(80), target)
    assert np.allclose(expand(basis, unseen)[:, :-1] @ weights, exact, atol=1e-5)


def test_fewer_inducing_points_leave_variance_missing_far_from_them():
    basis = Process.fit(FEATURES, np.full(3, 0.5), 0.01, 10)
    assert len(basis.points) == 10
    near, far = basis.points[:1] / 0.5, np.full((1, 3), 50.0)
    assert missing(basis, expand(basis, near))[0] == pytest.approx(0.0, abs=1e-5)
    assert missing(basis, expand(basis, far))[0] == pytest.approx(100.0, rel=1e-6)


NOISE_M = 0.05


def regressed(basis):
    """Weights as of a regression, so that a variance is a small difference of large numbers."""
    terms, rng = expand(basis, FEATURES), np.random.default_rng(1)
    precision = terms.T @ terms + np.diag(basis.ridge)
    root = np.linalg.inv(np.linalg.cholesky(precision)).T
    return rng.standard_normal((len(precision), 2)), root


BASES = {
    'monomials': Monomials.fit(FEATURES, 3, 1e-3),
    'gp': Process.fit(FEATURES, np.full(3, 0.2), 1e-4, 60),
}


@pytest.fixture(params=BASES)
def basis(request):
    return BASES[request.param]


@pytest.fixture
def metric_map(basis):
    return MetricMap.of(basis, *regressed(basis), NOISE_M, 2.0, 0.1)


def test_the_map_is_the_regression_in_closed_form(basis, metric_map):
    terms, (mean, root) = expand(basis, FEATURES), regressed(basis)
    variance = NOISE_M**2 * (((terms @ root) ** 2).sum(1) + 1.0 + missing(basis, terms))
    positions, covariances = metric_map.predict(FEATURES)
    assert np.allclose(positions, terms @ mean, atol=1e-6)
    expected = (2.0 * variance + 0.1**2)[:, None, None] * np.eye(2)
    assert np.allclose(covariances, expected, rtol=0.01)
    assert np.array_equal(covariances, covariances.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(covariances).min() >= 2.0 * NOISE_M**2 * (1 - 1e-9)


def test_saved_maps_and_single_rows_predict_alike_and_what_is_missing_is_named(metric_map):
    again = MetricMap.from_arrays(metric_map.to_arrays())
    positions, covariances = metric_map.predict(FEATURES)
    for a, b in zip((positions, covariances), again.predict(FEATURES), strict=True):
        assert np.allclose(a, b, rtol=1e-9)
    position, covariance = metric_map.predict(FEATURES[7])
    assert np.allclose(position[0], positions[7], atol=1e-9)
    assert np.allclose(covariance[0], covariances[7], rtol=1e-3)
    with pytest.raises(DataError, match='reads 3 slow features, not 2'):
        metric_map.predict(FEATURES[:, :2])
    for name in ('linear', 'factor'):
        arrays = {key: value for key, value in metric_map.to_arrays().items() if key != name}
        with pytest.raises(ModelError, match=name):
            MetricMap.from_arrays(arrays)
