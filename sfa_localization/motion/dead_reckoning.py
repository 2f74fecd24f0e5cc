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
from sfa_localization.data.rig import Quantity
from sfa_localization.data.run import Count, Odometry, Stamps, YawRate, differences
from sfa_localization.motion.settings import SegmentConfig

GAP_MAX_S = 0.5
"""Longer pauses of odometry or gyroscope are breaks: the robot may have been moved meanwhile."""
# Pauses are longer than so many periods of the odometry.
_PERIODS = 2.5
BRIDGE_MAX_S = 1.5
"""A shorter pause is bridged: the robot moved by a twist between those before and after."""

TURN_SLIDE = 0.05
"""m per rad: how far wheels slide sideways in a turn on the spot."""


class Way(NamedTuple):
    """The correction of a drive's wheels: distance = `scale` * counted - `loss` (m per radian) *
    turned + `offset` (m/s) * time.
    """

    scale: float = 1.0
    loss: Quantity = Quantity(0.0, 0.0)
    offset: Quantity = Quantity(0.0, 0.0)

    def scaled(self, factor: float) -> Way:
        """The same way after a change of the meter."""
        loss, offset = (Quantity(factor * each.value, factor * each.std) for each in self[1:])
        return Way(factor * self.scale, loss, offset)

    @property
    def values(self) -> Array:
        """Factors (3,) of the columns of `OdometryTrack.ways`."""
        return np.array([self.scale, self.loss.value, self.offset.value])


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
    bridged: Array
    """(N, 2) variances of the way ahead, m^2, and of the turns, rad^2, in bridged pauses."""
    by_gyro: bool = False
    """Whether a gyroscope measured the turns."""
    lever: complex = 0.0
    """Where the camera sits on the robot, ahead + i left, m."""

    @classmethod
    def of(
        cls, odometry: Odometry, config: SegmentConfig, yaw_rate: YawRate | None = None
    ) -> OdometryTrack:
        """From wheel odometry, with the turns of the gyroscope if there is one."""
        stamps = odometry.stamps_ns
        if len(stamps) < 2:
            raise DataError('fewer than two usable odometry messages: check the odometry topic')
        breaks = pauses(odometry)
        skipped = Counter[str](pauses=int(breaks.sum()))
        breaks |= np.diff(odometry.part) != 0
        yaw = np.unwrap(odometry.poses[:, 2])
        variances = odometry.variances[:, 1]
        poses = np.column_stack([odometry.poses[:, :2], yaw])
        by_gyro = False
        if config.yaw_source != 'odometry' and yaw_rate and len(yaw_rate.stamps_ns) > 1:
            by_gyro = True
            turns, variances = _gyro_turns(odometry, ~breaks, yaw_rate, skipped)
            yaw = yaw[0] + summed(turns)
        elif config.yaw_source == 'gyro':
            raise DataError('yaw_source is gyro, but there is no yaw rate: name the imu topic')
        unsure = bridged(odometry) * [1.0, not by_gyro]
        noise = _yaw_noise(stamps, variances, config.yaw_noise) + unsure[:, 1]
        part = summed(breaks).astype(np.int64)
        count = Count(len(stamps), dict(+skipped))
        sums = np.pad(np.cumsum(unsure, axis=0), ((1, 0), (0, 0)))
        return cls(stamps, poses, part, summed(noise), count, sums, by_gyro)._turned(yaw)

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

    def corrected(self, stamps_ns: Stamps, yaw: Array, variance: Array) -> OdometryTrack:
        """The same wheel steps, with `yaw` (M,) rad added at stamps (M,), linear between them; the
        turns then have a `variance` (M,) rad^2 since the first of these.
        """
        at = (stamps_ns - self.stamps_ns[0]) * 1e-9
        track = self._turned(self.yaw + np.interp(self.seconds, at, yaw))
        variance = np.interp(self.seconds, at, variance)
        return replace(track, yaw_variance=variance)

    def driven(self, way: Way) -> OdometryTrack:
        """The same turns with the corrected way."""
        return self._moved(self.ways() @ way.values, self.yaw)

    def steps(self) -> Complex:
        """Displacements (N - 1,) m of base_link between the stamps."""
        return np.asarray(np.diff(self.poses[:, 0] + 1j * self.poses[:, 1]))

    def ways(self) -> Complex:
        """Displacements (N - 1, 3) m by the steps, a loss of 1 m per radian, an offset of 1 m/s."""
        step = self.steps()
        turned = np.abs(np.diff(self.yaw))
        length = np.abs(step)
        moves = length > SPOT_RADIUS_M * turned
        ahead = np.divide(step, length, out=np.zeros_like(step), where=moves)
        backward = np.real(ahead * np.exp(-1j * self.yaw[:-1])) < 0
        forward = np.where(backward, -ahead, ahead)
        return np.column_stack([step, -turned * ahead, np.diff(self.seconds) * forward])

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
    """Mask (N - 1,) of the pauses of odometry that are too long to be bridged."""
    dt = np.diff(odometry.stamps_ns) * 1e-9
    return np.asarray(_paused(dt) & (dt >= BRIDGE_MAX_S))


def bridged(odometry: Odometry) -> Array:
    """Variances (N - 1, 2) of the way, m^2, and of the turn, rad^2, in the pauses that are bridged:
    0 where the twists before and after are equal, as of drivers that publish changes of commands.
    """
    twists = odometry.twists
    poses = odometry.poses
    twists = twists if twists.any() else differences(odometry.stamps_ns, poses)
    dt = np.diff(odometry.stamps_ns) * 1e-9
    change = np.diff(twists, axis=0)
    pause = _paused(dt) & (dt < BRIDGE_MAX_S) & change.any(axis=1)
    unsure = change**2 + np.mean(twists**2, axis=0)  # or another twist of this robot
    return np.asarray(np.where(pause[:, None], unsure * dt[:, None] ** 2, 0.0))


def _paused(dt: Array) -> Mask:
    return np.asarray(dt > max(GAP_MAX_S, _PERIODS * float(np.median(dt))))


def _yaw_noise(stamps_ns: Stamps, variances: Array, noise: float) -> Array:
    """Variances (N - 1,) rad^2 of the turns by those of their rates (N,), or by `noise`,
    rad/sqrt(s), where these are not stated."""
    dt = np.diff(stamps_ns) * 1e-9
    stated = variances[:-1] * dt**2
    return np.where(stated > 0, stated, noise**2 * dt)


def _gyro_turns(
    odometry: Odometry, unbroken: Mask, gyro: YawRate, skipped: Counter[str]
) -> tuple[Array, Array]:
    """Turns (N - 1,) between the odometry's stamps, and the variances (N,) of their rate.

    They are the gyroscope's where it has readings all along a step. Elsewhere they are the
    odometry's plus the gyroscope's mean offset, so that one bias remains for the whole drive.
    """
    stamps = odometry.stamps_ns
    variances = odometry.variances[:, 1]
    seconds = (gyro.stamps_ns - stamps[0]) * 1e-9
    at = (stamps - stamps[0]) * 1e-9
    areas = (gyro.omega[1:] + gyro.omega[:-1]) / 2 * np.diff(seconds)
    turns = np.diff(np.interp(at, seconds, summed(areas)))
    wheels = wrap_angle(np.diff(odometry.poses[:, 2]))
    dt = np.diff(at)
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
