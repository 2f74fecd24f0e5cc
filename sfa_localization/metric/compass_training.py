# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Learn the visual compass from the headings that metric learning found."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.features.image_features import ImageFeatures, evenly
from sfa_localization.features.rotation_spread import MEDIAN_TO_STD, Agreement, share_within
from sfa_localization.metric.compass import (
    Compass,
    calibrated,
    kernel_between,
    phase_variance,
    prior_variance,
    scaled_inputs,
)
from sfa_localization.metric.forecast import importance, nearest_used
from sfa_localization.metric.learning import MetricResult, headings, positions
from sfa_localization.metric.lower_factor import lower_root
from sfa_localization.metric.segments import Segments, assignment
from sfa_localization.metric.shared_tracks import tracks

Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]

logger = logging.getLogger(__name__)

COMPASS_LAYERS = (0, 1)
"""Layers (0-based) whose maps show the heading: the top layer's are nearly constant over it."""
PLACE_FEATURES = 8
"""Slow features that the kernel compares places by; the paper uses 8 for the map."""
FOLDS = 6
"""Parts of the segments left out in turn to measure the accuracy."""
INDUCING_IMAGES = 800
"""Images that span the compass: more are more accurate, but slow to predict with."""
# Fewer labels are too few to choose length, noise and calibration by.
_LABELS_MIN = 20
_LENGTHS = (0.7, 1.0, 1.5, 2.5, 4.0)
_NOISES = (1e-3, 1e-2, 1e-1)
# Inducing images while length and noise are chosen: the ranking is the same with few.
_SELECTION_IMAGES = 300
_POWERS = tuple(np.geomspace(6.0, 0.05, 60).tolist())
_COVERAGE = 0.95


@dataclass(frozen=True, slots=True)
class LearnedHeading:
    """A compass that was learned from labeled `images` (T,), indices among all; the factor on its
    variance by the `agreement` of an image's views, and figures of merit on paths between the
    trained ones.
    """

    compass: Compass
    images: Indices
    agreement: Agreement
    quality: dict[str, float]


def compass_layers(depth: int) -> tuple[int, ...]:
    """Layers (0-based) that the compass reads of a network of this depth."""
    return tuple(sorted({min(layer, depth - 1) for layer in COMPASS_LAYERS}))


def learn_heading(
    images: ImageFeatures, segments: Segments, result: MetricResult, sign: float
) -> LearnedHeading | None:
    """The compass from the certified headings of the sampled images; None with too few of them.

    `sign` is -1 where columns grow clockwise, seen from above.
    """
    in_segments, yaw = headings(result, segments)
    labeled, at_sample, at_label = np.intersect1d(images.sampled, in_segments, return_indices=True)
    owner = assignment(segments, len(images.slow))[labeled]
    part = tracks(segments)[owner] % FOLDS
    try:
        harmonic = images.harmonic[at_sample]
        fit = fit_compass(images.slow[labeled], harmonic, yaw[at_label], part, sign)
    except DataError as error:
        logger.warning('no heading is learned: %s', error)
        return None
    of_segments, places = positions(result, segments)
    distances = nearest_used(places[np.searchsorted(of_segments, labeled)], part)
    weight = importance(distances, result.forecast.distances)
    disagreement = images.disagreement[labeled]
    agreement = Agreement.fit(disagreement, fit.error**2, fit.std**2, axes=1, weight=weight)
    ratio = fit.error**2 / (fit.std**2 * agreement.factor(disagreement))
    mean = np.average(np.abs(fit.error), weights=weight)
    quality = {
        'expected_yaw_error_deg': float(np.degrees(mean)),
        'left_out_yaw_within_95': share_within(ratio, 1, 0.95, weight),
    }
    return LearnedHeading(fit.compass, labeled, agreement, quality)


@dataclass(frozen=True, slots=True)
class CompassFit:
    """A compass and its left-out errors `error` (T,) rad, with the `std` (T,) it claimed."""

    compass: Compass
    error: Array
    std: Array


def fit_compass(
    features: Array, harmonic: Complex, yaw: Array, folds: Indices, sign: float
) -> CompassFit:
    """Learn the compass from labels `yaw` (T,) rad of images with features and harmonics.

    `folds` (T,) numbers the parts that are left out in turn to choose the kernel's length and
    noise, and the variance's calibration.
    Raises DataError when there are too few labels.
    """
    if len(yaw) < _LABELS_MIN or len(np.unique(folds)) < 2:
        raise DataError(f'{len(yaw)} images with a heading are too few to learn a compass')
    problem = _CompassProblem.of(features, harmonic, yaw, folds, sign)
    choices = [(length, noise) for length in _LENGTHS for noise in _NOISES]
    length, noise = min(choices, key=lambda choice: problem.loss(*choice))
    g, variance = problem.left_out(length, noise)
    error = wrap_angle(sign * np.angle(g) - yaw)
    raw = phase_variance(g, variance)
    calibration = _calibrate(error, raw)
    std = np.sqrt(calibrated(raw, calibration))
    compass = problem.compass(length, noise, calibration)
    return CompassFit(compass, error, std)


@dataclass(frozen=True, slots=True)
class _CompassProblem:
    """Labels and standardized inputs; `chosen` (M,) are the inducing images."""

    s: Array
    f: Complex
    feature_scale: Array
    harmonic_scale: Array
    yaw: Array
    folds: Indices
    sign: float
    chosen: Indices

    @classmethod
    def of(
        cls, features: Array, harmonic: Complex, yaw: Array, folds: Indices, sign: float
    ) -> _CompassProblem:
        feature_scale = features[:, :PLACE_FEATURES].std(0) + 1e-12
        harmonic_scale = np.sqrt((np.abs(harmonic) ** 2).mean(0)) + 1e-12
        s, f = scaled_inputs(features, harmonic, feature_scale, harmonic_scale)
        chosen = evenly(len(yaw), INDUCING_IMAGES)
        return cls(s, f, feature_scale, harmonic_scale, yaw, folds, sign, chosen)

    def loss(self, length: float, noise: float) -> float:
        """Mean left-out error of a candidate, rad; with fewer inducing images."""
        few = self.chosen[evenly(len(self.chosen), _SELECTION_IMAGES)]
        g, _ = self.left_out(length, noise, few)
        return float(np.abs(wrap_angle(self.sign * np.angle(g) - self.yaw)).mean())

    def left_out(
        self, length: float, noise: float, chosen: Indices | None = None
    ) -> tuple[Complex, Array]:
        """Prediction g (T,) and its variance (T,) for each fold by all the others."""
        m = self.chosen if chosen is None else chosen
        prior = kernel_between(self.s[m], self.f[m], self.s[m], self.f[m], length)
        kernel = kernel_between(self.s, self.f, self.s[m], self.f[m], length)
        target = np.exp(1j * self.sign * self.yaw)
        normal, moment = kernel.conj().T @ kernel, kernel.conj().T @ target
        g, variance = np.zeros(len(self.yaw), complex), np.zeros(len(self.yaw))
        for fold in np.unique(self.folds):
            out = self.folds == fold
            part = kernel[out]
            rest = normal - part.conj().T @ part
            weights, uncertainty = _solve(rest, moment - part.conj().T @ target[out], prior, noise)
            g[out] = part @ weights
            explained = np.einsum('tm,tm->t', part @ uncertainty, part.conj()).real
            variance[out] = np.maximum(prior_variance(self.f[out]) - explained, 0.0) + noise
        return g, variance

    def compass(self, length: float, noise: float, calibration: Array) -> Compass:
        """The compass of all labels, solved for the inducing images as they will be saved."""
        s = self.s[self.chosen].astype(np.float32).astype(np.float64)
        f = self.f[self.chosen].astype(np.complex64).astype(np.complex128)
        kernel = kernel_between(self.s, self.f, s, f, length)
        moment = kernel.conj().T @ np.exp(1j * self.sign * self.yaw)
        weights, uncertainty = _solve(
            kernel.conj().T @ kernel, moment, kernel_between(s, f, s, f, length), noise
        )
        scales = self.feature_scale, self.harmonic_scale
        factor = np.asfortranarray(lower_root(uncertainty), np.complex64)
        return Compass(s, f, *scales, weights, factor, length, noise, self.sign, calibration)


def _solve(
    normal: Complex, moment: Complex, prior: Complex, noise: float
) -> tuple[Complex, Complex]:
    """Weights and reduction of variance of a process spanned by inducing images.

    With B = K_nm^H K_nm + r K_mm: weights B^-1 K_nm^H y, reduction K_mm^-1 - r B^-1.
    """
    jitter = 1e-6 * np.eye(len(prior)) * np.trace(prior).real / len(prior)
    b = linalg.inv(normal + noise * (prior + jitter), check_finite=False)
    reduction = linalg.inv(prior + jitter, check_finite=False) - noise * b
    return b @ moment, (reduction + reduction.conj().T) / 2


def _calibrate(error: Array, raw: Array) -> Array:
    """(power, floor) such that the variance covers 95 % of the left-out errors, and little more.

    The floor is the error where the process is most certain, the power the largest that covers.
    """
    most_certain = np.abs(error[raw <= np.quantile(raw, 0.25)])
    floor = float((MEDIAN_TO_STD * np.median(most_certain)) ** 2) + 1e-8
    for power in _POWERS:
        variance = calibrated(raw, np.array([power, floor]))
        if (error**2 <= 1.96**2 * variance).mean() >= _COVERAGE:
            break
    return np.array([power, floor])
