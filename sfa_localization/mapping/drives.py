# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The drives of a training: odometry, its errors as measured by images, and segments.

Images correct the turns of the wheels and, once there is a map, the way (odometry_errors.py).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.data.rig import TURN_FACTOR_STD, Quantity, Rig
from sfa_localization.data.run import Points, Run, Stamps
from sfa_localization.data.sphere import Sphere
from sfa_localization.keyframes.closures import Closures, Textures
from sfa_localization.keyframes.offsets import Offsets, find_offsets
from sfa_localization.keyframes.turning import lever_square
from sfa_localization.mapping.drive_check import ROUTE
from sfa_localization.mapping.learning import MetricResult, learn_metric
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.mapping.turned_maps import TurnedMaps
from sfa_localization.metric.loops import rough_offsets, with_closures
from sfa_localization.metric.measured_points import MeasuredPoints, Settled, settle
from sfa_localization.metric.mount import MOUNTED_ANEW_RAD, Mount
from sfa_localization.metric.pose_graph import Graph, graph_poses
from sfa_localization.metric.segments import Segments, cut_track, join
from sfa_localization.motion.check import MotionCheck
from sfa_localization.motion.dead_reckoning import OdometryTrack, Way
from sfa_localization.motion.odometry_errors import way_of
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.motion.sources import compare_map
from sfa_localization.motion.turns import Headings, by_images, estimated

Maps = tuple[MetricResult, TurnedMaps | None, MetricResult]
"""The first map, turned maps, and the map of these, or the first again."""
logger = logging.getLogger(__name__)

_POINT_ROUNDS = 3
"""Points straighten the map, which may show other points to be right."""
SCALE_STD = 0.01
"""Of a map whose meters are those of the wheels."""
_MOUNT_ROUNDS = 4
_MOUNT_SETTLED_M = 0.02
"""Offsets are measured again until the camera's place moves by less than their error."""
_LOSS_ROUNDS = 2
"""The first map underestimates the loss in turns by a third, the next one by a tenth."""


@dataclass(frozen=True, slots=True)
class Drive:
    """A run, the `headings` (N,) rad of its N images by the shifts between them, whose sign may be
    either, and by how much their stamps are late; None where the drive does not show it."""

    run: Run
    headings: Sequence[float]
    delay_ns: int | None = None

    @property
    def stamps_ns(self) -> Stamps:
        """(N,) of the images, by the clock of the odometry."""
        return self.run.panoramas.stamps_ns - (self.delay_ns or 0)


@dataclass(frozen=True, slots=True)
class Drives:
    """All drives, whose images are numbered drive after drive, their loop closures, with and
    without offsets, and measured points."""

    items: tuple[Drive, ...]
    closures: Closures
    config: SegmentConfig
    offsets: Offsets = field(default_factory=Offsets.none)
    points: Points | None = None
    mount: Mount = field(default_factory=Mount)
    tracks: tuple[OdometryTrack, ...] = ()
    """Dead reckoning of each drive, with the turns of its images where these are better; estimated
    once, if not given."""

    def __post_init__(self) -> None:
        object.__setattr__(self, 'mount', self.mount.of(len(self.items)))
        if not self.tracks:
            object.__setattr__(self, 'tracks', tuple(self._estimated_tracks()))

    @property
    def starts(self) -> list[int]:
        """Number of each drive's first image."""
        counts = [len(drive.run.panoramas) for drive in self.items]
        return [sum(counts[:k]) for k in range(len(counts))]

    def _estimated_tracks(self) -> list[OdometryTrack]:
        runs = [drive.run for drive in self.items]
        tracks = [OdometryTrack.of(run.odometry, self.config, run.yaw_rate) for run in runs]
        return by_images(tracks, self._headings(tracks), self.closures)

    def turn_factors(self) -> list[Quantity]:
        """Of each drive, true turns over those of the odometry, by images; none if these do not
        show them."""
        config = replace(self.config, yaw_source='odometry')
        tracks = [OdometryTrack.of(drive.run.odometry, config) for drive in self.items]
        return [each.factor for each in estimated(self._headings(tracks), self.closures) or []]

    def _headings(self, tracks: Sequence[OdometryTrack]) -> list[Headings]:
        pairs = zip(tracks, self.items, strict=True)
        return [Headings.of(track, each.stamps_ns, each.headings) for track, each in pairs]

    def cut(self, ways: Sequence[Way | None] = (), settled: Settled | None = None) -> Segments:
        """The segments of all drives (section 3.1), with the corrected `ways` of these, and with
        the points that are right by `settled`.

        Raises DataError.
        """
        ways = ways or [None] * len(self.items)
        parts = []
        for track, way, drive in zip(self.tracks, ways, self.items, strict=True):
            track = replace(track.driven(way) if way else track, lever=self.mount.lever)
            parts.append(cut_track(track, drive.stamps_ns, self.config))
        offsets = self.offsets.of_robot(self._camera_yaw)
        joined = join(parts, self.starts)
        joined = replace(joined, ways=tuple(ways), mount=self.mount, offsets=offsets)
        segments = with_closures(joined, self.closures.of_robot(self._camera_yaw))
        if self.points is None:
            return segments
        drives = [(drive.run.odometry, drive.stamps_ns) for drive in self.items]
        images = np.concatenate([one.images for one in segments])
        points = MeasuredPoints.of(self.points, drives, images, settled, self.mount.lever)
        return replace(segments, points=points)

    @property
    def _camera_yaw(self) -> Array:
        """Yaw of the camera on the robot, rad, of each image (N,)."""
        return np.repeat(self.mount.yaw, [len(drive.run.panoramas) for drive in self.items])

    def measured(self, views: Textures, sphere: Sphere) -> Drives:
        """With the offsets of `views`, near the poses of the graph of odometry and closures, and
        the camera's place on the robot, which both determine together."""
        headings = self._headings(self.tracks)
        turns = np.concatenate([each.track for each in headings])[views.images]
        mount = replace(self.mount, turning=lever_square(views, turns))
        drives = replace(self, mount=mount)
        count = int(views.images.max()) + 1
        drives = replace(drives, offsets=rough_offsets(drives.cut().closures))
        for _ in range(_MOUNT_ROUNDS):
            before = drives.mount
            drives = replace(drives, mount=Graph.of(drives.cut()).mount)
            poses = graph_poses(Graph.of(drives.cut()), count)
            drives = replace(drives, offsets=find_offsets(views, poses[views.images], sphere))
            if not drives.mount.differs(before, _MOUNT_SETTLED_M):
                break
        drives = replace(drives, mount=Graph.of(drives.cut()).mount)
        if drives.mount.contradiction:
            logger.warning(drives.mount.contradiction)
        for drive, yaw in zip(drives.items, drives.mount.yaw, strict=True):
            if abs(yaw) > MOUNTED_ANEW_RAD:
                logger.warning(
                    '%s: its camera is turned by %.1f degrees against %s: the headings of images '
                    'are not used; train drives of one mount alone',
                    drive.run.name, math.degrees(yaw), drives.items[0].run.name,
                )  # fmt: skip
        return drives

    def image_poses(self, result: MetricResult) -> Iterator[tuple[Stamps, Array]]:
        """Of each drive the stamps (M,) of its images in the segments, and poses (M, 3) of
        base_link at these by the map: x m, y m, yaw rad."""
        poses = result.poses - np.pad(result.residuals, ((0, 0), (0, 1)))
        for number, (drive, start) in enumerate(zip(self.items, self.starts, strict=True)):
            rows = result.images - start
            inside = (rows >= 0) & (rows < len(drive.stamps_ns))
            yield drive.stamps_ns[rows[inside]], result.mount.base(poses[inside], number)

    def ways(self, segments: Segments, result: MetricResult) -> list[Way | None]:
        """The correction of each drive's wheels by the map, if they lose distance in turns.

        All change their length by one factor: single drives do not show it better.
        """
        ways = list[Way | None]()
        longer = list[float]()
        for track, images, before in zip(
            self.tracks, self.image_poses(result), segments.ways, strict=True
        ):
            way = way_of(track, *images, before)
            lengths = [
                np.abs(track.ways() @ (each or Way()).values).sum() for each in (way, before)
            ]
            ways.append(way)
            longer.append(float(lengths[0] / max(lengths[1], 1e-9)))
        mean = np.mean([factor for factor, way in zip(longer, ways, strict=True) if way] or [1.0])
        return [
            way and way.scaled(float(mean) / factor)
            for way, factor in zip(ways, longer, strict=True)
        ]


def rig_of(drives: Drives, segments: Segments) -> Rig:
    """What was learned of the robot."""
    usual = Rig()
    delays = [d.delay_ns * 1e-9 for d in drives.items if d.delay_ns is not None]
    ways = [way or Way(1.0, usual.turn_loss, usual.speed_offset) for way in segments.ways]
    turn_factor = _together(drives.turn_factors() or [Quantity(1.0, 0.0)])
    scale_std = segments.points.settled.scale_std if segments.points else SCALE_STD
    return Rig(
        **segments.mount.quantities,
        camera_delay=usual.camera_delay._replace(value=float(np.median(delays or [0.0]))),
        wheel_scale=_together([Quantity(way.scale, scale_std) for way in ways]),
        turn_loss=_together([way.loss for way in ways]),
        speed_offset=_together([way.offset for way in ways]),
        turn_factor=turn_factor._replace(std=math.hypot(turn_factor.std, TURN_FACTOR_STD)),
    )


def _together(drives: Sequence[Quantity]) -> Quantity:
    """One quantity of several drives; the standard deviation includes how much it differs."""
    values, stds = np.array(drives).T
    return Quantity(float(values.mean()), math.hypot(float(values.std()), float(stds.max())))


def compare_with_map(checks: Sequence[MotionCheck], drives: Drives, result: MetricResult) -> None:
    """Add the comparison of the map with the odometry, with corrected turns, to each drive's."""
    for check, drive, track, images in zip(
        checks, drives.items, drives.tracks, drives.image_poses(result), strict=True
    ):
        pair = compare_map(replace(drive.run.odometry, poses=track.poses), *images)
        check.pairs += [pair] if pair else []


def learn_map(
    drives: Drives, features: Array, config: MetricConfig, seed: int = 0, strict: bool = False
) -> tuple[Segments, MetricResult]:
    """Segments, and the certified map from features (N, K) of all images to them: section 3.

    Where it shows that wheels lose way in turns, it is learned again with the corrected way. Raises
    DataError; a single route is an error with `strict`, else a warning.
    """
    segments = drives.cut()
    result = learn_metric(features, segments, config, seed)
    for _ in range(_LOSS_ROUNDS if config.solver == 'certified' else 0):
        ways = drives.ways(segments, result)
        if not any(ways):
            break
        try:
            corrected = drives.cut(ways)
            segments = corrected
            result = learn_metric(features, corrected, config, seed)
        except DataError as error:
            logger.warning('the way that wheels lose in turns stays in the map: %s', error)
            break
    if result.diagnostics.single_route and strict:
        raise DataError(f'{ROUTE}, or train without --strict')
    if result.diagnostics.single_route:
        logger.warning(ROUTE)
    return segments, result


def with_points(
    drives: Drives, segments: Segments, maps: Maps, again: Callable[[Segments], Maps]
) -> tuple[Segments, Maps]:
    """Segments and maps in the coordinates and meters of the measured points, if there are any: the
    points are fitted to the last map, and everything is learned `again`; and once more if the
    corrected map changes which points are inliers.
    """
    for _ in range(_POINT_ROUNDS if segments.points else 0):
        assert segments.points is not None
        before = segments.points.settled
        result = maps[-1]
        now = settle(segments.points, result.points, result.points_covariance)
        if (now.used == before.used).all():
            break
        ways = [(way or Way()).scaled(now.scale) for way in segments.ways]
        segments = drives.cut(ways, replace(now, scale=before.scale * now.scale))
        maps = again(segments)
    if segments.points is not None:
        for text in segments.points.warnings(maps[-1].points):
            logger.warning(text)
    return segments, maps
