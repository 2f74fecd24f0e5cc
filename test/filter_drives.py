# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated drives for the filter's tests: a true path, odometry and images with given errors."""

import math
from dataclasses import dataclass

import numpy as np

from sfa_localization.data.geometry import compose, wrap_angle
from sfa_localization.data.run import integrate
from sfa_localization.fusion.motion import TURN_RADIUS_M
from sfa_localization.fusion.pose_filter import PoseFilter

SECOND, START_NS = 1_000_000_000, 1_700_000_000_000_000_000
NOISY = {
    'v_std': 0.02, 'omega_std': 0.01, 'position_std': 0.2, 'yaw_std': 0.05, 'share': 0.7,
    'bias': 0.002, 'scale': 1.01,
}  # fmt: skip


def started(pose=(0.0, 0.0, 0.0), std=0.05, **how):
    """A filter that was told where it starts."""
    fused = PoseFilter(**how)
    fused.set_pose(START_NS, pose, std**2 * np.eye(3))
    return fused


def fed(fused, drive, events=None, heading=True):
    """The filter after a drive, or after its events in this order."""
    for event in drive.events() if events is None else events:
        drive.give(fused, event, heading)
    return fused


def snapshot(fused):
    state = fused.state
    return state.stamp_ns, state.mean.tolist(), state.covariance.tolist()


def seconds_of(event):
    """Of the drive."""
    return (event[0] - START_NS) * 1e-9


def stamps(count, rate_hz, start_ns=START_NS):
    return start_ns + np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)


def winding(seconds, rate_hz=50.0, speed=1.0, turn=0.5):
    """True twists (N, 2): constant speed, a turn rate that swings slowly."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    return np.stack([np.full_like(t, speed), turn * np.sin(0.7 * t)], 1)


def from_rest(twists, rate_hz=50.0, standing_s=0.6, faster_s=0.4):
    """Twists (N, 2) of a robot that stands at first, and drives as told when it is up to speed."""
    t = np.arange(len(twists)) / rate_hz
    return twists * np.clip((t - standing_s) / faster_s, 0.0, 1.0)[:, None]


def lasting(rng, fades, size):
    """Unit errors (N, size), each of which correlates with that before it by its factor (N,)."""
    errors = rng.standard_normal((len(fades), size))
    for k, fade in enumerate(fades[1:], 1):
        errors[k] = fade * errors[k - 1] + math.sqrt(1 - fade**2) * errors[k]
    return errors


@dataclass
class FilterDrive:
    """A drive to be fed to a filter: odometry in order, an image every `every` samples with the
    covariance of its errors, or of `claimed_m`.
    """

    seconds: float = 30.0
    rate_hz: float = 50.0
    every: int = 5
    start: tuple = (0.0, 0.0, 0.0)
    twists: np.ndarray | None = None
    v_std: float = 0.0
    omega_std: float = 0.0
    position_std: float = 0.0
    yaw_std: float = 0.0
    bias: float = 0.0
    scale: float = 1.0
    share: float = 0.0
    length: float = 0.6
    claimed_m: float | None = None
    seed: int = 0

    def __post_init__(self):
        if self.twists is None:
            self.twists = winding(self.seconds, self.rate_hz)
        rng, count = np.random.default_rng(self.seed), len(self.twists)
        self.stamps_ns = stamps(count, self.rate_hz)
        self.read, self.poses = self._driven(rng)
        # The robot was switched on somewhere else, and its odometry's pose drifts as its twist.
        elsewhere = np.random.default_rng([self.seed, 1])
        switched_on = np.array([*elsewhere.uniform(-20, 20, 2), elsewhere.uniform(-3, 3)])
        self.reckoned = integrate(self.stamps_ns, self.read, switched_on)
        self.pictures = np.arange(self.every, count, self.every)
        moved = np.cumsum(np.abs(self.twists) @ [1, TURN_RADIUS_M])[self.pictures] / self.rate_hz
        shared = lasting(rng, np.exp(-np.diff(moved, prepend=0) / self.length), 3)
        white = rng.standard_normal(shared.shape)
        errors = math.sqrt(self.share) * shared + math.sqrt(1 - self.share) * white
        self.seen = self.poses[self.pictures]
        self.seen += errors * [self.position_std, self.position_std, self.yaw_std]
        self.seen[:, 2] = wrap_angle(self.seen[:, 2])

    def _driven(self, rng):
        """Twists as they are read, and true poses; each twist was held since the stamp before."""
        noise = rng.standard_normal(self.twists.shape) * [self.v_std, self.omega_std]
        read = self.twists / [self.scale, 1.0] + [0.0, self.bias] + noise
        return read, integrate(self.stamps_ns, self.twists, np.array(self.start, float))

    def kidnap(self, picture, shift):
        """From this picture on, the robot drives the same way elsewhere: shift is (x, y, yaw)."""
        for poses, first in ((self.poses, self.pictures[picture]), (self.seen, picture)):
            poses[first:] = compose(np.array(shift), poses[first:])

    def covariance(self, heading):
        position, yaw = max(self.position_std, 0.05), max(self.yaw_std, 0.02)
        if self.claimed_m is not None:
            position, yaw = self.claimed_m, self.claimed_m / 10
        return np.diag(np.square([position, position, yaw][: 3 if heading else 2]))

    def events(self, start=0, stop=math.inf):
        """(stamp, kind, index) in order, of seconds [start, stop); odometry before the picture of
        the same stamp.
        """
        listed = [(s, 0, i) for i, s in enumerate(self.stamps_ns.tolist())]
        listed += [(s, 1, k) for k, s in enumerate(self.stamps_ns[self.pictures].tolist())]
        return sorted(each for each in listed if start <= seconds_of(each) < stop)

    def give(self, fused, event, heading=False):
        stamp_ns, kind, index = event
        if kind == 0:
            return fused.add_odometry(stamp_ns, *self.read[index], self.variances())
        value = self.seen[index] if heading else self.seen[index, :2]
        return fused.add_measurement(stamp_ns, value, self.covariance(heading))

    def give_turned(self, fused, stamp_ns, picture):
        """Tell how far images have turned by a picture, as stamped."""
        fused.add_turned(stamp_ns, float(self.poses[self.pictures[picture], 2]))

    def variances(self):
        return max(self.v_std, 1e-6) ** 2, max(self.omega_std, 1e-6) ** 2

    def feed(self, fused, heading=False, start=0, stop=math.inf, pictures=True):
        """Feed seconds [start, stop); per picture: (index, update, error, yaw error)."""
        outcomes = []
        for event in self.events(start, stop):
            if not event[1]:
                self.give(fused, event)
            elif pictures:
                update = self.give(fused, event, heading)
                outcomes.append((event[2], update, *self.error(fused, self.pictures[event[2]])))
        return outcomes

    def error(self, fused, sample):
        """Distance and heading error against the truth at a sample; NaN without a state."""
        if fused.state is None:
            return math.nan, math.nan
        miss = fused.state.pose - self.poses[sample]
        return math.hypot(miss[0], miss[1]), float(wrap_angle(miss[2]))
