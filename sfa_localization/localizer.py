# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The paper, live: judge an image, locate it, and fuse its pose with odometry in an EKF.

sfa_node runs the `Observer`, ekf_node the `PoseFilter`; between them pass poses with covariance,
and the turn of the robot as the images show it. `Localizer` holds both, for programs without ROS,
for evaluation and for tuning: offline the filter receives the same inputs as on the topics.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
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
from sfa_localization.fusion.pose_filter import PoseFilter, State, Status, Update
from sfa_localization.fusion.settings import FilterConfig
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


def filter_of(
    model: PlaceModel, config: FilterConfig | None = None, kind: type[PoseFilter] = PoseFilter
) -> PoseFilter:
    """A filter that starts with the robot of the model: camera delay, wheel scale, and so on."""
    fused = kind(config, model.error_correlation)
    fused.expect(model.rig)
    return fused


class Localizer:
    """Online localization: feed odometry and panoramas as they arrive.

    >>> localizer = Localizer(PlaceModel.load('garden.npz'))
    >>> localizer.add_odometry(stamp_ns, v, omega)
    >>> localizer.add_panorama(stamp_ns, panorama)
    >>> localizer.state.pose, localizer.status
    """

    def __init__(
        self,
        model: PlaceModel,
        config: FilterConfig | None = None,
        watch: WatchConfig | None = None,
        kind: type[PoseFilter] = PoseFilter,
    ) -> None:
        self.observer = Observer(model, watch)
        self.filter = filter_of(model, config, kind)

    def add_odometry(
        self,
        stamp_ns: int,
        v: float,
        omega: float,
        variances: Sequence[float] | Array = (0.0, 0.0),
        pose: Sequence[float] | Array | None = None,
    ) -> State | None:
        """Add speed m/s and yaw rate rad/s at a stamp, with their variances (0: unknown), and the
        pose (3,) of the odometry, x m, y m, yaw rad, if it has one.

        Returns the estimate at that stamp; None before the start, and for an unusable message.
        """
        if self.filter.add_odometry(stamp_ns, v, omega, variances, pose):
            return None
        return self.filter.at(stamp_ns)

    def add_panorama(self, stamp_ns: int, panorama: Image) -> Observation:
        """Locate a panorama (H, W, 3) uint8 BGR and fuse it. Raises ModelError for a wrong size."""
        observation = self.observer.observe(stamp_ns, panorama)
        self.add_observation(observation)
        return observation

    def add_observation(self, observation: Observation) -> Update:
        """Fuse the pose and the turn that an image shows."""
        stamp_ns = observation.stamp_ns
        self.filter.add_turned(stamp_ns, observation.turned)
        return self.filter.add_measurement(stamp_ns, observation.pose, observation.covariance)

    @property
    def state(self) -> State | None:
        """The newest estimate in the map frame; None before the start."""
        return self.filter.state

    @property
    def status(self) -> Status:
        """Whether the robot is lost, and why."""
        return self.filter.status
