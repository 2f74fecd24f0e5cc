# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Images of an evaluated drive, each beside its likest keyframe and the estimates there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from html import escape
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from PIL import Image as Pictures

from sfa_localization.data.geometry import (
    Array,
    Indices,
    RigidTransform,
    compose,
    rotation,
    wrap_angle,
)
from sfa_localization.data.run import Image
from sfa_localization.keyframes.likest import Likest, likest
from sfa_localization.reports import page
from sfa_localization.reports.figures import worst_images

if TYPE_CHECKING:
    from sfa_localization.evaluation import Evaluation, Step
    from sfa_localization.place_model import PlaceModel

MOST = 120
"""Images in a page, evenly over the drive: 5 kB each."""
WIDTH = 480
"""Pixels of a panorama in a page: phones show no more."""
QUALITY = 50
"""Of these small images; figures with text need more."""


class Estimate(NamedTuple):
    """A pose (3,) [x m, y m, yaw rad] in the frame of the truth, and its covariance (3, 3)."""

    pose: Array
    covariance: Array

    @classmethod
    def of(cls, transform: RigidTransform, pose: Array, covariance: Array) -> Estimate:
        """From an estimate in the map, which the transform leads to the frame of the truth."""
        turn = np.eye(3)
        turn[:2, :2] = rotation(transform.yaw_rad)
        return cls(compose(transform.pose, pose), turn @ covariance @ turn.T)


class Moment(NamedTuple):
    """An image of the drive, `seconds` after the truth's start: the panorama, the likest keyframe
    with its place (3,), and the true pose (3,), NaN where it was not recorded. The image alone
    shows `single`, or has a `problem`; `filtered` is None before the filter starts.
    """

    number: int
    stamp_ns: int
    seconds: float
    panorama: Image
    match: Likest
    keyframe: Array
    truth: Array
    single: Estimate
    problem: str
    filtered: Estimate | None

    @property
    def place(self) -> Array:
        """Where to mark it (2,) m: by the filter, or else by the image alone."""
        return (self.filtered or self.single).pose[:2]

    def error_m(self, estimate: Estimate | None) -> float:
        """The distance of an estimate from the truth, NaN where one of them is unknown."""
        if estimate is None:
            return math.nan
        return float(np.hypot(*(estimate.pose - self.truth)[:2]))


def moments_of(result: Evaluation, model: PlaceModel) -> list[Moment]:
    """Images evenly over the drive, and those whose own places are farthest from the truth."""
    steps = [step for step in result.steps if step.image is not None]
    taken_ns = np.array([step.state.stamp_ns if step.state else step.stamp_ns for step in steps])
    known = result.truth.covers(taken_ns)
    truth = np.where(known[:, None], result.truth.at(taken_ns), np.nan)
    seconds = (taken_ns - result.truth.stamps_ns[0]) * 1e-9
    return [
        _moment(row, steps[row], float(seconds[row]), truth[row], result, model)
        for row in _chosen(result, steps, truth).tolist()
    ]


def _chosen(result: Evaluation, steps: Sequence[Step], truth: Array) -> Indices:
    """Rows of at most MOST images, among them the worst ones."""
    poses = [step.image.pose for step in steps if step.image]
    errors = np.hypot(*(compose(result.transform.pose, np.array(poses)) - truth)[:, :2].T)
    used = [step.image is not None and not step.image.problem for step in steps]
    judged = np.flatnonzero(np.isfinite(errors) & used)
    worst = [judged[one.row] for one in worst_images(truth[judged, :2], errors[judged])]
    even = np.linspace(0, len(steps) - 1, min(MOST - len(worst), len(steps)))
    return np.unique([*np.rint(even).astype(int), *worst])


def _moment(
    row: int, step: Step, seconds: float, truth: Array, result: Evaluation, model: PlaceModel
) -> Moment:
    assert step.image is not None
    panorama = result.run.panoramas.read(row, row + 1)
    match = likest(model.keyframes, model.prepared(panorama)[0])
    transform = result.transform
    state = step.state
    return Moment(
        row,
        step.stamp_ns,
        seconds,
        panorama[0],
        match,
        compose(transform.pose, match.pose),
        truth,
        Estimate.of(transform, step.image.pose, step.image.covariance),
        step.image.problem,
        Estimate.of(transform, state.pose, state.pose_covariance) if state else None,
    )


def cards(moments: Sequence[Moment]) -> str:
    """A part of the page about each image, of which the script shows one."""
    return '\n'.join(_card(moment, shown=row == 0) for row, moment in enumerate(moments))


def _card(moment: Moment, shown: bool) -> str:
    """What an image shows, its likest keyframe, and the poses."""
    stamp = f'{moment.stamp_ns // 10**9}.{moment.stamp_ns % 10**9:09d}'
    hidden = '' if shown else ' hidden'
    problem = f'<p class="verdict weak">Not used: {escape(moment.problem)}</p>'
    return (
        f'<article class="moment" data-stamp="{moment.stamp_ns}" '
        f'data-seconds="{moment.seconds:.3f}"{hidden}>'
        f'<h3>Image {moment.number + 1} at {moment.seconds:.2f} s</h3>'
        f'<p>stamp {stamp} s</p>'
        + (problem if moment.problem else '')
        + ''.join(_pictures(moment))
        + page.table(('', 'x (m)', 'y (m)', 'heading (°)', 'error (m)'), _rows(moment))
        + '</article>'
    )


def _rows(moment: Moment) -> list[list[str]]:
    """Cells of the poses, with their standard deviations."""
    rows = [['truth', *_cells(moment.truth), '']]
    named = {'image alone': None if moment.problem else moment.single, 'filter': moment.filtered}
    for name, estimate in named.items():
        if estimate:
            std = np.sqrt(estimate.covariance.diagonal())
            rows.append([name, *_cells(estimate.pose, std), f'{moment.error_m(estimate):.2f}'])
    away_m = np.hypot(*(moment.keyframe - moment.truth)[:2])
    return [*rows, ['keyframe', *_cells(moment.keyframe), f'{away_m:.2f} away']]


def _cells(pose: Array, std: Array | None = None) -> list[str]:
    """x, y and heading (degrees) of a pose, with standard deviations if there are any."""
    values = *pose[:2].tolist(), math.degrees(wrap_angle(pose[2]))
    digits = 2, 2, 1
    texts = [f'{value:.{places}f}' for value, places in zip(values, digits, strict=True)]
    if std is None:
        return texts
    spreads = *std[:2].tolist(), math.degrees(std[2])
    return [
        f'{text} ± {spread:.{places}f}'
        for text, spread, places in zip(texts, spreads, digits, strict=True)
    ]


def _pictures(moment: Moment) -> Iterator[str]:
    """The panorama, and below it the textures that are compared, column by column."""
    match = moment.match
    panorama = _as_picture(moment.panorama)
    panorama.thumbnail((WIDTH, WIDTH))
    yield page.embedded(panorama, 'Image of the drive', QUALITY)
    likeness = f'Likest keyframe, number {match.row}: correlation {match.correlation:.2f}'
    size = WIDTH // 3, max(1, WIDTH * panorama.height // panorama.width // 3)
    for image, caption in (
        (match.image, 'The same, as it is compared'),
        (match.keyframe, likeness),
    ):
        yield page.embedded(_as_picture(image).resize(size), caption, QUALITY)


def _as_picture(image: Image) -> Pictures.Image:
    return Pictures.fromarray(np.ascontiguousarray(image[..., ::-1]))
