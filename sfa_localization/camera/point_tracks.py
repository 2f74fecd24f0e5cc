# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Points of the surroundings, followed through neighboring images of a drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.camera.lenses import CameraModel
from sfa_localization.data.errors import CameraError
from sfa_localization.data.geometry import Array, Indices, Mask, wrap_angle
from sfa_localization.data.run import Image, Stamps, Trajectory
from sfa_localization.data.sphere import rotation

Pixels = NDArray[np.float32]
LONGEST_SIDE = 800
"""Pixels: larger images are shrunk, as more pixels do not make the lens more certain."""
# of the robot between images: less hardly moves points
_STEP_M = 0.08
_STEP_RAD = 0.07
# in all, and in a row
_MOST_IMAGES = 500
_STRETCH = 60
# of the tracker: points move by up to 75 pixels
_PATCH = 19
_LEVELS = 3
_ITERATIONS = 30
_LARGEST_ERROR_PX = 0.7  # after tracking a point to the next image and back
# of new corners in an image
_POINTS = 80
_QUALITY = 0.01
_SPACING_PX = 14
# new corners every few images, and where few points are left
_EVERY = 6
_FEWEST = 60
_LONGEST = 40  # images in which a point is followed: wheels drift meanwhile
_SHORTEST = 3  # sightings that show more than where a point is
_TURNING_RAD = 0.02  # a turn that shows in which direction images rotate
_NEAR_NS = 500_000_000  # from odometry
_GRID = 4  # pixels between those of which it is computed how a turn moves them
_CHANGE = 5.0  # gray levels by which places in images change where they show the surroundings


@dataclass(frozen=True, slots=True)
class Tracks:
    """M sightings of points: the number of the `point` (M,), increasing, of the `image` (M,), and
    the `pixels` (M, 2) of images of `size` (rows, columns). Images were taken at `stamps_ns` (N,).
    `votes` counts the turns in which the images rotated as by each of the cameras tried.
    """

    point: Indices
    image: Indices
    pixels: Array
    stamps_ns: Stamps
    size: tuple[int, int]
    votes: tuple[int, ...]

    def __len__(self) -> int:
        return int(self.point[-1]) + 1 if len(self.point) else 0

    def chosen(self, points: Indices) -> Tracks:
        """Only some of the points (P,), numbered anew."""
        rows = np.isin(self.point, points)
        number = np.unique(self.point[rows], return_inverse=True)[1]
        return replace(self, point=number, image=self.image[rows], pixels=self.pixels[rows])


def changing(samples: Sequence[Image]) -> Mask:
    """Where images (H, W, 3) from all over a drive differ, but for a margin of half a patch."""
    size = samples[0].shape[:2]
    _, change = mean_and_change([_gray(sample).astype(float) for sample in samples])
    still = cv2.dilate((change < _CHANGE).astype(np.uint8), np.ones((_PATCH, _PATCH)))
    enlarged = cv2.resize(still, (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
    return np.equal(enlarged, 0)


def mean_and_change(grays: Sequence[Array]) -> tuple[Array, Array]:
    """Mean of gray images (H, W), and their standard deviation, smoothed."""
    mean = np.mean(grays, axis=0)
    variance = np.mean(np.square(grays), axis=0) - mean**2
    change = cv2.GaussianBlur(np.sqrt(np.maximum(variance, 0.0)), (0, 0), 2.0)
    return mean, np.asarray(change, float)


def scale_of(size: tuple[int, ...]) -> float:
    """Pixels of the images in which points are followed, per pixel of images of a size (H, W)."""
    return min(LONGEST_SIDE / max(size), 1.0)


def _gray(image: Image) -> Image:
    """An image (H, W, 3) in gray, no larger than the tracker needs it."""
    return _shrunk(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))


def _shrunk(image: Image, method: int = cv2.INTER_AREA) -> Image:
    """An image (H, W), no larger than the tracker needs it."""
    scale = scale_of(image.shape)
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    return np.asarray(cv2.resize(image, size, interpolation=method), np.uint8)


def chosen_images(stamps_ns: Stamps, odometry: Trajectory) -> dict[int, int]:
    """The stamps, of those of images (N,), that are needed, with the number of their stretch.

    Between the images of a stretch the robot moves; the stretches are spread over the drive.
    """
    stamps_ns = stamps_ns[odometry.covers(stamps_ns, _NEAR_NS)]
    if len(stamps_ns) == 0:
        raise CameraError('no image has odometry nearby: are both stamped by one clock?')
    poses = odometry.at(stamps_ns)
    moved = np.hypot(*np.diff(poses[:, :2], axis=0).T) / _STEP_M
    turned = np.abs(wrap_angle(np.diff(poses[:, 2]))) / _STEP_RAD
    step = np.floor(np.concatenate([[0.0], np.cumsum(np.maximum(moved, turned))]))
    stamps_ns = stamps_ns[np.diff(step, prepend=-1.0) > 0]
    number = np.arange(len(stamps_ns))
    period = max(len(number) * _STRETCH // _MOST_IMAGES, _STRETCH)
    chosen = number % period < _STRETCH
    return dict(zip(stamps_ns[chosen].tolist(), (number[chosen] // period).tolist(), strict=True))


@dataclass
class _Track:
    images: list[int]
    pixels: list[Any]


class PointTracker:
    """Follows points through the images of a drive, added in order.

    `cameras` are guesses that differ in the direction in which images rotate as the robot turns:
    each point is searched where they expect it. Nothing is followed where `samples` (images) do
    not change: the robot, and what is outside of the rim.
    """

    def __init__(self, cameras: Sequence[CameraModel], samples: Sequence[Image]) -> None:
        self.size = cameras[0].size
        self._scale = scale_of(self.size)
        self._cameras = cameras
        self._changing = _shrunk(changing(samples).astype(np.uint8), cv2.INTER_NEAREST) > 0
        self._before: Image | None = None
        self._pose = np.zeros(3)
        self._live: list[_Track] = []
        self._ended: list[_Track] = []
        self._stamps: list[int] = []
        self._votes = np.zeros(len(cameras), int)

    def add(self, stamp_ns: int, image: Image, pose: Array) -> None:
        """Follow the points into the next image (H, W, 3), taken at a pose (3,) by odometry."""
        gray = _gray(image)
        if self._before is not None and self._live:
            self._follow(gray, float(wrap_angle(pose[2] - self._pose[2])))
        self._before = gray
        self._pose = pose
        self._stamps.append(stamp_ns)
        if len(self._stamps) % _EVERY == 1 or len(self._live) < _FEWEST:
            self._begin(gray)

    def interrupt(self) -> None:
        """End all points: the next image does not follow the last."""
        self._ended += [track for track in self._live if len(track.images) >= _SHORTEST]
        self._live = []
        self._before = None

    def tracks(self) -> Tracks:
        """All points that were seen often enough."""
        self.interrupt()
        ended = self._ended
        lengths = [len(track.images) for track in ended]
        images = [number for track in ended for number in track.images]
        pixels = np.reshape([pixel for track in ended for pixel in track.pixels], (-1, 2))
        return Tracks(
            np.repeat(np.arange(len(ended)), lengths),
            np.array(images, np.int64),
            (pixels + 0.5) / self._scale - 0.5,
            np.array(self._stamps, np.int64),
            self.size,
            tuple(self._votes.tolist()),
        )

    def _begin(self, gray: Image) -> None:
        """Add corners beside the points that are followed already."""
        free = self._changing.astype(np.uint8)
        for track in self._live:
            column, row = np.rint(track.pixels[-1]).astype(int).tolist()
            cv2.circle(free, (column, row), _SPACING_PX, 0, -1)
        corners = cv2.goodFeaturesToTrack(gray, _POINTS, _QUALITY, _SPACING_PX, mask=free)
        number = len(self._stamps) - 1
        for corner in [] if corners is None else corners.reshape(-1, 2):
            self._live.append(_Track([number], [corner]))

    def _follow(self, gray: Image, turn: float) -> None:
        """Continue the points in an image after a turn, rad; lost ones end."""
        assert self._before is not None
        old = np.array([track.pixels[-1] for track in self._live], np.float32)
        ways = [(self._before, old)]
        turns = abs(turn) > _TURNING_RAD
        if turns:
            ways = [self._turned(camera, self._before, old, turn) for camera in self._cameras]
        flows = [self._flow(gray, *way) for way in ways]
        best = int(np.argmax([fits.sum() for _, fits in flows]))
        self._votes[best] += turns
        live = list[_Track]()
        number = len(self._stamps)
        for track, pixel, fits in zip(self._live, *flows[best], strict=True):
            if fits and len(track.images) < _LONGEST:
                track.images.append(number)
                track.pixels.append(pixel)
                live.append(track)
            elif len(track.images) >= _SHORTEST:
                self._ended.append(track)
        self._live = live

    def _turned(
        self, camera: CameraModel, image: Image, pixels: Pixels, turn: float
    ) -> tuple[Image, Pixels]:
        """An image (H, W) as after a turn, and the pixels (P, 2) in it."""
        height, width = image.shape
        cells = [(np.arange(n // _GRID) + 0.5) * n / (n // _GRID) - 0.5 for n in (width, height)]
        grid = np.stack(np.meshgrid(*cells), axis=-1)
        sources = self._after(camera, grid.reshape(-1, 2), -turn).reshape(grid.shape)
        maps = np.asarray(cv2.resize(sources, (width, height), interpolation=cv2.INTER_LINEAR))
        turned = cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
        return np.asarray(turned, np.uint8), self._after(camera, pixels, turn)

    def _after(self, camera: CameraModel, pixels: Array | Pixels, turn: float) -> Pixels:
        """Where far points (P, 2) lie after a turn; where they were if a camera does not see it."""
        rays = camera.unproject((np.asarray(pixels, float) + 0.5) / self._scale - 0.5)
        turned = (camera.project(rays @ rotation(0.0, 0.0, turn)) + 0.5) * self._scale - 0.5
        return np.asarray(np.where(np.isfinite(turned), turned, pixels), np.float32)

    def _flow(self, gray: Image, before: Image, old: Pixels) -> tuple[Pixels, Mask]:
        """Where the tracker sees the points (P, 2), and which of them (P,) it also leads back."""
        new, forth = _tracked(before, gray, old, old)
        again, back = _tracked(gray, before, new, old)
        height, width = gray.shape
        inside = np.all((new >= 0) & (new <= [width - 1, height - 1]), axis=1)
        places = np.clip(np.rint(new), 0, [width - 1, height - 1]).astype(int)
        near = np.hypot(*(again - old).T) < _LARGEST_ERROR_PX
        return new, inside & forth & back & near & self._changing[places[:, 1], places[:, 0]]


def _tracked(image: Image, after: Image, pixels: Pixels, guess: Pixels) -> tuple[Pixels, Mask]:
    """Pixels (P, 2) of one image in another, near a guess, and which (P,) the tracker found:
    B. Lucas and T. Kanade, IJCAI 1981, in pyramids.
    """
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        image,
        after,
        pixels,
        guess.copy(),
        winSize=(_PATCH, _PATCH),
        maxLevel=_LEVELS,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ITERATIONS, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(found, np.float32), np.asarray(status).ravel() == 1
