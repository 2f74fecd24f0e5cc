# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Dead reckoning of one drive: wheels and gyroscope, its breaks, and the errors it accumulates."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import SPOT_RADIUS_M, Array, Complex, Indices, Mask, wrap_angle
from sfa_localization.data.run import Count, Odometry, Stamps, YawRate, differences
from sfa_localization.metric.settings import SegmentConfig

GAP_MAX_S = 0.5
"""Longer pauses of odometry or gyroscope are breaks: the robot may have been moved meanwhile."""
# Pauses are longer than so many periods of the odometry.
_PERIODS = 2.5
# A shorter pause is bridged where the twists before and after differ by less.
_BRIDGE_MAX_S, _UNSURE_M, _UNSURE_RAD = 1.5, 0.05, 0.1

TURN_SLIDE = 0.05
"""m per rad: how far wheels slide sideways in a turn on the spot."""
SEEN_TURN_SLIDE = 0.01
"""m per rad: what remains of it where images correct the turns; 0.007 for two real indoor robots.
With more, the links are so weak that maps shrink by 4 %."""


class Way(NamedTuple):
    """The correction of a drive's wheels: distance = `scale` * counted - `loss` (m per radian) *
    turned; `loss_std` is the standard deviation of the loss.
    """

    scale: float = 1.0
    loss: float = 0.0
    loss_std: float = 0.0

    def scaled(self, factor: float) -> Way:
        """The same way after a change of the meter."""
        return Way(factor * self.scale, factor * self.loss, factor * self.loss_std)


@dataclass(frozen=True, slots=True)
class OdometryTrack:
    """Poses (N, 3) of base_link at the N odometry stamps, with unwrapped yaw, and what accumulates
    along them.
    """

    stamps_ns: Stamps
    poses: Array
    part: Indices
    """(N,) number of the unbroken part of each pose."""
    yaw_variance: Array
    """(N,) rad^2 since the start, without a bias of the yaw rate."""
    count: Count
    slide: float = TURN_SLIDE
    """m per rad turned: error of the places."""
    lever: complex = 0.0
    """Where the camera sits on the robot, ahead + i left, m."""

    @classmethod
    def of(
        cls, odometry: Odometry, config: SegmentConfig, yaw_rate: YawRate | None = None
    ) -> OdometryTrack:
        """From wheel odometry, with the turns of the gyroscope if there is one."""
        stamps, skipped = odometry.stamps_ns, Counter[str]()
        if len(stamps) < 2:
            raise DataError('fewer than two usable odometry messages: check the odometry topic')
        breaks = pauses(odometry)
        skipped['pauses'] += int(breaks.sum())
        breaks |= np.diff(odometry.part) != 0
        yaw, variances = np.unwrap(odometry.poses[:, 2]), odometry.variances[:, 1]
        poses = np.column_stack([odometry.poses[:, :2], yaw])
        if config.yaw_source != 'odometry' and yaw_rate and len(yaw_rate.stamps_ns) > 1:
            turns, variances = _gyro_turns(odometry, ~breaks, yaw_rate, skipped)
            yaw = yaw[0] + summed(turns)
        elif config.yaw_source == 'gyro':
            raise DataError('yaw_source is gyro, but there is no yaw rate: name the imu topic')
        dt = np.diff(stamps) * 1e-9
        stated = variances[:-1] * dt**2
        noise = np.where(stated > 0, stated, config.yaw_noise**2 * dt)
        part = summed(breaks).astype(np.int64)
        count = Count(len(stamps), dict(+skipped))
        return cls(stamps, poses, part, summed(noise), count)._turned(yaw)

    @property
    def seconds(self) -> Array:
        """(N,) since the start."""
        return np.asarray((self.stamps_ns - self.stamps_ns[0]) * 1e-9)

    @property
    def yaw(self) -> Array:
        """(N,) rad."""
        return self.poses[:, 2]

    @property
    def place(self) -> Complex:
        """Where the camera is, x + i y (N,) m."""
        place = self.poses[:, 0] + 1j * self.poses[:, 1] + self.lever * np.exp(1j * self.yaw)
        return np.asarray(place)

    @property
    def length(self) -> Array:
        """Driven since the start (N,), m."""
        return summed(np.abs(self.steps()))

    @property
    def turned(self) -> Array:
        """Turned in either direction since the start (N,), rad."""
        return summed(np.abs(np.diff(self.yaw)))

    def corrected(self, stamps_ns: Stamps, yaw: Array, noise: float) -> OdometryTrack:
        """The same wheel steps, with `yaw` (M,) rad added at stamps (M,), linear between them; the
        turns then have this noise, rad per square root of s.
        """
        at = (stamps_ns - self.stamps_ns[0]) * 1e-9
        track = self._turned(self.yaw + np.interp(self.seconds, at, yaw))
        return replace(track, yaw_variance=noise**2 * self.seconds, slide=SEEN_TURN_SLIDE)

    def driven(self, way: Way) -> OdometryTrack:
        """The same turns with the corrected way."""
        return self._moved(way.scale * self.steps() - way.loss * self.way_per_loss(), self.yaw)

    def steps(self) -> Complex:
        """Displacements (N - 1,) m of base_link between the stamps."""
        return np.asarray(np.diff(self.poses[:, 0] + 1j * self.poses[:, 1]))

    def way_per_loss(self) -> Complex:
        """Displacements (N - 1,) m that a loss of 1 m per radian takes from the steps."""
        step, turned = self.steps(), np.abs(np.diff(self.yaw))
        length = np.abs(step)
        moves = length > SPOT_RADIUS_M * turned
        return np.asarray(np.divide(step * turned, length, out=np.zeros_like(step), where=moves))

    def _turned(self, yaw: Array) -> OdometryTrack:
        """The same wheel steps driven with another yaw (N,)."""
        change = yaw - self.yaw
        return self._moved(self.steps() * np.exp(0.5j * (change[:-1] + change[1:])), yaw)

    def _moved(self, step: Complex, yaw: Array) -> OdometryTrack:
        """Displacements (N - 1,) m and yaw (N,) from the same start."""
        place = self.poses[0, 0] + 1j * self.poses[0, 1] + summed(step)
        return replace(self, poses=np.column_stack([place.real, place.imag, yaw]))


def summed(steps: NDArray[Any]) -> NDArray[Any]:
    """Sums (N + 1,) of steps (N,), from 0 on."""
    return np.concatenate([[0.0], np.cumsum(steps)])


def spaced(sums: Array, least: float) -> Indices:
    """Rows of increasing sums (N,): the first one, and each that is `least` beyond the last."""
    rows = [0]
    for row, value in enumerate(sums):
        if value - sums[rows[-1]] >= least:
            rows.append(row)
    return np.array(rows, np.int64)


def pauses(odometry: Odometry) -> Mask:
    """Mask (N - 1,) of the pauses of odometry; short ones with equal twists before and after do not
    count: drivers that publish only when a command changes pause like that.
    """
    twists, poses = odometry.twists, odometry.poses
    twists = twists if twists.any() else differences(odometry.stamps_ns, poses)
    dt = np.diff(odometry.stamps_ns) * 1e-9
    gap = dt > max(GAP_MAX_S, _PERIODS * float(np.median(dt)))
    unsure = np.abs(np.diff(twists, axis=0)) * dt[:, None]
    alike = (unsure[:, 0] < _UNSURE_M) & (unsure[:, 1] < _UNSURE_RAD)
    return np.asarray(gap & ~(alike & (dt < _BRIDGE_MAX_S)))


def _gyro_turns(
    odometry: Odometry, unbroken: Mask, gyro: YawRate, skipped: Counter[str]
) -> tuple[Array, Array]:
    """Turns (N - 1,) between the odometry's stamps, and the variances (N,) of their rate.

    They are the gyroscope's where it has readings all along a step. Elsewhere they are the
    odometry's plus the gyroscope's mean offset, so that one bias remains for the whole drive.
    """
    stamps, variances = odometry.stamps_ns, odometry.variances[:, 1]
    seconds, at = (gyro.stamps_ns - stamps[0]) * 1e-9, (stamps - stamps[0]) * 1e-9
    areas = (gyro.omega[1:] + gyro.omega[:-1]) / 2 * np.diff(seconds)
    turns = np.diff(np.interp(at, seconds, summed(areas)))
    wheels, dt = wrap_angle(np.diff(odometry.poses[:, 2])), np.diff(at)
    measured = without_pause(stamps[:-1], stamps[1:], gyro.stamps_ns, GAP_MAX_S)
    both = measured & unbroken
    if not both.any():
        skipped['without a usable gyroscope'] += int(unbroken.sum())
        return wheels, variances
    skipped['in a gap of the gyroscope'] += int((unbroken & ~measured).sum())
    offset = float((turns - wheels)[both].sum() / dt[both].sum())
    by_gyro = np.append(measured, measured[-1])
    variances = np.where(by_gyro, np.interp(at, seconds, gyro.variance), variances)
    return np.where(measured, turns, wheels + offset * dt), variances


def without_pause(begin: Stamps, end: Stamps, stamps: Stamps, pause_s: float) -> Mask:
    """Mask (M,) of the times from `begin` (M,) to `end` (M,) in which stamps (N,) never pause."""
    before = np.searchsorted(stamps, begin, 'right') - 1
    after = np.searchsorted(stamps, end, 'left')
    inside = (before >= 0) & (after < len(stamps))
    before, after = np.clip([before, after], 0, len(stamps) - 1)
    number = summed(np.diff(stamps) > pause_s * 1e9)
    return np.asarray(inside & (number[before] == number[after]))
