# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged bytes in every part of a bag: what comes out is data or our own error, never another."""

import contextlib
import logging
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from bag_formats import (
    Message,
    compress_files,
    drive,
    write_mcap,
    write_ros1,
    write_rosbags,
    write_version,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sfa_localization.bags.reader import KINDS, Bag
from sfa_localization.bags.run_loader import load_run
from sfa_localization.bags.settings import TopicNames
from sfa_localization.data.errors import LocalizationError
from sfa_localization.inspection import inspect

TOPICS = {
    'image': '/image_raw',
    'odometry': '/odom',
    'imu': '/imu',
    'ground_truth': '/ground_truth',
}
EDITS = st.lists(
    st.tuples(
        st.sampled_from(['flip', 'cut', 'insert', 'remove', 'blank', 'ones']),
        st.floats(0, 1),
        st.integers(1, 255),
    ),
    min_size=1,
    max_size=6,
)
Edits = list[tuple[str, float, int]]


def damaged(data: bytes, edits: Edits) -> bytes:
    """Apply edits, each at a share of the length."""
    for edit, share, number in edits:
        at = int(share * max(len(data) - 1, 0))
        changes = {
            'flip': lambda d, at, n: d[:at] + bytes([d[at] ^ n]) + d[at + 1 :] if d else d,
            'cut': lambda d, at, n: d[:at],
            'insert': lambda d, at, n: d[:at] + bytes([n]) * n + d[at:],
            'remove': lambda d, at, n: d[:at] + d[at + n :],
            'blank': lambda d, at, n: d[:at] + bytes(len(d[at : at + n])) + d[at + n :],
            'ones': lambda d, at, n: d[:at] + b'\xff' * len(d[at : at + n]) + d[at + n :],
        }
        data = changes[edit](data, at, number)
    return data


def read_all(path: Path, folder: Path) -> None:
    """Use every reading function; ours are the only errors that may come."""
    readers: list[Callable[[Bag], object]] = [
        lambda bag: [len(data) for _, _, data in bag.messages(bag.topics)],
        lambda bag: list(bag.images('/image_raw')),
        lambda bag: bag.odometry('/odom'),
        lambda bag: bag.yaw_rate(),
        lambda bag: bag.trajectory('/ground_truth'),
        lambda bag: [bag.find(kind) for kind in KINDS],
    ]
    for strict in (False, True):
        for reader in readers:
            try:
                with Bag(path, strict=strict) as bag:
                    reader(bag)
            except LocalizationError as error:
                assert '\n' not in str(error)
    for use in (lambda: inspect(path), lambda: run(path, folder)):
        with contextlib.suppress(LocalizationError):
            use()


def run(path: Path, folder: Path) -> None:
    """Load the drive with its truth."""
    topics = TopicNames(image='/image_raw', odometry='/odom', ground_truth='/ground_truth')
    load_run(path, cache=folder / 'cache', topics=topics, want_truth=True)


@pytest.fixture(scope='module')
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    """Return the drive that is damaged."""
    return drive(tmp_path_factory.mktemp('drive'))[:90]


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> None:
    """Keep warnings of thousands of damaged bags out of the report."""
    caplog.set_level(logging.ERROR, 'sfa_localization')


WRITERS: dict[str, Callable[[Path, list[Message]], object]] = {
    'sqlite3': lambda p, m: write_version(p, m, 5),
    'sqlite3 v9': lambda p, m: write_rosbags(p, m),
    'mcap': lambda p, m: write_mcap(p / 'a.mcap', m),
    'mcap zstd': lambda p, m: write_mcap(p / 'a.mcap', m, compression='zstd'),
    'mcap lz4': lambda p, m: write_mcap(p / 'a.mcap', m, compression='lz4'),
    'mcap bare': lambda p, m: write_mcap(p / 'a.mcap', m, compression=None, index=False),
    'ROS 1': lambda p, m: write_ros1(p / 'a.bag', m),
    'ROS 1 lz4': lambda p, m: write_ros1(p / 'a.bag', m, 'lz4'),
}


@pytest.fixture(scope='module')
def bags(tmp_path_factory: pytest.TempPathFactory, messages: list[Message]) -> Path:
    """Return a folder with one whole bag of every name."""
    folder = tmp_path_factory.mktemp('bags')
    for name, write in WRITERS.items():
        write(folder / name, messages)
    return folder


def lone(bag: Path, folder: str) -> Path:
    """Copy a bag without its metadata; return its file."""
    copy = Path(shutil.copytree(bag, Path(folder) / 'bag'))
    (copy / 'metadata.yaml').unlink(missing_ok=True)
    (file,) = copy.iterdir()
    return file


FUZZ = settings(
    deadline=None,
    derandomize='FUZZ_EXAMPLES' not in os.environ,
    max_examples=int(os.environ.get('FUZZ_EXAMPLES', '10')),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@pytest.mark.parametrize('name', WRITERS)
@FUZZ
@given(edits=EDITS)
def test_damaged_files(name: str, edits: Edits, bags: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = lone(bags / name, folder)
        file.write_bytes(damaged(file.read_bytes(), edits))
        read_all(file, Path(folder))


@pytest.mark.parametrize('name', ['sqlite3', 'mcap'])
@FUZZ
@given(edits=EDITS)
def test_damaged_compressed_files(name: str, edits: Edits, bags: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        compress_files(lone(bags / name, folder).parent)
        (file,) = (Path(folder) / 'bag').iterdir()
        file.write_bytes(damaged(file.read_bytes(), edits))
        read_all(file.parent, Path(folder))


@FUZZ
@given(edits=EDITS)
def test_damaged_metadata(edits: Edits, bags: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(shutil.copytree(bags / 'sqlite3 v9', Path(folder) / 'bag'))
        file = path / 'metadata.yaml'
        file.write_bytes(damaged(file.read_bytes(), edits))
        read_all(path, Path(folder))


@FUZZ
@given(text=st.text(alphabet=st.sampled_from('ab01:-[]{}"\'#&*!|>%@ \n\t\0é'), max_size=80))
def test_any_text_as_metadata(text: str, bags: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(shutil.copytree(bags / 'sqlite3 v9', Path(folder) / 'bag'))
        (path / 'metadata.yaml').write_text(text)
        read_all(path, Path(folder))


@pytest.mark.parametrize('topic', TOPICS.values())
@FUZZ
@given(edits=EDITS, every=st.integers(1, 4))
def test_damaged_messages(topic: str, edits: Edits, every: int, messages: list[Message]) -> None:
    spoilt = [
        m._replace(data=damaged(m.data, edits)) if m.topic == topic and not i % every else m
        for i, m in enumerate(messages)
    ]
    with tempfile.TemporaryDirectory() as folder:
        read_all(write_mcap(Path(folder) / 'bag.mcap', spoilt), Path(folder))


@FUZZ
@given(
    data=st.binary(max_size=200),
    start=st.sampled_from(
        [b'', b'SQLite format 3\0', b'\x89MCAP0\r\n', b'#ROSBAG V2.0\n', b'\x28\xb5\x2f\xfd']
    ),
)
def test_any_bytes_as_bag(data: bytes, start: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'bag.mcap'
        file.write_bytes(start + data)
        read_all(file, Path(folder))
