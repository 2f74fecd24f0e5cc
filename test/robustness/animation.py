# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Film the three nodes while a robot drives, is kidnapped and finds itself again: FILE.webp.

PYTHONPATH=.:test python -m robustness.animation resource/kidnapped.webp
"""

import argparse
import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from robustness.__main__ import live
from robustness.faults import FAULTS, FROM_S, Picture
from robustness.recorded import to_truth, two_laps

START_S, STOP_S = 6.0, 26.0
"""Seconds of the drive that are shown; it is kidnapped at FROM_S."""
STEP_S, PACE = 0.25, 2.0
"""Seconds of the drive between two frames, and how many pass in a second of the film."""
WIDTH, STRIP, MAP = 720, 72, 400
"""Columns, and rows of the panorama and of the map, in pixels."""
MARGIN_M = 0.7
QUALITY = 70
"""Of WebP: without visible artifacts the file stays below 1 MB."""
SIGMAS = math.sqrt(5.991)  # of the ellipse that holds 95 %
CARRIED_SHOWN_S = 2.0
COLORS = {'UNINITIALISED': (110, 110, 110), 'LOCALISED': (60, 140, 30), 'DEGRADED': (0, 130, 220),
          'LOST': (40, 40, 210)}  # fmt: skip
BLUE, GRAY, PALE = (178, 114, 0), (90, 90, 90), (215, 215, 215)


@dataclasses.dataclass(frozen=True, slots=True)
class Shot:
    """What is known at a second: true and estimated pose (3,) in the truth's frame, its spread."""

    second: float
    true: np.ndarray
    pose: np.ndarray
    spread: np.ndarray
    level: str
    panorama: np.ndarray


def filmed(messages, start_ns):
    """A shot each STEP_S of what the nodes publish; live, as the tests of robustness run them."""
    live()
    from robustness.live import DOMAIN, Chain

    class Camera(Chain):
        panorama, shots = None, []

        def take(self, message):
            if isinstance(message.content, Picture):
                self.panorama = message.content.image
            super().take(message)

        def note(self, message, ekf):
            second = (message.at_ns - start_ns) * 1e-9
            due = not self.shots or second >= self.shots[-1].second + STEP_S
            if not (due and START_S <= second < STOP_S and self.last and self.panorama is not None):
                return
            pose, spread = in_truth(self.last)
            level = ekf.status().level.name
            self.shots.append(Shot(second, message.true, pose, spread, level, self.panorama))

    to_truth()
    chain = Camera(DOMAIN, start_ns)
    try:
        for message in messages:
            chain.take(message)
        return chain.shots
    finally:
        chain.bench.close()


def in_truth(message):
    """Pose (3,) and covariance (2, 2) of an odometry message, turned into the truth's frame."""
    from sfa_localization.data.geometry import rotation
    from sfa_localization.nodes.conversions import read_odometry

    transform, pose = to_truth(), read_odometry(message).pose
    turn = rotation(transform.yaw_rad)
    spread = np.reshape(message.pose.covariance, (6, 6))[:2, :2]
    yaw = float(transform.apply_yaw(pose[2]))
    return np.append(transform.apply(pose[None, :2])[0], yaw), turn @ spread @ turn.T


class Stage:
    """Draws shots; `path` (N, 2) m is all of the true path."""

    def __init__(self, path):
        low, high = path.min(0) - MARGIN_M, path.max(0) + MARGIN_M
        self.scale = min(WIDTH / (high - low)[0], MAP / (high - low)[1])
        self.center = (low + high) / 2
        self.path = path

    def at(self, place):
        """Pixel (column, row) of a place (2,) m, in sixteenths, for smooth lines."""
        x, y = (np.asarray(place) - self.center) * self.scale
        return round(16 * (WIDTH / 2 + x)), round(16 * (STRIP + MAP / 2 - y))

    def frame(self, shots, k):
        """Shot k as an image (STRIP + MAP, WIDTH, 3), with a trail of those before."""
        shot = shots[k]
        canvas = np.full((STRIP + MAP, WIDTH, 3), 255, np.uint8)
        canvas[:STRIP] = cv2.resize(shot.panorama, (WIDTH, STRIP), interpolation=cv2.INTER_LINEAR)
        points = np.array([self.at(place) for place in self.path], np.int32)
        cv2.polylines(canvas, [points], False, PALE, 3, cv2.LINE_AA, 4)
        for one in shots[max(k - 24, 0) : k]:
            cv2.circle(canvas, self.at(one.pose[:2]), 2 * 16, BLUE, -1, cv2.LINE_AA, 4)
        self.robot(canvas, shot.true, GRAY, 2)
        self.ellipse(canvas, shot)
        self.robot(canvas, shot.pose, BLUE, -1)
        self.words(canvas, shot)
        return canvas

    def robot(self, canvas, pose, color, thickness):
        center = self.at(pose[:2])
        ahead = self.at(pose[:2] + 0.35 * np.array([math.cos(pose[2]), math.sin(pose[2])]))
        cv2.line(canvas, center, ahead, color, 2, cv2.LINE_AA, 4)
        cv2.circle(
            canvas, center, (7 if thickness > 0 else 4) * 16, color, thickness, cv2.LINE_AA, 4
        )

    def ellipse(self, canvas, shot):
        values, vectors = np.linalg.eigh(shot.spread)
        axes = [max(round(16 * SIGMAS * math.sqrt(v) * self.scale), 1) for v in values[::-1]]
        angle = -math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
        center = self.at(shot.pose[:2])
        cv2.ellipse(canvas, center, tuple(axes), angle, 0, 360, BLUE, 1, cv2.LINE_AA, 4)

    def words(self, canvas, shot):
        font, smooth = cv2.FONT_HERSHEY_SIMPLEX, cv2.LINE_AA
        bottom = STRIP + MAP - 14
        error = math.hypot(*(shot.pose - shot.true)[:2])
        cv2.putText(canvas, shot.level, (14, STRIP + 30), font, 0.8, COLORS[shot.level], 2, smooth)
        text = f'error {error:.2f} m'
        cv2.putText(canvas, text, (14, STRIP + 56), font, 0.5, GRAY, 1, smooth)
        legend = 'gray: true robot   blue: estimate, 95 %   rendered, 2 x real time'
        cv2.putText(canvas, legend, (14, bottom), font, 0.45, GRAY, 1, smooth)
        if 0 <= shot.second - FROM_S < CARRIED_SHOWN_S:
            where = (WIDTH - 150, STRIP + 30)
            cv2.putText(canvas, 'kidnapped!', where, font, 0.7, COLORS['LOST'], 2, smooth)


def write(path, frames):
    """Write frames as an animated WebP that begins anew."""
    images = [Image.fromarray(frame[..., ::-1]) for frame in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    images[0].save(path, save_all=True, append_images=images[1:], loop=0, quality=QUALITY,
                   duration=round(1000 * STEP_S / PACE))  # fmt: skip


def main():
    """Film, and write the file."""
    parser = argparse.ArgumentParser(prog='animation', description=__doc__)
    parser.add_argument('output', type=Path, metavar='FILE.webp')
    arguments = parser.parse_args()
    world = two_laps()
    shots = filmed(FAULTS['kidnapped'].messages(world), world.times_ns[0])
    stage = Stage(world.true[:, :2])
    write(arguments.output, [stage.frame(shots, k) for k in range(len(shots))])


if __name__ == '__main__':
    main()
