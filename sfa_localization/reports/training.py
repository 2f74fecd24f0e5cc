# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Figures of a training, like figures 3 to 5 of the paper; no ground truth is needed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sfa_localization.data.geometry import Array
from sfa_localization.metric.learning import positions
from sfa_localization.reports import evaluation as report
from sfa_localization.reports.summary import summary
from sfa_localization.training import Trained

# Inches.
_SIZE = (7.0, 6.0)


def write_training_report(folder: Path, trained: Trained) -> None:
    """Write coverage, line fits, firing maps and, where there are any, headings and descent.

    Makes the folder. Raises LocalizationError when a file cannot be written.
    """
    images, places = positions(trained.metric, trained.segments)
    names = ['coverage', 'line_fits', 'firing_maps']
    coverage_figure(folder / 'coverage.png', trained, places)
    line_fits_figure(folder / 'line_fits.png', trained, places)
    report.firing_maps_figure(folder / 'firing_maps.png', places, trained.features[images])
    if trained.heading is not None:
        names.append('headings')
        headings_figure(folder / 'headings.png', trained)
    if len(trained.metric.history):
        names.append('convergence')
        convergence_figure(folder / 'convergence.png', trained.metric.history)
    shown = [f'![{name}]({name}.png)' for name in names]
    text = '\n\n'.join(['# Training', f'```\n{summary(trained)}\n```', *shown]) + '\n'
    report.save_text(folder / 'training.md', text)


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
