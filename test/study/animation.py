# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Film the three nodes while a robot drives, is kidnapped and finds itself again: FILE.webp.

PYTHONPATH=.:test python -m study.animation resource/kidnapped.webp
"""

import argparse
import dataclasses
import math
from pathlib import Path

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from robustness.__main__ import live
from robustness.faults import FAULTS, FROM_S
from robustness.messages import Picture
from robustness.recorded import to_truth, two_laps

START_S, STOP_S = 6.0, 26.0
"""Seconds of the drive that are shown; it is kidnapped at FROM_S."""
STEP_S, PACE = 0.25, 2.0
"""Seconds of the drive between two frames, and how many pass in a second of the film."""
SIGMAS = math.sqrt(5.991)  # of the ellipse that holds 95 %
CARRIED_SHOWN_S = 2.0
TRAIL = 24
COLORS = {'UNINITIALISED': '0.4', 'LOCALISED': '#1e8c3c', 'DEGRADED': '#dc8200', 'LOST': '#d22828'}
BLUE, GRAY = '#0072b2', '0.35'


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
    from robustness.live import Chain, heard

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

    return heard(Camera, messages, start_ns).shots


def in_truth(message):
    """Pose (3,) and covariance (2, 2) of an odometry message, turned into the truth's frame."""
    from sfa_localization.data.geometry import compose, rotation
    from sfa_localization.nodes.conversions import read_odometry

    transform, pose = to_truth(), np.array(read_odometry(message)[2])
    turn = rotation(transform.yaw_rad)
    spread = np.reshape(message.pose.covariance, (6, 6))[:2, :2]
    return compose(transform.pose, pose), turn @ spread @ turn.T


def draw(figure, path, shots, k):
    """Shot k: the panorama above a map with all of the true path (N, 2) m and a trail."""
    shot, trail = shots[k], np.array([s.pose for s in shots[max(k - TRAIL, 0) : k + 1]])
    figure.clear()
    above, below = figure.subplots(2, 1, height_ratios=(72, 400))
    above.imshow(shot.panorama[..., ::-1], aspect='auto')
    above.set_axis_off()
    below.set_axis_off()
    below.set_aspect('equal')
    below.plot(*path.T, color='0.85', lw=3)
    below.plot(*trail[:, :2].T, '.', color=BLUE, ms=3)
    draw_robot(below, shot.true, GRAY, 10)
    draw_robot(below, shot.pose, BLUE, 6)
    values, vectors = np.linalg.eigh(shot.spread)
    width, height = 2 * SIGMAS * np.sqrt(values[::-1])
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    below.add_patch(Ellipse(shot.pose[:2], width, height, angle=angle, fill=False, color=BLUE))
    error = math.hypot(*(shot.pose - shot.true)[:2])
    figure.text(0.02, 0.77, shot.level, color=COLORS[shot.level], size='x-large')
    figure.text(0.02, 0.72, f'error {error:.2f} m', color=GRAY)
    legend = 'gray: true robot   blue: estimate, 95 %   rendered, 2 x real time'
    figure.text(0.02, 0.02, legend, color=GRAY)
    if 0 <= shot.second - FROM_S < CARRIED_SHOWN_S:
        figure.text(0.8, 0.77, 'kidnapped!', color=COLORS['LOST'], size='x-large')


def draw_robot(axes, pose, color, size):
    """A circle with its heading; a small one is filled."""
    ahead = pose[:2] + 0.35 * np.array([math.cos(pose[2]), math.sin(pose[2])])
    axes.plot(*np.stack([pose[:2], ahead]).T, color=color, lw=2)
    axes.plot(*pose[:2], 'o', color=color, ms=size, mfc='none' if size > 6 else color)


def film(output, figure, draw, count, rate_hz):
    """Write an animated WebP that begins anew; `draw` draws a frame by its number."""
    frames = FuncAnimation(figure, lambda k: draw(figure, k), count)
    frames.save(output, PillowWriter(rate_hz))


def main():
    """Film, and write the file."""
    parser = argparse.ArgumentParser(prog='animation', description=__doc__)
    parser.add_argument('output', type=Path, metavar='FILE.webp')
    arguments = parser.parse_args()
    world = two_laps()
    shots = filmed(FAULTS['kidnapped'].messages(world), world.times_ns[0])
    figure = Figure((7.2, 4.72), layout='constrained')
    path = world.true[:, :2]
    rate_hz = PACE / STEP_S
    film(
        arguments.output,
        figure,
        lambda figure, k: draw(figure, path, shots, k),
        len(shots),
        rate_hz,
    )


if __name__ == '__main__':
    main()
