# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Figures, tables and page of an evaluation: errors, their places, and covariances.

Trajectories are in the frame of the ground truth. The colors are those of Okabe and Ito for
color-blind readers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure, SubFigure

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.run import Image, Stamps, Trajectory
from sfa_localization.reports import page
from sfa_localization.reports.figures import (
    WorstImage,
    in_meters,
    save,
    worst_images,
    write_worst_images,
)

Estimates = Mapping[str, Trajectory]
Scores = Mapping[str, Mapping[str, Any]]

COLUMNS = ('mean', 'median', 'p95', 'rmse', 'max', 'n')
YAW_COLUMNS = ('mean', 'median', 'p95')
LABELS = {
    'odometry': 'wheel odometry',
    'sfa': 'SFA, one image each',
    'ekf': 'EKF: SFA + odometry',
    'smoothed': 'EKF, smoothed',
}
# Lines above dots above the truth; dots for estimates from single images.
STYLES: dict[str, dict[str, Any]] = {
    'odometry': {'color': '#E69F00', 'linestyle': '--', 'linewidth': 1.4, 'zorder': 3},
    'sfa': {'color': '#56B4E9', 'linestyle': '', 'marker': 'o', 'markersize': 2.6, 'zorder': 2},
    'ekf': {'color': '#0072B2', 'linestyle': '-', 'linewidth': 1.7, 'zorder': 4},
    'smoothed': {'color': '#D55E00', 'linestyle': '-', 'linewidth': 1.2, 'zorder': 5},
}
OTHER: dict[str, Any] = {'color': '#CC79A7', 'linestyle': '-', 'linewidth': 1.2}
TRUTH: dict[str, Any] = {'color': '0.72', 'linewidth': 5.0, 'solid_capstyle': 'round', 'zorder': 1}
FIRING_MAPS = 8
"""Firing maps in a figure, those of the slowest features."""
FEATURE_LIMIT = 2.0
"""Value at which the colors saturate; slow features have unit variance."""
MARGIN_M = 0.5
"""Margin around the paths (m)."""
TRUSTED_SHARE = 0.8
"""Share of true positions in the filter's 95 % regions below which its covariances are too small;
errors of neighboring images are correlated, so the share varies."""
_UNORDERED = 'stamp jumps', 'stamp out of order'
_WEAK = 2.0  # times the mean error, from which a place counts as weak


class Errors(NamedTuple):
    """Errors of the estimates that the truth covers: position (M,) m, and heading (M,) degrees, NaN
    without a heading; with stamps (M,), seconds (M,) since the truth's start, places (M, 2) m.
    """

    stamps_ns: Stamps
    seconds: Array
    places: Array
    position_m: Array
    heading_deg: Array


def errors_of(truth: Trajectory, estimate: Trajectory) -> Errors:
    """The errors of an estimate."""
    mask = truth.covers(estimate.stamps_ns)
    stamps = estimate.stamps_ns[mask]
    true = truth.at(stamps)
    x, y, yaw = (estimate.poses[mask] - true).T
    seconds = (stamps - truth.stamps_ns[0]) * 1e-9
    return Errors(stamps, seconds, true[:, :2], np.hypot(x, y), np.degrees(wrap_angle(yaw)))


def tables(scores: Scores) -> str:
    """Position and heading errors as Markdown tables."""
    both = _position_rows(scores), _heading_rows(scores)
    return '\n\n'.join(markdown(head, rows) for head, rows in both if rows)


def _position_rows(scores: Scores) -> tuple[list[str], list[list[str]]]:
    rows = [[_label(n), *(number(row[c], c) for c in COLUMNS)] for n, row in scores.items()]
    return ['position error (m)', *COLUMNS], rows


def _heading_rows(scores: Scores) -> tuple[list[str], list[list[str]]]:
    errors = {name: yaw for name, row in scores.items() if (yaw := row.get('yaw_deg'))}
    rows = [[_label(n), *(f'{yaw[c]:.2f}' for c in YAW_COLUMNS)] for n, yaw in errors.items()]
    return ['heading error (degrees)', *YAW_COLUMNS], rows


def number(value: float | None, column: str) -> str:
    """A score as text, by its column; '-' where there is none."""
    if value is None:
        return '-'
    return f'{int(value)}' if column == 'n' else f'{value:.3f}'


def _label(name: str) -> str:
    return LABELS.get(name, name)


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with padded columns, readable as plain text."""
    first = max(len(row[0]) for row in (head, *rows))
    width = max(len(cell) for row in (head, *rows) for cell in row[1:])
    lines = [
        f'| {row[0].ljust(first)} | ' + ' | '.join(cell.rjust(width) for cell in row[1:]) + ' |'
        for row in (head, *rows)
    ]
    rule = f'|{"-" * (first + 2)}|' + f'{"-" * (width + 1)}:|' * (len(head) - 1)
    return '\n'.join([lines[0], rule, *lines[1:]])


def trust_lines(scores: Scores) -> list[str]:
    """Calibration of the covariances, and errors after alignment by a similarity."""
    lines = []
    for name, row in scores.items():
        shares = {'positions': row.get('within_95'), 'headings': row.get('yaw_within_95')}
        inside = [f'{100 * share:.1f} % of {of}' for of, share in shares.items() if share]
        parts = [f'the 95 % regions contain {" and ".join(inside)}'] if inside else []
        if row.get('nees') is not None:
            low, high = row['nees_right']
            parts.append(
                f'squared errors are {row["nees"]:.2f} times their variances '
                f'({low:.2f} to {high:.2f} would be right on such a drive)'
            )
        best = row.get('similarity') or {}
        if best.get('mean') is not None:
            parts.append(f'at the best scale, {best["scale"]:.4f}, it errs by {best["mean"]:.3f} m')
        if parts:
            lines.append(f'{_label(name)}: {"; ".join(parts)}')
    return lines


def write_report(
    folder: Path,
    truth: Trajectory,
    estimates: Estimates,
    scores: Scores,
    positions: Array,
    features: Array,
) -> None:
    """Write overview.png, with paths, errors and firing maps, and errors.png into `folder`.

    Estimates are in the truth's frame; firing maps show `features` (N, K) at `positions` (N, 2) m.
    Raises LocalizationError.
    """
    figure = Figure(figsize=(13.0, 6.2), layout='constrained')
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.0, 1.2)).flat
    _draw_paths(left.add_subplot(), truth, estimates, scores)
    upper, lower = right.subfigures(2, 1, squeeze=False, height_ratios=(0.8, 1.0)).flat
    row = upper.subplots(1, 4, sharey=True, squeeze=False)[0]
    _draw_firing_maps(upper, row, positions, features)
    _draw_position_errors(lower.add_subplot(), truth, estimates)
    save(figure, folder / 'overview.png')
    errors_figure(folder / 'errors.png', truth, estimates)


def errors_figure(path: Path, truth: Trajectory, estimates: Estimates) -> None:
    """Draw position errors (m) and heading errors (degrees) over time (s)."""
    figure = Figure(figsize=(9.6, 6.0), layout='constrained')
    upper, lower = figure.subplots(2, 1, sharex=True)
    _draw_position_errors(upper, truth, estimates)
    for name, estimate in estimates.items():
        errors = errors_of(truth, estimate)
        lower.plot(errors.seconds, errors.heading_deg, **STYLES.get(name, OTHER))
    lower.axhline(0.0, color='0.4', linewidth=0.8)
    lower.set(xlabel='time (s)', ylabel='heading error (°)', xlim=(0, None))
    lower.grid(alpha=0.3)
    upper.set_xlabel('')
    save(figure, path)


def firing_maps_figure(path: Path, positions: Array, features: Array) -> None:
    """Draw the spatial firing maps of the first 8 slow features: their value at every place.

    `positions` (N, 2) of the images in meters; `features` (N, K).
    """
    figure = Figure(figsize=(12.0, 6.2), layout='compressed')
    grid = figure.subplots(2, FIRING_MAPS // 2, sharex=True, sharey=True, squeeze=False)
    _draw_firing_maps(figure, list(grid.flat), positions, features)
    save(figure, path)


def _draw_paths(axes: Axes, truth: Trajectory, estimates: Estimates, scores: Scores) -> None:
    axes.plot(truth.poses[:, 0], truth.poses[:, 1], label='ground truth', **TRUTH)
    axes.plot(*truth.poses[0, :2], marker='s', color='black', markersize=7, zorder=5, ls='')
    x, y = truth.poses[0, :2]
    axes.annotate('start', (x, y), xytext=(7, 7), textcoords='offset points')
    for name, estimate in estimates.items():
        mean = f': {number(scores[name]["mean"], "mean")} m'
        points = estimate.poses[truth.covers(estimate.stamps_ns)]
        axes.plot(points[:, 0], points[:, 1], label=_label(name) + mean, **STYLES.get(name, OTHER))
    _frame_view(axes, np.concatenate([truth.poses, *map(_bulk, estimates.values())])[:, :2])
    axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.09), ncols=2, frameon=False)
    axes.set_title('Estimated and true paths (mean error)')


def _draw_position_errors(axes: Axes, truth: Trajectory, estimates: Estimates) -> None:
    for name, estimate in estimates.items():
        errors = errors_of(truth, estimate)
        style = STYLES.get(name, OTHER)
        axes.plot(errors.seconds, errors.position_m, label=_label(name), **style)
    axes.set(xlabel='time (s)', ylabel='position error (m)', xlim=(0, None), ylim=(0, None))
    axes.grid(alpha=0.3)
    if estimates:
        above: dict[str, Any] = {'loc': 'lower left', 'bbox_to_anchor': (0.0, 1.0)}
        axes.legend(**above, frameon=False, ncols=len(estimates), fontsize='small')


def _draw_firing_maps(
    figure: Figure | SubFigure, panels: Sequence[Axes], positions: Array, features: Array
) -> None:
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
        bar = figure.colorbar(dots, ax=list(panels), shrink=0.7, aspect=14, extend='both')
        bar.set_label('standard deviations', fontsize='small')


def _bulk(estimate: Trajectory) -> Array:
    """Corners (2, 3) of an estimate without outliers, between its percentiles 1 and 99."""
    poses = estimate.poses[np.isfinite(estimate.poses).all(1)]
    if not len(poses):
        return poses
    low, high = np.percentile(poses[:, :2], (1.0, 99.0), axis=0)
    return np.pad(np.stack([low, high]), ((0, 0), (0, 1)))


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


def worst_of(truth: Trajectory, estimate: Trajectory) -> dict[WorstImage, int]:
    """The images whose positions are farthest from the truth, and their stamps."""
    errors = errors_of(truth, estimate)
    worst = worst_images(errors.places, errors.position_m)
    return {image: int(errors.stamps_ns[image.row]) for image in worst}


def write_evaluation_page(
    folder: Path,
    title: str,
    truth: Trajectory,
    estimates: Estimates,
    scores: Scores,
    counts: Mapping[str, Any],
    samples: Mapping[WorstImage, Image],
    notes: Sequence[str] = (),
) -> None:
    """Write `folder`/index.html with the figures of `write_report` and an error map.

    `counts` are those of Evaluation, `samples` the worst images, `notes` tell what the truth is.
    Raises LocalizationError.
    """
    error_map_figure(folder / 'error_map.png', truth, estimates['ekf'])
    if samples:
        write_worst_images(folder / 'worst_images.png', samples)
    headings = _heading_rows(scores)
    page.write_page(
        folder,
        title,
        page.verdict(*judgment(scores, counts)),
        page.section('How far off?', page.table(*_position_rows(scores)),
                     page.table(*headings) if headings[1] else '', page.items(notes),
                     page.figure(folder / 'overview.png', 'Estimated and true paths, slow features '
                                 'where the images seem to be taken, and errors')),
        page.section('Where is it weak?', page.items([*_weak_lines(truth, estimates['ekf'])]),
                     page.figure(folder / 'error_map.png', 'Error of the filter along the path')),
        page.section('May I trust it?', page.items(trust_lines(scores)),
                     page.figure(folder / 'errors.png', 'Errors over time')),
        page.section('What was rejected?', page.items(count_lines(counts))),
        page.section('Worst images', page.figure(folder / 'worst_images.png', 'Single images with '
                     'the largest errors, and where they were taken')) if samples else '',
    )  # fmt: skip


def judgment(scores: Scores, counts: Mapping[str, Any]) -> tuple[str, str]:
    """The grade of an evaluation, and a sentence about it."""
    mean = scores['ekf']['mean']
    wheels = scores['odometry']['mean']
    if mean is None:
        return page.BAD, 'The filter did not start, or the truth covers none of its estimates.'
    if counts['false_localised_s'] > 0:
        seconds = f'{counts["false_localised_s"]:.1f} s'
        return page.BAD, f'For {seconds} the filter was LOCALISED and more than a meter off.'
    if wheels is not None and mean > wheels:
        return (
            page.WEAK,
            f'The mean error is {mean:.2f} m, more than that of the wheels alone.',
        )
    trust, sound = _trust(scores['ekf'])
    return page.GOOD if sound else page.WEAK, f'The mean error is {mean:.2f} m, {trust}'


def _trust(row: Mapping[str, Any]) -> tuple[str, bool]:
    """Whether the squared errors of an estimate are as its covariances say, in words, and whether
    these are large enough.
    """
    share = row.get('within_95')
    ratio = row.get('nees')
    expected = row.get('nees_right')
    if share is not None and share < TRUSTED_SHARE:
        return 'but the covariances are too small.', False
    if ratio is None or expected is None or expected[0] <= ratio <= expected[1]:
        return 'and the covariances are right.', True
    errors = f'errors are {math.sqrt(ratio):.2f} times the standard deviations.'
    if ratio < expected[0]:
        return f'and the covariances are cautious: {errors}', True
    return f'but the covariances are too small: {errors}', False


def error_map_figure(path: Path, truth: Trajectory, estimate: Trajectory) -> None:
    """Draw the true path colored by the position error (m) of an estimate."""
    figure = Figure(figsize=(7.0, 6.0), layout='constrained')
    axes = figure.add_subplot()
    errors = errors_of(truth, estimate)
    top = max(float(np.percentile(errors.position_m, 98)), 0.05) if len(errors.places) else 1.0
    x, y = errors.places.T
    dots = axes.scatter(x, y, c=errors.position_m, s=14, cmap='viridis', vmin=0.0, vmax=top)
    figure.colorbar(dots, label='position error (m)', shrink=0.85, extend='max')
    in_meters(axes, 'Position error of the filter')
    save(figure, path)


def _weak_lines(truth: Trajectory, estimate: Trajectory) -> Iterator[str]:
    """Where the errors of the filter are largest, and the remedy."""
    _, _, places, errors, _ = errors_of(truth, estimate)
    if not len(errors):
        return
    worst = [k for k in worst_images(places, errors) if k.error_m > _WEAK * errors.mean()]
    for k in worst[:3]:
        yield f'near x {k.x_m:.1f} m, y {k.y_m:.1f} m: {k.error_m:.2f} m'
    if worst:
        yield 'These coordinates are those of the ground truth.'
        yield 'Drive there in a further training drive, in two directions.'
    else:
        yield f'Nowhere is the error more than {_WEAK:g} times its mean.'


def count_lines(counts: Mapping[str, Any]) -> list[str]:
    """Used and skipped inputs, rejections of the filter, seconds in each state, camera delay."""
    lines = []
    cameras = [stream for stream in counts if stream.startswith('images of ')]
    for stream in ('images', *cameras, 'odometry', 'observations'):
        skipped = sorted(counts[stream]['skipped'].items())
        reasons = ''.join(f'; {n} skipped: {reason}' for reason, n in skipped)
        lines.append(f'{stream}: {counts[stream]["used"]} used{reasons}')
    usual = 'odometry: used', 'measurement: accepted', 'measurement: started'
    lines += _image_lines(counts)
    rejected = sorted((why, n) for why, n in counts['fusion'].items() if why not in usual)
    lines += [f'filter: {n} times {reason}' for reason, n in rejected]
    states = ', '.join(f'{name} {seconds:.1f} s' for name, seconds in counts['states_s'].items())
    lines.append(f'state: {states}')
    if (wrong := counts['false_localised_s']) > 0:
        lines.append(f'state: LOCALISED for {wrong:.1f} s with an error of more than a meter')
    if (delay := counts.get('camera_delay_s')) is not None:
        late = 'late' if delay > 0 else 'early'
        lines.append(f'camera: images are stamped {abs(delay):.2f} s {late}')
    return lines


def _image_lines(counts: Mapping[str, Any]) -> Iterator[str]:
    """What is wrong with the images of the drive, and the remedy."""
    skipped = counts['images']['skipped']
    if unordered := sum(skipped.get(reason, 0) for reason in _UNORDERED):
        total = counts['images']['used'] + sum(skipped.values())
        yield (
            f'images: {unordered} of {total} are left out because their stamps jump or are out of '
            'order: the driver must stamp images when they are taken, and send them in that order'
        )
    if silence := counts.get('without_images'):
        start_s = silence['from_s']
        end = 'the end' if silence['to_the_end'] else f'{start_s + silence["seconds"]:.0f} s'
        yield (
            f'images: none could be used from {start_s:.0f} s of the drive to {end}: '
            'does the camera stop, or is its view dark or covered there?'
        )
