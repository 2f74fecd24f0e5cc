# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Train on many machines: a Dask cluster computes the sums over the shards of a drive.

Workers read the decoded panoramas from the file that `train` keeps beside its output, so they run
on the same host or see that folder under the same path. They need this package installed. A shard
whose worker is lost is computed again by another one.
"""

from __future__ import annotations

import copy
import importlib
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sfa_localization.data.errors import ConfigError, DataError
from sfa_localization.data.run import Image, PanoramaArray, Stamps
from sfa_localization.data.threads import one_core
from sfa_localization.features.network_training import Executor, Shard, in_this_process
from sfa_localization.features.rotation import Sums

logger = logging.getLogger(__name__)

_CONNECT_TIMEOUT_S = 20


def executor_at(address: str | None) -> AbstractContextManager[Executor]:
    """The executor on the cluster at `address`; this process without one."""
    return dask_executor(address) if address else nullcontext(in_this_process)


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """An executor for network_training.train_network on the Dask scheduler at `address`.

    Raises ConfigError without Dask, scheduler or worker.
    """
    distributed = _distributed()
    try:
        client = distributed.Client(address, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(
            f'no Dask scheduler answers at {address} ({error}): start it with `dask scheduler`'
        ) from None
    with client:
        workers = len(client.scheduler_info(n_workers=-1)['workers'])
        if not workers:
            raise ConfigError(f'{address}: the scheduler has no worker: start `dask worker`')
        logger.info('training on %d workers of %s', workers, address)
        yield partial(_compute, client)


def _distributed() -> Any:
    try:
        return importlib.import_module('distributed')
    except ImportError:
        raise ConfigError(
            'the option dask needs the extra: pip install "sfa_localization[distributed]"'
        ) from None


def _compute(
    client: Any,
    work: Callable[[Shard], Sums],
    shards: Sequence[Shard],
    on_shard: Callable[[int], object],
) -> Sums:
    """Map the shards over the cluster and merge neighbors there until one is left."""
    shared = client.scatter(work, broadcast=True, hash=False)
    futures = [client.submit(_on_worker, shared, _portable(s), pure=False) for s in shards]
    sizes = {future.key: s.stop - s.start for future, s in zip(futures, shards, strict=True)}
    total = _merged(client, futures)
    for future in _distributed().as_completed(futures, loop=client.loop, raise_errors=False):
        on_shard(sizes[future.key])
    return _result(total)


def _merged(client: Any, futures: list[Any]) -> Any:
    """A tree of merges of neighbors: its shape depends on their number only."""
    while len(futures) > 1:
        pairs = zip(futures[::2], futures[1::2], strict=False)
        merged = [client.submit(_pair, *pair, pure=False) for pair in pairs]
        futures = merged + futures[len(merged) * 2 :]
    return futures[0]


def _result(future: Any) -> Sums:
    try:
        sums: Sums = future.result()
    except FileNotFoundError as error:
        raise DataError(
            f'a worker cannot read {error.filename}: write the model to a folder that all '
            'workers share'
        ) from None
    except _distributed().KilledWorker as error:
        raise DataError(
            f'workers are killed by this training ({error}): give them more memory'
        ) from None
    return sums


def _on_worker(work: Callable[[Shard], Sums], shard: Shard) -> Sums:
    with one_core():
        return work(shard)


def _pair(first: Sums, second: Sums) -> Sums:
    """Both merged; the originals stay, because they are needed again when a worker is lost."""
    merged = copy.deepcopy(first)
    merged.merge(second)
    return merged


@dataclass(frozen=True, slots=True)
class RemotePanoramas:
    """Panoramas in a file of plain bytes, images of `shape` from `offset` on.

    Small enough to be sent to workers, which read the images themselves.
    """

    stamps_ns: Stamps
    shape: tuple[int, int, int]
    path: Path
    offset: int

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def read(self, start: int, stop: int) -> Image:
        """Panoramas start .. stop - 1. Raises FileNotFoundError."""
        stop = min(stop, len(self))
        size = int(np.prod(self.shape))
        at = self.offset + start * size
        flat = np.fromfile(self.path, np.uint8, (stop - start) * size, offset=at)
        return flat.reshape(stop - start, *self.shape)

    def batches(self, size: int) -> Iterator[Image]:
        """Panoramas in order, at most `size` at a time."""
        for start in range(0, len(self), size):
            yield self.read(start, start + size)


def _portable(shard: Shard) -> Shard:
    """The shard with the name of its file in place of the images."""
    panoramas = shard.sequence.panoramas
    if not isinstance(panoramas, PanoramaArray) or not isinstance(panoramas.images, np.memmap):
        raise DataError('a cluster needs panoramas in a file, not in memory')
    images = panoramas.images
    path = Path(str(images.filename)).absolute()
    file = RemotePanoramas(panoramas.stamps_ns, panoramas.shape, path, images.offset)
    return replace(shard, sequence=replace(shard.sequence, panoramas=file))
