# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The pose of an image and its covariance: one mixture of Gaussians.

Each keyframe whose correlation is close to the highest one starts a hypothesis h, unless another
one starts near it with a similar heading: a regression among its neighbors puts the image at p_h
with variance v_h (`ErrorModel`), and leaves the part u_h of it unexplained. An image counts as n
independent numbers (`PARTS`):

    -2 ln p(image | h) = n ln(u_h / (1 + u_h)).

Slow features, read at the heading of h, put it at q_h with variance w_h: they are another sensor,
of the same image. In another light, or on a tilted robot, they err more: by a scale s of w, of
several with probabilities P(s) that follow the latest images:

    p(image) = sum_hs P(s) (u_h / (1 + u_h))^(-n / 2) N(p_h - q_h; v_h + s w_h),

and each term is a Gaussian of the place with mean p_h + k (q_h - p_h) and variance (1 - k) v_h,
k = v_h / (v_h + s w_h). The pose is the mean about the likeliest start; the covariance is that of
the whole mixture about it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.keyframes.errors import ErrorModel
from sfa_localization.keyframes.keyframes import Keyframes
from sfa_localization.keyframes.regression import Fit
from sfa_localization.keyframes.texture import Spectra, columns_of, turned
from sfa_localization.keyframes.upright import UprightImage, without

STARTS = 3
SPACING_M = 1.0
SPACING_RAD = 0.5
"""Most starts, and their least distance in position or heading: one regression resolves nearer
places."""
LESS_LIKE = 0.1
"""The correlation with such a keyframe is at most so much less than that with the likest one."""
SCALES = 3.0 ** np.arange(8)
"""Scales of the variance of slow features, up to 47 times the standard deviation."""


@dataclass(frozen=True, slots=True)
class Location:
    """Where an image was taken: `pose` (3,) [x m, y m, yaw rad] and `covariance` (3, 3), and the
    likeliest `fit`; `facing` is the mean of exp(i yaw) of the keyframes there. `scales` (S,) are
    the probabilities of `SCALES`, `tilt` (2,) rad is the roll and pitch of the robot.
    """

    pose: Array
    covariance: Array
    fit: Fit
    facing: complex
    scales: Array
    tilt: Array


def hypotheses(
    keyframes: Keyframes, image: UprightImage, pattern: Spectra | None
) -> tuple[list[Fit], Array]:
    """Hypotheses of an image, after the `pattern` (rows, F) of its light and the tilt of the most
    likely hypothesis are removed; and its total tilt (2,) rad.
    """
    likely = _from_starts(keyframes, image, pattern)
    upright = without(keyframes, image, _remaining_tilt(likely))
    if upright is not image:
        likely = _from_starts(keyframes, upright, pattern)
    return likely, upright.tilt + _remaining_tilt(likely)


def _remaining_tilt(fits: Sequence[Fit]) -> Array:
    """Roll and pitch (2,) rad that an image shows by the likeliest hypothesis."""
    return max(fits, key=lambda fit: fit.evidence).changes[:2]


def located(
    fits: Sequence[Fit],
    slow: tuple[Array, Array],
    scales: Array,
    errors: ErrorModel,
    tilt: Array,
) -> Location:
    """The mixture of H hypotheses with the places (H, 2) m of slow features at the heading of each,
    and their variances (H,) m^2 along each axis by the map; `scales` (S,) are the probabilities of
    `SCALES` by the images before, `tilt` (2,) that of the image.
    """
    weight, means, variance = _mixture(fits, slow, scales, errors)
    by_fit = weight.sum(axis=1)
    unlike, yaws, starts = np.array([(f.unlike, f.yaw, f.start) for f in fits]).T
    here = starts == np.bincount(starts.astype(int), by_fit).argmax()
    near = np.where(here[:, None], weight, 0.0) / by_fit[here].sum()
    place = np.tensordot(near, means, 2)
    of_fit = near.sum(axis=1)
    yaw = float(np.angle(of_fit @ np.exp(1j * yaws)))
    # The covariance of position and heading omits the other hypotheses.
    covariance = np.zeros((3, 3))
    offset = means - place
    covariance[:2, :2] = np.einsum('hs,hsi,hsj->ij', weight, offset, offset)
    covariance[:2, :2] += variance * np.eye(2)
    covariance[2, 2] = by_fit @ (wrap_angle(yaws - yaw) ** 2 + errors.yaw_variance(unlike))
    return Location(
        np.array([*place, wrap_angle(yaw)]),
        covariance,
        fits[int(of_fit.argmax())],
        complex(of_fit @ np.array([f.facing for f in fits])),
        weight.sum(axis=0),
        tilt,
    )


def _mixture(
    fits: Sequence[Fit], slow: tuple[Array, Array], scales: Array, errors: ErrorModel
) -> tuple[Array, Array, float]:
    """Weights (H, S) of sum 1 and means (H, S, 2) m of the terms of `located`, and the mean of
    their variances, m^2 per axis.
    """
    by_residual, outward, unlike, evidence = np.array(
        [(f.variance, f.outward, f.unlike, f.evidence) for f in fits]
    ).T
    places = np.array([f.place for f in fits])
    by_keyframes = errors.variance(by_residual, outward, unlike)[:, None]
    total = by_keyframes + errors.slow_variance(slow[1], unlike)[:, None] * SCALES
    gain = by_keyframes / total
    difference = slow[0] - places
    joint = evidence[:, None] + np.log(scales) - np.log(total)
    joint -= (difference**2).sum(1)[:, None] / (2 * total)
    weight = np.exp(joint - joint.max())
    weight /= weight.sum()
    means = places[:, None] + gain[:, :, None] * difference[:, None]
    return weight, means, float((weight * by_keyframes * (1 - gain)).sum())


def _from_starts(keyframes: Keyframes, image: UprightImage, pattern: Spectra | None) -> list[Fit]:
    """Hypotheses of an image in each light of the training from each start."""
    likely = list[Fit]()
    lights = keyframes.likeliest_lights(image.scores)
    for start, (x, y, yaw) in enumerate(_starts(keyframes, image)):
        spectrum = image.spectrum
        if pattern is not None:
            spectrum = spectrum - turned(pattern, -keyframes.sign * yaw)
        changes = keyframes.changes(spectrum)
        for light in lights:
            fit = keyframes.fit_about(changes, np.array([x, y]), yaw, light)
            likely.append(replace(fit, start=start))
    return likely


def _starts(keyframes: Keyframes, image: UprightImage) -> list[tuple[float, float, float]]:
    """Poses [x, y, yaw] of keyframes that are about as like the image as the likest one."""
    starts = list[tuple[float, float, float]]()
    for row in np.argsort(-image.scores, kind='stable').tolist():
        if len(starts) >= STARTS or image.scores[row] < image.score - LESS_LIKE:
            break
        x, y = keyframes.poses[row, :2].tolist()
        near = [yaw for a, b, yaw in starts if math.hypot(x - a, y - b) < SPACING_M]
        if all(abs(wrap_angle(yaw - image.yaws[row])) > SPACING_RAD for yaw in near):
            starts += [(x, y, yaw) for yaw in _headings(keyframes, image, row)]
    return starts[:STARTS]


def _headings(keyframes: Keyframes, image: UprightImage, row: int) -> list[float]:
    """The heading rad with the highest correlation with a keyframe, and a second one with nearly
    the same: in a corridor, turned by 180 degrees.
    """
    first = float(image.yaws[row])
    columns = keyframes.columns
    product = (keyframes.aligned([row])[0] * image.visible.conj()).sum(axis=0)
    curve = 2 * columns_of(product, 2 * columns)
    yaws = -keyframes.sign * np.pi / columns * np.arange(len(curve))
    curve[np.abs(wrap_angle(yaws.astype(float) - first)) < SPACING_RAD] = -np.inf
    second = int(curve.argmax())
    if curve[second] <= image.scores[row] - LESS_LIKE:
        return [first]
    return [first, float(yaws[second])]
