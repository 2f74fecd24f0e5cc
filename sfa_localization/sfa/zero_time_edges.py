# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures between drives as neighbors in the training sequence, with no time between them.

The two images of a closure differ in light, or season, but not in place. As neighbors they make
only such features slow that are alike in both lights. Without them, the difference between the
drives would be the slowest feature of all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Indices
from sfa_localization.data.run import Image, Panoramas, Stamps
from sfa_localization.data.statistics import evenly
from sfa_localization.keyframes.closures import Closures
from sfa_localization.sfa.network_training import ImageSequence

_MOST = 200
"""Most edges of a training: enough for statistics, in a small part of its time."""


@dataclass(frozen=True, slots=True)
class PairedPanoramas:
    """The images a, b of each of E loop closures: b is turned to the heading of a and one rotation
    step farther, as the simulated rotation expects of neighbors.

    `pairs` (E, 2) are indices among the images of all `drives`; b is turned by `columns` (E,).
    """

    drives: tuple[Panoramas, ...]
    pairs: Indices
    columns: Indices

    @property
    def stamps_ns(self) -> Stamps:
        return np.arange(len(self), dtype=np.int64)

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.drives[0].shape

    def __len__(self) -> int:
        return 2 * len(self.pairs)

    def read(self, start: int, stop: int) -> Image:
        """Images start .. stop - 1 of the sequence (stop - start, H, W, C)."""
        return np.stack([self._image(*divmod(n, 2)) for n in range(start, min(stop, len(self)))])

    def batches(self, size: int) -> Iterator[Image]:
        for start in range(0, len(self), size):
            yield self.read(start, start + size)

    def _image(self, pair: int, second: int) -> Image:
        starts = np.cumsum([0, *(len(drive) for drive in self.drives)])
        index = int(self.pairs[pair, second])
        drive = int(np.searchsorted(starts, index, 'right')) - 1
        row = index - int(starts[drive])
        image = self.drives[drive].read(row, row + 1)[0]
        return np.roll(image, int(self.columns[pair]), axis=1) if second else image


def edges_between(
    drives: Sequence[Panoramas], closures: Closures, rotations: int, clockwise: bool
) -> list[ImageSequence]:
    """The closures between different drives as a sequence for a network of so many rotations; no
    sequence without closures.
    """
    starts = np.cumsum([0, *(len(drive) for drive in drives)])
    drive = np.searchsorted(starts, closures.images, 'right')
    between = np.flatnonzero(drive[:, 0] != drive[:, 1])
    if not len(between):
        return []
    chosen = between[evenly(len(between), _MOST)]
    width = drives[0].shape[1]
    turned = closures.turn[chosen] * (width / (2 * np.pi if clockwise else -2 * np.pi))
    columns = np.round(width / rotations - turned).astype(np.int64)
    paired = PairedPanoramas(tuple(drives), closures.images[chosen], columns)
    joined: NDArray[np.bool_] = np.arange(len(paired) - 1) % 2 == 0
    return [ImageSequence(paired, joined)]
