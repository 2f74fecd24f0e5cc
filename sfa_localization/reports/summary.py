# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The result of a training in a few lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sfa_localization.training import Trained


def summary(trained: Trained) -> str:
    """Amount of data, certificate, expected errors, and what was skipped; without ground truth."""
    quality = trained.model.quality
    coverage = quality['coverage']
    worst = quality['worst']
    along, across = coverage['extent_m']
    proof = 'proven optimal' if quality['certified'] else 'NOT proven optimal'
    turned = ', then turned maps' if quality['turned'] else ''
    lines = [
        f'images: {quality["pictures"]} in {quality["segments"]} segments of odometry, '
        f'{coverage["length_m"]:.0f} m driven, about {along:.0f} m x {across:.0f} m covered',
        f'map: {quality["features_used"]} slow features{turned}, directions {proof} '
        f'(certificate {quality["certificate"]:.1e})',
        f'position: expect {quality["expected_error_m"]:.2f} m mean error of one image on paths '
        f'between the trained ones; worst near x {worst["x_m"]:.1f} m, y {worst["y_m"]:.1f} m: '
        f'{worst["expected_error_m"]:.2f} m',
    ]
    if 'expected_yaw_error_deg' in quality:
        lines.append(
            f'heading: expect {quality["expected_yaw_error_deg"]:.1f} degrees mean error there'
        )
    lines += point_lines(quality)
    for run, check in zip(trained.runs, trained.checks, strict=False):
        lines += [f'{run.name}: {text}' for text in check.wrong + check.corrected]
    for run, loss in zip(trained.runs, quality['turn_loss'], strict=True):
        if loss:
            lines.append(
                f'{run.name}: wheels lose {loss:.2f} m per radian in turns: taken into account'
            )
    used = {f'{run.name}: {name}': n for run in trained.runs for name, n in run.counts.items()}
    used['metric learning: images'] = trained.segments.images
    used['metric learning: odometry'] = trained.segments.odometry
    for name, count in used.items():
        lines += [f'{name}: {n} skipped: {why}' for why, n in sorted(count.skipped.items())]
    return '\n'.join(lines)


def point_lines(quality: Mapping[str, Any]) -> list[str]:
    """By how much the map misses each measured point, and what these say of the wheels."""
    if 'points' not in quality:
        return []
    lines = [
        f'{one["name"]}: x {one["x_m"]:.2f} m, y {one["y_m"]:.2f} m: missed by '
        f'{one["miss_m"]:.3f} m' + ('' if one['used'] else ', left out')
        for one in quality['points']
    ]
    scale, std = quality['odometry_scale'], quality['scale_std']
    return [*lines, f'scale: the way of wheels counts {scale:.4f} times, +- {std:.4f}']
