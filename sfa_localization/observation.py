# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What a panorama says of the robot's pose: judged, located, and made ready for the filter.

sfa_node, `Localizer`, evaluation and tuning all look at pictures through `Observer`, so that what
the filter gets offline is what crosses the topic between sfa_node and ekf_node.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from sfa_localization.config import WatchConfig
from sfa_localization.errors import ModelError
from sfa_localization.geometry import Array
from sfa_localization.heading import UNKNOWN_YAW_VARIANCE
from sfa_localization.place_model import Estimate, PlaceModel
from sfa_localization.run import BATCH, Image, Run, Stamps
from sfa_localization.visual_turns import VisualGyro

UNKNOWN_VARIANCE = 1e6
"""Variance, m^2, of the position of an unusable picture: the filter leaves it out."""
_STRIDE = 3


@dataclass(frozen=True, slots=True)
class Observation:
    """One panorama's measurement of the robot's pose: `pose` and `covariance` reach the filter.

    `pose` (3,) is [x m, y m, yaw rad] in the map, yaw 0 where the model has no compass;
    `covariance` (3, 3) in the same order. `problem` is why the picture cannot be believed, ''
    when it can; the covariance then says that nothing is known. `estimate` is the model's own.
    `turned` is the heading (rad, from wherever) that the shifts between the pictures add up to,
    NaN for a picture that shows nothing: it knows no map, and tells the filter the camera's delay.
    """

    stamp_ns: int
    pose: Array
    covariance: Array
    problem: str
    estimate: Estimate
    turned: float = np.nan


class Observer:
    """Looks at the panoramas of one camera, in the order in which they were taken."""

    def __init__(self, model: PlaceModel, config: WatchConfig | None = None) -> None:
        self.model = model
        self.watch = PictureWatch(config)
        self._gyro = VisualGyro(model.panorama.clockwise)

    def observe(self, stamp_ns: int, panorama: Image) -> Observation:
        """Judge and locate a panorama (H, W, 3) uint8 BGR. Raises ModelError for a wrong size."""
        self._require_size(panorama)
        problem, turned = self._judge(panorama)
        return self._observation(stamp_ns, self.model.locate(panorama), problem, turned)

    def observe_all(self, stamps_ns: Stamps, panoramas: Image) -> list[Observation]:
        """The same for panoramas (T, H, W, 3) with stamps (T,), quicker."""
        for panorama in panoramas[:1]:
            self._require_size(panorama)
        judged = [self._judge(panorama) for panorama in panoramas]
        estimates = self.model.locate_all(panoramas)
        return [
            self._observation(int(stamp_ns), estimate, *verdict)
            for stamp_ns, estimate, verdict in zip(stamps_ns, estimates, judged, strict=True)
        ]

    def observe_run(self, run: Run) -> Iterator[Observation]:
        """The same for every picture of a recorded run."""
        at = 0
        for batch in run.panoramas.batches(BATCH):
            yield from self.observe_all(run.panoramas.stamps_ns[at : at + len(batch)], batch)
            at += len(batch)

    def _judge(self, panorama: Image) -> tuple[str, float]:
        """The problem of the next picture, and how far it has turned."""
        problem = self.watch.judge(panorama)
        return problem, np.nan if problem else self._gyro.add(panorama)

    def _require_size(self, panorama: Image) -> None:
        size = self.model.panorama
        if panorama.shape[:2] != (size.height, size.width):
            height, width = panorama.shape[:2]
            raise ModelError(
                f'panorama is {width}x{height}, but the model was trained on '
                f'{size.width}x{size.height}: set width and height of omnicam_node'
            )

    def _observation(
        self, stamp_ns: int, estimate: Estimate, problem: str, turned: float
    ) -> Observation:
        if not _is_finite(estimate):
            problem = problem or 'the model gives no finite estimate for this picture'
            nothing = unusable_covariance()
            return Observation(stamp_ns, np.zeros(3), nothing, problem, estimate, turned)
        problem = problem or self.watch.judge_novelty(estimate.novelty)
        yaw = estimate.yaw if np.isfinite(estimate.yaw) else 0.0
        covariance = unusable_covariance() if problem else estimate.covariance
        return Observation(
            stamp_ns, np.append(estimate.position, yaw), covariance, problem, estimate, turned
        )


class PictureWatch:
    """Is a picture worth believing? Dark, covered, frozen and foreign ones are not."""

    def __init__(self, config: WatchConfig | None = None) -> None:
        self.config = config or WatchConfig()
        self._last: Image | None = None
        self._repeats = 0

    def judge(self, panorama: Image) -> str:
        """Why a panorama (H, W, 3) uint8, the next one, cannot be believed; '' when it can."""
        sample = panorama[::_STRIDE, ::_STRIDE]
        equal = self._last is not None and np.array_equal(sample, self._last)
        self._repeats = self._repeats + 1 if equal else 0
        if not equal:
            self._last = sample.copy()
        mean, deviation = cv2.meanStdDev(sample)
        if float(mean.mean()) < self.config.dark_level:
            return 'picture is dark'
        if float(deviation.mean()) < self.config.flat_level:
            return 'picture is covered: it shows nothing'
        if self._repeats + 1 >= self.config.frozen_pictures:
            return 'camera is frozen: it repeats its picture'
        return ''

    def judge_novelty(self, novelty: float) -> str:
        """Why a picture of this novelty cannot be believed; '' when it can."""
        if not novelty <= self.config.novelty_unusable:
            return 'picture is unlike any of training'
        return ''


def unusable_covariance() -> Array:
    """Covariance (3, 3) of [x, y, yaw] of a picture that shows nothing."""
    return np.diag([UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, UNKNOWN_YAW_VARIANCE])


def _is_finite(estimate: Estimate) -> bool:
    """Whether all is known that must be; the yaw may be missing."""
    known = (estimate.slow_features, estimate.position, estimate.covariance)
    return all(bool(np.all(np.isfinite(part))) for part in known)
