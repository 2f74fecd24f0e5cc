# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The page of a training: the map, its weak places and calibration, and what to drive next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from sfa_localization.data.files import write_bytes
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image
from sfa_localization.inspection import InspectionConfig, covered_share, sparse_lanes
from sfa_localization.mapping.forecast import Forecast
from sfa_localization.reports import figures, page
from sfa_localization.reports.bag import motion_section
from sfa_localization.reports.figures import WorstImage
from sfa_localization.reports.summary import has_forecast, judgment, summary
from sfa_localization.training import Trained

FEW_CROSSINGS = 5
"""With fewer crossings, a bad stretch of odometry bends the map unnoticed."""
PARALLEL = 0.3
"""Spread of driving directions (0 parallel, 1 even) below which the drive was one-sided."""
_WEAK = 1.5  # times the expected error, from which a place counts as weak
SHOWN = 95
"""Percentile of the expected errors up to which colors differ: a few corners would use up all."""
_CAPTIONS = {
    'coverage': 'Where images were taken (black), on the expected error of one image',
    'line_fits': 'Each segment by odometry (wide) and by slow features (thin)',
    'firing_maps': figures.FIRING_CAPTION,
    'lens': 'The lens that the drive shows: elevations (green) in an image and in its panorama, '
    'whose edges are yellow',
    'worst_images': 'Images that the map puts farthest from where they were taken',
}


def worst_of(trained: Trained) -> dict[WorstImage, tuple[int, int]]:
    """Run and stamp of the images with the largest distance between map and segment."""
    images = trained.metric.images
    places = trained.metric.poses[:, :2]
    stamps = [
        (number, stamp)
        for number, run in enumerate(trained.runs)
        for stamp in run.panoramas.stamps_ns.tolist()
    ]
    worst = figures.worst_images(places, np.hypot(*trained.metric.residuals.T))
    return {image: stamps[images[image.row]] for image in worst}


def write_training_report(
    folder: Path,
    trained: Trained,
    samples: Mapping[WorstImage, Image] | None = None,
    lens: bytes = b'',
    warnings: Sequence[str] = (),
) -> None:
    """Write figures of the training, with `samples` of the worst images and a picture (PNG) of the
    lens, and index.html, which repeats the warnings of the training.

    Raises LocalizationError if a file cannot be written.
    """
    places = trained.metric.poses[:, :2]
    parts = _figures(folder, trained, samples, lens)
    grade, sentence = judgment(trained)
    told = summary(trained).splitlines()
    page.write_page(
        folder,
        f'Training on {", ".join(run.name for run in trained.runs)}',
        page.verdict(grade, sentence),
        page.section('Is my map good?', page.items([line for line in told if line != sentence]),
                     parts['line_fits']),
        page.section(page.NOTICED, page.items([text for text in warnings if text not in told])),
        page.section('Where is it weak?', page.items(weak_lines(trained)), parts['coverage'])
        if has_forecast(grade, trained.model.quality) else '',
        page.section('May I trust it?', page.items(trust_lines(trained))),
        page.section('What do I drive next?', page.items(advice(trained, places))),
        *(motion_section(check.as_dict()) for check in trained.checks),
        page.section('The camera', parts.get('lens', '')),
        page.section('Slow features', parts['firing_maps']),
        page.section('Worst images', parts.get('worst_images', '')),
    )  # fmt: skip


def _figures(
    folder: Path, trained: Trained, samples: Mapping[WorstImage, Image] | None, lens: bytes
) -> dict[str, str]:
    """Write the figures; parts of the page by their names in _CAPTIONS."""
    images = trained.metric.images
    places = trained.metric.poses[:, :2]
    coverage_figure(folder / 'coverage.png', trained, places)
    line_fits_figure(folder / 'line_fits.png', trained, places)
    figures.firing_maps_figure(folder / 'firing_maps.png', places, trained.features[images])
    if samples:
        figures.write_worst_images(folder / 'worst_images.png', samples)
    if lens:
        write_bytes(folder / 'lens.png', lens)
    drawn = {'lens': bool(lens), 'worst_images': bool(samples)}
    names = [name for name in _CAPTIONS if drawn.get(name, True)]
    return {name: page.figure(folder / f'{name}.png', _CAPTIONS[name]) for name in names}


def weak_places(forecast: Forecast) -> list[WorstImage]:
    """Up to three places with the largest expected error."""
    worst = figures.worst_images(forecast.places, forecast.local, 3, 2.0)
    return [place for place in worst if place.error_m >= _WEAK * forecast.expected_m]


def weak_lines(trained: Trained) -> list[str]:
    """Where the expected error is large."""
    forecast = trained.metric.forecast
    share = float((forecast.local > _WEAK * forecast.expected_m).mean())
    lines = [
        f'near x {x:.1f} m, y {y:.1f} m: {error:.2f} m' for x, y, error, _ in weak_places(forecast)
    ]
    even = f'Nowhere is the expected error more than {_WEAK} times the mean.'
    uneven = f'On {share:.0%} of the covered ground it is more than {_WEAK} times the mean.'
    why = 'The usual reason: few images around it, as at the edge of the driven ground.'
    frame = 'x and y are in the odometry frame of the first drive, or as start_pose moves it.'
    if trained.segments.points is not None:
        frame = 'x and y are those of the measured points.'
    return [*lines, *([uneven, why] if lines else [even]), frame]


def trust_lines(trained: Trained) -> list[str]:
    """The certificate and the calibration, in words."""
    quality = trained.model.quality
    angle = np.degrees(trained.metric.diagnostics.angle_std_rad)
    proven = (
        'Proven: no other directions of the pieces of the drive fit odometry and images better '
        if quality['certified']
        else 'NOT proven: other directions of the pieces of the drive may fit better '
    )
    return [
        proven + f'(certificate {quality["certificate"]:.1e}, at least zero up to rounding).',
        f'Of the left-out images, {quality["left_out_within_95"]:.0%} lie in their 95 % region.',
        f'The direction of each piece of the drive is known to {angle:.1f} degrees or better.',
        'Not included: other light than in training, and a wrong wheel radius.',
    ]


def advice(trained: Trained, places: Array) -> list[str]:
    """What to drive next, most useful first; images were taken at places (M, 2) m."""
    diagnostics = trained.metric.diagnostics
    forecast = trained.metric.forecast
    lines = [
        f'Cross x {x:.1f} m, y {y:.1f} m, in two directions.' for x, y, *_ in weak_places(forecast)
    ]
    if not diagnostics.single_route:
        reach = InspectionConfig().reach
        lines += sparse_lanes(covered_share(places, reach), reach)
    if diagnostics.directions < PARALLEL:
        lines.append('Drive in other directions: most of this drive was parallel.')
    if diagnostics.crossings < FEW_CROSSINGS:
        lines.append(f'Cross your own track: this drive does so {diagnostics.crossings} times.')
    return [*lines, 'For other light, drive again under clouds, or at another hour.']


def coverage_figure(path: Path, trained: Trained, places: Array) -> None:
    """Draw where images were taken, (M, 2) m, on the expected error around them."""
    figure = Figure(figsize=figures.SQUARE, layout='constrained')
    axes = figure.subplots()
    expected = trained.metric.forecast
    local = expected.local
    x, y = expected.places.T
    top = float(np.percentile(local, SHOWN))
    dots = axes.scatter(x, y, c=local, s=30, cmap='viridis', vmin=0.0, vmax=top)
    label = 'expected position error of one image (m)'
    figure.colorbar(dots, ax=axes, label=label, extend='max')
    axes.scatter(places[:, 0], places[:, 1], s=2, color='black')
    x, y, error = expected.worst
    axes.plot(x, y, 'x', color='red', markersize=10, label=f'worst: {error:.2f} m')
    for point, at in zip(
        trained.model.quality.get('points', ()), trained.metric.points, strict=True
    ):
        color = 'blue' if point['used'] else 'red'
        axes.plot([point['x_m'], at.real], [point['y_m'], at.imag], color=color)
        label = f'{point["name"]}: missed by {point["miss_m"]:.2f} m'
        axes.plot(point['x_m'], point['y_m'], '+', color=color, markersize=10, label=label)
    figure.legend(loc='outside lower center')
    figures.in_meters(axes, 'Images in the map, and the expected error between them')
    figures.save(figure, path)


def line_fits_figure(path: Path, trained: Trained, places: Array) -> None:
    """Draw every segment by odometry (places (M, 2) m) and by the slow features."""
    figure = Figure(figsize=figures.SQUARE, layout='constrained')
    axes = figure.subplots()
    predicted = places - trained.metric.residuals
    start = 0
    for segment in trained.segments:
        part = slice(start, start + len(segment.images))
        (line,) = axes.plot(*places[part].T, linewidth=2.5, alpha=0.4)
        axes.plot(*predicted[part].T, linewidth=0.8, color=line.get_color())
        start = part.stop
    figures.in_meters(axes, 'Segments: odometry (wide), slow features (thin)')
    figures.save(figure, path)
