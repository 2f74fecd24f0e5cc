# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether the cameras of a live robot look where they looked in training."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np

from sfa_localization.camera.sectors import MountedCamera
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.camera.yaws import (
    AS_TRAINED,
    KNOCKED_RAD,
    WITHIN_NS,
    Shown,
    Sighting,
    YawComparison,
    pairs,
)
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image

_EVERY_NS = 500_000_000
"""Between images that are compared: a thread takes some 20 ms for two."""
_KEPT = 30  # pairs: a camera is certain to half a degree with 12, and a knock shows after as many


class YawWatch:
    """Compares what cameras see, one after another, in the last minute.

    `sentences` name those that were turned, or show other things; a thread of its own finds them.
    """

    def __init__(self, cameras: Sequence[MountedCamera], panorama: PanoramaConfig) -> None:
        self.sentences: list[str] = []
        self._comparison = YawComparison(cameras, panorama)
        self._shown: deque[tuple[int, Shown]] = deque()
        self._pairs: deque[list[Sighting]] = deque(maxlen=_KEPT)
        self._thread: threading.Thread | None = None

    def add(self, stamp_ns: int, pose: Array, images: Mapping[str, Image]) -> None:
        """Take images (H, W, 3) of a time, and the pose (3,) of base_link by odometry."""
        if self._thread is not None and self._thread.is_alive():
            return
        if self._shown and stamp_ns < self._shown[-1][0]:
            self._shown.clear()
        if self._shown and stamp_ns - self._shown[-1][0] < _EVERY_NS:
            return
        arguments = stamp_ns, pose.copy(), dict(images)
        self._thread = threading.Thread(target=self._compare, args=arguments, daemon=True)
        self._thread.start()

    def finish(self) -> None:
        """Wait for the comparison in progress."""
        if self._thread is not None:
            self._thread.join()

    def _compare(self, stamp_ns: int, pose: Array, images: Mapping[str, Image]) -> None:
        """Compare the images with those of the nearest place in another heading."""
        shown = self._comparison.shown(pose, images)
        while self._shown and stamp_ns - self._shown[0][0] > WITHIN_NS:
            self._shown.popleft()
        self._shown.append((stamp_ns, shown))
        stamps_ns = np.array([at for at, _ in self._shown])
        poses = np.array([earlier.pose for _, earlier in self._shown])
        last = len(poses) - 1
        partners = [one for one, other in pairs(stamps_ns, poses, last)]
        if partners:
            before = self._shown[partners[0]][1]
            self._pairs.append([*self._comparison.sightings(0, before, shown)])
            self._judge()

    def _judge(self) -> None:
        """Fit the yaws to the last pairs."""
        numbered = [
            sighting._replace(pair=number)
            for number, sightings in enumerate(self._pairs)
            for sighting in sightings
        ]
        self.sentences = self._comparison.fit(numbered).sentences(AS_TRAINED, KNOCKED_RAD)
