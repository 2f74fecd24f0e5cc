# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The features of the map that a model saves: a lower layer's output, turned to heading 0.

Slow features do not change with the heading, and lose what does. Once the headings of images are
known, the maps of a lower layer can be turned until their columns point in fixed directions. Their
principal components depend on the place alone, and hold more of it than slow features. So metric
learning runs twice: on slow features, for certified headings, and on maps turned by these.

A layer's map is kept as its harmonics over the columns, F_k = sum_c Z[c] exp(-2 pi i k c / R). The
robot's turn by phi multiplies F_k by exp(i k sign phi), sign -1 where columns grow clockwise,
so that it is undone exactly, also by fractions of a column.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.mapping.saved_map import MetricMap
from sfa_localization.sfa.image_features import Spectrum

Vectors = NDArray[np.float32]

DIMENSIONS = 32
"""Principal components that the map reads."""
# Three sigma points of an uncertain heading, in standard deviations, and their weights: those of an
# unknown heading are a third of a turn from each other.
_SIGMA_POINTS = np.array([0.0, 1.0, -1.0]) * 2 / np.sqrt(3)
_WEIGHTS = np.array([2.0, 3.0, 3.0]) / 8


def turned_back(spectra: Spectrum, yaw: Array, sign: float) -> Vectors:
    """Real vectors (T, (2 H - 1) J) of spectra (T, H, J) at headings yaw (T,) rad, turned to
    heading 0; `sign` is -1 where columns grow clockwise."""
    phase = -1j * sign * np.outer(yaw, np.arange(spectra.shape[1]))
    at_zero = spectra * np.exp(phase).astype(np.complex64)[:, :, None]
    parts = [at_zero.real, at_zero.imag[:, 1:]]
    return np.concatenate(parts, axis=1).reshape(len(spectra), -1)


@dataclass(frozen=True, slots=True)
class TurnedMaps:
    """Principal components of turned maps: `mean` (D,) and orthonormal `axes` (D, K) of vectors
    (D,) that are turned back by `sign`.
    """

    mean: Vectors
    axes: Vectors
    sign: float

    @classmethod
    def fit(cls, spectra: Spectrum, yaw: Array, sign: float) -> TurnedMaps:
        """Of spectra (T, H, J) at headings yaw (T,) rad. Raises DataError where all are equal."""
        from scipy import linalg  # for training alone

        vectors = turned_back(spectra, yaw, sign)
        mean = vectors.mean(0, dtype=np.float64).astype(np.float32)
        centered = vectors - mean
        size = len(centered)
        count = min(DIMENSIONS, len(centered) - 1, vectors.shape[1])
        gram = (centered @ centered.T).astype(np.float64)
        power, sides = linalg.eigh(gram, subset_by_index=(size - count, size - 1))
        kept = power > 1e-6 * max(float(power[-1]), 1e-30)
        if not kept.any():
            raise DataError('the maps of all images are equal')
        axes = centered.T @ (sides[:, kept] / np.sqrt(power[kept])).astype(np.float32)
        return cls(mean, np.ascontiguousarray(axes[:, ::-1]), sign)

    def features(self, spectra: Spectrum, yaw: Array) -> Array:
        """Components (T, K), the strongest first, of spectra (T, H, J) at headings yaw (T,)."""
        return np.asarray((turned_back(spectra, yaw, self.sign) - self.mean) @ self.axes, float)

    def predict(
        self, metric: MetricMap, spectra: Spectrum, yaw: Array, yaw_variance: Array
    ) -> tuple[Array, Array, Array]:
        """Positions (T, 2) m by a map of the components at headings yaw (T,) rad with variances
        (T,), their covariances (T, 2, 2) by the map, and those by the headings."""
        yaws = yaw + np.outer(_SIGMA_POINTS, np.sqrt(yaw_variance))
        features = self.features(np.tile(spectra, (len(yaws), 1, 1)), yaws.ravel())
        places, covariances = metric.predict(features)
        places, covariances = (a.reshape(len(yaws), len(yaw), 2, -1) for a in (places, covariances))
        moved = places - places[0]
        by_yaw = np.tensordot(_WEIGHTS, moved @ moved.swapaxes(-1, -2), 1)
        return places[0, :, :, 0], np.tensordot(_WEIGHTS, covariances, 1), by_yaw

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays to save, without pickle."""
        return {'mean': self.mean, 'axes': self.axes, 'sign': np.array(self.sign)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> TurnedMaps:
        """Raises KeyError or ValueError for arrays of something else."""
        return cls(arrays['mean'], arrays['axes'], float(arrays['sign']))
