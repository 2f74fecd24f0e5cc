# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope beside wheels and images: samples that both contradict, and whether it helps.

Where gyroscope and wheels disagree, the turns between images decide. Both explanations of each
window between two images, a faulty gyroscope and slipping wheels, are weighed by their likelihood.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.special import logit

from sfa_localization.data.geometry import Array, Mask, wrap_angle
from sfa_localization.data.run import Odometry, Stamps, YawRate
from sfa_localization.data.statistics import MEDIAN_TO_STD, quantile, surprise
from sfa_localization.motion.dead_reckoning import GAP_MAX_S, without_pause
from sfa_localization.motion.fit import compare
from sfa_localization.motion.samples import OUTLIER, fault_sentence, faulty
from sfa_localization.motion.sources import (
    EQUAL,
    GYRO,
    IMAGES,
    POSE,
    Source,
    sources_of,
)

HARMLESS = 0.05
"""rad/s: a sample that is wrong by less turns the robot by 0.002 rad at 25 Hz, half of the error
of the turn between two images."""
WORSE = 2.0
"""A gyroscope whose turns err by this factor more than those of the wheels spoils them: 0.8 to 1.2
of right ones, 1.3 with noise of 0.05 rad/s, 7 of one with half of its rates 0, in three drives."""
_SURE = OUTLIER**2 / 2  # log-likelihood ratio of a residual of OUTLIER standard deviations
_SHIFTS = 9
_UNITS = 1.0, 180 / np.pi  # rad/s and degrees/s


def smoothed(gyro: YawRate) -> YawRate:
    """Without single faulty samples, which do not matter for a clock."""
    return replace(gyro, omega=ndimage.median_filter(gyro.omega, 5, mode='nearest'))


def cleaned(
    odometry: Odometry, images: tuple[Stamps, Array] | None, gyro: YawRate | None
) -> tuple[YawRate | None, str]:
    """The gyroscope without samples that contradict wheels and images, or None if it is worse than
    the wheels even then; and a sentence, '' for none.
    """
    if gyro is None:
        return None, ''
    compared = _compared(odometry, images, smoothed(gyro))
    if not compared:
        return gyro, ''
    (wheels, _), (rates, factor), (views, scale) = compared
    unit = np.copysign(min(_UNITS, key=lambda unit: abs(np.log(abs(factor) / unit))), factor)
    mask = np.zeros(len(gyro.omega), bool)
    if 1 / EQUAL < factor / unit < EQUAL:  # else not only single samples are faulty
        beyond = _beyond(wheels, rates.stamps_ns, gyro.omega / factor)
        turns = _between(wheels, views, scale)
        mask = _guilty(rates.stamps_ns, beyond, views.stamps_ns, *turns)
    kept = YawRate(gyro.stamps_ns[~mask], gyro.omega[~mask], gyro.variance[~mask])
    at_ns = rates.stamps_ns[~mask]
    *_, rates = sources_of(odometry, None, replace(kept, stamps_ns=at_ns, omega=kept.omega / unit))
    if _is_worse(rates, wheels, views, float(np.sign(scale))):
        far = f'it turns {abs(factor):.3g} times as far as these'
        return None, f'{GYRO}: left out: the wheels agree better with the images; {far}'
    return kept, fault_sentence(GYRO, mask, gyro.stamps_ns, 'wheels and images')


def _guilty(stamps_ns: Stamps, beyond: Array, at: Stamps, turned: Array, error: Array) -> Mask:
    """Which samples (N,) of a gyroscope, `beyond` the wheels by rad/s, are faulty: there the turns
    between images `at` (M,) agree with those of the wheels, `turned` (M - 1,) rad, but for a usual
    `error` (M - 1,). A run of contradictions is one fault, or one slip of the wheels.
    """
    window = np.searchsorted(at, stamps_ns, 'right')  # 0 and M are before and after all images
    wrong = np.bincount(window, beyond * np.gradient(stamps_ns * 1e-9), len(at) + 1)
    usual = quantile(np.abs(error), 0.5, np.maximum(np.abs(turned), 1e-9))
    variance = max((MEDIAN_TO_STD * usual) ** 2, 1e-12)
    error = np.pad(error, 1)
    ratio = surprise((error - wrong) ** 2 / variance, 1) - surprise(error**2 / variance, 1)
    ratio[[0, -1]] = 0.0
    run, number = ndimage.label(beyond)
    of_run, there = np.unique([run, window], axis=1)
    evidence = np.clip(np.bincount(of_run, ratio[there])[1:], -_SURE, _SURE)
    # The share of faults decides where images do not.
    share = ((evidence > 0).sum() + 0.5) / (number + 1)
    guilty = evidence + logit(share) > 0
    guilty &= evidence[guilty].sum() >= _SURE
    return np.asarray(np.append(False, guilty)[run])


def _compared(
    odometry: Odometry, images: tuple[Stamps, Array] | None, gyro: YawRate | None
) -> list[tuple[Source, float]]:
    """Wheels, gyroscope and images, all by the clock of the wheels, and how many times as far as
    these they turn; empty where they measure another motion, or too little.
    """
    sources = {source.name: source for source in sources_of(odometry, images, gyro)}
    if not {POSE, GYRO, IMAGES} <= sources.keys():
        return []
    compared = [(sources[POSE], 1.0)]
    for source in sources[GYRO], sources[IMAGES]:
        pair = compare(sources[POSE], source)
        if pair is None or pair.independent or not pair.scale:
            return []
        late_ns = round((pair.delay_s or 0.0) * 1e9)
        compared.append((replace(source, stamps_ns=source.stamps_ns - late_ns), pair.scale))
    return compared


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


def _between(wheels: Source, views: Source, scale: float) -> tuple[Array, Array]:
    """The turns (M - 1,) of the wheels between images, and by how much those of the images, over a
    scale, exceed these, rad.
    """
    at = views.stamps_ns
    turned = wheels.moved(np.column_stack([at[:-1], at[1:]]), 'turns')
    return turned, wrap_angle(np.diff(views.sums['turns']) - scale * turned) / scale


def _is_worse(rates: Source, wheels: Source, views: Source, sign: float) -> bool:
    """Whether the turns between images agree with the wheels, and not with the gyroscope without
    its bias: by the mean error.
    """
    (_, by_gyro), (_, by_wheels) = (_between(one, views, sign) for one in (rates, wheels))
    at = views.stamps_ns
    whole = without_pause(at[:-1], at[1:], rates.stamps_ns, GAP_MAX_S) & (np.diff(at) > 0)
    if not whole.any():
        return False
    by_gyro = by_gyro[whole]
    seconds = np.diff(at)[whole] * 1e-9
    by_gyro -= np.median(by_gyro / seconds) * seconds
    return bool(np.abs(by_gyro).mean() > WORSE * np.abs(by_wheels[whole]).mean())
