# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Figures and table of an evaluation: the estimated paths and their errors.

Every function takes plain arrays and trajectories in the frame of the ground truth and writes one
file; nothing here opens a window. The colors are those of Okabe and Ito for color-blind readers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure, SubFigure

from sfa_localization.data.files import atomic_write
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.rejections import encodable
from sfa_localization.data.run import Stamps, Trajectory

Estimates = Mapping[str, Trajectory]
Scores = Mapping[str, Mapping[str, Any]]

COLUMNS = ('mean', 'median', 'p95', 'rmse', 'max', 'n')
YAW_COLUMNS = ('mean', 'median', 'p95')
LABELS = {
    'odometry': 'wheel odometry',
    'sfa': 'SFA, one image each',
    'ekf': 'EKF: SFA + odometry',
    'smoothed': 'EKF, smoothed',
    'supervised': 'supervised reference',
}
# Lines above dots above the truth; dots for estimates from single images.
STYLES: dict[str, dict[str, Any]] = {
    'odometry': {'color': '#E69F00', 'linestyle': '--', 'linewidth': 1.4, 'zorder': 3},
    'sfa': {'color': '#56B4E9', 'linestyle': '', 'marker': 'o', 'markersize': 2.6, 'zorder': 2},
    'supervised': {'color': '#009E73', 'linestyle': '', 'marker': 'x', 'markersize': 3},
    'ekf': {'color': '#0072B2', 'linestyle': '-', 'linewidth': 1.7, 'zorder': 4},
    'smoothed': {'color': '#D55E00', 'linestyle': '-', 'linewidth': 1.2, 'zorder': 5},
}
OTHER: dict[str, Any] = {'color': '#CC79A7', 'linestyle': '-', 'linewidth': 1.2}
TRUTH: dict[str, Any] = {'color': '0.72', 'linewidth': 5.0, 'solid_capstyle': 'round', 'zorder': 1}
MAPS_SHOWN = 8
"""Firing maps in one figure: the slowest features carry the place."""
FEATURE_LIMIT = 2.0
"""Standard deviations at which the colors saturate; slow features have unit variance."""
DOTS_PER_INCH = 130
"""Resolution of the figures: sharp on a screen, and still small files."""
MARGIN_M = 0.5
"""Margin around the paths (m)."""


def position_errors(truth: Trajectory, estimate: Trajectory) -> tuple[Array, Array]:
    """Seconds since the truth's start (M,) and Euclidean errors in meters (M,).

    Estimates at stamps without ground truth are left out.
    """
    kept = truth.covers(estimate.stamps_ns)
    offset = estimate.poses[kept, :2] - truth.at(estimate.stamps_ns[kept])[:, :2]
    return _seconds(truth, estimate.stamps_ns[kept]), np.hypot(offset[:, 0], offset[:, 1])


def heading_errors(truth: Trajectory, estimate: Trajectory) -> tuple[Array, Array]:
    """Seconds since the truth's start (M,) and signed heading errors in degrees (M,).

    Estimates without a heading (NaN) or without ground truth are left out.
    """
    kept = truth.covers(estimate.stamps_ns) & np.isfinite(estimate.poses[:, 2])
    offset = wrap_angle(estimate.poses[kept, 2] - truth.at(estimate.stamps_ns[kept])[:, 2])
    return _seconds(truth, estimate.stamps_ns[kept]), np.degrees(offset)


def _seconds(truth: Trajectory, stamps_ns: Stamps) -> Array:
    return np.asarray((stamps_ns - truth.stamps_ns[0]) * 1e-9)


def trajectories_figure(
    path: Path, truth: Trajectory, estimates: Estimates, scores: Scores | None = None
) -> None:
    """Draw the true and the estimated paths from above, axes equal, in meters.

    `scores`, by the estimates' names, adds each mean error to the legend.
    """
    figure = Figure(figsize=(8.0, 7.6), layout='constrained')
    _draw_paths(figure.add_subplot(), truth, estimates, scores or {})
    save(figure, path)


def errors_figure(path: Path, truth: Trajectory, estimates: Estimates) -> None:
    """Draw position errors (m) and heading errors (degrees) over time (s)."""
    figure = Figure(figsize=(9.6, 6.0), layout='constrained')
    upper, lower = figure.subplots(2, 1, sharex=True)
    _draw_position_errors(upper, truth, estimates)
    _draw_heading_errors(lower, truth, estimates)
    upper.set_xlabel('')
    save(figure, path)


def heading_figure(path: Path, truth: Trajectory, estimate: Trajectory, name: str = 'ekf') -> None:
    """Draw the true path colored by the absolute heading error (degrees) of one estimate."""
    figure = Figure(figsize=(8.0, 6.6), layout='constrained')
    axes = figure.add_subplot()
    kept = truth.covers(estimate.stamps_ns) & np.isfinite(estimate.poses[:, 2])
    places = truth.at(estimate.stamps_ns[kept])[:, :2]
    _, error = heading_errors(truth, estimate)
    top = max(float(np.percentile(np.abs(error), 98)), 1.0) if len(error) else 1.0
    dots = _dots(axes, places, np.abs(error), 16.0, 'viridis', (0.0, top))
    figure.colorbar(dots, label='absolute heading error (°)', shrink=0.85, extend='max')
    axes.set_title(f'Heading error along the path: {_label(name)}')
    save(figure, path)


def firing_maps_figure(path: Path, positions: Array, features: Array) -> None:
    """Draw the spatial firing maps of the first 8 slow features: their value at every place.

    `positions` (N, 2) of the images in meters; `features` (N, K).
    """
    figure = Figure(figsize=(12.0, 6.2), layout='compressed')
    grid = figure.subplots(2, MAPS_SHOWN // 2, sharex=True, sharey=True, squeeze=False)
    _draw_firing_maps(figure, list(grid.flat), positions, features)
    save(figure, path)


def overview_figure(
    path: Path,
    truth: Trajectory,
    estimates: Estimates,
    scores: Scores,
    positions: Array,
    features: Array,
) -> None:
    """Draw paths, position error over time and four firing maps in one figure.

    `positions` (N, 2) of the images in meters; `features` (N, K).
    """
    figure = Figure(figsize=(13.0, 6.2), layout='constrained')
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.0, 1.2)).flat
    _draw_paths(left.add_subplot(), truth, estimates, scores)
    upper, lower = right.subfigures(2, 1, squeeze=False, height_ratios=(0.8, 1.0)).flat
    row = upper.subplots(1, 4, sharey=True, squeeze=False)[0]
    _draw_firing_maps(upper, row, positions, features)
    _draw_position_errors(lower.add_subplot(), truth, estimates)
    save(figure, path)


def table(scores: Scores) -> str:
    """Position errors in meters, one line per estimate, as a Markdown table."""
    rows = {name: [number(score[c], c) for c in COLUMNS] for name, score in scores.items()}
    return _markdown('position error (m)', COLUMNS, rows)


def heading_table(scores: Scores) -> str:
    """Heading errors in degrees, one line per estimate that has a heading."""
    errors = {name: score['yaw_deg'] for name, score in scores.items() if score.get('yaw_deg')}
    rows = {name: [f'{yaw[column]:.2f}' for column in YAW_COLUMNS] for name, yaw in errors.items()}
    return _markdown('heading error (degrees)', YAW_COLUMNS, rows)


def trust_lines(scores: Scores) -> list[str]:
    """Whether the covariances are right, and the errors left after a similarity alignment on the
    drive itself; of the estimates that have these scores.
    """
    lines = []
    for name, one in scores.items():
        shares = {'positions': one.get('within_95'), 'headings': one.get('yaw_within_95')}
        held = [f'{100 * share:.1f} % of {of}' for of, share in shares.items() if share]
        parts = [f'regions of 95 % hold {" and ".join(held)}'] if held else []
        if one.get('nees') is not None:
            low, high = one['nees_right']
            parts.append(
                f'squared errors are {one["nees"]:.2f} times the expected ones '
                f'(on such a drive {low:.2f} to {high:.2f} where covariances are right)'
            )
        best = one.get('similarity') or {}
        if best.get('mean') is not None:
            parts.append(f'scaled by {best["scale"]:.4f} it errs by {best["mean"]:.3f} m')
        if parts:
            lines.append(f'{_label(name)}: {"; ".join(parts)}')
    return lines


def _markdown(corner: str, columns: Sequence[str], rows: Mapping[str, Sequence[str]]) -> str:
    """A table with padded columns, so that it is readable as plain text too."""
    labels = {name: _label(name) for name in rows}
    first = max(map(len, [corner, *labels.values()]))
    width = max(map(len, [*columns, *(cell for row in rows.values() for cell in row)]))
    lines = [
        _row(corner.ljust(first), columns, width),
        f'|{"-" * (first + 2)}|' + f'{"-" * (width + 1)}:|' * len(columns),
        *(_row(labels[name].ljust(first), row, width) for name, row in rows.items()),
    ]
    return '\n'.join(lines)


def _row(head: str, cells: Sequence[str], width: int) -> str:
    return f'| {head} | ' + ' | '.join(cell.rjust(width) for cell in cells) + ' |'


def write_report(
    folder: Path,
    truth: Trajectory,
    estimates: Estimates,
    scores: Scores,
    positions: Array,
    features: Array,
) -> None:
    """Write all figures and ``report.md`` into `folder`, created when missing.

    Estimates are in the truth's frame; `positions` (N, 2) m and `features` (N, K) belong together.
    Raises LocalizationError when a file cannot be written.
    """
    trajectories_figure(folder / 'trajectories.png', truth, estimates, scores)
    errors_figure(folder / 'errors.png', truth, estimates)
    firing_maps_figure(folder / 'firing_maps.png', positions, features)
    overview_figure(folder / 'overview.png', truth, estimates, scores, positions, features)
    figures = ['trajectories', 'errors', 'firing_maps']
    if 'ekf' in estimates:
        heading_figure(folder / 'heading.png', truth, estimates['ekf'])
        figures.append('heading')
    images = [f'![{name}]({name}.png)' for name in figures]
    parts = ['# Evaluation', table(scores), heading_table(scores), *images]
    save_text(folder / 'report.md', '\n\n'.join(parts) + '\n')


def _draw_paths(axes: Axes, truth: Trajectory, estimates: Estimates, scores: Scores) -> None:
    axes.plot(truth.poses[:, 0], truth.poses[:, 1], label='ground truth', **TRUTH)
    axes.plot(*truth.poses[0, :2], marker='s', color='black', markersize=7, zorder=5, ls='')
    x, y = truth.poses[0, :2]
    axes.annotate('start', (x, y), xytext=(7, 7), textcoords='offset points')
    for name, estimate in estimates.items():
        mean = f': {number(scores[name]["mean"], "mean")} m' if name in scores else ''
        points = estimate.poses[truth.covers(estimate.stamps_ns)]
        axes.plot(points[:, 0], points[:, 1], label=_label(name) + mean, **STYLES.get(name, OTHER))
    _frame_view(axes, np.concatenate([truth.poses, *map(_bulk, estimates.values())])[:, :2])
    axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.09), ncols=2, frameon=False)
    axes.set_title('Estimated and true paths (mean error)' if scores else 'Paths')


def _draw_position_errors(axes: Axes, truth: Trajectory, estimates: Estimates) -> None:
    for name, estimate in estimates.items():
        axes.plot(*position_errors(truth, estimate), label=_label(name), **STYLES.get(name, OTHER))
    axes.set(xlabel='time (s)', ylabel='position error (m)', xlim=(0, None), ylim=(0, None))
    axes.grid(alpha=0.3)
    if estimates:
        above: dict[str, Any] = {'loc': 'lower left', 'bbox_to_anchor': (0.0, 1.0)}
        axes.legend(**above, frameon=False, ncols=len(estimates), fontsize='small')


def _draw_heading_errors(axes: Axes, truth: Trajectory, estimates: Estimates) -> None:
    for name, estimate in estimates.items():
        axes.plot(*heading_errors(truth, estimate), label=_label(name), **STYLES.get(name, OTHER))
    axes.axhline(0.0, color='0.4', linewidth=0.8)
    axes.set(xlabel='time (s)', ylabel='heading error (°)', xlim=(0, None))
    axes.grid(alpha=0.3)


def _draw_firing_maps(
    figure: Figure | SubFigure, panels: Sequence[Axes], positions: Array, features: Array
) -> None:
    limits = (-FEATURE_LIMIT, FEATURE_LIMIT)
    size = _filling_size(figure, len(panels), len(positions))
    dots = None
    for index, axes in enumerate(panels):
        if index >= features.shape[1]:
            axes.set_axis_off()
            continue
        dots = _dots(axes, positions, features[:, index], size, 'RdBu_r', limits)
        axes.set_title(f'slow feature {index + 1}', fontsize='medium')
        axes.label_outer()
    if dots is not None:
        bar = figure.colorbar(dots, ax=list(panels), shrink=0.7, aspect=14, extend='both')
        bar.set_label('standard deviations', fontsize='small')


def _filling_size(figure: Figure | SubFigure, panels: int, points: int) -> float:
    """Area of a dot in square points so that the dots of a panel touch one another."""
    inches = figure.bbox.width * figure.bbox.height / figure.dpi**2
    return float(np.clip(0.6 * inches * 72**2 / panels / max(points, 1), 2.0, 40.0))


def _dots(
    axes: Axes,
    points: Array,
    numbers: Array,
    size: float,
    colormap: str,
    limits: tuple[float, float],
) -> PathCollection:
    """Scatter points (N, 2) colored by numbers (N,)."""
    x, y = points[:, 0], points[:, 1]
    low, high = limits
    dots = axes.scatter(x, y, c=numbers, s=size, cmap=colormap, vmin=low, vmax=high, linewidths=0)
    _frame_view(axes, points)
    return dots


def _bulk(estimate: Trajectory) -> Array:
    """Corners (2, 3) of the estimate without its outermost percents, which need not be seen."""
    low, high = np.nanpercentile(estimate.poses[:, :2], (1.0, 99.0), axis=0)
    return np.pad(np.stack([low, high]), ((0, 0), (0, 1)))


def _frame_view(axes: Axes, points: Array) -> None:
    """Equal axes in meters, limited to the points and a margin."""
    if len(points):
        low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect('equal')
    axes.set(xlabel='x (m)', ylabel='y (m)')
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)


def _label(name: str) -> str:
    return LABELS.get(name, name)


def number(value: float | None, column: str) -> str:
    """A score as text, by its column; '-' where there is none."""
    if value is None:
        return '-'
    return f'{int(value)}' if column == 'n' else f'{value:.3f}'


def as_title(text: str) -> str:
    """A text with names of files or topics, as matplotlib draws it: a dollar starts no formula."""
    return encodable(text).replace('$', r'\$')


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, completely or not at all. Raises LocalizationError."""
    with atomic_write(path) as file:
        figure.savefig(file, dpi=DOTS_PER_INCH, format='png')


def save_text(path: Path, text: str) -> None:
    """Write a text file, completely or not at all. Raises LocalizationError."""
    with atomic_write(path) as file:
        file.write(encodable(text).encode())
