# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where an image was taken, and how sure that is: one mixture of Gaussians.

Each keyframe that is about as like the image as the likest one, and not near another such one or at
another heading, begins a hypothesis h: a regression among its neighbors puts the image at p_h with
variance v_h (`ErrorModel`), and leaves the part u_h of it unexplained. An image counts as n
independent numbers, of which the place explains all but that part:

    -2 ln p(image | h) = n ln(u_h / (1 + u_h)).

Slow features, read at the heading of h, put it at q_h with variance w_h: they are another sensor,
of the same image. In another light, or on a tilted robot, they err more; a scale s of w, of several
with probabilities P(s) that adapt to the images of late, says how much:

    p(image) = sum_hs P(s) (u_h / (1 + u_h))^(-n / 2) N(p_h - q_h; v_h + s w_h),

and each term is a Gaussian of the place with mean p_h + k (q_h - p_h) and variance (1 - k) v_h,
k = v_h / (v_h + s w_h). The pose is the mean about the likeliest start; the covariance is that of
the whole mixture about it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.keyframes.errors import ErrorModel
from sfa_localization.keyframes.keyframes import Keyframes
from sfa_localization.keyframes.regression import Fit
from sfa_localization.keyframes.texture import Spectra, columns_of, turned
from sfa_localization.keyframes.upright import UprightImage, without

STARTS, APART_M, APART_RAD = 3, 1.0, 0.5
"""Hypotheses begin at so many keyframes at most, as far apart, or turned: what is nearer, one
regression tells apart."""
LESS_LIKE = 0.1
"""Correlation by which a keyframe that begins one may be less like the image than the likest."""
PARTS = 60
"""n: neighboring pixels are one. From 20 to 200, places are the same."""
SCALES = 3.0 ** np.arange(8)
"""Of the variance of slow features, up to standard deviations that are 47 times as large."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A `fit` from one of several starts, numbered `start`."""

    fit: Fit
    start: int

    @property
    def evidence(self) -> float:
        """ln p(image | h), up to what all have in common."""
        return PARTS / 2 * math.log1p(1 / max(self.fit.unlike, 1e-9))


@dataclass(frozen=True, slots=True)
class SlowPlace:
    """Where slow features put an image: `place` (2,) m, and the `variance` m^2 along each axis that
    their map claims.
    """

    place: Array
    variance: float


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
    keyframes: Keyframes, image: UprightImage, pattern: Spectra | None = None
) -> tuple[list[Hypothesis], Array]:
    """Where an image may have been taken, without the `pattern` (rows, F) of its light, after what
    the likeliest one still shows of its tilt is taken out; and its whole tilt, (2,) rad.
    """
    likely = _from_starts(keyframes, image, pattern)
    finer = without(keyframes, image, _tilt_left(likely))
    if finer is not image:
        likely = _from_starts(keyframes, finer, pattern)
    return likely, finer.tilt + _tilt_left(likely)


def _tilt_left(likely: Sequence[Hypothesis]) -> Array:
    """Roll and pitch (2,) rad that an image shows by the likeliest hypothesis."""
    return max(likely, key=lambda one: one.evidence).fit.changes[:2]


def located(
    likely: Sequence[Hypothesis],
    slow: Sequence[SlowPlace],
    scales: Array,
    errors: ErrorModel,
    tilt: Array,
) -> Location:
    """The mixture of hypotheses with what slow features say at the heading of each; `scales` (S,)
    are the probabilities of `SCALES` by the images before, `tilt` (2,) that of the image.
    """
    fits = [one.fit for one in likely]
    own, both, unlike = _variances(fits, slow, errors)
    places, headings = np.array([f.place for f in fits]), np.array([f.yaw for f in fits])
    apart = np.array([s.place for s in slow]) - places
    evidence = np.array([one.evidence for one in likely])[:, None] - np.log(both)
    evidence = evidence + np.log(scales) - (apart**2).sum(1)[:, None] / (2 * both)
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    gain = own / both
    means = places[:, None] + gain[:, :, None] * apart[:, None]
    starts, by_fit = np.array([one.start for one in likely]), weight.sum(axis=1)
    here = starts == np.bincount(starts, by_fit).argmax()
    near, of_fit = (np.where(here, w.T, 0.0).T / w[here].sum() for w in (weight, by_fit))
    place = np.tensordot(near, means, 2)
    yaw = float(np.angle(of_fit @ np.exp(1j * headings)))
    # Without the covariance of place and heading: one that is elsewhere is no error of this one.
    covariance, offset = np.zeros((3, 3)), means - place
    covariance[:2, :2] = np.einsum('hs,hsi,hsj->ij', weight, offset, offset)
    covariance[:2, :2] += float((weight * own * (1 - gain)).sum()) * np.eye(2)
    turned_away = np.asarray(wrap_angle(headings - yaw))
    covariance[2, 2] = float(by_fit @ (turned_away**2 + errors.yaw_variance(unlike)))
    facing = complex(of_fit @ np.array([f.facing for f in fits]))
    shown = fits[int(of_fit.argmax())], facing, weight.sum(axis=0), tilt
    return Location(np.array([*place, wrap_angle(yaw)]), covariance, *shown)


def _variances(
    fits: Sequence[Fit], slow: Sequence[SlowPlace], errors: ErrorModel
) -> tuple[Array, Array, Array]:
    """Of H fits v_h (H, 1), v_h + s w_h at all scales (H, S), m^2, and what is unlike of each."""
    numbers = [(f.variance, f.outward, f.unlike) for f in fits]
    by_residual, outward, unlike = np.array(numbers).T
    own = errors.variance(by_residual, outward, unlike)[:, None]
    other = errors.slow_variance(np.array([s.variance for s in slow]), unlike)
    return own, own + other[:, None] * SCALES, unlike


def _from_starts(
    keyframes: Keyframes, image: UprightImage, pattern: Spectra | None
) -> list[Hypothesis]:
    """Hypotheses of an image in each light of the training from each start."""
    likely, lights = list[Hypothesis](), keyframes.likeliest_lights(image.scores)
    for start, (x, y, yaw) in enumerate(_starts(keyframes, image)):
        plain = image.spectrum
        if pattern is not None:
            plain = plain - turned(pattern, -keyframes.sign * yaw)
        fits = [keyframes.fit_about(plain, np.array([x, y]), yaw, light) for light in lights]
        likely += [Hypothesis(fit, start) for fit in fits]
    return likely


def _starts(keyframes: Keyframes, image: UprightImage) -> list[tuple[float, float, float]]:
    """Poses [x, y, yaw] of keyframes that are about as like the image as the likest one."""
    starts = list[tuple[float, float, float]]()
    for row in np.argsort(-image.scores, kind='stable').tolist():
        if len(starts) == STARTS or image.scores[row] < image.score - LESS_LIKE:
            break
        x, y = keyframes.poses[row, :2].tolist()
        near = [yaw for a, b, yaw in starts if math.hypot(x - a, y - b) < APART_M]
        if all(abs(wrap_angle(yaw - image.yaws[row])) > APART_RAD for yaw in near):
            starts += [(x, y, yaw) for yaw in _headings(keyframes, image, row)]
    return starts[:STARTS]


def _headings(keyframes: Keyframes, image: UprightImage, row: int) -> list[float]:
    """The heading rad at which an image is likest a keyframe, and the other one at which it is
    about as like it: in a corridor turned by 180 degrees.
    """
    first, columns = float(image.yaws[row]), keyframes.columns
    product = (keyframes.aligned([row])[0] * image.visible.conj()).sum(axis=0)
    curve = 2 * columns_of(product, 2 * columns)
    yaws = -keyframes.sign * np.pi / columns * np.arange(len(curve))
    curve[np.abs(wrap_angle(yaws.astype(float) - first)) < APART_RAD] = -np.inf
    other = int(curve.argmax())
    return [first, float(yaws[other])] if curve[other] > image.scores[row] - LESS_LIKE else [first]
