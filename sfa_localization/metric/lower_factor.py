# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Variances k A k^H by a triangular factor of A: half the work, and half of a model file."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sfa_localization.data.geometry import Array


def lower_root(hermitian: NDArray[Any]) -> NDArray[Any]:
    """Lower triangular L with L L^H = a matrix (N, N), its negative part (rounding) left out."""
    try:
        return np.asarray(linalg.cholesky(hermitian, lower=True))
    except linalg.LinAlgError:
        values, axes = linalg.eigh(hermitian)
        root = axes * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(linalg.qr(root.conj().T, mode='r')[0].conj().T)


def squares(rows: NDArray[Any], factor: NDArray[Any]) -> Array:
    """|k L|^2 (M,) of rows k (M, N), reading only the lower triangle for a single one.

    `factor` (N, N) is in Fortran order; the products are of its type.
    """
    rows = rows.astype(factor.dtype, copy=False)
    if len(rows) > 1:
        product = rows @ factor
    else:
        multiply = linalg.get_blas_funcs('trmv', (factor,))
        product = multiply(factor, rows[0], lower=1, trans=1)[None]
    return np.asarray((np.abs(product).astype(np.float64) ** 2).sum(1))
