# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Train the network layer by layer from streamed panoramas and mergeable statistics.

Each layer needs two passes: one for its linear SFA, one for the SFA of the expanded signals. A
pass is a sum over shards of the drives, so it may run in this process or on a cluster; the sums
are merged in the shards' order, so the result does not depend on who did the work.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import ConfigError, DataError
from sfa_localization.data.run import BATCH, Image, Panoramas
from sfa_localization.data.threads import one_core
from sfa_localization.features.network import (
    LAYERS,
    Architecture,
    Layer,
    Network,
    Node,
    expand_into,
    folded,
    linear_stage,
    prepare,
)
from sfa_localization.features.rotation import FieldStatistics, Map, SampleStatistics, Sums
from sfa_localization.features.settings import NetworkConfig
from sfa_localization.features.sfa import Solution, Statistics, solve

# Pictures of a shard; signals of a node multiplied at once, which fit a cache.
SHARD = 64
_TOGETHER = 1440


@dataclass(frozen=True, slots=True)
class Drive:
    """The panoramas of one drive and the scale (N - 1,) of the differences between neighbors.

    A scale of 0 is a break; 1 is the paper's difference per picture.
    """

    panoramas: Panoramas
    scale: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Shard:
    """Pictures start .. stop - 1 of a drive, with the pair that leads into them.

    `photometric_std` and `seed` perturb the light of each picture, by its number.
    """

    drive: Drive
    start: int
    stop: int
    photometric_std: float = 0.0
    seed: tuple[int, int] = (0, 0)

    def batches(self) -> Iterator[tuple[Image, NDArray[np.float32]]]:
        """Pictures (T, H, W, C), and the scale (T,) of the difference that leads into each."""
        scale = np.concatenate([np.zeros(1, np.float32), self.drive.scale])
        for start in range(self.start, self.stop, BATCH):
            stop = min(start + BATCH, self.stop)
            yield self._lit(start, stop), scale[start:stop]

    def lead(self) -> Image | None:
        """The picture (1, H, W, C) before the first one; None at the drive's start."""
        return self._lit(self.start - 1, self.start) if self.start else None

    def _lit(self, start: int, stop: int) -> Image:
        images = self.drive.panoramas.read(start, stop)
        if self.photometric_std == 0:
            return images
        gains = np.stack(
            [_gain(self.photometric_std, (*self.seed, at)) for at in range(start, stop)]
        )
        lit = images * gains[:, None, None, :]
        return np.asarray(np.clip(lit, 0, 255).round().astype(np.uint8))


def _gain(std: float, seed: Sequence[int]) -> NDArray[np.float32]:
    """Random exposure and color balance (3,) of one picture, always the same for it."""
    normal = np.random.default_rng(seed).standard_normal(4).astype(np.float32)
    return np.asarray(np.exp(std * (normal[0] + normal[1:] / 3)), np.float32)


class Executor(Protocol):
    """Whoever computes the sums over the shards and merges them; the same way every time.

    It tells `on_shard` the number of pictures of each finished shard.
    """

    def __call__(
        self,
        work: Callable[[Shard], Sums],
        shards: Sequence[Shard],
        on_shard: Callable[[int], None],
    ) -> Sums: ...


def in_this_process(
    work: Callable[[Shard], Sums], shards: Sequence[Shard], on_shard: Callable[[int], None]
) -> Sums:
    """Compute the shards on all cores, and merge them in their order."""
    parts = _in_threads(work, shards)
    total: Sums | None = None
    for part, shard in zip(parts, shards, strict=True):
        if total is None:
            total = part
        else:
            total.merge(part)
        on_shard(shard.stop - shard.start)
    assert total is not None
    return total


def _in_threads(work: Callable[[Shard], Sums], shards: Sequence[Shard]) -> Iterator[Sums]:
    """The shards' sums in order; one more shard than there are cores is on its way."""
    workers = _cores()
    with one_core(), ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[Sums]] = deque()
        try:
            for shard in shards:
                waiting.append(pool.submit(work, shard))
                if len(waiting) > workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def _cores() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, 'sched_getaffinity', None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@dataclass(frozen=True, slots=True)
class Partial:
    """A network in the making: finished layers, and perhaps the linear half of the next."""

    architecture: Architecture
    nodes: tuple[Node, ...] = ()
    linear: Solution | None = None
    deltas: tuple[NDArray[np.float64], ...] = field(default=())
    ranks: tuple[tuple[int, int], ...] = field(default=())

    @property
    def depth(self) -> int:
        return len(self.nodes)

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
    """Sums of the stage that comes next, over one shard."""
    network = partial.network()
    sums = _sums(partial)
    signals = _signals(partial)
    architecture = partial.architecture
    nodes = architecture.map_rows[partial.depth + 1] * architecture.rotations
    together = max(1, _TOGETHER // nodes)
    lead = shard.lead()
    if lead is not None:
        sums.lead(signals(_below(network, lead)))
    for images, scale in shard.batches():
        maps = _below(network, images)
        for start in range(0, len(maps), together):
            part = slice(start, start + together)
            sums.add(signals(maps[part]), scale[part])
    return sums


def stage_statistics(partial: Partial, shard: Shard) -> Statistics:
    """Statistics of the stage that comes next, over one shard."""
    return stage_sums(partial, shard).result()


def _sums(partial: Partial) -> Sums:
    """Empty sums for the stage that comes next."""
    architecture, depth = partial.architecture, partial.depth
    layer, receptive = architecture.layers[depth], architecture.fields[depth]
    if partial.linear is not None:
        return SampleStatistics(architecture.rotations, layer.expanded)
    strip = receptive.rows * architecture.channels[depth]
    return FieldStatistics(receptive, architecture.rotations, strip)


def _signals(partial: Partial) -> Callable[[Map], Map]:
    """From the maps below to the signals whose SFA comes next."""
    if partial.linear is None:
        return lambda maps: maps
    receptive = partial.architecture.fields[partial.depth]
    linear, offset = folded(partial.linear)

    def expanded(maps: Map) -> Map:
        dimensions = partial.architecture.layers[partial.depth].expanded
        rows = receptive.rows_out(maps.shape[1])
        out = np.empty((dimensions, len(maps), rows, maps.shape[2]), np.float32)
        for t, below in enumerate(maps):
            expand_into(linear_stage(below, receptive, linear, offset), out[:, t])
        return out

    return expanded


def _below(network: Network, images: Image) -> Map:
    """Input map of the layer above all of the network's."""
    maps = prepare(images, network.architecture)
    for depth in range(len(network.nodes)):
        maps = network.layer(maps, depth)
    return maps


def shards_of(drives: Sequence[Drive], config: NetworkConfig) -> list[Shard]:
    """All drives cut into shards of equal length."""
    return [
        Shard(
            drive,
            start,
            min(start + SHARD, len(drive.panoramas)),
            config.photometric_std,
            (config.photometric_seed, number),
        )
        for number, drive in enumerate(drives)
        for start in range(0, len(drive.panoramas), SHARD)
    ]


def architecture_of(config: NetworkConfig, size: tuple[int, int]) -> Architecture:
    """The network that the configuration asks for, for panoramas of (rows, columns).

    Raises ConfigError when the layers do not fit the size; it tells the sizes that would.
    """
    if config.layers == 'custom':
        return Architecture(size, config.binning, config.normalization, _custom(config))
    if config.layers != 'auto':
        binning, layers = LAYERS[config.layers]
        return Architecture(size, binning, config.normalization, layers)
    refusals = []
    for binning, layers in LAYERS.values():
        try:
            return Architecture(size, binning, config.normalization, layers)
        except ConfigError as error:
            refusals.append(str(error))
    raise ConfigError(f'no standard network fits: {"; ".join(refusals)}; or give layers: custom')


def _custom(config: NetworkConfig) -> tuple[Layer, ...]:
    columns = (
        config.field_rows,
        config.field_columns,
        config.stride_rows,
        config.stride_columns,
        config.linear_dimensions,
        config.output_dimensions,
    )
    if len({len(column) for column in columns}) != 1:
        raise ConfigError('field_*, stride_*, linear_dimensions, output_dimensions: one per layer')
    return tuple(
        Layer((fr, fc), (sr, sc), linear, outputs, config.clip)
        for fr, fc, sr, sc, linear, outputs in zip(*columns, strict=True)
    )


def train_network(
    architecture: Architecture,
    drives: Sequence[Drive],
    config: NetworkConfig,
    *,
    start: Partial | None = None,
    executor: Executor = in_this_process,
    on_stage: Callable[[Partial], None] = lambda partial: None,
    on_shard: Callable[[int], None] = lambda images: None,
) -> Network:
    """Train all layers on the full simulated rotation of every drive.

    `start` continues a training that was cut off; `on_stage` is told each finished stage, and
    `on_shard` how many pictures have been worked through since the last call.
    Raises DataError when the pictures vary too little.
    """
    if not any(len(drive.panoramas) > 1 for drive in drives):
        raise DataError('training needs at least two consecutive panoramas')
    partial = start or Partial(architecture)
    shards = shards_of(drives, config)
    while not partial.finished:
        total = executor(_Stage(partial), shards, on_shard)
        with one_core():
            partial = partial.advanced(total.result(), config.relative_cut)
        on_stage(partial)
    return partial.network()


@dataclass(frozen=True, slots=True)
class _Stage:
    """The work on one shard: a plain object, so that it can be sent to another machine."""

    partial: Partial

    def __call__(self, shard: Shard) -> Sums:
        return stage_sums(self.partial, shard)
