# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The page of a training: is the map good, where is it weak, may I trust it, what to drive next."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sfa_localization.data.geometry import Array, align
from sfa_localization.metric.forecast import Forecast
from sfa_localization.metric.learning import positions
from sfa_localization.reports import page
from sfa_localization.reports.summary import summary
from sfa_localization.training import Trained

GOOD_M, USEFUL_M = 0.5, 2.0
"""Expected errors of one image (m) at which the filter's default limits make a state DEGRADED, and
LOST."""
TRUSTED_SHARE = 0.9
"""Of the left-out images, the regions of 95 % hold at least so many where they can be believed."""
FEW_CROSSINGS = 5
"""With fewer crossings one bad stretch of odometry bends the map unnoticed."""
PARALLEL = 0.3
"""Spread of driving directions (0 parallel, 1 even) below which the drive was one-sided."""
_PLACES, _APART_M = 3, 2.0  # weak places named, and the distance between them (m)
_WEAK = 1.5  # times the expected error: ground that is clearly worse than usual
_SMOOTH = (
    'Each map shows one feature at the places of the images. Good ones change smoothly from place '
    'to place, and are the same whatever the heading.'
)
_UNUSUAL = (
    'Those that the map puts farthest from where they were taken. Look for a covered lens, people, '
    'glare, or places that look alike.'
)
Named = Sequence[tuple[str, str]]


def write_training_page(folder: Path, title: str, trained: Trained, figures: Named) -> None:
    """Write `folder`/index.html from figures there, (file, caption). Raises LocalizationError."""
    shown = {name: page.figure(folder / name, caption) for name, caption in figures}
    page.write_page(
        folder,
        title,
        page.verdict(*judgment(trained)),
        page.section('Is my map good?', page.items(quality_lines(trained)),
                     shown.get('line_fits.png', '')),
        page.section('Where is it weak?', page.items(weak_lines(trained)),
                     shown.get('coverage.png', '')),
        page.section('May I trust it?', page.items(trust_lines(trained)),
                     shown.get('headings.png', '')),
        page.section('What do I drive next?', page.items(advice(trained))),
        page.section('What was corrected in the odometry?', page.items(odometry_lines(trained)),
                     shown.get('odometry.png', '')),
        page.section('Slow features', page.paragraph(_SMOOTH), shown.get('firing_maps.png', '')),
        page.section('Worst images', page.paragraph(_UNUSUAL), shown['worst_images.png'])
        if 'worst_images.png' in shown else '',
        page.section('All numbers', page.text_block(summary(trained)),
                     shown.get('convergence.png', '')),
    )  # fmt: skip


def judgment(trained: Trained) -> tuple[str, str]:
    """The color of the page, and its answer in a sentence."""
    quality = trained.model.quality
    expected = quality['expected_error_m']
    if expected > USEFUL_M or trained.metric.diagnostics.mirror_ambiguous:
        return page.BAD, 'The map cannot be used yet: see what to drive next.'
    sure = quality['certified'] and quality['left_out_within_95'] >= TRUSTED_SHARE
    if expected > GOOD_M or not sure:
        return page.WEAK, 'The map can be used with care: see where it is weak.'
    return page.GOOD, f'The map is good: expect an error of {expected:.2f} m from one image.'


def quality_lines(trained: Trained) -> list[str]:
    """How much was driven, and what error to expect."""
    quality = trained.model.quality
    coverage = quality['coverage']
    along, across = coverage['extent_m']
    lines = [
        f'One image errs by {quality["expected_error_m"]:.2f} m on average on paths between the '
        'trained ones, in the light of training. The filter, which adds odometry, errs by less.',
        f'{quality["pictures"]} images, {coverage["length_m"]:.0f} m driven over about '
        f'{along:.0f} m x {across:.0f} m.',
        f'Odometry and slow features differ by {quality["residual_m"]:.2f} m on average.',
    ]
    if 'expected_yaw_error_deg' in quality:
        lines.insert(1, f'Its heading errs by {quality["expected_yaw_error_deg"]:.1f} degrees.')
    return lines


def weak_places(forecast: Forecast) -> Iterator[tuple[float, float, float]]:
    """x, y (m) and expected error (m) where it is largest, each apart from the others."""
    local, points = forecast.local, forecast.points
    left = np.ones(len(points), bool)
    for _ in range(_PLACES):
        at = int(np.argmax(np.where(left, local, -np.inf)))
        if not left[at] or local[at] < _WEAK * forecast.expected_m:
            return
        yield float(points[at, 0]), float(points[at, 1]), float(local[at])
        left &= np.hypot(*(points - points[at]).T) > _APART_M


def weak_lines(trained: Trained) -> list[str]:
    """Where the expected error is large."""
    forecast = trained.metric.forecast
    share = float((forecast.local > _WEAK * forecast.expected_m).mean())
    lines = [
        f'near x {x:.1f} m, y {y:.1f} m: {error:.2f} m' for x, y, error in weak_places(forecast)
    ]
    even = f'Nowhere is the expected error more than {_WEAK} times the mean.'
    uneven = f'On {share:.0%} of the covered ground it is more than {_WEAK} times the mean.'
    frame = 'x and y are those of the odometry where the first drive starts, or of its anchor.'
    return [*lines, uneven if lines else even, frame]


def trust_lines(trained: Trained) -> list[str]:
    """The certificate and the calibration, in words."""
    quality, result = trained.model.quality, trained.metric
    angle = np.degrees(result.diagnostics.angle_std_rad)
    proven = (
        'Proven: no other directions of the segments fit odometry and images better '
        if quality['certified']
        else 'NOT proven: other directions of the segments may fit better '
    )
    lines = [
        proven + f'(certificate {quality["certificate"]:.1e}, at least zero up to rounding).',
        f'Of the images that were left out, {quality["left_out_within_95"]:.0%} lie in the region '
        'that claims to hold 95 %.',
        f'The least certain direction of a segment is known to {angle:.1f} degrees.',
        'Not included: other light than in training, and a wheel radius that is wrong everywhere.',
    ]
    if result.diagnostics.mirror_ambiguous:
        lines.insert(1, 'The mirror image of the map fits as well: drive curves.')
    return lines


def advice(trained: Trained) -> list[str]:
    """What to drive next, most useful first."""
    found, result = trained.metric.diagnostics, trained.metric
    lines = [
        f'Cross x {x:.1f} m, y {y:.1f} m, in two directions.'
        for x, y, _ in weak_places(result.forecast)
    ]
    if found.directions < PARALLEL:
        lines.append('Drive in other directions: most of this drive was parallel.')
    if found.crossings < FEW_CROSSINGS:
        lines.append(f'Cross your own track: this drive does so {found.crossings} times.')
    if found.mirror_ambiguous:
        lines.append('Drive some curves: straight lines alone do not show left and right.')
    lines.append('For other light, drive once more when it is cloudy, or at another hour.')
    return lines


def odometry_lines(trained: Trained) -> list[str]:
    """By how much odometry drifted against the map."""
    bias = np.degrees(trained.metric.yaw_bias)
    lines = []
    if len(bias):
        largest = float(bias[np.abs(bias).argmax()])
        fast = 'fast' if largest > 0 else 'slowly'
        lines.append(f'It turned too {fast}, by up to {abs(largest):.2f} degrees per second.')
    for run, places, driven in drives(trained):
        apart = np.hypot(*(driven - places).T)
        lines.append(
            f'{run}: its path alone, laid on the map, is off by {apart.mean():.2f} m on average '
            f'and by {apart.max():.2f} m at most.'
        )
    return lines


def drives(trained: Trained) -> Iterator[tuple[str, Array, Array]]:
    """Of each drive its name, its places in the map (M, 2), and those of odometry laid on them."""
    images, places = positions(trained.metric, trained.segments)
    delays = trained.model.quality['camera_delay_s']
    start = 0
    for run, delay in zip(trained.runs, delays, strict=True):
        stop = start + len(run.panoramas)
        own = (images >= start) & (images < stop)
        if own.sum() > 1:
            stamps = run.panoramas.stamps_ns[images[own] - start] - round((delay or 0.0) * 1e9)
            driven = run.odometry.trajectory.at(stamps)[:, :2]
            yield run.name, places[own], align(driven, places[own]).apply(driven)
        start = stop
