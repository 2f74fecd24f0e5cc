# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope beside wheels and images: samples that both contradict, and whether it helps.

Where gyroscope and wheels disagree, the turns between images decide. Both explanations of each
window between two images, a faulty gyroscope and slipping wheels, are weighed by their likelihood.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import expit, logit

from sfa_localization.data.geometry import Array, Mask, wrap_angle
from sfa_localization.data.run import Odometry, Stamps, YawRate
from sfa_localization.data.statistics import MEDIAN_TO_STD, quantile, surprise
from sfa_localization.metric.dead_reckoning import GAP_MAX_S, summed, without_pause
from sfa_localization.metric.motion_samples import OUTLIER, fault_sentence, faulty
from sfa_localization.metric.motion_sources import (
    GYRO,
    IMAGES,
    POSE,
    Pair,
    Source,
    compare,
    sources_of,
)

HARMLESS = 0.05
"""rad/s: a sample that is wrong by less turns the robot by 0.002 rad at 25 Hz, half of the error
of the turn between two images."""
WORSE, _CHANCE = 2.0, 3.0
"""A gyroscope whose turns err by this factor more than those of the wheels, by more than so many
standard errors, spoils them: 0.8 to 1.2 of right ones, 1.3 with noise of 0.05 rad/s, 7 of one with
half of its rates 0, in three drives."""
_SURE = OUTLIER**2 / 2  # log-likelihood ratio of a residual of OUTLIER standard deviations
_SHIFTS, _ITERATIONS = 9, 20


def cleaned(
    odometry: Odometry, images: tuple[Stamps, Array] | None, gyro: YawRate | None
) -> tuple[YawRate | None, str]:
    """The gyroscope without samples that contradict wheels and images, and a sentence on them; ''
    for none.
    """
    if gyro is None or images is None or not len(gyro.omega):
        return gyro, ''
    kept = replace(gyro, omega=_smooth(gyro.omega))
    for _ in range(2):  # faulty samples also spoil the delay
        compared = _compared(odometry, images, kept)
        if compared is None:
            return gyro, ''
        wheels, rate, seen = compared
        stamps_ns = gyro.stamps_ns - _late_ns(rate)
        beyond = _beyond(wheels, stamps_ns, gyro.omega / rate.scale)
        mask = _guilty(stamps_ns, beyond, *_between(wheels, images, seen, seen.scale))
        kept = YawRate(gyro.stamps_ns[~mask], gyro.omega[~mask], gyro.variance[~mask])
    return kept, fault_sentence(GYRO, mask, gyro.stamps_ns, 'wheels and images')


def _smooth(omega: Array) -> Array:
    """Medians of five neighbors each, of which single faulty ones do not matter."""
    return np.asarray(np.median(sliding_window_view(np.pad(omega, 2, 'edge'), 5), axis=1))


def _guilty(stamps_ns: Stamps, beyond: Array, at: Stamps, turned: Array, error: Array) -> Mask:
    """Which samples (N,) of a gyroscope, `beyond` the wheels by rad/s, are faulty: there the turns
    between images `at` (M,) agree with those of the wheels, `turned` (M - 1,) rad, but for an
    `error` (M - 1,), as usual in turns.

    A run of contradictions is one fault, or one slip of the wheels. The share of faults is
    estimated from all runs; it decides where images do not.
    """
    window = np.searchsorted(at, stamps_ns, 'right')  # 0 and M are before and after all images
    wrong = np.bincount(window, beyond * np.gradient(stamps_ns * 1e-9), len(at) + 1)
    usual = quantile(np.abs(error), 0.5, np.maximum(np.abs(turned), 1e-9))
    variance, error = max((MEDIAN_TO_STD * usual) ** 2, 1e-12), np.pad(error, 1)
    ratio = surprise((error - wrong) ** 2 / variance, 1) - surprise(error**2 / variance, 1)
    ratio[[0, -1]] = 0.0
    faults = beyond != 0
    run = summed(np.diff(faults) & faults[1:]).astype(np.int64)
    of_run, there = np.unique([run[faults], window[faults]], axis=1)
    judged = np.unique(of_run)
    evidence = np.clip(np.bincount(of_run, ratio[there])[judged], -_SURE, _SURE)
    share = 0.5
    for _ in range(_ITERATIONS):
        of_gyro = expit(evidence + logit(share))
        share = (float(of_gyro.sum()) + 0.5) / (len(judged) + 1)
    if evidence[of_gyro > 0.5].sum() < _SURE:
        return np.zeros(len(faults), bool)
    return np.asarray(faults & np.isin(run, judged[of_gyro > 0.5]))


def _compared(
    odometry: Odometry, images: tuple[Stamps, Array] | None, gyro: YawRate
) -> tuple[Source, Pair, Pair] | None:
    """The wheels, and how gyroscope and images compare with them; None where they do not."""
    sources = {source.name: source for source in sources_of(odometry, images, gyro)}
    if not {POSE, GYRO, IMAGES} <= sources.keys():
        return None
    wheels = sources[POSE]
    rate, seen = compare(wheels, sources[GYRO]), compare(wheels, sources[IMAGES])
    if rate is None or seen is None or rate.independent or seen.independent:
        return None
    return (wheels, rate, seen) if rate.scale and seen.scale else None


def _late_ns(pair: Pair) -> int:
    return round((pair.delay_s or 0.0) * 1e9)


def _beyond(wheels: Source, stamps_ns: Stamps, omega: Array) -> Array:
    """By how much yaw rates (N,) contradict those of the wheels around their stamps, rad/s; 0 where
    they do not.
    """
    # Messages may come in bundles.
    steps = (np.diff(each) * 1e-9 for each in (wheels.stamps_ns, stamps_ns))
    period_s = max(float(np.percentile(step, 99)) for step in steps)
    around = np.linspace(-2 * period_s, 2 * period_s, _SHIFTS)[:, None]
    middle = stamps_ns + np.round(around * 1e9).astype(np.int64)
    half_ns = round(period_s * 5e8)
    rates = wheels.moved(np.stack([middle - half_ns, middle + half_ns], -1), 'turns') / period_s
    usual = rates[_SHIFTS // 2]
    rest = omega - np.clip(omega, rates.min(0), rates.max(0))
    wrong = faulty(omega - usual, HARMLESS) & faulty(rest, HARMLESS)
    return np.where(wrong, rest, 0.0)


def _between(
    wheels: Source, images: tuple[Stamps, Array], seen: Pair, scale: float
) -> tuple[Stamps, Array, Array]:
    """Stamps (M,) of images by the clock of the wheels, the turns (M - 1,) of the wheels between
    them, and by how much those of the images, over a scale, exceed these, rad.
    """
    at = images[0] - _late_ns(seen)
    turned = wheels.moved(np.column_stack([at[:-1], at[1:]]), 'turns')
    return at, turned, wrap_angle(np.diff(images[1]) - scale * turned) / scale


def is_worse(odometry: Odometry, images: tuple[Stamps, Array] | None, gyro: YawRate | None) -> bool:
    """Whether the turns between images agree with the wheels, and not with the gyroscope without
    its bias: by the mean error, beyond chance.
    """
    compared = None if gyro is None else _compared(odometry, images, gyro)
    if gyro is None or images is None or compared is None:
        return False
    wheels, rate, seen = compared
    at, turned, by_wheels = _between(wheels, images, seen, np.sign(seen.scale))
    (rates,) = (source for source in sources_of(odometry, None, gyro) if source.name == GYRO)
    windows = np.column_stack([at[:-1], at[1:]])
    more = turned - rates.moved(windows + _late_ns(rate), 'turns')
    whole = without_pause(at[:-1], at[1:], gyro.stamps_ns - _late_ns(rate), GAP_MAX_S)
    whole &= at[1:] > at[:-1]
    if not whole.any():
        return False
    seconds, by_gyro = np.diff(at)[whole] * 1e-9, wrap_angle(by_wheels + more)[whole]
    by_gyro = np.abs(by_gyro - np.median(by_gyro / seconds) * seconds)
    by_wheels = np.abs(by_wheels[whole])
    excess = by_gyro - by_wheels
    chance = _CHANCE * excess.std() / np.sqrt(len(excess))
    return bool(excess.mean() > max(chance, (WORSE - 1) * by_wheels.mean()))
