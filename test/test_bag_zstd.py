# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Compressed bags are read with whichever package for zstd there is."""

import re
import sys
import types
from pathlib import Path

import pytest
from bag_formats import COUNTS, FORMATS, Message, drive
from test_package import setup_arguments

from sfa_localization import cli
from sfa_localization.bags import mcap as bag_mcap
from sfa_localization.bags import storage as bag_storage
from sfa_localization.bags import zstd as bag_zstd
from sfa_localization.bags.reader import Bag

STANDARD = ('compression.zstd', 'backports.zstd')


class OfZstandard:
    """The interface of the package `zstandard`, around the one that is there."""

    class ZstdError(Exception):
        """What that package raises."""

    class Object:
        def __init__(self) -> None:
            self._inner = bag_zstd.decompressor()

        def decompress(self, data: bytes) -> bytes:
            if self.eof:
                raise OfZstandard.ZstdError('cannot use a decompressobj multiple times')
            try:
                return self._inner.decompress(data)
            except bag_zstd.ZstdError as error:
                raise OfZstandard.ZstdError(str(error)) from None

        @property
        def eof(self) -> bool:
            return self._inner.eof

        @property
        def unused_data(self) -> bytes:
            return self._inner.unused_data

    class ZstdDecompressor:
        def decompressobj(self) -> 'OfZstandard.Object':
            return OfZstandard.Object()


@pytest.fixture(scope='module')
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    """Return the drive that all bags hold."""
    return drive(tmp_path_factory.mktemp('drive'))


@pytest.fixture
def only_zstandard(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let neither Python's own package nor its backport be found."""
    module = types.ModuleType('zstandard')
    module.ZstdError = OfZstandard.ZstdError
    module.ZstdDecompressor = OfZstandard.ZstdDecompressor
    for name in STANDARD:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, 'zstandard', module)
    decompressor, error = bag_zstd._load_package()
    assert error is OfZstandard.ZstdError
    for user in (bag_mcap, bag_storage):
        monkeypatch.setattr(user, 'decompressor', decompressor)
        monkeypatch.setattr(user, 'ZstdError', error)


@pytest.mark.parametrize('name', [name for name in FORMATS if 'zstd' in name])
def test_zstandard_alone_reads_every_compressed_bag(name, tmp_path, messages, only_zstandard):
    with Bag(FORMATS[name](tmp_path / 'bag', messages), strict=True) as bag:
        assert {topic.name: topic.count for topic in bag.topics.values()} == COUNTS
        assert len(bag.odometry().stamps_ns) == COUNTS['/odom']


def test_zstandard_alone_finds_the_same_damage(tmp_path, messages, only_zstandard):
    path = FORMATS['mcap zstd file'](tmp_path / 'bag', messages)
    packed = next(path.glob('*.zstd'))
    data = packed.read_bytes()
    for damaged, why in (
        (data[: len(data) // 2], 'cut-off zstd data'),
        (data[:6] + b'\xff' * 60 + data[66:], 'damaged zstd data'),
        (data + data, ''),
    ):
        packed.write_bytes(damaged)
        assert bag_storage.inflate_file(packed, tmp_path / 'plain').startswith(why)
        assert why or (tmp_path / 'plain').read_bytes() != b''


@pytest.mark.parametrize('cut', [20, -4])
def test_a_cut_off_message_is_no_message(cut):
    import bag_formats

    data = bag_formats.zstd.compress(bytes(range(256)) * 40)
    assert bag_storage.inflate_message(data, 1 << 20) == bytes(range(256)) * 40
    with pytest.raises(bag_storage.BagError, match='cut off'):
        bag_storage.inflate_message(data[:cut], 1 << 20)


def test_without_any_the_remedy_is_named(monkeypatch, capsys):
    for name in (*STANDARD, 'zstandard'):
        monkeypatch.setitem(sys.modules, name, None)
    assert cli.guarded(bag_zstd._load_package) == 1
    assert 'pip install backports.zstd' in capsys.readouterr().err


def test_what_reads_bags_is_declared():
    required = {re.match(r'[\w.]+', line)[0] for line in setup_arguments()['install_requires']}
    assert {'rosbags', 'backports.zstd', 'lz4'} <= required
    table = (Path(__file__).parents[1] / 'CONTRIBUTING.md').read_text('utf-8')
    assert 'backports.zstd' in table and 'lz4' in table
