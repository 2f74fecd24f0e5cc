# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Images of several cameras that were taken at one time, by their stamps.

One camera leads. To each of its images belongs the nearest image of every other camera, if their
stamps differ by half a period at most. Live and offline images pass in the order of reception.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sfa_localization.data.run import Image

NO_IMAGE = 'it sends no images'
LATE = 'its images come after those of the next time'
_STEPS = 9
"""Intervals of a camera, of which the median is its period: a lost image doubles one."""
_AWAITED = 3
"""Times in a row that a camera without images is waited for: each costs a period at most."""
_SILENT = 1.5
"""Periods after which a silent camera no longer leads: one image is lost for certain."""


class Joined(NamedTuple):
    """Images (H, W, 3) of one time with their stamps, ns, by camera; the mean `stamp_ns`; and the
    cameras that have none, each with the reason.
    """

    stamp_ns: int
    images: dict[str, tuple[int, Image]]
    absent: dict[str, str]


@dataclass(slots=True)
class _Track:
    """The images of a camera that wait, and the steps of its stamps, ns."""

    waiting: deque[tuple[int, Image]] = field(default_factory=deque)
    steps: deque[int] = field(default_factory=lambda: deque(maxlen=_STEPS))
    last_ns: int | None = None
    is_late: bool = False
    absences: int = 0
    """Times in a row for which no image came."""

    @property
    def period_ns(self) -> float:
        """The median step; 0 before the second image."""
        return float(np.median(self.steps)) if self.steps else 0.0

    def nearest(self, stamp_ns: int, most_ns: float) -> tuple[int, Image] | None:
        """The image nearest to a stamp, within `most_ns`; it and earlier ones wait no more."""
        while self.waiting and self.waiting[0][0] < stamp_ns - most_ns:
            self.waiting.popleft()
        near = [item for item in self.waiting if item[0] <= stamp_ns + most_ns]
        if not near:
            return None
        chosen = min(near, key=lambda item: abs(item[0] - stamp_ns))
        while self.waiting[0] is not chosen:
            self.waiting.popleft()
        return self.waiting.popleft()

    def is_decided(self, stamp_ns: int, period_ns: float) -> bool:
        """Whether no later image can be nearer to a stamp than those that wait."""
        half = (self.period_ns or period_ns) / 2
        return any(at > stamp_ns - half for at, _ in self.waiting)


class StampJoiner:
    """Joins the images of cameras, 2 or more, by their `names`; those of a time are given up when
    `patience` later images of the leading camera have come.
    """

    def __init__(self, names: Sequence[str], patience: int = 1) -> None:
        self._patience = patience
        self._tracks = {name: _Track() for name in names}
        self._lead = names[0]
        self._absent: dict[str, str] = {}
        self._joined_ns: int | None = None  # stamp of the leading image of the last images

    def add(self, name: str, stamp_ns: int, image: Image) -> list[Joined]:
        """Take an image of a camera; return what is complete now. A stamp that steps back begins
        anew.
        """
        track = self._tracks[name]
        if track.last_ns is not None:
            if stamp_ns <= track.last_ns:
                self._restart()
            else:
                track.steps.append(stamp_ns - track.last_ns)
        track.last_ns = stamp_ns
        track.absences = 0
        if name in self._absent and self._belongs_to_joined(stamp_ns):
            track.is_late = True
        else:
            track.waiting.append((stamp_ns, image))
        return self._complete()

    def flush(self) -> list[Joined]:
        """What the images that still wait give, at the end."""
        return self._complete(ended=True)

    def _restart(self) -> None:
        for track in self._tracks.values():
            track.waiting.clear()
            track.last_ns = None
        self._joined_ns = None

    def _belongs_to_joined(self, stamp_ns: int) -> bool:
        """Whether an image of a camera that was absent is of the last time, or of earlier ones."""
        half = self._tracks[self._lead].period_ns / 2
        return self._joined_ns is not None and stamp_ns <= self._joined_ns + half

    def _complete(self, ended: bool = False) -> list[Joined]:
        done = []
        while joined := self._next(ended):
            done.append(joined)
        return done

    def _next(self, ended: bool) -> Joined | None:
        """The next images, if they are complete or others will not come."""
        self._choose_lead()
        lead = self._tracks[self._lead]
        period_ns = lead.period_ns
        if not lead.waiting or not (period_ns or ended):
            return None
        stamp_ns = lead.waiting[0][0]
        is_over = ended or len(lead.waiting) > self._patience
        if not is_over and any(self._is_awaited(track, stamp_ns) for track in self._others()):
            return None
        return self._join(stamp_ns, period_ns / 2)

    def _others(self) -> list[_Track]:
        return [track for name, track in self._tracks.items() if name != self._lead]

    def _is_awaited(self, track: _Track, stamp_ns: int) -> bool:
        period_ns = self._tracks[self._lead].period_ns
        return track.absences < _AWAITED and not track.is_decided(stamp_ns, period_ns)

    def _choose_lead(self) -> None:
        """Let the first camera with images lead where the present one is silent."""
        lead = self._tracks[self._lead]
        if lead.waiting:
            return
        for name, track in self._tracks.items():
            if not track.waiting or not track.period_ns:
                continue
            silent_ns = track.waiting[-1][0] - (lead.last_ns or 0)
            if silent_ns > _SILENT * (lead.period_ns or track.period_ns):
                self._lead = name
                return

    def _join(self, stamp_ns: int, half_ns: float) -> Joined:
        images = {}
        absent = {}
        for name, track in self._tracks.items():
            if item := track.nearest(stamp_ns, half_ns):
                images[name] = item
                track.is_late = False
            else:
                track.absences += 1
                absent[name] = LATE if track.is_late else NO_IMAGE
        mean_ns = stamp_ns + round(sum(at - stamp_ns for at, _ in images.values()) / len(images))
        self._joined_ns = stamp_ns
        self._absent = absent
        return Joined(mean_ns, images, absent)
