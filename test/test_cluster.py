# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Training over a Dask cluster gives the same network, also when a worker is lost."""

import os
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cylinder_worlds import ARCHITECTURE, drive
from test_hierarchy import correlations

from sfa_localization.data.errors import ConfigError, DataError
from sfa_localization.data.run import PanoramaArray
from sfa_localization.features import cluster
from sfa_localization.features import network_training as hierarchy
from sfa_localization.features.network_training import ImageSequence, train_network

distributed = pytest.importorskip('distributed', reason='the extra distributed is not installed')

PLAIN = {'light_std': 0.0, 'relative_cut': 1e-7}


@contextmanager
def cluster_of(workers: int):
    """A scheduler and workers, each a process of its own, on this host."""
    with distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        dashboard_address=':0',
        host='127.0.0.1',
        memory_limit=0,
    ) as made:
        yield made


@pytest.fixture(scope='module')
def local():
    with cluster_of(2) as made:
        yield made


@pytest.fixture
def on_disk(tmp_path, monkeypatch) -> ImageSequence:
    """A drive of 40 pictures in a file, in shards of 4."""
    monkeypatch.setattr(hierarchy, 'SHARD', 4)
    of = drive(40)
    images = of.panoramas.read(0, 40)
    path = tmp_path / 'panoramas.u8'
    path.write_bytes(b'12345678' + images.tobytes())
    mapped = np.memmap(path, np.uint8, 'r', 8, images.shape)
    return ImageSequence(PanoramaArray(of.panoramas.stamps_ns, mapped), of.joined)


def assert_same(one, other, images):
    """Sums in another order differ by their rounding, which whitening enlarges: by 2e-4 of the
    weights on some processors. What the features show does not.
    """
    for a, b in zip(one.nodes, other.nodes, strict=True):
        scale = np.abs(a.slow).max()
        assert np.abs(a.slow - b.slow).max() < 1e-3 * scale
    for a, b in zip(one.maps(images), other.maps(images), strict=True):
        assert (1 - correlations(a, b)).max() < 1e-6


def test_a_cluster_learns_the_same(local, on_disk):
    seen = []
    with cluster.dask_executor(local.scheduler_address) as executor:
        theirs, again = (
            train_network(ARCHITECTURE, [on_disk], **PLAIN, executor=executor, on_shard=how)
            for how in (seen.append, lambda _: None)
        )
    assert sum(seen) == 6 * 40
    assert all(a.slow.tobytes() == b.slow.tobytes() for a, b in zip(theirs.nodes, again.nodes,
                                                                    strict=True))  # fmt: skip
    assert_same(
        train_network(ARCHITECTURE, [on_disk], **PLAIN), theirs, on_disk.panoramas.read(0, 40)
    )


class Deadly:
    """Work that kills its worker, once, at a shard in the middle."""

    def __init__(self, work, flag: Path) -> None:
        self.work = work
        self.flag = flag

    def __call__(self, shard):
        if shard.start == 20:
            try:
                self.flag.touch(exist_ok=False)
            except FileExistsError:
                return self.work(shard)
            os._exit(1)
        return self.work(shard)


def test_a_lost_worker_is_survived(on_disk, tmp_path):
    """A worker dies in the midst of the second stage; the others compute its shards again."""
    stages = []
    flag = tmp_path / 'died'
    with cluster_of(2) as made, cluster.dask_executor(made.scheduler_address) as executor:

        def dying(work, shards, on_shard):
            stages.append(len(shards))
            return executor(Deadly(work, flag) if len(stages) == 2 else work, shards, on_shard)

        theirs = train_network(ARCHITECTURE, [on_disk], **PLAIN, executor=dying)
    assert flag.exists() and len(stages) == 6
    assert_same(
        train_network(ARCHITECTURE, [on_disk], **PLAIN), theirs, on_disk.panoramas.read(0, 40)
    )


def test_workers_that_cannot_read_the_pictures(local, on_disk):
    Path(on_disk.panoramas.images.filename).unlink()
    with cluster.dask_executor(local.scheduler_address) as executor:
        with pytest.raises(DataError, match=r'cannot read .*panoramas\.u8.*folder'):
            train_network(ARCHITECTURE, [on_disk], **PLAIN, executor=executor)
        with pytest.raises(DataError, match='in a file'):
            train_network(ARCHITECTURE, [drive(8)], **PLAIN, executor=executor)


def test_nobody_answers_or_nobody_works(monkeypatch):
    monkeypatch.setattr(cluster, '_CONNECT_TIMEOUT_S', 0.5)
    with (
        pytest.raises(ConfigError, match=r'no Dask scheduler answers at tcp://127\.0\.0\.1:9'),
        cluster.dask_executor('tcp://127.0.0.1:9'),
    ):
        pytest.fail('connected')
    with (
        cluster_of(0) as made,
        pytest.raises(ConfigError, match='no worker'),
        cluster.dask_executor(made.scheduler_address),
    ):
        pytest.fail('went on')


def test_threads_give_the_same_bytes(on_disk, monkeypatch):
    networks = []
    for cores in (1, 3):
        monkeypatch.setattr(hierarchy, '_cores', lambda cores=cores: cores)
        networks.append(train_network(ARCHITECTURE, [replace(on_disk)], **PLAIN))
    for one, other in zip(networks[0].nodes, networks[1].nodes, strict=True):
        assert one.slow.tobytes() == other.slow.tobytes()
