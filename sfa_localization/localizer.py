# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The paper, live: judge an image, locate it, and fuse its pose with odometry in an EKF.

sfa_node runs the `Observer`, ekf_node the `PoseFilter`; between them pass poses with covariance,
and the turn of the robot as the images show it. `Localizer` holds both, for programs without ROS,
for evaluation and for tuning: offline the filter receives the same inputs as on the topics.
"""

from __future__ import annotations

from collections.abc import Sequence

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image, Run
from sfa_localization.fusion.pose_filter import PoseFilter, State, Status, Update
from sfa_localization.fusion.replay import FilterTrack, replay
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.observer import Observation, Observer
from sfa_localization.place_model import PlaceModel


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

    def replay(self, drive: Run) -> FilterTrack:
        """Feed a recorded drive in the order of its stamps, as the nodes would receive it: the
        estimates at the stamps of its odometry, `poses` (stamps and poses (N, 3)) and `covariances`
        (N, 3, 3) of [x m, y m, yaw rad] in the map.
        """
        images = self.observer.observe_run(drive)
        fed = replay(self.filter, drive.odometry, drive.panoramas.stamps_ns, images)
        states = (self.filter.at(stamp_ns) for stamp_ns, image, _ in fed if image is None)
        return FilterTrack.of([state for state in states if state])

    @property
    def state(self) -> State | None:
        """The newest estimate in the map frame; None before the start."""
        return self.filter.state

    @property
    def status(self) -> Status:
        """Whether the robot is lost, and why."""
        return self.filter.status
