# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Dead reckoning of one drive: wheels and gyroscope, its breaks, and the errors it accumulates."""

from __future__ import annotations

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
# Periods of the odometry that are no pause, however slow it is.
_PERIODS = 2.5
# A pause up to this long is bridged where the twists before and after differ by no more.
_BRIDGE_MAX_S = 1.5
_UNSURE_M, _UNSURE_RAD = 0.05, 0.1
# Yaw rates are averaged over this long before they are compared with a threshold.
_SMOOTHING_S = 0.3

TURN_SLIDE = 0.05
"""m per rad: how far the wheels slide sideways in a turn on the spot, and turns seem misplaced."""
SEEN_TURN_SLIDE = 0.01
"""m per rad: what remains of it where images show the turns; 0.007 of two real indoor robots. With
more, links are so weak that their maps shrink by 4 %."""

# Columns of the accumulated sums: driven meters, radians turned in either direction, yaw variance,
# and the two parts of the moment of time, the integral of t dp, on which a yaw-rate bias acts.
LENGTH, TURNED, YAW_VARIANCE, MOMENT = 0, 1, 2, slice(3, 5)


@dataclass(frozen=True, slots=True)
class TurnCorrection:
    """What to add to the yaw of a track: `yaw` (N,) rad at stamps (N,), linear between them, and
    the `noise` of the turns that result, rad per square root of s.
    """

    stamps_ns: Stamps
    yaw: Array
    noise: float


class Way(NamedTuple):
    """The way of a drive by that which its wheels counted: `scale` times it, less a `loss`, m per
    radian, in turns, which is known to `loss_std`.
    """

    scale: float = 1.0
    loss: float = 0.0
    loss_std: float = 0.0

    def scaled(self, factor: float) -> Way:
        """The same in meters that are longer by a factor."""
        return Way(*(factor * each for each in self))


@dataclass(frozen=True, slots=True)
class OdometryTrack:
    """Poses at the N odometry stamps, with running sums of what accumulates along the track."""

    stamps_ns: Stamps
    poses: Array
    yaw: Array
    speed: Array
    turn_rate: Array
    part: Indices
    """(N,) number of the unbroken part that each pose is in."""
    sums: Array
    """(N, 5), see the columns above."""
    count: Count
    slide: float = TURN_SLIDE
    """m per rad turned: by how much the places are wrong."""

    @classmethod
    def of(
        cls, odometry: Odometry, config: SegmentConfig, yaw_rate: YawRate | None = None
    ) -> OdometryTrack:
        """From wheel odometry, with the turns of the gyroscope where there is one."""
        stamps, poses, skipped = odometry.stamps_ns, odometry.poses, dict[str, int]()
        if len(stamps) < 2:
            raise DataError('fewer than two usable odometry messages: check the odometry topic')
        twists = _twists(odometry)
        breaks = pauses(odometry)
        tally(skipped, 'pauses', breaks)
        breaks |= np.diff(odometry.part) != 0
        variances, yaw = odometry.variances[:, 1], np.unwrap(poses[:, 2])
        gyro = None if config.yaw_source == 'odometry' else yaw_rate
        if gyro is not None and len(gyro.stamps_ns) > 1:
            turns, variances = _gyro_turns(stamps, yaw, variances, ~breaks, gyro, skipped)
            measured = yaw[0] + summed(turns)
            poses, yaw = _with_yaw(poses, yaw, measured), measured
            twists = np.column_stack([twists[:, 0], np.gradient(yaw, seconds_since_start(stamps))])
        elif config.yaw_source == 'gyro':
            raise DataError('yaw_source is gyro, but there is no yaw rate: name the imu topic')
        sums = _running_sums(stamps, poses, yaw, variances, config.yaw_noise)
        rate = _smoothed(seconds_since_start(stamps), twists[:, 1])
        part = np.concatenate([[0], np.cumsum(breaks)])
        count = Count(len(stamps), skipped)
        return cls(stamps, poses, yaw, np.abs(twists[:, 0]), rate, part, sums, count)

    def corrected(self, turns: TurnCorrection) -> OdometryTrack:
        """The same wheel steps with corrected turns."""
        seconds = seconds_since_start(self.stamps_ns)
        at = (turns.stamps_ns - self.stamps_ns[0]) * 1e-9
        yaw = self.yaw + np.interp(seconds, at, turns.yaw)
        poses = _with_yaw(self.poses, self.yaw, yaw)
        sums = _running_sums(self.stamps_ns, poses, yaw, np.zeros(len(yaw)), turns.noise)
        rate = _smoothed(seconds, np.gradient(yaw, seconds))
        return replace(self, poses=poses, yaw=yaw, turn_rate=rate, sums=sums, slide=SEEN_TURN_SLIDE)

    def driven(self, way: Way) -> OdometryTrack:
        """The same turns with the way that was driven, not that which wheels counted."""
        step = way.scale * self.steps() - way.loss * self.way_per_loss()
        poses = _along(self.poses[0], step, self.poses[:, 2])
        sums, of_way = self.sums.copy(), _sums_of_way(self.stamps_ns, step)
        sums[1:, LENGTH], sums[1:, MOMENT] = of_way[:, 0], of_way[:, 1:]
        return replace(self, poses=poses, sums=sums)

    def mounted(self, lever: complex) -> OdometryTrack:
        """The way of a camera that sits at a `lever`, ahead + i left, m, of base_link."""
        place = self.poses[:, 0] + 1j * self.poses[:, 1] + lever * np.exp(1j * self.poses[:, 2])
        poses, sums = np.column_stack([place.real, place.imag, self.poses[:, 2]]), self.sums.copy()
        sums[1:, MOMENT] = _sums_of_way(self.stamps_ns, np.diff(place))[:, 1:]
        return replace(self, poses=poses, sums=sums)

    def steps(self) -> Complex:
        """Displacements (N - 1,) m between the stamps."""
        return _steps(self.poses)

    def way_per_loss(self) -> Complex:
        """Displacements (N - 1,) m that a loss of 1 m per radian takes from them."""
        step, turned = self.steps(), np.abs(np.diff(self.yaw))
        length = np.abs(step)
        moves = length > SPOT_RADIUS_M * turned
        return np.asarray(np.divide(step * turned, length, out=np.zeros_like(step), where=moves))


def summed(steps: NDArray[Any]) -> NDArray[Any]:
    """Sums (N + 1,) of steps (N,), from 0 on."""
    return np.concatenate([[0.0], np.cumsum(steps)])


def seconds_since_start(stamps_ns: Stamps) -> Array:
    return np.asarray((stamps_ns - stamps_ns[0]) * 1e-9)


def pauses(odometry: Odometry) -> Mask:
    """Mask (N - 1,) of the pauses that odometry does not bridge: it says the same before and after
    short ones. Drivers that repeat a command, or speak only when it changes, pause like that.
    """
    dt = np.diff(odometry.stamps_ns) * 1e-9
    # Odometry that is always slow does not pause at each message.
    gap = dt > max(GAP_MAX_S, _PERIODS * float(np.median(dt)))
    unsure = np.abs(np.diff(_twists(odometry), axis=0)) * dt[:, None]
    alike = (unsure[:, 0] < _UNSURE_M) & (unsure[:, 1] < _UNSURE_RAD)
    return np.asarray(gap & ~(alike & (dt < _BRIDGE_MAX_S)))


def _twists(odometry: Odometry) -> Array:
    """Twists (N, 2); of drivers that publish poses only, those of the poses."""
    if np.any(odometry.twists):
        return odometry.twists
    return differences(odometry.stamps_ns, odometry.poses)


def _gyro_turns(
    stamps: Stamps,
    yaw: Array,
    variances: Array,
    unbroken: Mask,
    gyro: YawRate,
    skipped: dict[str, int],
) -> tuple[Array, Array]:
    """Turns (N - 1,) between the odometry's stamps, and the variances (N,) of their rate.

    The gyroscope's where it has readings all along a step, else the odometry's: less exact, but
    a gyroscope that pauses or ends did not measure the turns since. To the odometry's turns the
    gyroscope's mean offset is added, so that one bias remains for the whole drive.
    """
    seconds, at = (gyro.stamps_ns - stamps[0]) * 1e-9, seconds_since_start(stamps)
    areas = (gyro.omega[1:] + gyro.omega[:-1]) / 2 * np.diff(seconds)
    turns = np.diff(np.interp(at, seconds, summed(areas)))
    wheels, dt = np.diff(yaw), np.diff(at)
    measured = without_pause(stamps[:-1], stamps[1:], gyro.stamps_ns, GAP_MAX_S)
    both = measured & unbroken
    if not both.any():
        tally(skipped, 'without a usable gyroscope', unbroken)
        return wheels, variances
    tally(skipped, 'in a gap of the gyroscope', unbroken & ~measured)
    offset = float((turns - wheels)[both].sum() / dt[both].sum())
    own = np.interp(at, seconds, gyro.variance)
    own = np.where(np.append(measured, measured[-1]), own, variances)
    return np.where(measured, turns, wheels + offset * dt), own


def without_pause(begin: Stamps, end: Stamps, stamps: Stamps, pause_s: float) -> Mask:
    """Mask (M,) of the times from `begin` (M,) to `end` (M,) in which stamps (N,) never pause."""
    before = np.searchsorted(stamps, begin, 'right') - 1
    after = np.searchsorted(stamps, end, 'left')
    inside = (before >= 0) & (after < len(stamps))
    before, after = np.clip([before, after], 0, len(stamps) - 1)
    number = summed(np.diff(stamps) > pause_s * 1e9)
    return np.asarray(inside & (number[before] == number[after]))


def _with_yaw(poses: Array, yaw: Array, measured: Array) -> Array:
    """The same wheel steps driven with another yaw (N,)."""
    middle = (yaw[:-1] + yaw[1:]) / 2
    step = _steps(poses) * np.exp(1j * ((measured[:-1] + measured[1:]) / 2 - middle))
    return _along(poses[0], step, wrap_angle(measured))


def _steps(poses: Array) -> Complex:
    """Displacements (N - 1,) m between poses (N, 3)."""
    return np.diff(poses[:, 0] + 1j * poses[:, 1])


def _along(start: Array, step: Complex, yaw: Array) -> Array:
    """Poses (N, 3) from the place of a `start` (3,) by displacements (N - 1,) m, with yaw (N,)."""
    place = start[0] + 1j * start[1] + summed(step)
    return np.column_stack([place.real, place.imag, yaw])


def _sums_of_way(stamps: Stamps, step: Complex) -> Array:
    """Running sums (N - 1, 3) of displacements (N - 1,) m: LENGTH and the two parts of MOMENT."""
    t = seconds_since_start(stamps)
    moment = step * (t[1:] + t[:-1]) / 2
    return np.cumsum(np.column_stack([np.abs(step), moment.real, moment.imag]), axis=0)


def _running_sums(
    stamps: Stamps, poses: Array, yaw: Array, variances: Array, yaw_noise: float
) -> Array:
    """Running sums (N, 5); `yaw_noise` (rad per square root of s) where variances (N,) are 0."""
    dt = np.diff(seconds_since_start(stamps))
    stated = variances[:-1] * dt**2
    noise = np.where(stated > 0, stated, yaw_noise**2 * dt)
    sums, of_way = np.zeros((len(stamps), 5)), _sums_of_way(stamps, _steps(poses))
    sums[1:, LENGTH], sums[1:, MOMENT] = of_way[:, 0], of_way[:, 1:]
    sums[1:, TURNED], sums[1:, YAW_VARIANCE] = np.cumsum(np.abs(np.diff(yaw))), np.cumsum(noise)
    return sums


def _smoothed(seconds: Array, rates: Array) -> Array:
    """Moving average over a fixed time, by the running integral."""
    total = summed((rates[1:] + rates[:-1]) / 2 * np.diff(seconds))
    low = np.clip(seconds - _SMOOTHING_S / 2, seconds[0], seconds[-1])
    high = np.clip(seconds + _SMOOTHING_S / 2, seconds[0], seconds[-1])
    area = np.interp(high, seconds, total) - np.interp(low, seconds, total)
    return np.asarray(area / np.maximum(high - low, 1e-9))


def tally(skipped: dict[str, int], reason: str, mask: Mask) -> None:
    """Count the entries that were not used for a reason."""
    if mask.any():
        skipped[reason] = skipped.get(reason, 0) + int(mask.sum())
