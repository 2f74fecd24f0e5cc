# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Drives through a world whose slow features are known functions of the place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from places import distances

from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import Odometry, Stamps, Trajectory, YawRate, integrate
from sfa_localization.keyframes.offsets import Offsets
from sfa_localization.metric.segments import cut
from sfa_localization.motion.settings import SegmentConfig

RATE = 50
STEP_NS = 1_000_000_000 // RATE


@dataclass
class DriveWithTruth:
    """What a robot records, and where it was: `poses` (N, 3) at the pictures."""

    odometry: Odometry
    stamps_ns: Stamps
    poses: np.ndarray
    gyro: YawRate

    def segments(self, config=None, gyro=None):
        """The segments of the odometry."""
        return cut(self.odometry, self.stamps_ns, config or SegmentConfig(), gyro)


def drive(twists, start=(0.0, 0.0, 0.0), *, bias=0.0, yaw_noise=0.0, speed_noise=0.0, seed=0):
    """Drive twists (T, 2) at 50 Hz; odometry adds a yaw-rate bias and white noise. 5 pictures/s."""
    rng = np.random.default_rng(seed)
    twists = np.asarray(twists, float)
    stamps = 1_000_000_000 + STEP_NS * np.arange(len(twists) + 1)
    held = np.vstack([np.zeros((1, 2)), twists])
    truth = integrate(stamps, held, np.array(start))
    measured = held * (1 + speed_noise * rng.standard_normal((len(held), 1)) * [1, 0])
    measured[:, 1] += bias + yaw_noise * rng.standard_normal(len(held))
    poses = integrate(stamps, measured)
    odometry = Odometry(stamps, poses, measured, np.zeros((len(stamps), 2)))
    # The rate between two stamps, as the trapezoid of the rates at both would have it.
    omega = np.interp(np.arange(len(held)), np.arange(len(held) - 1) + 0.5, measured[1:, 1])
    gyro = YawRate(stamps, omega, np.zeros(len(stamps)))
    pictures = stamps[::10]
    return DriveWithTruth(odometry, pictures, Trajectory(stamps, truth).at(pictures), gyro)


def straight(length, speed=1.0):
    """Twists of a straight line."""
    steps = round(abs(length / speed) * RATE)
    return np.tile([length / steps * RATE, 0.0], (steps, 1))


def turn(angle, rate=0.6):
    """Twists of a turn on the spot."""
    steps = max(round(abs(angle) / rate * RATE), 1)
    return np.tile([0.0, angle / steps * RATE], (steps, 1))


def stand(seconds):
    return np.zeros((round(seconds * RATE), 2))


def criss_cross(lines, half=(8.0, 9.0), seed=0, shortest=8.0):
    """Twists from corner point to corner point of a garden, turning on the spot; start pose."""
    rng = np.random.default_rng(seed)
    place, yaw = rng.uniform(-1, 1, 2) * half, 0.0
    start, parts = (*place, yaw), []
    for _ in range(lines):
        goal = rng.uniform(-1, 1, 2) * half
        while np.hypot(*(goal - place)) < shortest:
            goal = rng.uniform(-1, 1, 2) * half
        direction = np.arctan2(*(goal - place)[::-1])
        angle = (direction - yaw + np.pi) % (2 * np.pi) - np.pi
        parts += [turn(angle), straight(np.hypot(*(goal - place)))]
        place, yaw = goal, direction
    return np.vstack(parts), start


def lanes(length, gap, count, first=1):
    """Twists of parallel lanes to and fro, `gap` apart, the first turn to the left, or right
    (-1)."""
    parts = []
    for k in range(count):
        side = first * (-1) ** k * np.pi / 2
        parts += [straight(length), turn(side), straight(gap), turn(side)]
    return np.vstack(parts)


def grid(length, gap, count):
    """Twists of a mower's square: an odd number of lanes along x, then as many across them."""
    return np.vstack([lanes(length, gap, count), turn(np.pi / 2), lanes(length, gap, count, -1)])


def meander(length, half=(8.0, 9.0), seed=0, speed=1.0):
    """Twists of a curved drive that stays in the garden, never straight; start pose."""
    rng = np.random.default_rng(seed)
    place, yaw, rate, twists = np.zeros(2), 0.0, 0.0, []
    for _ in range(round(length / speed * RATE)):
        rate += -rate / RATE + 0.5 * rng.standard_normal() / np.sqrt(RATE)
        home = (np.arctan2(*-place[::-1]) - yaw + np.pi) % (2 * np.pi) - np.pi
        outside = np.abs(place / half).max() > 0.85
        omega = 0.8 * np.sign(home) if outside and abs(home) > 0.5 else rate
        twists.append((speed, omega))
        middle = yaw + omega / RATE / 2
        place = place + speed / RATE * np.array([np.cos(middle), np.sin(middle)])
        yaw += omega / RATE
    return np.array(twists), (0.0, 0.0, 0.0)


def exact_features(places):
    """Slow features whose second-degree monomials hold the place exactly: (N, 5)."""
    x, y = places[:, 0] / 8, places[:, 1] / 9
    return np.column_stack(
        [x + 0.3 * y**2, y, np.sin(2 * x + y), np.cos(x - 2 * y), np.sin(3 * x) * np.cos(2 * y)]
    )


def garden_features(poses, *, noise=0.0, count=12, seed=0, world=0):
    """Smooth random functions of the place of poses (N, 3), the slowest first, with noise: (N,
    count)."""
    rng, places = np.random.default_rng(world), poses[:, :2]
    waves = rng.standard_normal((count, 3, 2)) * np.linspace(0.08, 0.35, count)[:, None, None]
    phases = rng.uniform(0, 2 * np.pi, (count, 3))
    values = np.cos(np.einsum('nd,kwd->nkw', places, waves) + phases).sum(2)
    x = np.cos(np.pi * (places / [8.0, 9.0] + 1) / 2)
    values[:, :2] += 3 * x
    return values + noise * np.random.default_rng(seed).standard_normal(values.shape)


def mixtures(stack, poses, noise_m=0.0, count=400, seed=0, lasting=False):
    """Offsets of images among six others within 1.5 m, whose places explain theirs; `lasting`
    errors fade within 1 m along the drive. Turns err by 0.1 rad per meter of these."""
    rng, rows = np.random.default_rng(seed), []
    errors = noise_m * rng.standard_normal((len(stack.images), 2))
    fades = np.exp(-stack.steps) if lasting else np.zeros(len(errors))
    for row, part in enumerate(fades[1:], 1):
        errors[row] = part * errors[row - 1] + np.sqrt(1 - part**2) * errors[row]
    places = poses[stack.images]
    for row in rng.permutation(len(places))[:count]:
        distance = distances(places, places[row])
        near = np.flatnonzero((distance < 1.5) & (np.abs(stack.owner - stack.owner[row]) > 1))
        if len(near) >= 12:
            near = rng.permutation(near)[:6]
            design = np.column_stack([places[near, :2], np.ones(6)]).T
            wanted = np.append(places[row, :2] + errors[row], 1.0)
            shares = np.linalg.lstsq(design, wanted, rcond=0.02)[0]
            turn = wrap_angle(places[row, 2] - places[near, 2] + 0.1 * errors[row, 0])
            if np.allclose(design @ shares, wanted):  # not where they lie on a line
                rows.append((stack.images[row], stack.images[near], shares, turn, 0.1))
    return Offsets(*map(np.array, zip(*rows, strict=True)))
