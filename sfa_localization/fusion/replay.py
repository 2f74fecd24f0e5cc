# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Feed a filter with a recorded drive, in the order in which a robot would have received it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from sfa_localization.data.events import ODOMETRY, merge_by_stamp
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Odometry, Stamps, Trajectory
from sfa_localization.fusion.pose_filter import PoseFilter, State, Update


class Measurement(Protocol):
    """A position (2,) m or `pose` (3,) in the map, with its covariance, and how far the images have
    `turned` until it, rad; NaN where that is unknown.
    """

    @property
    def pose(self) -> Array: ...
    @property
    def covariance(self) -> Array: ...
    @property
    def turned(self) -> float: ...


@dataclass(frozen=True, slots=True)
class FilterTrack:
    """Estimates in the map: `poses` with their `covariances` (N, 3, 3)."""

    poses: Trajectory
    covariances: Array

    @classmethod
    def of(cls, states: Sequence[State]) -> FilterTrack:
        """The estimates of a filter."""
        stamps = np.array([state.stamp_ns for state in states], np.int64)
        poses = np.reshape([state.pose for state in states], (-1, 3))
        covariances = np.reshape([state.pose_covariance for state in states], (-1, 3, 3))
        return cls(Trajectory(stamps, poses), covariances)


M = TypeVar('M', bound=Measurement)


def replay(
    fused: PoseFilter, odometry: Odometry, stamps_ns: Stamps, measurements: Iterable[M]
) -> Iterator[tuple[int, M | None, Update | None]]:
    """Feed all odometry, and measurements at their stamps (M,), in the order of time.

    Yields (stamp, measurement, update) after each measurement, and (stamp, None, None) after each
    message of the odometry that was used.
    """
    images = iter(measurements)
    for stamp_ns, kind, i in merge_by_stamp(odometry.stamps_ns, stamps_ns):
        if kind == ODOMETRY:
            v, omega = odometry.twists[i].tolist()
            noise = odometry.variances[i].tolist()
            pose = odometry.poses[i].tolist()
            if not fused.add_odometry(stamp_ns, v, omega, noise, pose):
                yield stamp_ns, None, None
            continue
        image = next(images)
        fused.add_turned(stamp_ns, image.turned)
        yield stamp_ns, image, fused.add_measurement(stamp_ns, image.pose, image.covariance)
