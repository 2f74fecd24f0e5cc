# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Exact SFA statistics of a full simulated rotation, without rotating a single image.

Section 2.2 of the paper trains each layer on "image t at rotations 0 .. R-1, then image t+1 at
rotations 0 .. R-1, ...". Turning the robot shifts the columns of a panorama, and layers with shared
weights commute with that shift. So with a feature map of R columns, one rotation step apart, the R
views of a node are its map's R columns, and the sums over the whole sequence, over the R nodes of a
row, are sums over the columns of one map per image:

    samples              R       sum_c        x_c x_c^T
    within an image      (R - 1) sum_c        (x_{c+1} - x_c) (x_{c+1} - x_c)^T
    between images               sum_c        (x_{t+1,c} - x_{t,c-1}) (...)^T

all indices cyclic. Everything here is divided by R. Maps are (T, rows, R, channels) float32.

The rotation can be left out, for comparison: then only the differences x_{t+1,c} - x_{t,c} count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Mask
from sfa_localization.sfa.slowness import Statistics

Map = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Field:
    """A receptive field: `rows` x `columns` units of a map, columns `spacing` apart.

    Fields start at every column, wrapping around, and at every `row_stride`-th row.
    """

    rows: int
    columns: int
    row_stride: int
    spacing: int = 1

    def rows_out(self, rows: int) -> int:
        return (rows - self.rows) // self.row_stride + 1

    def row_slices(self, rows: int) -> list[slice]:
        starts = range(0, rows - self.rows + 1, self.row_stride)
        return [slice(start, start + self.rows) for start in starts]


def strips(maps: Map, field: Field) -> Map:
    """Single columns of every field: (T, rows_out, R, field.rows * channels)."""
    t, rows, columns, channels = maps.shape
    cut = np.empty((t, field.rows_out(rows), columns, field.rows, channels), maps.dtype)
    for out, rows_of in enumerate(field.row_slices(rows)):
        cut[:, out] = maps[:, rows_of].transpose(0, 2, 1, 3)
    return cut.reshape(t, cut.shape[1], columns, field.rows * channels)


def unfold(maps: Map, field: Field) -> Map:
    """All fields: (T, rows_out, R, field.columns * field.rows * channels), columns outermost."""
    return shifted(strips(maps, field), range(0, field.columns * field.spacing, field.spacing))


def shifted(columns: Map, shifts: Sequence[int]) -> Map:
    """Beside each other the columns c + shift (cyclic) of each shift: (..., R, len(shifts) * P)."""
    period = columns.shape[-2]
    index = (np.arange(period)[:, None] + np.array(shifts)) % period
    return np.asarray(columns[..., index, :].reshape(*columns.shape[:-1], -1))


class Sums(Protocol):
    """Sums over the rotation sequence, image after image."""

    def lead(self, maps: Map) -> None:
        """Set the map (1, ...) before the first one, which counts only as a neighbor."""

    def add(self, maps: Map, joined: Mask) -> None:
        """Add maps (T, ...), and the difference to the map before where `joined` (T,) is true."""

    def merge(self, other: Any) -> None:
        """Add the sums of another part of the sequence."""

    def result(self) -> Statistics:
        """The sums over the explicit rotation sequence, divided by the number of rotations."""


class FieldStatistics:
    """Statistics of linear SFA on the fields of a map, in their block-Toeplitz form.

    Over all cyclic column positions, block (i, j) of a field's second moment is
    R(l) = sum_c x_c x_{c+l}^T with l the distance of columns j and i. Every R(l) that the three
    sums need comes from one product of the strips with their shifted copies.
    """

    def __init__(self, field: Field, rotations: int, strip: int, rotate: bool = True) -> None:
        self.field = field
        self.rotations = rotations
        self.rotate = rotate
        self.lags = self._lags()
        self.total = np.zeros(strip)
        self.same = np.zeros((strip, len(self.lags) * strip))
        self.between = np.zeros((strip, field.columns * strip))
        self.samples = self.pairs = 0
        self._last: Map | None = None

    def _lags(self) -> list[int]:
        """Column lags of the blocks of samples and of differences within images."""
        steps = range(self.field.columns)
        return sorted({i * self.field.spacing + e for i in steps for e in (-1, 0, 1)})

    def lead(self, maps: Map) -> None:
        self._last = strips(maps, self.field)

    def add(self, maps: Map, joined: Mask) -> None:
        columns = strips(maps, self.field)
        self.samples += columns.shape[0] * columns.shape[1]
        self.total += columns.sum((0, 1, 2), dtype=np.float64)
        self.same += _product(columns, shifted(columns, self.lags))
        difference = _between_images(columns, self._last, joined, self.rotate, time=0)
        self.pairs += difference.shape[0] * difference.shape[1]
        if len(difference):
            steps = range(0, self.field.columns * self.field.spacing, self.field.spacing)
            self.between += _product(difference, shifted(difference, steps))
        self._last = columns[-1:]

    def merge(self, other: FieldStatistics) -> None:
        self.samples += other.samples
        self.pairs += other.pairs
        self.total += other.total
        self.same += other.same
        self.between += other.between

    def result(self) -> Statistics:
        count = self.samples * self.rotations
        r = self.rotations
        steps = self.pairs + (self.samples * (r - 1) if self.rotate else 0)
        total = np.tile(self.total, self.field.columns)
        second = self._blocks(self._lag)
        difference = self._blocks(self._difference)
        return Statistics(float(count), total, second, float(steps), difference)

    def _blocks(self, block_of: Callable[[int], Array]) -> Array:
        """Assemble (D, D) from the blocks of column lags l >= 0."""
        p = len(self.total)
        n = self.field.columns
        out = np.empty((n, p, n, p))
        for lag in range(n):
            block = block_of(lag * self.field.spacing)
            for i in range(n - lag):
                out[i, :, i + lag] = block
                out[i + lag, :, i] = block.T
        return out.reshape(n * p, n * p)

    def _difference(self, lag: int) -> Array:
        """Within images R - 1 times, between images once."""
        r = self.rotations
        if not self.rotate:
            return self._lag_between(lag) / r
        within = 2 * self._lag(lag) - self._lag(lag + 1) - self._lag(lag - 1)
        return within * ((r - 1) / r) + self._lag_between(lag) / r

    def _lag(self, lag: int) -> Array:
        p = len(self.total)
        at = self.lags.index(lag)
        return self.same[:, at * p : (at + 1) * p]

    def _lag_between(self, lag: int) -> Array:
        p = len(self.total)
        at = lag // self.field.spacing
        return self.between[:, at * p : (at + 1) * p]


def _between_images(signals: Map, last: Map | None, joined: Mask, rotate: bool, time: int) -> Map:
    """x_{t,c} - x_{t-1,c-1} of the pairs that are joined, or x_{t,c} - x_{t-1,c} without rotation,
    along the axis `time`; columns are two axes behind it, and `last` comes before the first image.
    """
    seconds = np.flatnonzero(joined)
    if last is None:
        seconds = seconds[seconds > 0]
    else:
        signals = np.concatenate([last, signals], axis=time)
        seconds = seconds + 1
    before = np.roll(signals.take(seconds - 1, axis=time), int(rotate), axis=time + 2)
    return np.asarray(signals.take(seconds, axis=time) - before)


def _product(a: Map, b: Map) -> Map:
    """a^T b over all leading axes."""
    return np.asarray(a.reshape(-1, a.shape[-1]).T @ b.reshape(-1, b.shape[-1]))


class SampleStatistics:
    """Statistics of linear SFA on signals of D dimensions, given signal-major: (D, T, rows, R)."""

    def __init__(self, rotations: int, dimensions: int, rotate: bool = True) -> None:
        self.rotations = rotations
        self.rotate = rotate
        self.samples = self.pairs = 0
        self.total = np.zeros(dimensions)
        self.second, self.within, self.between = np.zeros((3, dimensions, dimensions))
        self._last: Map | None = None

    def lead(self, maps: Map) -> None:
        self._last = maps[:, -1:]

    def add(self, maps: Map, joined: Mask) -> None:
        self.samples += maps.shape[1] * maps.shape[2]
        self.total += maps.sum((1, 2, 3), dtype=np.float64)
        self.second += _square(maps)
        if self.rotate:
            self.within += _square(np.roll(maps, -1, axis=-1) - maps)
        pairs = _between_images(maps, self._last, joined, self.rotate, time=1)
        self.between += _square(pairs)
        self.pairs += pairs.shape[1] * pairs.shape[2]
        self._last = maps[:, -1:].copy()

    def merge(self, other: SampleStatistics) -> None:
        self.samples += other.samples
        self.pairs += other.pairs
        self.total += other.total
        self.second += other.second
        self.within += other.within
        self.between += other.between

    def result(self) -> Statistics:
        r = self.rotations
        difference = self.within * ((r - 1) / r) + self.between / r
        steps = self.pairs + (self.samples * (r - 1) if self.rotate else 0)
        return Statistics(
            float(self.samples * r), self.total, self.second, float(steps), difference
        )


def _square(signals: Map) -> Map:
    flat = signals.reshape(len(signals), -1)
    return np.asarray(flat @ flat.T)
