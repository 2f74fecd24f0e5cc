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
from typing import TYPE_CHECKING, Any

import numpy as np

from sfa_localization.camera.watch import DROWNED_WARNING, drowned_text
from sfa_localization.data.geometry import Array
from sfa_localization.reports import page
from sfa_localization.reports.figures import (
    FIRING_CAPTION,
    firing_maps_figure,
    worst_images,
)
from sfa_localization.reports.moments import Moment, moments_of
from sfa_localization.reports.plots import Line, curves_of, errors_of, linked_plots

if TYPE_CHECKING:
    from sfa_localization.evaluation import Evaluation
    from sfa_localization.place_model import PlaceModel

Scores = Mapping[str, Mapping[str, Any]]

COLUMNS = ('mean', 'median', 'p95', 'rmse', 'max', 'n')
YAW_COLUMNS = ('mean', 'median', 'p95')
LABELS = {
    'odometry': 'wheel odometry',
    'sfa': 'SFA, one image each',
    'ekf': 'EKF: SFA + odometry',
    'smoothed': 'EKF, smoothed',
}
LOOKS = {
    'odometry': ('#E69F00', 'dash', 'lines'),
    'sfa': ('#56B4E9', 'solid', 'markers'),
    'ekf': ('#0072B2', 'solid', 'lines'),
    'smoothed': ('#CC79A7', 'solid', 'lines'),
}
"""Color, dash and mode of the curves."""
TRUSTED_SHARE = 0.8
"""Share of true positions in the filter's 95 % regions below which its covariances are too small;
errors of neighboring images are correlated, so the share varies."""
_UNORDERED = 'stamp jumps', 'stamp out of order'
_WEAK = 2.0  # times the mean error, from which a place counts as weak


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


def write_evaluation_page(
    folder: Path,
    title: str,
    result: Evaluation,
    model: PlaceModel,
    features: tuple[Array, Array],
    notes: Sequence[str] = (),
) -> None:
    """Write `folder`/index.html with plots to click, and firing maps of features: places (N, 2) m
    in the frame of the truth, and values (N, K). `notes` tell what the truth is.

    Raises LocalizationError.
    """
    firing_maps_figure(folder / 'firing_maps.png', *features)
    scores = result.scores
    headings = _heading_rows(scores)
    moments = moments_of(result, model)
    curves = curves_of(result.truth, result.estimates)
    trained = result.transform.apply(model.keyframes.poses[:, :2])
    lines = [Line(_label(name), curves[name], *LOOKS[name]) for name in result.estimates]
    page.write_page(
        folder,
        title,
        page.verdict(*judgment(scores, result.counts)),
        page.section('How far off?', page.table(*_position_rows(scores)),
                     page.table(*headings) if headings[1] else '', page.items(notes)),
        page.section('Where, and what did it see?', '<p>Click a point, or move the slider: all '
                     'plots mark that moment, and its image appears.</p>',
                     linked_plots(folder, curves['truth'], lines, moments, trained)),
        page.section('Where is it weak?', *_weak_parts(result, moments)),
        page.section('May I trust it?', page.items(trust_lines(scores))),
        page.section('What was rejected?', page.items(count_lines(result.counts))),
        page.section('Slow features', page.figure(folder / 'firing_maps.png', FIRING_CAPTION)),
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


def _weak_parts(result: Evaluation, moments: Sequence[Moment]) -> Iterator[str]:
    """Where the errors of the filter are largest, the remedy, and buttons for the worst images."""
    errors = errors_of(result.truth, result.estimates['ekf'])
    if not len(errors.seconds):
        return
    mean = errors.position_m.mean()
    weak = [k for k in worst_images(errors.places, errors.position_m) if k.error_m > _WEAK * mean]
    at = [f'near x {k.x_m:.1f} m, y {k.y_m:.1f} m: {k.error_m:.2f} m' for k in weak[:3]]
    remedy = (
        'These coordinates are those of the ground truth.',
        'Drive there in a further training drive, in two directions.',
    )
    even = f'Nowhere is the error more than {_WEAK:g} times its mean.'
    yield page.items([*at, *remedy] if at else [even])
    judged = [k for k in moments if not k.problem and math.isfinite(k.error_m(k.single))]
    places = np.array([moment.truth[:2] for moment in judged]).reshape(-1, 2)
    worst = worst_images(places, np.array([k.error_m(k.single) for k in judged]))
    buttons = [
        f'<button class="at" data-seconds="{judged[k.row].seconds:.3f}">x {k.x_m:.1f} m, '
        f'y {k.y_m:.1f} m: error {k.error_m:.2f} m</button>'
        for k in worst
    ]
    if buttons:
        yield f'<p>Images whose own places are farthest off: {" ".join(buttons)}</p>'


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
    rejected = sorted((why, n) for why, n in counts.get('fusion', {}).items() if why not in usual)
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
    if (drowned := counts.get('drowned', 0.0)) > DROWNED_WARNING:
        yield f'images: {drowned_text(drowned)}: drive at another hour, or shade the lens'
