# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The drives that a map is learned from: odometry, what images show of its errors, and segments.

Wheels err in turns: images show how far the robot turned and, once there is a map, how much of the
way was lost in turns (odometry_errors.py).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.data.run import Points, Run, Stamps
from sfa_localization.data.sphere import Sphere
from sfa_localization.keyframes.closures import Closures, Views
from sfa_localization.keyframes.offsets import Offsets, find_offsets
from sfa_localization.keyframes.turning import lever_square
from sfa_localization.metric.dead_reckoning import OdometryTrack, Way
from sfa_localization.metric.drive_check import ROUTE
from sfa_localization.metric.learning import MetricResult, learn_metric
from sfa_localization.metric.loops import rough_offsets, with_closures
from sfa_localization.metric.measured_points import MeasuredPoints, Settled, settle
from sfa_localization.metric.motion_check import MotionCheck
from sfa_localization.metric.motion_sources import compare_map
from sfa_localization.metric.mount import MOUNTED_ANEW_RAD, Mount
from sfa_localization.metric.odometry_errors import Headings, corrections, way_of
from sfa_localization.metric.pose_graph import Graph, graph_poses
from sfa_localization.metric.segments import Segments, cut_track, join
from sfa_localization.metric.settings import MetricConfig, SegmentConfig
from sfa_localization.metric.turned_maps import TurnedMaps

Maps = tuple[MetricResult, TurnedMaps | None, MetricResult]
"""The first map, turned maps, and the map of these, or the first again."""
logger = logging.getLogger(__name__)

_POINT_ROUNDS = 3
"""Points that bend the map straight may show other ones to be right, which bend it again."""
SCALE_STD = 0.01
"""Of a map: its meters are those of wheels, seldom known better."""
_MOUNT_ROUNDS, _MOUNT_SETTLED_M = 4, 0.02
"""Offsets are measured anew until the camera's place moves by less than they err."""
_LOSS_ROUNDS = 2
"""The first map hides a third of the way that wheels lose in turns, the next one a tenth."""


@dataclass(frozen=True, slots=True)
class Drive:
    """A run, the headings (N,) rad `seen` in its N images, whose sign may be either, and by how
    much their stamps are late, None where the drive does not show it."""

    run: Run
    seen: Sequence[float]
    delay_ns: int | None = None

    @property
    def stamps_ns(self) -> Stamps:
        """(N,) of the images, by the clock of the odometry."""
        return self.run.panoramas.stamps_ns - (self.delay_ns or 0)

    @property
    def delay_s(self) -> float | None:
        """By how much the stamps are late."""
        return None if self.delay_ns is None else self.delay_ns * 1e-9


@dataclass(frozen=True, slots=True)
class Drives:
    """All drives, whose images are numbered drive after drive, their loop closures, with and
    without offsets, and points that were measured."""

    items: tuple[Drive, ...]
    closures: Closures
    config: SegmentConfig
    offsets: Offsets = field(default_factory=Offsets.none)
    points: Points | None = None
    mount: Mount = field(default_factory=Mount)

    @property
    def starts(self) -> list[int]:
        """Number of each drive's first image."""
        counts = [len(drive.run.panoramas) for drive in self.items]
        return [sum(counts[:k]) for k in range(len(counts))]

    def tracks(self) -> list[OdometryTrack]:
        """Dead reckoning of each drive, with the turns that images show where these are better."""
        tracks = [
            OdometryTrack.of(drive.run.odometry, self.config, drive.run.yaw_rate)
            for drive in self.items
        ]
        both = list(zip(tracks, self.items, strict=True))
        seen = [Headings.of(track, drive.stamps_ns, drive.seen) for track, drive in both]
        turns = corrections(seen, self.closures)
        if turns is None:
            return tracks
        return [track.corrected(own) for track, own in zip(tracks, turns, strict=True)]

    def _driven(self, ways: Sequence[Way | None]) -> Iterator[OdometryTrack]:
        """Dead reckoning of each drive with the way that was driven."""
        for track, way in zip(self.tracks(), ways, strict=True):
            yield track.driven(way) if way else track

    def cut(self, ways: Sequence[Way | None] = (), settled: Settled | None = None) -> Segments:
        """The segments of section 3.1, of all drives; `ways` correct what wheels counted, and the
        points are those that `settled` found right.

        Raises DataError.
        """
        ways, mount = ways or [None] * len(self.items), self.mount.of(len(self.items))
        parts = [
            cut_track(track.mounted(mount.lever), drive.stamps_ns, self.config)
            for track, drive in zip(self._driven(ways), self.items, strict=True)
        ]
        offsets = self.offsets.of_robot(self._camera_yaw)
        joined = replace(join(parts, self.starts), ways=tuple(ways), mount=mount, offsets=offsets)
        segments = with_closures(joined, self.closures.of_robot(self._camera_yaw))
        if self.points is None:
            return segments
        drives = [(drive.run.odometry, drive.stamps_ns) for drive in self.items]
        images = np.concatenate([one.images for one in segments])
        points = MeasuredPoints.of(self.points, drives, images, settled, mount.lever)
        return replace(segments, points=points)

    def _yaws(self) -> Iterator[Array]:
        """Headings rad of the odometry at the images of each drive."""
        for track, drive in zip(self.tracks(), self.items, strict=True):
            yield Headings.of(track, drive.stamps_ns, drive.seen).track

    @property
    def _camera_yaw(self) -> Array:
        """By how much the camera is turned on the robot, rad, of each image (N,)."""
        yaw = self.mount.of(len(self.items)).yaw
        return np.repeat(yaw, [len(drive.run.panoramas) for drive in self.items])

    def measured(self, views: Views, sphere: Sphere) -> Drives:
        """With the offsets of `views`, which the graph of odometry and closures leads to, and the
        place of the camera, which both show together."""
        turns = np.concatenate(list(self._yaws()))[views.images]
        mount = replace(self.mount, turning=lever_square(views, turns))
        drives, count = replace(self, mount=mount), int(views.images.max()) + 1
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
        for drive, yaw in zip(drives.items, drives.mount.of(len(drives.items)).yaw, strict=True):
            if abs(yaw) > MOUNTED_ANEW_RAD:
                logger.warning(
                    '%s: its camera is turned by %.1f degrees against %s: the headings of images '
                    'are not used; train drives of one mount alone',
                    drive.run.name, math.degrees(yaw), drives.items[0].run.name,
                )  # fmt: skip
        return drives

    def shown(self, result: MetricResult) -> Iterator[tuple[Stamps, Array]]:
        """Of each drive the stamps (M,) of its images in the segments, and x m, y m, yaw rad (M, 3)
        of base_link at these by the map."""
        poses = result.poses - np.pad(result.residuals, ((0, 0), (0, 1)))
        for number, (drive, start) in enumerate(zip(self.items, self.starts, strict=True)):
            rows = result.images - start
            own = (rows >= 0) & (rows < len(drive.stamps_ns))
            yield drive.stamps_ns[rows[own]], result.mount.base(poses[own], number)

    def ways(self, segments: Segments, result: MetricResult) -> list[Way | None]:
        """The way of each drive by the map, where its wheels lose some in turns.

        All have the same scale: it is that of the map, and no drive is better known by itself.
        """
        drives = zip(self.tracks(), self.shown(result), segments.ways, strict=True)
        found = [way_of(track, *shown, way) for track, shown, way in drives]
        scales = [way.scale for way in found if way]
        return [way and way._replace(scale=float(np.mean(scales))) for way in found]


def rig_of(drives: Drives, segments: Segments) -> Rig:
    """What was learned of the robot."""
    usual, delays = Rig(), [drive.delay_s for drive in drives.items if drive.delay_s is not None]
    ways = np.array([way or Way(loss_std=usual.turn_loss.std) for way in segments.ways])
    scale_std = segments.points.settled.scale_std if segments.points else SCALE_STD
    scale, loss, _ = ways.mean(axis=0).tolist()
    return Rig(
        **segments.mount.quantities,
        camera_delay=usual.camera_delay._replace(value=float(np.median(delays or [0.0]))),
        wheel_scale=Quantity(scale, scale_std),
        turn_loss=Quantity(loss, math.hypot(float(ways[:, 1].std()), float(ways[:, 2].max()))),
    )


def compare_with_map(checks: Sequence[MotionCheck], drives: Drives, result: MetricResult) -> None:
    """Add to what the sources of each drive's motion tell how far the images moved by the map."""
    shown = drives.shown(result)
    for check, drive, (stamps_ns, poses) in zip(checks, drives.items, shown, strict=True):
        pair = compare_map(drive.run.odometry, stamps_ns, poses)
        check.pairs += [pair] if pair else []


def learn_map(
    drives: Drives, features: Array, config: MetricConfig, seed: int = 0, strict: bool = False
) -> tuple[Segments, MetricResult]:
    """Segments, and the certified map from features (N, K) of all images to them: section 3.

    Where the map shows that wheels lose way in turns, it is learned once more without that. Raises
    DataError; `strict` also for a single route, of which else a warning says so.
    """
    segments = drives.cut()
    result = learn_metric(features, segments, config, seed)
    for _ in range(_LOSS_ROUNDS if config.solver == 'certified' else 0):
        ways = drives.ways(segments, result)
        if not any(ways):
            break
        try:
            shorter = drives.cut(ways)
            segments, result = shorter, learn_metric(features, shorter, config, seed)
        except DataError as error:
            logger.warning('the way that wheels lose in turns stays in the map: %s', error)
            break
    if result.diagnostics.one_route and strict:
        raise DataError(f'{ROUTE}, or train without --strict')
    if result.diagnostics.one_route:
        logger.warning(ROUTE)
    return segments, result


def with_points(
    drives: Drives, segments: Segments, maps: Maps, again: Callable[[Segments], Maps]
) -> tuple[Segments, Maps]:
    """Segments and maps in the coordinates and meters of the measured points, if there are any: the
    last map shows what these say, and all are learned `again`; once more where the map that the
    points bend straight shows other ones to be right.
    """
    for _ in range(_POINT_ROUNDS if segments.points else 0):
        assert segments.points is not None
        before, result = segments.points.settled, maps[-1]
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
