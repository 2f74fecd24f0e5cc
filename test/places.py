# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Lengths and distances in the plane, of places (N, 2) or poses (N, 3)."""

import numpy as np

from sfa_localization.data.geometry import align


def lengths(places):
    """Lengths (N,) of vectors, or that of a single one."""
    return np.hypot(*np.asarray(places)[..., :2].T)


def distances(places, others):
    """Distances (N,) of places, or of a single one, from others."""
    return lengths(np.asarray(places)[..., :2] - np.asarray(others)[..., :2])


def aligned_errors(places, truth):
    """Distances (N,) of places from the truth once they are laid onto it as well as they fit."""
    return distances(align(places[:, :2], truth[:, :2]).apply(places[:, :2]), truth)


def as_complex(places):
    """Places (N, 2) as x + i y."""
    return places[..., 0] + 1j * places[..., 1]
