# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The result of a training in a few lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sfa_localization.camera import surround
from sfa_localization.camera.lens_report import sentence
from sfa_localization.inspection import InspectionConfig, too_sparse
from sfa_localization.motion.sources import MAP
from sfa_localization.training import Trained

GOOD = 'good'
WEAK = 'weak'
BAD = 'bad'
GOOD_M = 0.5
USEFUL_M = 2.0
GOOD_DEG = 11.5
"""Expected errors of an image at which a filter with default limits is DEGRADED and LOST (m), and
DEGRADED by its heading (degrees)."""
TRUSTED_SHARE = 0.9
"""Share of left-out images in their 95 % regions below which covariances are too small."""
EXPLAINED = 0.5
"""Share of the variance of places that the features explain in left-out images; with less, the
images are almost useless."""


def summary(trained: Trained) -> str:
    """Amount of data, certificate, expected errors, and skipped data, without ground truth."""
    grade, verdict = judgment(trained)
    quality = trained.model.quality
    lines = [*_map_lines(quality), *_drive_lines(trained)]
    if has_forecast(grade, quality):
        lines[2:2] = _forecast_lines(quality)
    used = {f'{run.name}: {name}': n for run in trained.runs for name, n in run.counts.items()}
    used['metric learning: images'] = trained.segments.images
    used['metric learning: odometry'] = trained.segments.odometry
    for name, count in used.items():
        lines += [f'{name}: {n} skipped: {why}' for why, n in sorted(count.skipped.items())]
    return '\n'.join(lines if grade == GOOD else [verdict, *lines])


def has_forecast(grade: str, quality: Mapping[str, Any]) -> bool:
    """Whether errors can be forecast: only for a map of the right shape, of images that show it."""
    return grade != BAD or bool(quality['expected_error_m'] > USEFUL_M)


def _map_lines(quality: Mapping[str, Any]) -> list[str]:
    """Amount of data, and certificate."""
    coverage = quality['coverage']
    along, across = coverage['extent_m']
    proof = 'proven optimal' if quality['certified'] else 'NOT proven optimal'
    turned = ', then turned maps' if quality['turned'] else ''
    return [
        f'images: {quality["pictures"]} in {quality["segments"]} segments of odometry, '
        f'{coverage["length_m"]:.0f} m driven, about {along:.0f} m x {across:.0f} m covered',
        f'map: {quality["features_used"]} slow features{turned}, directions {proof} '
        f'(certificate {quality["certificate"]:.1e})',
    ]


def _forecast_lines(quality: Mapping[str, Any]) -> list[str]:
    """Expected errors of one image."""
    worst = quality['worst']
    lines = [
        f'position: expect {quality["expected_error_m"]:.2f} m mean error of one image on paths '
        f'between the trained ones; worst near x {worst["x_m"]:.1f} m, y {worst["y_m"]:.1f} m: '
        f'{worst["expected_error_m"]:.2f} m',
    ]
    if 'expected_yaw_error_deg' in quality:
        lines.append(f'heading: expect {quality["expected_yaw_error_deg"]:.1f} degrees mean error')
    return lines


def _drive_lines(trained: Trained) -> list[str]:
    """Lens, rig and measured points, and what was corrected of each drive."""
    lines = []
    if trained.model.surround:
        lines.append(surround.sentence(trained.model.surround))
    if trained.lens:
        is_used = trained.lens.calibration == trained.model.lens
        of = 'lens' if is_used else 'lens as the drive shows it, beside the described one in use'
        lines.append(f'{of}: {sentence(trained.lens)}')
    lines += [*trained.model.rig.as_text(), *point_lines(trained.model.quality)]
    for run, check in zip(trained.runs, trained.checks, strict=False):
        lines += [f'{run.name}: {text}' for text in check.wrong + check.corrected]
    for run, way in zip(trained.runs, trained.segments.ways, strict=True):
        if way and way.loss.value:
            loss = f'{way.loss.value:.2f} m per radian in turns'
            lines.append(f'{run.name}: wheels lose {loss}: taken into account')
    return lines


def judgment(trained: Trained) -> tuple[str, str]:
    """The grade of a map, and a sentence about it."""
    quality = trained.model.quality
    expected = quality['expected_error_m']
    by_map = [pair for check in trained.checks for pair in check.pairs if pair.b == MAP]
    if any(pair.differs('alike') or pair.differs('scale') for pair in by_map):
        return BAD, 'The map cannot be used: it has another shape than its odometry.'
    route = trained.metric.diagnostics.single_route
    if quality['explained'] < EXPLAINED and not route:
        return BAD, 'The map cannot be used: the images hardly show where they were taken.'
    if expected > USEFUL_M:
        return BAD, (
            f'The map cannot be used yet: expect an error of {expected:.2f} m from one image; see '
            'what to drive next.'
        )
    care = too_sparse(trained.metric.poses, InspectionConfig().max_spacing)
    if quality.get('expected_yaw_error_deg', 0.0) > GOOD_DEG:
        care.append('images look alike at several headings, and perhaps at several places')
    if expected > GOOD_M:
        care.append(f'expect an error of {expected:.2f} m from one image')
    if not quality['certified']:
        care.append('no certificate proves that no other map fits better')
    if (share := quality['left_out_within_95']) < TRUSTED_SHARE:
        care.append(f'its 95 % regions hold {share:.0%} of the images that were left out')
    if care:
        return WEAK, f'The map can be used with care: {"; ".join(care)}.'
    return GOOD, f'The map is good: expect an error of {expected:.2f} m from one image.'


def point_lines(quality: Mapping[str, Any]) -> list[str]:
    """The origin of satellite fixes, and the error of the map at each measured point."""
    lines = []
    if 'origin' in quality:
        latitude, longitude = quality['origin']
        lines = [
            f'points: latitude {latitude:.7f}, longitude {longitude:.7f} is the origin; x east, '
            'y north'
        ]
    return lines + [
        f'{point["name"]}: x {point["x_m"]:.2f} m, y {point["y_m"]:.2f} m: missed by '
        f'{point["miss_m"]:.3f} m' + ('' if point['used'] else ', left out')
        for point in quality.get('points', ())
    ]
