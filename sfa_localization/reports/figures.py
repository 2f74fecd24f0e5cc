# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Functions for the figures of all reports: files, axes, contact sheets, worst images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sfa_localization.data.files import atomic_write, write_bytes
from sfa_localization.data.geometry import Array
from sfa_localization.data.rejections import encodable
from sfa_localization.data.run import Image

DOTS_PER_INCH = 130
"""Resolution of the figures: sharp on a screen, in small files."""


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, completely or not at all. Raises LocalizationError."""
    with atomic_write(path) as file:
        figure.savefig(file, dpi=DOTS_PER_INCH, format='png')


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
    write_contact_sheet([*samples.values()], 'Worst images', path, captions)


def write_contact_sheet(
    samples: Sequence[Image], title: str, path: Path, captions: Sequence[str] = ()
) -> None:
    """Write BGR images (H, W, 3) as one PNG, in reading order, each below its caption.

    Raises LocalizationError.
    """
    height, width = samples[0].shape[:2]
    columns = max(1, round(np.sqrt(len(samples) * height / width)))
    rows = -(-len(samples) // columns)
    row = 10 / columns * height / width + (0.3 if captions else 0.0)
    figure = Figure((10, rows * row + 0.5), layout='constrained')
    figure.suptitle(as_title(title), fontsize=10)
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for axis in axes:
        axis.set_axis_off()
    for axis, sample, caption in zip(axes, samples, captions or [''] * len(samples), strict=False):
        axis.imshow(sample[..., ::-1], interpolation='lanczos')
        axis.set_title(caption, fontsize=9)
    save(figure, path)
