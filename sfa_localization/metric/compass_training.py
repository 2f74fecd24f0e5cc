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
    NOISE,
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
# Fewer labels are too few to choose the calibration by.
_LABELS_MIN = 20
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

    `folds` (T,) numbers the parts that are left out in turn for the variance's calibration.
    Raises DataError when there are too few labels.
    """
    if len(yaw) < _LABELS_MIN or len(np.unique(folds)) < 2:
        raise DataError(f'{len(yaw)} images with a heading are too few to learn a compass')
    scales = (
        features[:, :PLACE_FEATURES].std(0) + 1e-12,
        np.sqrt((np.abs(harmonic) ** 2).mean(0)) + 1e-12,
    )
    s, f = scaled_inputs(features, harmonic, *scales)
    chosen = evenly(len(yaw), INDUCING_IMAGES)
    # The inducing images as they will be saved.
    s_m = s[chosen].astype(np.float32).astype(np.float64)
    f_m = f[chosen].astype(np.complex64).astype(np.complex128)
    prior, kernel = kernel_between(s_m, f_m, s_m, f_m), kernel_between(s, f, s_m, f_m)
    target = np.exp(1j * sign * yaw)
    g, explained = _left_out(kernel, target, prior, folds)
    error = wrap_angle(sign * np.angle(g) - yaw)
    raw = phase_variance(g, np.maximum(prior_variance(f) - explained, 0.0) + NOISE)
    calibration = _calibrate(error, raw)
    weights, reduction = _solve(kernel.conj().T @ kernel, kernel.conj().T @ target, prior)
    factor = np.asfortranarray(lower_root(reduction), np.complex64)
    compass = Compass(s_m, f_m, *scales, weights, factor, sign, calibration)
    return CompassFit(compass, error, np.sqrt(calibrated(raw, calibration)))


def _left_out(
    kernel: Complex, target: Complex, prior: Complex, folds: Indices
) -> tuple[Complex, Array]:
    """Prediction g (T,) of each fold by all the others, and by how much its variance is less (T,).

    From the kernel (T, M) of the images, and the `prior` (M, M) of the inducing ones.
    """
    normal, moment = kernel.conj().T @ kernel, kernel.conj().T @ target
    g, explained = np.zeros(len(target), complex), np.zeros(len(target))
    for fold in np.unique(folds):
        out = folds == fold
        part = kernel[out]
        rest = normal - part.conj().T @ part, moment - part.conj().T @ target[out]
        weights, reduction = _solve(*rest, prior)
        g[out] = part @ weights
        explained[out] = np.einsum('tm,tm->t', part @ reduction, part.conj()).real
    return g, explained


def _solve(normal: Complex, moment: Complex, prior: Complex) -> tuple[Complex, Complex]:
    """Weights and reduction of variance of a process spanned by inducing images.

    With B = K_nm^H K_nm + r K_mm: weights B^-1 K_nm^H y, reduction K_mm^-1 - r B^-1.
    """
    jitter = 1e-6 * np.eye(len(prior)) * np.trace(prior).real / len(prior)
    b = linalg.inv(normal + NOISE * (prior + jitter), check_finite=False)
    reduction = linalg.inv(prior + jitter, check_finite=False) - NOISE * b
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
