# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Train the network layer by layer from streamed panoramas: section 2.2 of the paper.

Each layer needs two passes: one for its linear SFA, one for the SFA of the expanded signals. A
pass is a sum over shards of the drives, computed on all cores; the sums are merged in the order of
the shards, so the result does not depend on how many cores there are.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.run import BATCH, Image, Panoramas, Run
from sfa_localization.data.threads import one_core
from sfa_localization.sfa.network import (
    Architecture,
    Network,
    Node,
    expand,
    folded,
    input_map,
    linear_stage,
)
from sfa_localization.sfa.rotation import FieldStatistics, Map, SampleStatistics, Sums
from sfa_localization.sfa.slowness import LinearSfa, Statistics, solve

SHARD = 64
"""Images of one task: enough for efficient products, few enough to balance the cores."""
MOST = 3500
"""The network is trained on so many images, of longer drives on some of each shard. More of them
would be no better on 32 m x 36 m than on 16 m x 18 m, and take longer."""
BREAK_TIME_S = 5.0
BREAK_DISTANCE_M = 2.0
"""Consecutive images with more than either between them are not neighbors: the drive was
interrupted."""
LIGHT_STD = 0.3
"""Standard deviation of the logarithmic gain of each training image: features must not code for
exposure, which changes more between days than within one drive."""
RELATIVE_CUT = 1e-3
"""Signals of less variance than this part of the largest are dropped: they are mostly noise."""
# Signals of a node that are multiplied at once, such that they fit a cache.
_TOGETHER = 1440


@dataclass(frozen=True, slots=True)
class ImageSequence:
    """The panoramas of one drive, and whether consecutive ones are neighbors, `joined` (N - 1,)."""

    panoramas: Panoramas
    joined: NDArray[np.bool_]

    @classmethod
    def of(cls, run: Run) -> ImageSequence:
        """The images of a run; pauses and jumps of the odometry are breaks."""
        stamps = run.panoramas.stamps_ns
        seconds = np.diff(stamps) * 1e-9
        places = run.odometry.trajectory.at(stamps)[:, :2]
        meters = np.hypot(*np.diff(places, axis=0).T)
        joined = (seconds > 0) & (seconds <= BREAK_TIME_S) & (meters <= BREAK_DISTANCE_M)
        return cls(run.panoramas, joined)


@dataclass(frozen=True, slots=True)
class Shard:
    """Images start .. stop - 1 of a sequence, with the pair that leads into them; they stand for
    the images until `end`. The light of each image is changed at random, by `seed` and its number.
    """

    sequence: ImageSequence
    start: int
    stop: int
    end: int
    light_std: float = 0.0
    seed: tuple[int, int] = (0, 0)

    def batches(self) -> Iterator[tuple[Image, NDArray[np.bool_]]]:
        """Images (T, H, W, C), and whether each is a neighbor of the one before it (T,)."""
        joined = np.concatenate([[False], self.sequence.joined])
        for start in range(self.start, self.stop, BATCH):
            stop = min(start + BATCH, self.stop)
            yield self._lit(start, stop), joined[start:stop]

    def lead(self) -> Image | None:
        """The image (1, H, W, C) before the first one; None at the start of the sequence."""
        return self._lit(self.start - 1, self.start) if self.start else None

    def _lit(self, start: int, stop: int) -> Image:
        images = self.sequence.panoramas.read(start, stop)
        if self.light_std == 0:
            return images
        gains = np.stack([_gain(self.light_std, (*self.seed, n)) for n in range(start, stop)])
        lit = images * gains[:, None, None, :]
        return np.asarray(np.clip(lit, 0, 255).round().astype(np.uint8))


def _gain(std: float, seed: Sequence[int]) -> NDArray[np.float32]:
    """Random exposure and color balance (3,) of an image, always the same for this image."""
    normal = np.random.default_rng(seed).standard_normal(4).astype(np.float32)
    return np.asarray(np.exp(std * (normal[0] + normal[1:] / 3)), np.float32)


def _summed(partial: Partial, shards: Sequence[Shard], on_shard: Callable[[int], object]) -> Sums:
    """Sums of the next stage over all shards, merged in their order."""
    total = _sums(partial)
    for part, shard in zip(_in_threads(partial, shards), shards, strict=True):
        total.merge(part)
        on_shard(shard.end - shard.start)
    return total


def _in_threads(partial: Partial, shards: Sequence[Shard]) -> Iterator[Sums]:
    """The sums of the shards in order; one more shard than there are cores is in progress."""
    workers = cores()
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[Sums]] = deque()
        try:
            for shard in shards:
                waiting.append(pool.submit(stage_sums, partial, shard))
                if len(waiting) > workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def cores() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, 'sched_getaffinity', None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@dataclass(frozen=True, slots=True)
class Partial:
    """A partly trained network: finished layers, and perhaps the linear half of the next one.

    `stages` counts the finished halves of layers; without `rotate` there is no simulated rotation.
    """

    architecture: Architecture
    nodes: tuple[Node, ...] = ()
    linear: LinearSfa | None = None
    deltas: tuple[NDArray[np.float64], ...] = field(default=())
    ranks: tuple[tuple[int, int], ...] = field(default=())
    rotate: bool = True

    @property
    def depth(self) -> int:
        return len(self.nodes)

    @property
    def stages(self) -> int:
        return 2 * self.depth + (self.linear is not None)

    @property
    def finished(self) -> bool:
        return self.depth == len(self.architecture.layers)

    def network(self) -> Network:
        return Network(self.architecture, self.nodes, self.deltas, self.ranks)

    def advanced(self, statistics: Statistics, relative_cut: float) -> Partial:
        """The next stage, from the statistics of this one."""
        layer = self.architecture.layers[self.depth]
        if self.linear is None:
            return replace(self, linear=solve(statistics, layer.linear, relative_cut))
        slow = solve(statistics, layer.outputs, relative_cut)
        return replace(
            self,
            nodes=(*self.nodes, Node.from_solutions(self.linear, slow)),
            linear=None,
            deltas=(*self.deltas, slow.delta),
            ranks=(*self.ranks, (self.linear.rank, slow.rank)),
        )


def stage_sums(partial: Partial, shard: Shard) -> Sums:
    """Sums of the next stage over one shard."""
    network = partial.network()
    sums = _sums(partial)
    signals = _signals(partial)
    architecture = partial.architecture
    nodes = architecture.map_rows[partial.depth + 1] * architecture.rotations
    together = max(1, _TOGETHER // nodes)
    lead = shard.lead()
    if lead is not None:
        sums.lead(signals(_below(network, lead)))
    for images, joined in shard.batches():
        maps = _below(network, images)
        for start in range(0, len(maps), together):
            part = slice(start, start + together)
            sums.add(signals(maps[part]), joined[part])
    return sums


def _sums(partial: Partial) -> Sums:
    """Empty sums for the next stage."""
    architecture = partial.architecture
    depth = partial.depth
    layer = architecture.layers[depth]
    receptive = architecture.fields[depth]
    if partial.linear is not None:
        return SampleStatistics(architecture.rotations, layer.expanded, partial.rotate)
    strip = receptive.rows * architecture.channels[depth]
    return FieldStatistics(receptive, architecture.rotations, strip, partial.rotate)


def _signals(partial: Partial) -> Callable[[Map], Map]:
    """The function from the maps below to the signals of the next SFA."""
    if partial.linear is None:
        return lambda maps: maps
    receptive = partial.architecture.fields[partial.depth]
    linear, offset = folded(partial.linear)

    def expanded(maps: Map) -> Map:
        reduced = [linear_stage(below, receptive, linear, offset) for below in maps]
        return expand(np.stack(reduced, axis=1))

    return expanded


def _below(network: Network, images: Image) -> Map:
    """The input map of the first layer that is not trained yet."""
    maps = input_map(images, network.architecture)
    for depth in range(len(network.nodes)):
        maps = network.layer(maps, depth)
    return maps


def shards_of(
    sequences: Sequence[ImageSequence], seed: int, light_std: float = LIGHT_STD
) -> list[Shard]:
    """All sequences cut into shards of equal length, with at most `MOST` images in all."""
    images = sum(len(s.panoramas) for s in sequences)
    used = max(math.ceil(SHARD * MOST / max(images, MOST)), 2)  # at least a pair
    shards = []
    for number, s in enumerate(sequences):
        count = len(s.panoramas)
        for start in range(0, count, SHARD):
            stop = min(start + used, count)
            end = min(start + SHARD, count)
            shards.append(Shard(s, start, stop, end, light_std, (seed, number)))
    return shards


def require_pairs(sequences: Sequence[ImageSequence]) -> None:
    """Raise DataError where there is no difference between images to learn from."""
    if not any(len(s.panoramas) > 1 for s in sequences):
        raise DataError('training needs at least two consecutive panoramas')


@one_core()
def train_network(
    architecture: Architecture,
    sequences: Sequence[ImageSequence],
    seed: int = 0,
    *,
    light_std: float = LIGHT_STD,
    relative_cut: float = RELATIVE_CUT,
    rotate: bool = True,
    start: Partial | None = None,
    on_stage: Callable[[Partial], object] = lambda partial: None,
    on_shard: Callable[[int], object] = lambda images: None,
) -> Network:
    """Train all layers on the full simulated rotation of every sequence (section 2.2).

    `rotate` false leaves out the simulated rotation, for comparison. `start` continues an
    interrupted training; `on_stage` receives each finished stage, `on_shard` the number of images
    since its last call.
    Raises DataError when the images vary too little.
    """
    require_pairs(sequences)
    partial = start or Partial(architecture, rotate=rotate)
    shards = shards_of(sequences, seed, light_std)
    while not partial.finished:
        total = _summed(partial, shards, on_shard)
        partial = partial.advanced(total.result(), relative_cut)
        on_stage(partial)
    return partial.network()
