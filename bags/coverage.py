# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Draw good and bad drives over one lawn, as `inspect` judges them: `python bags/coverage.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sfa_localization.data.geometry import Array
from sfa_localization.inspection import (
    MIN_COVERED,
    MIN_DIRECTIONS,
    InspectionConfig,
    covered_share,
    directions,
    hull_area,
    path_length,
)
from sfa_localization.simulation.routes import Lawn, coverage

HALF = np.array([8.0, 9.0])
SPACING_M = 0.2
GOOD, BAD = '#009E73', '#D55E00'


def along(corners: Array) -> Array:
    """Places (N, 2) every 0.2 m along straight legs between corners (M, 2)."""
    reached = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    at = np.arange(0.0, reached[-1], SPACING_M)
    return np.stack([np.interp(at, reached, corners[:, axis]) for axis in (0, 1)], -1)


def criss_cross() -> Array:
    """The simulator's coverage drive, (N, 2)."""
    start = np.array([-6.0, -8.0, 0.0])
    x, y, heading = start
    corners = [(x, y)]
    for motion in coverage(Lawn(HALF, np.empty((0, 3))), start, np.random.default_rng(4)):
        for distance, turn in motion.steps:
            heading += turn
            x, y = x + distance * np.cos(heading), y + distance * np.sin(heading)
            corners.append((x, y))
    return along(np.array(corners))


def lanes(count: int, axis: int = 0) -> Array:
    """Corners of parallel lanes, driven to and fro, (2 count, 2)."""
    offsets = np.repeat(np.linspace(-0.95, 0.95, count), 2)
    ends = np.tile([-0.95, 0.95, 0.95, -0.95], count)[: 2 * count]
    corners = np.stack([ends, offsets] if axis == 0 else [offsets, ends], -1)
    return corners * HALF


def diagonals(count: int) -> Array:
    """Corners of lanes at 45 degrees, (2 count, 2)."""
    turned = lanes(count) @ np.array([[1.0, 1.0], [-1.0, 1.0]]) / 2
    return np.clip(turned, -0.95 * HALF, 0.95 * HALF)


def loop() -> Array:
    """Once around, with rounded corners, (N, 2)."""
    angle = np.linspace(0, 2 * np.pi, 200)
    unit = np.stack([np.cos(angle), np.sin(angle)], -1)
    return along(np.sign(unit) * np.sqrt(np.abs(unit)) * 0.9 * HALF)


def wander() -> Array:
    """A curve that crosses itself often, (N, 2)."""
    time = np.linspace(0, 2 * np.pi, 3000)
    x = 0.62 * np.sin(7 * time) + 0.33 * np.sin(3 * time + 1)
    y = 0.62 * np.cos(5 * time + 0.5) + 0.33 * np.sin(8 * time)
    return along(np.stack([x, y], -1) * HALF)


DRIVES = {
    'straight legs that criss-cross': criss_cross(),
    'lanes along, across and diagonal': np.concatenate(
        [along(lanes(6)), along(-lanes(6, 1)[::-1]), along(diagonals(6))]
    ),
    'wandering that crosses itself': wander(),
    'once around': loop(),
    'lanes one way only': along(lanes(10)),
    'along and across only, wide apart': np.concatenate(
        [along(lanes(3)), along(lanes(3, 1)[::-1])]
    ),
}


def draw(axes: Axes, title: str, places: Array) -> None:
    """One drive (N, 2), the ground it covers, and whether it is enough."""
    share, number = covered_share(places, InspectionConfig().reach), directions(places)
    enough = share >= MIN_COVERED and number >= MIN_DIRECTIONS
    axes.add_patch(Rectangle(tuple(-HALF), *(2 * HALF), fill=False, color='0.4'))
    axes.plot(*places.T, linewidth=26, color='0.9', solid_joinstyle='round', zorder=0)
    axes.plot(*places.T, linewidth=1.3, color=GOOD if enough else BAD)
    axes.set(aspect='equal', xlim=(-9, 9), ylim=(-10, 10), xticks=[], yticks=[])
    axes.set_title(f'{"good" if enough else "bad"}: {title}', color=GOOD if enough else BAD)
    covered = f'{path_length(places):.0f} m over {hull_area(places):.0f} m², {share:.0%} covered'
    axes.set_xlabel(f'{covered}, {number} of 6 directions')


def main() -> None:
    """Write coverage.png beside this file."""
    figure = Figure((12, 8.8), layout='constrained')
    for axes, (title, places) in zip(figure.subplots(2, 3).flat, DRIVES.items(), strict=True):
        draw(axes, title, places)
    FigureCanvasAgg(figure)
    figure.savefig(Path(__file__).with_suffix('.png'), dpi=80, metadata={'Software': None})


if __name__ == '__main__':
    main()
