# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The page of an evaluation: how far off, where, and was the robot ever sure and wrong."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image, Stamps, Trajectory
from sfa_localization.reports import evaluation as report
from sfa_localization.reports import page
from sfa_localization.reports.bag import write_contact_sheet

WORST_IMAGES, WORST_APART_M = 6, 1.0
"""Worst images shown, and the distance (m) between them: neighbors look alike."""
TRUSTED_SHARE = 0.8
"""Of the true positions, the filter's regions of 95 % hold at least so many where they can be
believed: errors of neighboring images are alike, so one bad corner moves the share."""
_WEAK = 2.0  # times the mean error: places that are clearly worse than usual


class WorstImage(NamedTuple):
    """An image, where it was taken (x, y in m, in the frame of the truth), and its error (m)."""

    stamp_ns: int
    x_m: float
    y_m: float
    error_m: float


def worst_images(truth: Trajectory, estimate: Trajectory) -> list[WorstImage]:
    """The images whose positions are farthest from the truth, each apart from the others."""
    found: list[WorstImage] = []
    stamps, places, errors = _errors(truth, estimate)
    for k in np.argsort(-errors):
        x, y = places[k].tolist()
        if any(np.hypot(one.x_m - x, one.y_m - y) < WORST_APART_M for one in found):
            continue
        found.append(WorstImage(int(stamps[k]), x, y, float(errors[k])))
        if len(found) == WORST_IMAGES:
            break
    return found


def _errors(truth: Trajectory, estimate: Trajectory) -> tuple[Stamps, Array, Array]:
    """Stamps (M,), true places (M, 2) and position errors (M,) m where the truth is known."""
    kept = truth.covers(estimate.stamps_ns)
    places = truth.at(estimate.stamps_ns[kept])[:, :2]
    errors = np.asarray(np.hypot(*(estimate.poses[kept, :2] - places).T))
    return estimate.stamps_ns[kept], places, errors


def write_evaluation_page(
    folder: Path,
    title: str,
    truth: Trajectory,
    estimates: Mapping[str, Trajectory],
    scores: report.Scores,
    counts: Mapping[str, Any],
    samples: Mapping[WorstImage, Image],
) -> None:
    """Write `folder`/index.html beside the figures of `evaluation.write_report`.

    `counts` are those of Evaluation, `samples` the worst images. Raises LocalizationError.
    """
    error_map_figure(folder / 'error_map.png', truth, estimates['ekf'])
    captions = [f'x {k.x_m:.1f} m, y {k.y_m:.1f} m: error {k.error_m:.2f} m' for k in samples]
    if samples:
        sheet = folder / 'worst_images.png'
        write_contact_sheet([*samples.values()], 'Worst images', sheet, captions)
    page.write_page(
        folder,
        title,
        page.verdict(*judgment(scores, counts)),
        page.section('How far off?', _position_table(scores), _heading_table(scores),
                     page.figure(folder / 'trajectories.png', 'Estimated and true paths')),
        page.section('Where is it weak?', page.items([*_weak_lines(truth, estimates['ekf'])]),
                     page.figure(folder / 'error_map.png', 'Error of the filter along the path')),
        page.section('May I trust it?', page.items([*_trust_lines(scores, counts)]),
                     page.figure(folder / 'errors.png', 'Errors over time')),
        page.section('What was rejected?', page.items([*_rejected(counts)])),
        page.section('Slow features',
                     page.figure(folder / 'firing_maps.png', 'Slow features at the estimates')),
        page.section('Worst images', page.figure(folder / 'worst_images.png', 'Single images with '
                     'the largest errors, and where they were taken')) if samples else '',
    )  # fmt: skip


def judgment(scores: report.Scores, counts: Mapping[str, Any]) -> tuple[str, str]:
    """The color of the page, and its answer in a sentence."""
    mean = scores['ekf']['mean']
    if mean is None:
        return page.BAD, 'The filter did not start, or the truth covers none of its estimates.'
    if counts['false_localised_s'] > 0:
        seconds = f'{counts["false_localised_s"]:.1f} s'
        return page.BAD, f'For {seconds} the robot was sure and more than a meter off.'
    wheels = scores['odometry']['mean']
    if wheels is not None and mean > wheels:
        return page.WEAK, f'The filter errs by {mean:.2f} m: more than the wheels alone.'
    held = scores['ekf'].get('within_95')
    if held is not None and held < TRUSTED_SHARE:
        return page.WEAK, f'The filter errs by {mean:.2f} m, but is surer than it should be.'
    return page.GOOD, f'The filter errs by {mean:.2f} m on average, and says how sure it is.'


def error_map_figure(path: Path, truth: Trajectory, estimate: Trajectory) -> None:
    """Draw the true path colored by the position error (m) of an estimate."""
    figure = Figure(figsize=(7.0, 6.0), layout='constrained')
    axes = figure.add_subplot()
    _, places, errors = _errors(truth, estimate)
    top = max(float(np.percentile(errors, 98)), 0.05) if len(errors) else 1.0
    dots = axes.scatter(
        places[:, 0], places[:, 1], c=errors, s=14, cmap='viridis', vmin=0.0, vmax=top
    )
    figure.colorbar(dots, label='position error (m)', shrink=0.85, extend='max')
    axes.set_aspect('equal', adjustable='datalim')
    axes.set(xlabel='x (m)', ylabel='y (m)', title='Position error of the filter')
    axes.grid(alpha=0.3)
    report.save(figure, path)


def _position_table(scores: report.Scores) -> str:
    head = ['position error (m)', *report.COLUMNS]
    return page.table(head, [
        [report.LABELS.get(name, name), *(report.number(one[c], c) for c in report.COLUMNS)]
        for name, one in scores.items()
    ])  # fmt: skip


def _heading_table(scores: report.Scores) -> str:
    head = ['heading error (degrees)', *report.YAW_COLUMNS]
    return page.table(head, [
        [report.LABELS.get(name, name), *(f'{one["yaw_deg"][c]:.2f}' for c in report.YAW_COLUMNS)]
        for name, one in scores.items() if one.get('yaw_deg')
    ])  # fmt: skip


def _weak_lines(truth: Trajectory, estimate: Trajectory) -> Iterator[str]:
    """Where the filter is worst: what to drive again in a further training drive."""
    _, _, errors = _errors(truth, estimate)
    if not len(errors):
        return
    found = [one for one in worst_images(truth, estimate) if one.error_m > _WEAK * errors.mean()]
    for one in found[:3]:
        yield f'x {one.x_m:.1f} m, y {one.y_m:.1f} m: {one.error_m:.2f} m'
    if found:
        yield 'Drive there in a further training drive, in two directions.'
    else:
        yield f'Nowhere is the error more than {_WEAK:g} times its mean.'


def _trust_lines(scores: report.Scores, counts: Mapping[str, Any]) -> Iterator[str]:
    yield from report.trust_lines(scores)
    total = sum(counts['states_s'].values())
    for name, seconds in counts['states_s'].items():
        yield f'{name}: {seconds / max(total, 1e-9):.0%} of the drive'
    yield f'LOCALISED and more than a meter off: {counts["false_localised_s"]:.1f} s'


def _rejected(counts: Mapping[str, Any]) -> Iterator[str]:
    """What was not used, and why: of the inputs, and by the filter."""
    for stream in ('images', 'odometry', 'observations'):
        for reason, n in sorted(counts[stream]['skipped'].items()):
            yield f'{n} {stream}: {reason}'
    used = {'odometry: used', 'measurement: accepted', 'measurement: started'}
    for reason, n in sorted(counts['fusion'].items()):
        if reason not in used:
            yield f'{n} times {reason}'
