# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The paper in one file: a panorama tells where the robot is, odometry how it moves, an EKF fuses.

The three nodes do the same in three processes; this is for programs without ROS, and for the
evaluation of bags.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sfa_localization.config import FilterConfig
from sfa_localization.geometry import Array
from sfa_localization.place_model import Estimate, PlaceModel
from sfa_localization.pose_filter import PoseFilter, State, Status, Update
from sfa_localization.run import Image, Run

_BATCH = 16


class Localizer:
    """Online localization: feed it odometry and panoramas as they come, in any order.

    >>> localizer = Localizer(PlaceModel.load('garden.npz'))
    >>> localizer.add_odometry(stamp_ns, v, omega)
    >>> localizer.add_panorama(stamp_ns, panorama)
    >>> localizer.state.pose, localizer.status
    """

    def __init__(self, model: PlaceModel, config: FilterConfig | None = None) -> None:
        self.model = model
        self.filter = PoseFilter(config, model.error_correlation)

    def add_odometry(
        self, stamp_ns: int, v: float, omega: float, variances: Sequence[float] | Array = (0.0, 0.0)
    ) -> None:
        """Take speed m/s and yaw rate rad/s at a stamp, with their variances (0: unknown)."""
        self.filter.add_odometry(stamp_ns, v, omega, variances)

    def add_panorama(self, stamp_ns: int, panorama: Image) -> Estimate:
        """Locate a panorama (H, W, 3) uint8 BGR and fuse it. Raises ModelError for a wrong size."""
        estimate = self.model.locate(panorama)
        self.add_estimate(stamp_ns, estimate)
        return estimate

    def add_estimate(self, stamp_ns: int, estimate: Estimate) -> Update:
        """Fuse what a picture told."""
        pose = np.append(estimate.position, estimate.yaw)
        return self.filter.add_measurement(stamp_ns, pose, estimate.covariance)

    @property
    def state(self) -> State | None:
        """The newest estimate in the map frame; None before the start."""
        return self.filter.state

    @property
    def status(self) -> Status:
        """Whether the robot is lost, and why."""
        return self.filter.status

    def replay(self, run: Run) -> Iterator[tuple[int, Estimate | None, State | None]]:
        """Feed a recorded run in the order of its stamps, telling (stamp, estimate, state).

        The estimate is None at odometry messages.
        """
        odometry, at = run.odometry, 0
        for stamp_ns, estimate in self.locate_run(run):
            while at < len(odometry.stamps_ns) and odometry.stamps_ns[at] <= stamp_ns:
                yield self._replay_odometry(run, at)
                at += 1
            self.add_estimate(stamp_ns, estimate)
            yield stamp_ns, estimate, self.state
        for rest in range(at, len(odometry.stamps_ns)):
            yield self._replay_odometry(run, rest)

    def _replay_odometry(self, run: Run, at: int) -> tuple[int, None, State | None]:
        odometry = run.odometry
        stamp_ns, (v, omega) = int(odometry.stamps_ns[at]), odometry.twists[at]
        self.add_odometry(stamp_ns, float(v), float(omega), odometry.variances[at])
        return stamp_ns, None, self.state

    def locate_run(self, run: Run) -> Iterator[tuple[int, Estimate]]:
        """Stamp and estimate of each picture of a run."""
        at = 0
        for batch in run.panoramas.batches(_BATCH):
            for estimate in self.model.locate_all(batch):
                yield int(run.panoramas.stamps_ns[at]), estimate
                at += 1
