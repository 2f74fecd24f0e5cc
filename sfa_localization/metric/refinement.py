# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Slow features find the place and the heading; turned maps refine it.

Slow features are the same at every heading, and so lose whatever depends on the heading. Once they
have found the place, and the compass the heading, a lower layer's map can be turned until its
columns point in fixed directions of the map frame. Its principal components then depend on the
place alone, and hold more of it than the slow features do. Metric learning on them, certified in
the same way, gives a finer map. The first estimate remains as a check: where the two differ by
more than is usual, the covariance grows.

A layer's map is kept as its harmonics over the columns, F_k = sum_c Z[c] exp(-2 pi i k c / R). The
robot's turn by phi multiplies F_k by exp(i k sign phi), sign as the compass has it, so turning
back is exact also by fractions of a column.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.features.image_features import ImageFeatures, Spectrum
from sfa_localization.features.rotation_spread import Agreement, quantile
from sfa_localization.metric.basis import Process
from sfa_localization.metric.compass_training import LearnedHeading
from sfa_localization.metric.learning import (
    MetricResult,
    headings,
    learn_metric,
    left_out_agreement,
)
from sfa_localization.metric.saved_map import MetricMap as FastProcess
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.selection import Span
from sfa_localization.metric.settings import MetricConfig

logger = logging.getLogger(__name__)
Vectors = NDArray[np.float32]

DIMENSIONS = 32
"""Principal components that the finer map reads."""
POINTS = 1000
"""Inducing points of the finer map: with half as many more it is no better, and the model file and
the time of an estimate are larger."""
# Images that the components are found from, evenly along the drives: they are smooth statistics.
_COMPONENT_IMAGES = 1500
# Images turned at a time: memory.
_BATCH = 1000
# Step of the heading for the slope of the position, about the compass's own error.
_YAW_STEP_RAD = np.deg2rad(1.0)
# With a heading less sure than this the slope says nothing of the position.
_YAW_STD_MAX_RAD = np.deg2rad(60.0)
# The coarse estimate stays where its variance is this many times smaller. At a wrong heading the
# finer map is unsure by more; by less it often is near trunks, where it is right all the same.
_SURER = 2.0
# Share of left-out images whose distance between both estimates counts as usual.
_USUAL = 0.95


def turned_back(spectra: Spectrum, yaw: Array, sign: float) -> Vectors:
    """Spectra (T, H, J), seen at headings yaw (T,) rad, as they would be at heading 0.

    As real vectors (T, (2 H - 1) J); `sign` as in the compass: -1 where columns grow clockwise.
    """
    phase = -1j * sign * np.outer(yaw, np.arange(spectra.shape[1]))
    at_zero = spectra * np.exp(phase).astype(np.complex64)[:, :, None]
    parts = [at_zero.real, at_zero.imag[:, 1:]]
    return np.concatenate(parts, axis=1).reshape(len(spectra), -1)


@dataclass(frozen=True, slots=True)
class Projection:
    """Onto the principal components: `mean` (D,) and orthonormal `axes` (D, K) of vectors (D,)."""

    mean: Vectors
    axes: Vectors

    @classmethod
    def fit(cls, vectors: Vectors, count: int = DIMENSIONS) -> Projection:
        """Of vectors (T, D); at most `count` components. Raises DataError where all are equal."""
        mean = vectors.mean(0, dtype=np.float64).astype(np.float32)
        centered = vectors - mean
        size, count = len(centered), min(count, len(centered) - 1, vectors.shape[1])
        gram = (centered @ centered.T).astype(np.float64)
        power, sides = linalg.eigh(gram, subset_by_index=(size - count, size - 1))
        kept = power > 1e-6 * max(float(power[-1]), 1e-30)
        if not kept.any():
            raise DataError('the maps of all images are equal: nothing to refine positions with')
        axes = centered.T @ (sides[:, kept] / np.sqrt(power[kept])).astype(np.float32)
        return cls(mean, np.ascontiguousarray(axes[:, ::-1]))

    def features(self, vectors: Vectors) -> Array:
        """Components (T, K), the strongest first, of vectors (T, D)."""
        return np.asarray((vectors - self.mean) @ self.axes, np.float64)


@dataclass(frozen=True, slots=True)
class Refinement:
    """From a layer's maps, the heading and a first estimate to a finer position.

    `usual` is the squared distance of both estimates, in units of their joint covariance, that
    most left-out images keep.
    """

    projection: Projection
    metric: FastProcess
    agreement: Agreement
    sign: float
    usual: float

    def predict(self, spectra: Spectrum, yaw: Array, views: Array) -> tuple[Array, Array]:
        """Positions (T, 2) m and covariances (T, 2, 2) by the finer map alone, at exact headings.

        Of spectra (T, H, J) at headings yaw (T,) rad, with the disagreement (T,) of the views.
        """
        places, covariances = self.metric.predict(self.features(spectra, yaw))
        return places, self._doubted(covariances, views)

    def _doubted(self, covariances: Array, views: Array) -> Array:
        """Covariances (T, 2, 2) with the factor for the disagreement (T,) of the views."""
        return covariances * self.agreement.factor(views)[:, None, None]

    def refine(
        self,
        spectra: Spectrum,
        yaw: Array,
        yaw_variance: Array,
        views: Array,
        coarse: tuple[Array, Array],
    ) -> tuple[Array, Array]:
        """Positions (T, 2) m and covariances (T, 2, 2) from the coarse ones of the same images.

        An uncertain heading adds to the covariance. Where the coarse estimate is then far surer,
        or the heading unknown (NaN), it stays; where the two differ by more than is usual, the
        covariance covers both.
        """
        known = np.isfinite(yaw) & (yaw_variance < _YAW_STD_MAX_RAD**2)
        places, covariances, slope = self._with_slope(spectra, np.where(known, yaw, 0.0), views)
        covariances = covariances + _outer(slope) * yaw_variance[:, None, None]
        finer = known & (_size(covariances) < _SURER * _size(coarse[1]))
        apart = places - coarse[0]
        covariances = covariances + _outer(apart) * self._excess(apart, covariances + coarse[1])
        chosen = finer[:, None]
        return (
            np.where(chosen, places, coarse[0]),
            np.where(chosen[:, None], covariances, coarse[1]),
        )

    def _excess(self, apart: Array, joint: Array) -> Array:
        """Share (T, 1, 1) of the squared distance `apart` that the covariances do not explain."""
        squared = _squared(apart, joint)
        return np.maximum(1.0 - self.usual / np.maximum(squared, 1e-12), 0.0)[:, None, None]

    def _with_slope(
        self, spectra: Spectrum, yaw: Array, views: Array
    ) -> tuple[Array, Array, Array]:
        """As `predict`, and the change of the positions with the heading, (T, 2) m / rad."""
        count, steps = len(yaw), np.array([0.0, 1.0, -1.0]) * _YAW_STEP_RAD
        yaws = np.add.outer(steps, yaw).ravel()
        features = self.features(np.tile(spectra, (len(steps), 1, 1)), yaws)
        places, covariances = self.metric.predict(features[:count])
        ahead, behind = np.split(self.metric.predict(features[count:])[0], 2)
        slope = (ahead - behind) / (2.0 * _YAW_STEP_RAD)
        return places, self._doubted(covariances, views), np.asarray(slope)

    def features(self, spectra: Spectrum, yaw: Array) -> Array:
        """What the finer map reads, (T, K), of spectra (T, H, J) at headings yaw (T,) rad."""
        return self.projection.features(turned_back(spectra, yaw, self.sign))

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays to save, without pickle."""
        arrays = {'mean': self.projection.mean, 'axes': self.projection.axes}
        arrays['scalars'] = np.array([self.sign, self.usual])
        arrays |= {f'metric_{name}': a for name, a in self.metric.to_arrays().items()}
        return arrays | {f'agreement_{name}': a for name, a in self.agreement.to_arrays().items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Refinement:
        """Raises KeyError or ValueError for arrays that are not a refinement's."""
        sign, usual = (float(value) for value in arrays['scalars'])
        return cls(
            Projection(arrays['mean'], arrays['axes']),
            FastProcess.from_arrays(_under(arrays, 'metric_')),
            Agreement.from_arrays(_under(arrays, 'agreement_')),
            sign,
            usual,
        )


@dataclass(frozen=True, slots=True)
class LearnedRefinement:
    """The refinement, and what metric learning found on its features, in the first map's frame."""

    refinement: Refinement
    metric: MetricResult


def learn_refinement(
    spectra: Spectrum,
    disagreement: Array,
    segments: Segments,
    first: MetricResult,
    sign: float,
    seed: int = 0,
) -> LearnedRefinement:
    """Learn the finer map, at the certified headings of the first one.

    `spectra` (N, H, J) and the `disagreement` (N,) of the views of all images; `first` was learned
    from the same segments; `sign` is the compass's. Raises DataError as ``learn_metric``.
    """
    images, yaw = headings(first, segments)
    projection = _components(spectra, images, yaw, sign)
    features = np.zeros((len(spectra), projection.axes.shape[1]))
    for start in range(0, len(images), _BATCH):
        rows = images[start : start + _BATCH]
        turned = turned_back(spectra[rows], yaw[start : start + _BATCH], sign)
        features[rows] = projection.features(turned)
    # They count by their own size, as principal components do.
    scale = np.full(features.shape[1], 1.0 / np.sqrt(features[images].var(0).sum()))
    metric = learn_metric(features, segments, MetricConfig(), seed, Span(POINTS, scale), first)
    agreement = left_out_agreement(disagreement, metric)
    assert isinstance(metric.map.basis, Process)
    fast = metric.map
    refinement = Refinement(projection, fast, agreement, sign, _usual(first, metric))
    return LearnedRefinement(refinement, metric)


def refined(
    images: ImageFeatures,
    segments: Segments,
    first: MetricResult,
    heading: LearnedHeading | None,
    config: MetricConfig,
    seed: int = 0,
) -> LearnedRefinement | None:
    """As `learn_refinement`; None without a heading or a layer to refine with, and where no finer
    map can be learned.

    The paper's descent and its monomials stay as they are: they are there for comparison.
    """
    article = config.solver == 'paper' or config.metric_map == 'monomials'
    if images.spectra is None or heading is None or article:
        return None
    views, sign = images.disagreement, heading.compass.sign
    try:
        return learn_refinement(images.spectra, views, segments, first, sign, seed)
    except DataError as error:
        logger.warning('positions are not refined: %s', error)
        return None


def _components(
    spectra: Spectrum, images: NDArray[np.int64], yaw: Array, sign: float
) -> Projection:
    """Of the images (M,) at headings yaw (M,)."""
    chosen = np.linspace(0, len(images) - 1, min(len(images), _COMPONENT_IMAGES))
    rows = np.unique(chosen.round().astype(np.int64))
    return Projection.fit(turned_back(spectra[images[rows]], yaw[rows], sign))


def _usual(first: MetricResult, finer: MetricResult) -> float:
    """Squared distance between both maps' estimates that most left-out images keep, at least 1."""
    variance = first.left_out_variance + finer.left_out_variance
    squared = ((first.left_out - finer.left_out) ** 2).sum(1) / variance
    return max(quantile(squared, _USUAL, finer.left_out_weight), 1.0)


def _outer(vectors: Array) -> Array:
    """v v^T (T, 2, 2) of vectors (T, 2)."""
    return vectors[:, :, None] * vectors[:, None, :]


def _size(covariances: Array) -> Array:
    """Total variance (T,)."""
    return np.asarray(np.trace(covariances, axis1=1, axis2=2))


def _squared(vectors: Array, covariances: Array) -> Array:
    """v^T C^-1 v (T,)."""
    solved = np.linalg.solve(covariances, vectors[:, :, None])[:, :, 0]
    return np.asarray((vectors * solved).sum(1))


def _under(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    return {name[len(prefix) :]: a for name, a in arrays.items() if name.startswith(prefix)}
