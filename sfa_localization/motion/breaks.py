# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where a drive's odometry breaks: nothing is assumed of the motion between its parts.

Odometry breaks where its pose jumps (data/odometry_steps.py) while the twist does not say that the
robot drove on as before; where the wheels turn while the images stand; and where the images show
another place after the wheels stood, as of a robot that was carried. For the last two the change of
the images over each step of the odometry is compared with the usual one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Mask, relative
from sfa_localization.data.odometry_steps import JUMP, beyond, tolerance
from sfa_localization.data.run import Odometry, Stamps, chained
from sfa_localization.data.statistics import quantile
from sfa_localization.keyframes.closures import LIKE
from sfa_localization.motion.dead_reckoning import pauses, spaced, summed

StampedTextures = tuple[Stamps, NDArray[np.int8]]
"""Stamps (N,) of images, and small versions of these (N, rows, columns), of zero mean around the
robot."""
STEP = 0.2
"""m or rad, by odometry, between two images that are compared."""
STILL = 1 / 20
STRAIGHT = 0.25
"""Images stand still if they change by less than this share of the usual change for the distance
driven: those of a standing robot by 1/500, of a driving one by 1/7 or more (two gardens, four real
logs). The usual change is the lower quartile over distances driven straight, because images change
more in turns."""
STANDING = 0.01
STOOD_S = 1.0
"""Slower wheels, m/s or rad/s, stand; a robot that stands so long may be carried."""
OTHER = 0.05
"""Quantile of the correlations of neighboring images below which an image may show another
place."""
# Correlations below are those of noise.
_LEAST_LIKE = 1e-2


def _jumps(odometry: Odometry) -> tuple[Mask, Array, float]:
    """Mask (N - 1,) of impossible steps, the steps (N - 1, 3) interpolated from the speeds around
    them, and the noise, m or rad, of the regular steps: see data.odometry_steps.
    """
    step = relative(odometry.poses[:-1], odometry.poses[1:])
    dt = np.diff(odometry.stamps_ns) * 1e-9
    period = max(float(np.median(dt)), 1e-3)
    usual_s = np.maximum(dt, period)
    # Messages may be stamped late, or in bundles.
    longest_s = usual_s + float(np.percentile(np.abs(dt - period), 90))
    speed = step / usual_s[:, None]
    padded = np.pad(speed, ((1, 1), (0, 0)), 'edge')  # before and after
    distances = [
        beyond(step[:, axes], longest_s, [padded[:-2, axes], padded[2:, axes]])
        for axes in (slice(0, 2), slice(2, 3))
    ]
    distance = np.max(distances, axis=0)
    noise = quantile(distance, 0.68)  # as data.odometry_steps learns it
    jump = distance > tolerance(usual_s, noise)
    rows = np.arange(len(step))
    around = [np.interp(rows, rows[~jump], each[~jump]) for each in speed.T]
    return jump, np.transpose(around) * dt[:, None], noise


def parted(odometry: Odometry) -> tuple[Odometry, str]:
    """Odometry that breaks at its pauses and jumps, and a sentence on jumps, and on pauses after
    which the pose is another; '' for none.

    Where the twist says that the robot drove on as before, only the pose has jumped: it goes on.
    """
    if len(odometry.stamps_ns) < 3:
        return odometry, ''
    pause = pauses(odometry)
    jump, usual, noise = _jumps(odometry)
    jump &= ~pause
    seconds = np.diff(odometry.stamps_ns) * 1e-9
    v, omega = (odometry.twists[1:] * seconds[:, None]).T
    by_twist = np.column_stack([v, 0 * v, omega])
    drove_on = np.abs(by_twist - usual).max(axis=1) < tolerance(seconds, noise)
    cut = jump & ~(drove_on & odometry.twists.any())
    odometry = replace(odometry, part=summed(pause | cut).astype(np.int64))
    step = relative(odometry.poses[:-1], odometry.poses[1:])
    elsewhere = _goes_on_elsewhere(odometry, pause, step)
    if not jump.any():
        return odometry, elsewhere
    far = float(np.hypot(*(step - usual)[jump, :2].T).max())
    step = np.where(jump[:, None], usual, step)
    poses = chained(odometry.poses[0], step)
    text = _jumps_text(far, int(jump.sum()), int((jump & ~cut).sum()), seconds.sum() / 60)
    return replace(odometry, poses=poses), '; '.join(filter(None, (text, elsewhere)))


def _jumps_text(far: float, count: int, joined: int, minutes: float) -> str:
    """A sentence on `count` jumps by up to `far` m, of which so many are joined."""
    times = 'once' if count == 1 else f'{count} times'
    how = ['joined by its motion around'] * (joined > 0) + ['cut there'] * (joined < count)
    text = f'odometry pose jumps {times}, by up to {far:.2f} m: {" or ".join(how)}'
    if joined > max(minutes, 1.0):  # a driver is not reset so often
        text += '; if a localization corrects it, record the frame odom instead of map'
    return text


def _goes_on_elsewhere(odometry: Odometry, pause: Mask, step: Array) -> str:
    """A sentence on pauses (N - 1,) over which the pose makes steps (N - 1, 3); '' for none."""
    far = np.hypot(step[:, 0], step[:, 1]) * pause
    rows = np.flatnonzero(far > JUMP)
    if not len(rows):
        return ''
    times, most = ('once', '') if len(rows) == 1 else (f'{len(rows)} times', 'up to ')
    first_s = (odometry.stamps_ns[rows[0]] - odometry.stamps_ns[0]) * 1e-9
    return (
        f'odometry pauses {times}, first after {first_s:.1f} s, and goes on {most}{far.max():.2f} '
        'm from where it was: cut there'
    )


def contradicted(
    odometry: Odometry, stamps_ns: Stamps, textures: NDArray[np.int8]
) -> tuple[Odometry, list[str]]:
    """Odometry that breaks where images, `textures` at their stamps, contradict the wheels, and
    sentences on that.
    """
    stamps = odometry.stamps_ns
    step = relative(odometry.poses[:-1], odometry.poses[1:])
    seconds = (stamps - stamps[0]) * 1e-9
    length = np.hypot(step[:, 0], step[:, 1])
    moved = length + np.abs(step[:, 2])
    still_s = np.where(moved < STANDING * np.diff(seconds), np.diff(seconds), 0.0)
    inside = (stamps_ns >= stamps[0]) & (stamps_ns <= stamps[-1])
    images_s = (stamps_ns[inside] - stamps[0]) * 1e-9
    rows = spaced(np.interp(images_s, seconds, summed(moved)), STEP)
    if len(rows) < 3:
        return odometry, []
    at = images_s[rows]
    small = textures[inside][rows]
    moved, length, still_s = (
        np.diff(np.interp(at, seconds, summed(sums))) for sums in (moved, length, still_s)
    )
    stands, other = _unlike_wheels(small, moved, length, still_s)
    return _broken(odometry, seconds, at, stands, other), _contradictions(at, stands, other)


def _broken(odometry: Odometry, seconds: Array, at: Array, stands: Mask, other: Mask) -> Odometry:
    """Odometry at `seconds` (M,) that breaks between images at seconds (N,) where these, in steps
    (N - 1,), contradict the wheels.
    """
    # The wheels began to spin after the image before, and ended before the next one.
    padded = np.pad(stands, 1)
    unknown = np.pad(stands | other | padded[:-2] | padded[2:], 1)
    unsure = unknown[np.searchsorted(at, seconds, 'right')]
    breaks = (np.diff(odometry.part) != 0) | unsure[1:] | unsure[:-1]
    return replace(odometry, part=summed(breaks).astype(np.int64))


def _contradictions(at: Array, stands: Mask, other: Mask) -> list[str]:
    """Sentences on the steps (N - 1,) between images at seconds (N,) that contradict the wheels."""
    sentences = {
        'the wheels turn from {:.1f} s to {:.1f} s while the images stand: cut there': stands,
        'images from {:.1f} s to {:.1f} s, while the wheels stand, move: cut there': other,
    }
    texts = []
    for text, mask in sentences.items():
        ends = np.flatnonzero(np.diff(np.pad(mask, 1).astype(int))).reshape(-1, 2)
        texts += [text.format(*at[pair]) for pair in ends]
    return texts


def _unlike_wheels(
    textures: NDArray[np.int8], moved: Array, length: Array, still_s: Array
) -> tuple[Mask, Mask]:
    """Masks (N - 1,) of the steps between images (N, ...) in which these stand while the wheels
    turn, and show another place while the wheels stand.

    Wheels `moved` (N - 1,) m and rad, of which `length` (N - 1,) m, and stood for `still_s`.
    """
    likeness, turned_likeness = _likeness(textures)
    # Only ways ahead show what is usual: wheels may report turns of a robot that does not turn.
    change = -np.log(likeness)
    ahead = length > moved / 2
    usual = quantile(change[ahead] / length[ahead], STRAIGHT) if ahead.any() else 0.0
    stands = change < STILL * usual * length
    other = turned_likeness < min(LIKE, float(np.quantile(turned_likeness, OTHER)))
    return stands, other & (still_s > STOOD_S)


def _likeness(textures: NDArray[np.int8]) -> tuple[Array, Array]:
    """Correlations (N - 1,) of neighbors (N, rows, columns), and those at the best rotation; at
    least _LEAST_LIKE.
    """
    images = textures.astype(np.float32)
    spectra = np.fft.rfft(images)
    power = np.maximum(np.sum(images**2, axis=(1, 2)), 1e-6)
    products = np.sum(spectra[1:] * spectra[:-1].conj(), axis=1)
    alike = np.fft.irfft(products, textures.shape[2]) / np.sqrt(power[1:] * power[:-1])[:, None]
    alike = np.clip(alike, _LEAST_LIKE, 1.0)
    return alike[:, 0], alike.max(axis=1)
