# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Functions for the figures of all reports: files, axes, contact sheets, worst images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.spines import Spine
from matplotlib.text import Text

from sfa_localization.data.files import atomic_write, write_bytes
from sfa_localization.data.geometry import Array
from sfa_localization.data.rejections import encodable
from sfa_localization.data.run import Image

FIRING_MAPS = 8
"""Firing maps in a figure, those of the slowest features."""
FEATURE_LIMIT = 2.0
"""Value at which the colors saturate; slow features have unit variance."""
FIRING_CAPTION = 'Slow features at the places of the images: good ones change smoothly'
MARGIN_M = 0.5
"""Margin around places in firing maps (m)."""
SQUARE = 5.4, 4.6
"""Inches of a map: its text of 10 points is 10 pixels high on a phone of 390 pixels."""
DOTS_PER_INCH = 130
"""Resolution of the figures: sharp on a screen, in small files."""
_INK = '#7c7c7c'
"""Of texts and axes: its contrast is 4.2 both on the white pages and on the dark ones."""


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG without a background, for light and dark pages, completely or not at
    all. Raises LocalizationError.
    """
    for kind in (Text, Spine):
        for part in figure.findobj(kind):
            part.set(color=_INK)
    for axes in figure.axes:
        axes.tick_params(color=_INK)
    for legend in figure.findobj(Legend):
        legend.set_frame_on(False)
    with atomic_write(path) as file:
        figure.savefig(file, dpi=DOTS_PER_INCH, format='png', transparent=True)


def save_text(path: Path, text: str) -> None:
    """Write a text file, completely or not at all. Raises LocalizationError."""
    write_bytes(path, encodable(text).encode())


def as_title(text: str) -> str:
    """A text for matplotlib, in which a dollar does not start a formula."""
    return encodable(text).replace('$', r'\$')


def in_meters(axes: Axes, title: str, frame: str = '') -> None:
    """Equal axes x and y in meters, with the name of a frame if needed."""
    axes.set_aspect('equal', adjustable='datalim')
    axes.set(xlabel=f'x{frame} (m)', ylabel=f'y{frame} (m)')
    axes.set_title(as_title(title), fontsize=10)
    axes.grid(alpha=0.3)


class WorstImage(NamedTuple):
    """Where an image was taken (x, y in m), its error (m), and its row among all images."""

    x_m: float
    y_m: float
    error_m: float
    row: int


def worst_images(
    places: Array, errors: Array, count: int = 6, distance_m: float = 1.0
) -> list[WorstImage]:
    """The images at places (M, 2) m with the largest errors (M,) m, `distance_m` or more from each
    other.
    """
    rest = np.ones(len(errors), bool)
    worst = list[WorstImage]()
    while rest.any() and len(worst) < count:
        row = int(np.argmax(np.where(rest, errors, -np.inf)))
        x, y = places[row].tolist()
        worst.append(WorstImage(x, y, float(errors[row]), row))
        rest &= np.hypot(*(places - places[row]).T) >= distance_m
    return worst


def write_worst_images(path: Path, samples: Mapping[WorstImage, Image]) -> None:
    """Write the worst images as one PNG. Raises LocalizationError."""
    captions = [f'x {k.x_m:.1f} m, y {k.y_m:.1f} m: error {k.error_m:.2f} m' for k in samples]
    write_contact_sheet([*samples.values()], path, captions)


def write_contact_sheet(samples: Sequence[Image], path: Path, captions: Sequence[str] = ()) -> None:
    """Write BGR images (H, W, 3) as one PNG, in reading order, each below its caption.

    Raises LocalizationError.
    """
    height, width = samples[0].shape[:2]
    columns = max(1, round(np.sqrt(len(samples) * height / width)))
    rows = -(-len(samples) // columns)
    # Captions are legible on a phone.
    across = SQUARE[0] if captions else 10
    row = across / columns * height / width + (0.3 if captions else 0.1)
    figure = Figure((across, rows * row), layout='constrained')
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for axis in axes:
        axis.set_axis_off()
    for axis, sample, caption in zip(axes, samples, captions or [''] * len(samples), strict=False):
        axis.imshow(sample[..., ::-1], interpolation='lanczos')
        axis.set_title(caption, fontsize=10)
    save(figure, path)


def firing_maps_figure(path: Path, positions: Array, features: Array) -> None:
    """Draw the spatial firing maps of the first 8 slow features: their value at every place.

    `positions` (N, 2) of the images in meters; `features` (N, K).
    """
    figure = Figure(figsize=(12.0, 6.2), layout='compressed')
    grid = figure.subplots(2, FIRING_MAPS // 2, sharex=True, sharey=True, squeeze=False)
    panels = list(grid.flat)
    # Dots of a panel touch one another: their area in square points.
    inches = figure.bbox.width * figure.bbox.height / figure.dpi**2
    size = np.clip(0.6 * inches * 72**2 / len(panels) / max(len(positions), 1), 2.0, 40.0)
    dots: PathCollection | None = None
    for index, axes in enumerate(panels):
        if index >= features.shape[1]:
            axes.set_axis_off()
            continue
        dots = axes.scatter(
            positions[:, 0], positions[:, 1], c=features[:, index], s=size, linewidths=0,
            cmap='RdBu_r', vmin=-FEATURE_LIMIT, vmax=FEATURE_LIMIT,
        )  # fmt: skip
        _frame_view(axes, positions)
        axes.set_title(f'slow feature {index + 1}', fontsize='medium')
        axes.label_outer()
    if dots is not None:
        bar = figure.colorbar(dots, ax=panels, shrink=0.7, aspect=14, extend='both')
        bar.set_label('standard deviations', fontsize='small')
    save(figure, path)


def _frame_view(axes: Axes, points: Array) -> None:
    """Equal axes in meters, limited to the points and a margin."""
    if len(points):
        low = points.min(axis=0) - MARGIN_M
        high = points.max(axis=0) + MARGIN_M
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect('equal')
    axes.set(xlabel='x (m)', ylabel='y (m)')
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
