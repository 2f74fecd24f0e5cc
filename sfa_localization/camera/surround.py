# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Several cameras around the robot are one panorama: images in, in the order of reception, and
panoramas out. The nodes and the reading of bags both use it.
"""

from __future__ import annotations

from array import array
from bisect import bisect
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sfa_localization.camera.joining import Joined, StampJoiner
from sfa_localization.camera.sectors import MountedCamera, Overlap, Part, SurroundView, View
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.camera.watch import ImageWatch
from sfa_localization.camera.yaw_watch import YawWatch
from sfa_localization.data.errors import CameraError
from sfa_localization.data.geometry import Array, Indices, Mask
from sfa_localization.data.rejections import RejectionCounter
from sfa_localization.data.run import Image, Trajectory

FEWEST_CAMERAS = 2
MOST_CAMERAS = 8
BRIDGED_S = 3.0
"""Seconds for which the panorama may lack a camera, before that is a reason to doubt the pose."""
_POSES = 200  # that are kept: those of a second or more
_RATES = 1_000_000  # of turns that are kept, 16 bytes each: those of 5 hours at 50 Hz
_SAMPLED = 4  # every fourth pixel along each axis tells whether a camera is dark or frozen
_SAME_POSE_NS = 100_000_000  # between images and a pose that tells theirs
_NEAR_NS = 200_000_000  # an older rate of turn says nothing about an image


class Trouble(NamedTuple):
    """Why a camera is not used, and since when, ns."""

    reason: str
    since_ns: int


class Surround:
    """Makes panoramas of the images of 2 to 8 `cameras`.

    A camera that is late, missing, frozen, dark or covered is named in `troubles`, and its sector
    is hidden: it repeats the nearest pixels that others see, as `visible` says. A missing image is
    waited for until `patience` later ones of another camera have come.
    """

    def __init__(
        self,
        cameras: Sequence[MountedCamera],
        panorama: PanoramaConfig,
        blind_sectors: tuple[float, ...] = (),
        patience: int = 1,
    ) -> None:
        names = [camera.name for camera in cameras]
        require_rig(names)
        self.cameras = tuple(cameras)
        self.troubles: dict[str, Trouble] = {}
        self._view = SurroundView(cameras, panorama, blind_sectors)
        self._joiner = StampJoiner(names, patience)
        self._watches = {name: ImageWatch() for name in names}
        self._exposures = Exposures(names)
        self._turns = TurnRates()
        self._yaws = YawWatch(cameras, panorama)
        self._poses: deque[tuple[int, Array]] = deque(maxlen=_POSES)
        self._shown: View | None = None
        self._stamp_ns = 0
        self._uses: Counter[frozenset[str]] = Counter()
        self.unused: dict[str, RejectionCounter] = {name: RejectionCounter() for name in names}
        """How many images of each camera were not used, by reason."""

    @property
    def panorama(self) -> PanoramaConfig:
        """Size and geometry of the panoramas."""
        return self._view.panorama

    @property
    def place(self) -> complex:
        """The place of the panorama on base_link, ahead + i left, m: the mean of the cameras'."""
        return place_of(self.cameras)

    @property
    def visible(self) -> Mask | None:
        """Which pixels (H, W) of the last panorama cameras saw; None before it."""
        return None if self._shown is None else self._shown.visible

    @property
    def problems(self) -> list[str]:
        """Which cameras the panorama has lacked for longer than BRIDGED_S, and why; and which look
        elsewhere than their poses say.
        """
        lacked = [
            f'camera {name}: {trouble.reason}'
            for name, trouble in self.troubles.items()
            if self._stamp_ns > trouble.since_ns + BRIDGED_S * 1e9
        ]
        return lacked + self.knocked

    @property
    def owners(self) -> Indices | None:
        """The number of the camera that shows most of each pixel (H, W) of the last panorama, -1
        where it is hidden; None before it.
        """
        return None if self._shown is None else self._view.owners(self._shown)

    @property
    def seen(self) -> Mask | None:
        """Which pixels (H, W) most panoramas showed so far; None if all."""
        if not self._uses:
            return None
        ((most, _),) = self._uses.most_common(1)
        view = self._view.of(most)
        return None if view.visible.all() else view.visible

    def check(self) -> None:
        """Raise CameraError for cameras that cannot be used, as far as their lenses tell."""
        sizes = {c.name: (c.lens.image_height, c.lens.image_width) for c in self.cameras}
        self._view.view({name: size for name, size in sizes.items() if 0 not in size})

    def add_turn_rate(self, stamp_ns: int, omega: float) -> None:
        """Take the rate of turn of the robot, rad/s, by odometry or gyroscope."""
        self._turns.add(stamp_ns, omega)

    def add_pose(self, stamp_ns: int, pose: Array) -> None:
        """Take the pose (3,) of base_link by odometry: with it, cameras that were turned since the
        training are named in `knocked`.
        """
        if self._poses and stamp_ns <= self._poses[-1][0]:
            self._poses.clear()
        self._poses.append((stamp_ns, pose))

    @property
    def knocked(self) -> list[str]:
        """Sentences about cameras that look elsewhere than stated, or show other things."""
        return self._yaws.sentences

    def finish(self) -> None:
        """Wait for the comparison of the last images, which tells what is `knocked`."""
        self._yaws.finish()

    def add(self, name: str, stamp_ns: int, image: Image) -> list[tuple[int, Image]]:
        """Take an image (H, W, 3) uint8 of a camera; return the panoramas (H, W, 3) uint8, with
        their stamps, that are complete now. Raises CameraError for an image of another camera.
        """
        self._view.sector(name, image.shape[:2])
        joined = self.join(name, stamp_ns, image)
        return [(images.stamp_ns, self.compose(images)) for images in joined]

    def join(self, name: str, stamp_ns: int, image: Image) -> list[Joined]:
        """Take an image; return the images of one time that are complete now."""
        return self._joiner.add(name, stamp_ns, image)

    def flush(self) -> list[Joined]:
        """What the last images give, at the end."""
        return self._joiner.flush()

    def compose(self, joined: Joined) -> Image:
        """The panorama (H, W, 3) uint8 of images of one time. Raises CameraError."""
        problems = {
            name: problem
            for name, (_, image) in joined.images.items()
            if (problem := self._watches[name].judge(image[::_SAMPLED, ::_SAMPLED]))
        }
        usable = {n: item for n, item in joined.images.items() if n not in problems}
        if not usable:  # a dark night, or a robot that stands: the panorama is judged as a whole
            usable = joined.images
            problems = {}
        for name, problem in problems.items():
            self.unused[name].add(problem)
        self._report({**joined.absent, **problems}, joined.stamp_ns)
        images = {name: image for name, (_, image) in usable.items()}
        view = self._view.view({name: image.shape[:2] for name, image in images.items()})
        shifts = {n: self._columns(joined.stamp_ns, at) for n, (at, _) in usable.items()}
        parts = self._view.parts(images, shifts)
        self._exposures.add(joined.stamp_ns, parts, view.overlaps)
        self._watch_yaws(joined.stamp_ns, images)
        self._shown = view
        self._uses[frozenset(images)] += 1
        return self._view.joined(parts, view, self._exposures.factors)

    def _watch_yaws(self, stamp_ns: int, images: Mapping[str, Image]) -> None:
        """Compare what cameras see with what they saw, where a pose is known."""
        if any(abs(at_ns - stamp_ns) < _SAME_POSE_NS for at_ns, _ in self._poses):
            stamps_ns, poses = zip(*self._poses, strict=True)
            path = Trajectory(np.array(stamps_ns), np.array(poses))
            self._yaws.add(stamp_ns, path.at(np.array([stamp_ns]))[0], images)

    def _report(self, reasons: Mapping[str, str], stamp_ns: int) -> None:
        """Keep since when each camera has been in trouble."""
        before = self.troubles
        self._stamp_ns = stamp_ns
        self.troubles = {
            name: Trouble(reason, before[name].since_ns if name in before else stamp_ns)
            for name, reason in reasons.items()
        }

    def _columns(self, stamp_ns: int, taken_ns: int) -> float:
        """By how many columns the content of an image taken at another time is moved."""
        turn = self._turns.turn(stamp_ns, taken_ns)
        sign = -1.0 if self.panorama.clockwise else 1.0
        return sign * turn * self.panorama.width / (2 * np.pi)


def require_rig(names: Sequence[str]) -> None:
    """Raise CameraError unless these are the names of 2 to 8 cameras."""
    if not FEWEST_CAMERAS <= len(names) <= MOST_CAMERAS:
        raise CameraError(
            f'{len(names)} cameras: give {FEWEST_CAMERAS} to {MOST_CAMERAS} for one panorama'
        )
    if len(set(names)) < len(names):
        raise CameraError(f'two cameras have one name: {", ".join(names)}')


def place_of(cameras: Sequence[MountedCamera]) -> complex:
    """The place of their panorama on base_link, ahead + i left, m: the mean of the cameras'."""
    places = np.array([camera.place[:2] for camera in cameras])
    return complex(*places.mean(axis=0))


def sentence(cameras: Sequence[MountedCamera]) -> str:
    """Which cameras make one panorama, and where they look."""
    looks = [f'{camera.name} {round(float(np.degrees(camera.yaw)))}' for camera in cameras]
    return f'{len(cameras)} cameras are one panorama, looking to {", ".join(looks)} degrees of yaw'


class TurnRates:
    """The rates of turn of the robot, rad/s, of some hours: a converted bag may hold all odometry
    before all images.
    """

    def __init__(self) -> None:
        self._stamps_ns = array('q')
        self._rates = array('d')

    def add(self, stamp_ns: int, omega: float) -> None:
        """Take the rate at a stamp; a stamp that steps back begins anew."""
        if self._stamps_ns and stamp_ns <= self._stamps_ns[-1]:
            self._forget(len(self._rates))
        if len(self._rates) >= _RATES:
            self._forget(_RATES // 2)
        self._stamps_ns.append(stamp_ns)
        self._rates.append(omega)

    def _forget(self, count: int) -> None:
        del self._stamps_ns[:count]
        del self._rates[:count]

    def turn(self, start_ns: int, end_ns: int) -> float:
        """The turn from one stamp to another, rad, less than half a period apart; 0 where no rate
        is known.
        """
        middle_ns = (start_ns + end_ns) / 2
        after = bisect(self._stamps_ns, middle_ns)
        stamps_ns = self._stamps_ns[max(after - 1, 0) : after + 1]
        if end_ns == start_ns or not stamps_ns:
            return 0.0
        if min(abs(at_ns - middle_ns) for at_ns in stamps_ns) > _NEAR_NS:
            return 0.0
        rates = self._rates[max(after - 1, 0) : after + 1]
        return float(np.interp(middle_ns, stamps_ns, rates)) * (end_ns - start_ns) * 1e-9


class Exposures:
    """How bright cameras show what two of them see, by the mean of some seconds.

    The exposure of each, a logarithm for each channel, is that which explains the ratios of all
    pairs with least squares; the mean of all is 0, so that panoramas stay as bright as images.
    """

    MEMORY_S = 3.0
    """Cameras set their exposure in about a second; within it noise and parallax average out."""
    FEWEST = 30
    """Pixels of an overlap that show a ratio."""
    RANGE = 8.0, 247.0
    """Gray levels that are neither cut off nor mostly noise."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = list(names)
        self._ratios: dict[tuple[str, str], Array] = {}
        self._counts: dict[tuple[str, str], int] = {}
        self._last_ns: int | None = None

    @property
    def factors(self) -> dict[str, Array]:
        """Factors of the channels (3,) of each camera, by the ratios so far; {} without any."""
        if not self._ratios:
            return {}
        design = np.zeros((len(self._ratios), len(self._names)))
        for row, (one, other) in enumerate(self._ratios):
            design[row, self._names.index(one)] = 1.0
            design[row, self._names.index(other)] = -1.0
        exposures, *_ = np.linalg.lstsq(design, np.array([*self._ratios.values()]), rcond=None)
        return dict(zip(self._names, np.exp(-exposures), strict=True))

    def add(
        self,
        stamp_ns: int,
        parts: Mapping[str, Part],
        overlaps: Mapping[tuple[str, str], Overlap],
    ) -> None:
        """Take the sectors of a panorama."""
        step_s = 0.0 if self._last_ns is None else max(stamp_ns - self._last_ns, 0) * 1e-9
        self._last_ns = stamp_ns
        for pair, overlap in overlaps.items():
            first = parts[pair[0]][overlap.rows, overlap.first]
            second = parts[pair[1]][overlap.rows, overlap.second]
            ratio = self._ratio(first, second)
            if ratio is None:
                continue
            count = self._counts.get(pair, 0) + 1
            share = max(1.0 / count, 1.0 - np.exp(-step_s / self.MEMORY_S))
            before = self._ratios.get(pair, np.zeros(3))
            self._ratios[pair] = before + share * (ratio - before)
            self._counts[pair] = count

    def _ratio(self, first: Part, second: Part) -> Array | None:
        """The median logarithm (3,) of the ratio of pixels (N, 3); None where few are fit."""
        low, high = self.RANGE
        darkest = np.minimum(first, second).min(axis=1)
        brightest = np.maximum(first, second).max(axis=1)
        fit = (darkest > low) & (brightest < high)
        if np.count_nonzero(fit) < self.FEWEST:
            return None
        return np.asarray(np.median(np.log(first[fit] / second[fit]), axis=0), float)
