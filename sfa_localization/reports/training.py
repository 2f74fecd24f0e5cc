# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Figures of a training, like figures 3 to 5 of the paper; no ground truth is needed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image
from sfa_localization.metric.learning import positions
from sfa_localization.reports import evaluation as report
from sfa_localization.reports.bag import write_contact_sheet
from sfa_localization.reports.summary import summary
from sfa_localization.reports.training_page import drives, write_training_page
from sfa_localization.training import Trained

# Inches.
_SIZE = (7.0, 6.0)


WORST_IMAGES, WORST_APART_M = 6, 1.0
"""Worst images shown, and the distance (m) between them: neighbors look alike."""
_CAPTIONS = {
    'coverage': 'Where images were taken (black), on the expected error of one image',
    'line_fits': 'Each segment by odometry (wide) and by slow features (thin)',
    'firing_maps': 'Slow features at the places of the images',
    'odometry': 'The path by odometry alone, and in the map',
    'headings': 'Heading errors of images that were left out',
    'convergence': "Cost of the paper's descent",
    'worst_images': 'Images with the largest errors, and where they were taken',
}


class WorstImage(NamedTuple):
    """An image of a drive, where it was taken in the map (x, y in m), and its error (m)."""

    run: int
    stamp_ns: int
    x_m: float
    y_m: float
    error_m: float


def worst_images(trained: Trained) -> list[WorstImage]:
    """The images that the map puts farthest from where their segment does."""
    images, places = positions(trained.metric, trained.segments)
    errors = np.hypot(*trained.metric.residuals.T)
    counts = np.cumsum([0, *(len(run.panoramas) for run in trained.runs)])
    found: list[WorstImage] = []
    for k in np.argsort(-errors):
        x, y = places[k].tolist()
        if any(np.hypot(one.x_m - x, one.y_m - y) < WORST_APART_M for one in found):
            continue
        run = int(np.searchsorted(counts, images[k], 'right')) - 1
        stamps = trained.runs[run].panoramas.stamps_ns
        found.append(WorstImage(run, int(stamps[images[k] - counts[run]]), x, y, float(errors[k])))
        if len(found) == WORST_IMAGES:
            break
    return found


def write_training_report(
    folder: Path, trained: Trained, samples: Mapping[WorstImage, Image] | None = None
) -> None:
    """Write figures of the training, training.md, and the page index.html that contains them all.

    Coverage, line fits, odometry, firing maps and, where there are any, headings, descent and the
    `samples` of the worst images. Makes the folder. Raises LocalizationError when a file cannot
    be written.
    """
    images, places = positions(trained.metric, trained.segments)
    names = ['coverage', 'line_fits', 'odometry', 'firing_maps']
    coverage_figure(folder / 'coverage.png', trained, places)
    line_fits_figure(folder / 'line_fits.png', trained, places)
    odometry_figure(folder / 'odometry.png', trained)
    report.firing_maps_figure(folder / 'firing_maps.png', places, trained.features[images])
    if trained.heading is not None:
        names.append('headings')
        headings_figure(folder / 'headings.png', trained)
    if len(trained.metric.history):
        names.append('convergence')
        convergence_figure(folder / 'convergence.png', trained.metric.history)
    if samples:
        names.append('worst_images')
        _worst_figure(folder / 'worst_images.png', samples)
    shown = [f'![{name}]({name}.png)' for name in names]
    text = '\n\n'.join(['# Training', f'```\n{summary(trained)}\n```', *shown]) + '\n'
    report.save_text(folder / 'training.md', text)
    title = f'Training on {", ".join(run.name for run in trained.runs)}'
    figures = [(f'{name}.png', _CAPTIONS[name]) for name in names]
    write_training_page(folder, title, trained, figures)


def _worst_figure(path: Path, samples: Mapping[WorstImage, Image]) -> None:
    captions = [f'x {k.x_m:.1f} m, y {k.y_m:.1f} m: error {k.error_m:.2f} m' for k in samples]
    write_contact_sheet([*samples.values()], 'Worst images', path, captions)


def odometry_figure(path: Path, trained: Trained) -> None:
    """Draw the path of each drive by odometry alone, laid on its path in the map."""
    figure, axes = _figure()
    for number, (_, places, driven) in enumerate(drives(trained)):
        first = number == 0
        axes.plot(*driven.T, color='#E69F00', linewidth=1.0, label='odometry' if first else None)
        axes.plot(*places.T, color='#0072B2', linewidth=1.4, label='map' if first else None)
    axes.legend(loc='upper right')
    _places(axes, 'Odometry alone, and corrected by the map')
    report.save(figure, path)


def coverage_figure(path: Path, trained: Trained, places: Array) -> None:
    """Draw where images were taken, (M, 2) m, on the expected error around them."""
    figure, axes = _figure()
    expected = trained.metric.forecast
    dots = axes.scatter(
        expected.points[:, 0], expected.points[:, 1], c=expected.local, s=30, cmap='viridis'
    )
    figure.colorbar(dots, ax=axes, label='expected position error of one image (m)')
    axes.scatter(places[:, 0], places[:, 1], s=2, color='black')
    x, y, error = expected.worst
    axes.plot(x, y, 'x', color='red', markersize=10, label=f'worst: {error:.2f} m')
    axes.legend(loc='upper right')
    _places(axes, 'Images in the map, and the expected error between them')
    report.save(figure, path)


def line_fits_figure(path: Path, trained: Trained, places: Array) -> None:
    """Draw every segment by odometry (places (M, 2) m) and by the slow features."""
    figure, axes = _figure()
    predicted = places - trained.metric.residuals
    start = 0
    for segment in trained.segments:
        part = slice(start, start + len(segment.images))
        (line,) = axes.plot(*places[part].T, linewidth=2.5, alpha=0.4)
        axes.plot(*predicted[part].T, linewidth=0.8, color=line.get_color())
        start = part.stop
    _places(axes, 'Segments: odometry (wide), slow features (thin)')
    report.save(figure, path)


def headings_figure(path: Path, trained: Trained) -> None:
    """Draw the left-out heading error along the drive, and against the compass's certainty |g|."""
    fit = trained.heading
    assert fit is not None
    figure = Figure(figsize=(9.0, 6.0), layout='constrained')
    along, against = figure.subplots(2, 1)
    error = np.degrees(fit.left_out_error)
    limit = max(3 * float(np.quantile(np.abs(error), 0.95)), 1.0)
    band = np.degrees(1.96 * fit.left_out_std)
    along.fill_between(fit.images, -band, band, alpha=0.25, label='95 % interval')
    along.plot(fit.images, error, '.', markersize=3, color='black')
    along.set(xlabel='image', ylabel='left-out heading error (deg)', ylim=(-limit, limit))
    along.legend(loc='upper right')
    against.semilogy(fit.certainty, np.abs(error) + 1e-3, '.', markersize=3)
    against.set(xlabel='certainty |g|', ylabel='|heading error| (deg)')
    for axes in (along, against):
        axes.grid(alpha=0.3)
    report.save(figure, path)


def convergence_figure(path: Path, history: Array) -> None:
    """Draw the cost (I,) of the paper's descent over its iterations."""
    figure, axes = _figure()
    axes.loglog(np.arange(1, len(history) + 1), history)
    axes.set(xlabel='iteration', ylabel='cost (m²)', title='Momentum descent (equations 7, 8)')
    axes.grid(alpha=0.3)
    report.save(figure, path)


def _figure() -> tuple[Figure, Axes]:
    figure = Figure(figsize=_SIZE, layout='constrained')
    return figure, figure.subplots()


def _places(axes: Axes, title: str) -> None:
    axes.set_aspect('equal')
    axes.set(xlabel='x in map (m)', ylabel='y in map (m)', title=title)
    axes.grid(alpha=0.3)
