# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The paper in one file: a panorama shows where the robot is, odometry how it moves, an EKF fuses.

The nodes do the same in two processes: sfa_node holds the `Observer`, ekf_node the `PoseFilter`,
and a pose with its covariance, and how far the pictures have turned, are all that passes between
them. This is for programs without ROS,
and for the evaluation of bags.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sfa_localization.config import FilterConfig, WatchConfig
from sfa_localization.events import ODOMETRY, in_order
from sfa_localization.geometry import Array
from sfa_localization.observation import Observation, Observer
from sfa_localization.place_model import PlaceModel
from sfa_localization.pose_filter import PoseFilter, State, Status, Update
from sfa_localization.run import Image, Run


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
    ) -> None:
        self.observer = Observer(model, watch)
        self.filter = PoseFilter(config, model.error_correlation)
        self.filter.expect_delay(model.camera_delay_s)

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
        """Fuse what a picture shows."""
        seen = observation
        self.filter.add_turned(seen.stamp_ns, seen.turned)
        return self.filter.add_measurement(seen.stamp_ns, seen.pose, seen.covariance)

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

        The observation is None at odometry messages. The state is what the nodes would have
        published then: it knows nothing of what came later.
        """
        odometry, observations = run.odometry, self.observer.observe_run(run)
        for stamp_ns, kind, i in in_order(odometry.stamps_ns, run.panoramas.stamps_ns):
            if kind == ODOMETRY:
                v, omega = odometry.twists[i].tolist()
                noise, pose = odometry.variances[i], odometry.poses[i].tolist()
                yield stamp_ns, None, self.add_odometry(stamp_ns, v, omega, noise, pose)
                continue
            observation = next(observations)
            self.add_observation(observation)
            yield stamp_ns, observation, self.filter.at(stamp_ns)
