# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The paper, live: judge an image, locate it, and fuse its pose with odometry in an EKF.

sfa_node holds the `Observer`, ekf_node the `PoseFilter`; a pose with its covariance, and how far
the images have turned, are all that passes between them. `Localizer` is both in one object, for
programs without ROS, for evaluation and for tuning: the filter receives offline what it receives
on the topics between the nodes.
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
from sfa_localization.fusion.replay import replay
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.keyframes.light import Conditions
from sfa_localization.keyframes.observation import UNKNOWN_YAW_VARIANCE
from sfa_localization.keyframes.observation import Observation as Observation
from sfa_localization.place_model import PlaceModel, View, require_panorama

UNKNOWN_VARIANCE = LARGEST_VARIANCE
"""Variance, m^2, of the position of an unusable image: the filter leaves it out."""


class Observer:
    """Judges and locates the panoramas of one camera, in the order in which they were taken."""

    def __init__(self, model: PlaceModel, config: WatchConfig | None = None) -> None:
        self.watch = ImageWatch(config)
        self._gyro = VisualGyro(model.panorama.clockwise)
        self.use(model)

    def use(self, model: PlaceModel) -> None:
        """Go on with a model, which may know another light than the one before."""
        self.model = model
        self._conditions = Conditions()

    @property
    def slow_error_factor(self) -> float:
        """How many times as large as in training the errors of slow features are of late."""
        return self._conditions.slow_error_factor

    def observe(self, stamp_ns: int, panorama: Image) -> Observation:
        """Judge and locate a panorama (H, W, 3) uint8 BGR. Raises ModelError for a wrong size."""
        require_panorama(panorama)
        return self.observe_all(np.array([stamp_ns]), panorama[None])[0]

    @one_core()
    def observe_all(self, stamps_ns: Stamps, panoramas: Image) -> list[Observation]:
        """The same for panoramas (T, H, W, 3) with stamps (T,), quicker."""
        if len(panoramas):
            self._require_size(panoramas[0])
        judged = list(map(self._judge, panoramas))
        each = zip(stamps_ns.tolist(), judged, self.model.views(panoramas), strict=True)
        return [
            replace(self._locate(view, problem), stamp_ns=stamp_ns, turned=turned)
            for stamp_ns, (problem, turned), view in each
        ]

    def observe_run(self, run: Run) -> Iterator[Observation]:
        """The same for every image of a recorded run."""
        at = 0
        for batch in run.panoramas.batches(BATCH):
            yield from self.observe_all(run.panoramas.stamps_ns[at : at + len(batch)], batch)
            at += len(batch)

    def _judge(self, panorama: Image) -> tuple[str, float]:
        """The problem of the next image, and how far the images have turned."""
        problem = self.watch.judge(panorama)
        return problem, math.nan if problem else self._gyro.add(panorama)

    def _locate(self, view: View, problem: str) -> Observation:
        """Located in the conditions of late, which usable images of known places teach."""
        location = self.model.located(view, self._conditions)
        found = self._usable(replace(self.model.observed(view, location), problem=problem))
        if not found.problem:
            self._conditions.add(location)
        return found

    def _usable(self, found: Observation) -> Observation:
        """What reaches the filter: of an unusable image, that nothing is known."""
        problem, finite = found.problem, found.finite
        if not finite:
            problem = problem or 'the model gives no finite estimate for this image'
        problem = problem or self.watch.judge_place(found.explained)
        if not problem:
            return found
        pose = found.pose if finite else np.zeros(3)
        return replace(found, pose=pose, covariance=unusable_covariance(), problem=problem)

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
    """Covariance (3, 3) of [x, y, yaw] of an unusable image."""
    return np.diag([UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, UNKNOWN_YAW_VARIANCE])


def filter_of(
    model: PlaceModel, config: FilterConfig | None = None, kind: type[PoseFilter] = PoseFilter
) -> PoseFilter:
    """A filter that begins with what the training of a model found of the robot."""
    fused = kind(config, model.error_correlation)
    fused.expect(model.rig)
    return fused


class Localizer:
    """Online localization: feed it odometry and panoramas as they come, in any order.

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
        """Take speed m/s and yaw rate rad/s at a stamp, with their variances (0: unknown).

        `pose` (3,) is odometry's own, x m, y m, yaw rad, where there is one.

        Returns the estimate at that stamp; None before the start, and for what cannot be used.
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
        """Fuse the pose that an image shows."""
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

    def replay(self, run: Run) -> Iterator[tuple[int, Observation | None, State | None]]:
        """Feed a recorded run in the order of its stamps: (stamp, observation, state at it).

        The observation is None at the odometry messages that were used. The state is what the nodes
        would have published then.
        """
        images = run.panoramas.stamps_ns, self.observer.observe_run(run)
        for stamp_ns, observation, _ in replay(self.filter, run.odometry, *images):
            yield stamp_ns, observation, self.filter.at(stamp_ns)
