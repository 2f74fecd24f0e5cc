# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The first half of the paper, live: judge an image, and locate it. It imports no filter."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.camera.turns import VisualGyro
from sfa_localization.camera.watch import ImageWatch
from sfa_localization.data.errors import ModelError
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import LARGEST_VARIANCE
from sfa_localization.data.run import BATCH, Image, Run, Stamps
from sfa_localization.data.threads import one_core
from sfa_localization.keyframes.light import Conditions
from sfa_localization.keyframes.observation import UNKNOWN_YAW_VARIANCE
from sfa_localization.keyframes.observation import Observation as Observation
from sfa_localization.place_model import PlaceModel, View, require_panorama

UNKNOWN_VARIANCE = LARGEST_VARIANCE
"""Position variance, m^2, of an unusable image: the filter ignores such a pose."""


class Observer:
    """Judges and locates the panoramas of a camera, in the order of time."""

    def __init__(self, model: PlaceModel, config: WatchConfig | None = None) -> None:
        self.watch = ImageWatch(config)
        self._gyro = VisualGyro(model.panorama.clockwise)
        self.use(model)

    def use(self, model: PlaceModel) -> None:
        """Continue with another model, and forget the light estimated with the last one."""
        self.model = model
        self._conditions = Conditions()

    @property
    def slow_error_factor(self) -> float:
        """Factor by which the errors of slow features have lately exceeded those of training."""
        return self._conditions.slow_error_factor

    def observe(self, stamp_ns: int, panorama: Image) -> Observation:
        """Judge and locate a panorama (H, W, 3) uint8 BGR. Raises ModelError for a wrong size."""
        require_panorama(panorama)
        return self.observe_all(np.array([stamp_ns]), panorama[None])[0]

    @one_core()
    def observe_all(self, stamps_ns: Stamps, panoramas: Image) -> list[Observation]:
        """Observe panoramas (T, H, W, 3) with stamps (T,) at once, which is faster."""
        if len(panoramas):
            self._require_size(panoramas[0])
        panoramas = self.model.prepared(panoramas)
        judged = [self._judge(panorama) for panorama in panoramas]
        views = self.model.views(panoramas)
        return [
            replace(self._locate(view, problem), stamp_ns=stamp_ns, turned=turned)
            for stamp_ns, (problem, turned), view in zip(
                stamps_ns.tolist(), judged, views, strict=True
            )
        ]

    def observe_run(self, run: Run) -> Iterator[Observation]:
        """Observe every image of a recorded run."""
        start = 0
        for batch in run.panoramas.batches(BATCH):
            yield from self.observe_all(run.panoramas.stamps_ns[start : start + len(batch)], batch)
            start += len(batch)

    def _judge(self, panorama: Image) -> tuple[str, float]:
        """The problem of the next image, and the turn of the camera since the first one, rad."""
        problem = self.watch.judge(panorama)
        return problem, math.nan if problem else self._gyro.add(panorama)

    def _locate(self, view: View, problem: str) -> Observation:
        """Locate an image in the recent light; a usable image updates the estimate of the light.

        An unusable image gets the covariance of an unknown pose.
        """
        location = self.model.located(view, self._conditions)
        observation = self.model.observed(view, location)
        if not observation.finite:
            problem = problem or 'the model gives no finite estimate for this image'
        problem = problem or self.watch.judge_place(observation.explained)
        if not problem:
            self._conditions.add(location)
            return observation
        pose = observation.pose if observation.finite else np.zeros(3)
        return replace(observation, pose=pose, covariance=unusable_covariance(), problem=problem)

    def _require_size(self, panorama: Image) -> None:
        size = self.model.panorama
        require_panorama(panorama)
        if panorama.shape[:2] != (size.height, size.width):
            height, width = panorama.shape[:2]
            raise ModelError(
                f'panorama is {width}x{height}, but the model was trained on '
                f'{size.width}x{size.height}: set width and height of omnicam_node'
            )


def unusable_covariance() -> Array:
    """Covariance (3, 3) of [x, y, yaw] for an unusable image."""
    return np.diag([UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, UNKNOWN_YAW_VARIANCE])
