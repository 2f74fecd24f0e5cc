# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Exact SFA statistics of a full simulated rotation, without rotating a single picture.

The paper trains each layer on "image t at rotations 0 .. R-1, then image t+1 at rotations
0 .. R-1, ...". Turning the robot shifts a panorama's columns, and layers with shared weights
commute with that shift. So with a feature map of R columns, one rotation step apart, the R views
of a node are its map's R columns, and the sums over the whole sequence, over the R nodes of a
row, are sums over the columns of one map per image:

    samples              R       sum_c        x_c x_c^T
    within an image      (R - 1) sum_c        (x_{c+1} - x_c) (x_{c+1} - x_c)^T
    between images               sum_c        (x_{t+1,c} - x_{t,c-1}) (...)^T

all indices cyclic. Everything here is divided by R. Maps are (T, rows, R, channels) float32.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.geometry import Array
from sfa_localization.sfa import Statistics

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
    return shifted(strips(maps, field), [i * field.spacing for i in range(field.columns)])


def shifted(columns: Map, shifts: list[int]) -> Map:
    """Stack the columns c + shift (cyclic) for every shift: (..., R, len(shifts) * P)."""
    width = columns.shape[-1]
    period = columns.shape[-2]
    out = np.empty((*columns.shape[:-1], len(shifts) * width), columns.dtype)
    for i, shift in enumerate(shifts):
        part = out[..., i * width : (i + 1) * width]
        k = shift % period
        part[..., : period - k, :] = columns[..., k:, :]
        part[..., period - k :, :] = columns[..., :k, :]
    return out


def between_images(maps: Map, scale: Map) -> Map:
    """scale[t] (x_{t+1,c} - x_{t,c-1}) for the pairs of nonzero scale: (pairs, rows, R, P)."""
    joined = scale > 0
    first, second = maps[:-1][joined], maps[1:][joined]
    difference = second - np.roll(first, 1, axis=2)
    difference *= scale[joined, None, None, None]
    return difference


class FieldStatistics:
    """Statistics of linear SFA on the fields of a map, in their block-Toeplitz form.

    Over all cyclic column positions, block (i, j) of a field's second moment is
    R(l) = sum_c x_c x_{c+l}^T with l the distance of columns j and i. Every R(l) that the three
    sums need comes from one product of the strips with their shifted copies.
    """

    def __init__(self, field: Field, rotations: int, strip: int) -> None:
        self.field = field
        self.rotations = rotations
        self.lags = self._lags()
        self.total = np.zeros(strip)
        self.same = np.zeros((strip, len(self.lags) * strip))
        self.between = np.zeros((strip, field.columns * strip))
        self.samples = self.pairs = 0

    def _lags(self) -> list[int]:
        """Column lags of the blocks of samples and of differences within images."""
        steps = range(self.field.columns)
        return sorted({i * self.field.spacing + e for i in steps for e in (-1, 0, 1)})

    def add(self, maps: Map, fresh: int, scale: Map) -> None:
        """Add the last `fresh` maps (of T), and the differences of pairs times scale (T - 1,).

        A scale of 0 marks a break between two images.
        """
        columns = strips(maps, self.field)
        new = columns[len(columns) - fresh :]
        self.samples += new.shape[0] * new.shape[1]
        self.total += new.sum((0, 1, 2), dtype=np.float64)
        self.same += _product(new, shifted(new, self.lags))
        difference = between_images(columns, scale)
        self.pairs += difference.shape[0] * difference.shape[1]
        steps = [i * self.field.spacing for i in range(self.field.columns)]
        if len(difference):
            self.between += _product(difference, shifted(difference, steps))

    def result(self) -> Statistics:
        """The sums over the explicit rotation sequence, divided by the number of rotations."""
        count, r = self.samples * self.rotations, self.rotations
        within = self._blocks(self._within)
        second = self._blocks(self._lag)
        between = self._blocks(self._lag_between)
        steps = self.samples * (r - 1) + self.pairs
        total = np.tile(self.total, self.field.columns)
        return Statistics(
            float(count), total, second, float(steps), within * (r - 1) / r + between / r
        )

    def _blocks(self, block_of: Callable[[int], Array]) -> Array:
        """Assemble (D, D) from the blocks of column lags l >= 0."""
        p, n = len(self.total), self.field.columns
        out = np.empty((n, p, n, p))
        for lag in range(n):
            block = block_of(lag * self.field.spacing)
            for i in range(n - lag):
                out[i, :, i + lag] = block
                out[i + lag, :, i] = block.T
        return out.reshape(n * p, n * p)

    def _lag(self, lag: int) -> Array:
        p, at = len(self.total), self.lags.index(lag)
        return self.same[:, at * p : (at + 1) * p]

    def _within(self, lag: int) -> Array:
        return 2 * self._lag(lag) - self._lag(lag + 1) - self._lag(lag - 1)

    def _lag_between(self, lag: int) -> Array:
        p, at = len(self.total), lag // self.field.spacing
        return self.between[:, at * p : (at + 1) * p]


def _product(a: Map, b: Map) -> Array:
    """a^T b over all leading axes, in float32, returned in float64."""
    return np.asarray(a.reshape(-1, a.shape[-1]).T @ b.reshape(-1, b.shape[-1]), np.float64)


class SampleStatistics:
    """Statistics of linear SFA on the nodes' own signals, signal-major: (D, T, rows, R)."""

    def __init__(self, rotations: int, dimensions: int) -> None:
        self.rotations = rotations
        self.sums = Statistics.empty(dimensions)

    def add(self, signals: Map, fresh: int, scale: Map) -> None:
        """Add the last `fresh` of T images, and the pairs' differences times scale (T - 1,)."""
        r, s = self.rotations, self.sums
        new = signals[:, signals.shape[1] - fresh :]
        nodes = new.shape[1] * new.shape[2]
        s.weight += nodes * r
        s.total += new.sum((1, 2, 3), dtype=np.float64)
        s.second += _square(new)
        s.difference += _square(_turned(new)) * ((r - 1) / r)
        s.steps += nodes * (r - 1)
        self._add_pairs(signals, scale)

    def result(self) -> Statistics:
        return self.sums

    def _add_pairs(self, signals: Map, scale: Map) -> None:
        joined = scale > 0
        if not joined.any():
            return
        first, second = signals[:, :-1][:, joined], signals[:, 1:][:, joined]
        pairs = second - np.roll(first, 1, axis=3)
        pairs *= scale[joined, None, None]
        self.sums.difference += _square(pairs) / self.rotations
        self.sums.steps += pairs.shape[1] * pairs.shape[2]


def _turned(signals: Map) -> Map:
    """Differences between columns one rotation step apart (cyclic)."""
    out = np.empty_like(signals)
    np.subtract(signals[..., 1:], signals[..., :-1], out=out[..., :-1])
    np.subtract(signals[..., 0], signals[..., -1], out=out[..., -1])
    return out


def _square(signals: Map) -> Array:
    flat = signals.reshape(len(signals), -1)
    return np.asarray(flat @ flat.T, np.float64)
