# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Phase synchronization: global minima, proofs, and their absence."""

import itertools

import numpy as np
import pytest

from sfa_localization.metric.phases import (
    certify,
    derivatives,
    phase_cost,
    refine,
    synchronize,
)


def ring(angles, noise, rng):
    """A connection Laplacian of all pairs with noisy angles."""
    n = len(angles)
    h = np.zeros((n, n), complex)
    for i, j in itertools.combinations(range(n), 2):
        w = np.exp(1j * (angles[j] - angles[i] + noise * rng.standard_normal()))
        h[i, i] += 1
        h[j, j] += 1
        h[j, i] -= w
        h[i, j] -= np.conj(w)
    return h


def best_of_grid(h, steps=60):
    """Smallest cost over a grid of angles, the first fixed."""
    angles = 2 * np.pi * np.arange(steps) / steps
    grid = itertools.product(angles, repeat=len(h) - 1)
    return min(phase_cost(h, np.exp(1j * np.array((0.0, *a)))) for a in grid)


def test_noiseless_angles_are_recovered_up_to_one_rotation():
    rng = np.random.default_rng(0)
    angles = rng.uniform(-np.pi, np.pi, 20)
    h = ring(angles, 0.0, rng)
    z = synchronize(h)
    turned = z * np.exp(-1j * angles)
    assert np.abs(turned - turned[0]).max() < 1e-10
    assert certify(h, z).certified


@pytest.mark.parametrize('seed', range(2))
def test_no_grid_point_beats_a_certified_minimum(seed):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((4, 4)) + 1j * rng.standard_normal((4, 4))
    h = a.conj().T @ a
    z = synchronize(h)
    # Even uncertified, it is no worse than a grid of 6 degrees finds.
    assert phase_cost(h, z) <= best_of_grid(h) + 1e-9


def test_a_worse_minimum_is_not_certified():
    # On a ring of n equal links, angles that wind once around are a local minimum.
    n = 12
    h = np.zeros((n, n), complex)
    for i in range(n):
        j = (i + 1) % n
        h[[i, j], [i, j]] += 1
        h[i, j] = h[j, i] = -1
    wound = refine(h, np.exp(2j * np.pi * np.arange(n) / n))
    assert phase_cost(h, wound) > 1.0
    assert np.linalg.eigvalsh(derivatives(h, wound)[1])[0] > -1e-9
    assert not certify(h, wound).certified
    z = synchronize(h, [wound])
    assert certify(h, z).certified
    assert phase_cost(h, z) == pytest.approx(0.0, abs=1e-12)
