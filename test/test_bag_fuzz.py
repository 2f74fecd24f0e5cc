# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged bytes in every part of a bag: what comes out is data or our own error, never another."""

import contextlib
import logging
import os
import shutil
import tempfile
from pathlib import Path

import pytest
from bag_formats import FORMATS, drive
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sfa_localization.bags.reader import KINDS, Bag
from sfa_localization.bags.run_loader import load_run
from sfa_localization.bags.settings import TopicNames
from sfa_localization.data.errors import LocalizationError
from sfa_localization.inspection import inspect

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
TOPICS = TopicNames(image='/image_raw', odometry='/odom', ground_truth='/ground_truth')
FUZZ = settings(
    deadline=None,
    derandomize='FUZZ_EXAMPLES' not in os.environ,
    max_examples=int(os.environ.get('FUZZ_EXAMPLES', '10')),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def damaged(data: bytes, edits: Edits) -> bytes:
    """Apply edits, each at a share of the length."""
    for edit, share, number in edits:
        at = int(share * max(len(data) - 1, 0))
        before, part, after = data[:at], data[at : at + number], data[at + number :]
        data = (
            before
            + {
                'flip': bytes([data[at] ^ number]) + data[at + 1 :] if data else b'',
                'cut': b'',
                'insert': bytes([number]) * number + data[at:],
                'remove': after,
                'blank': bytes(len(part)) + after,
                'ones': b'\xff' * len(part) + after,
            }[edit]
        )
    return data


def read_all(path: Path, folder: Path) -> None:
    """Use every reading function; ours are the only errors that may come."""
    uses = [
        lambda bag: [len(data) for _, _, data in bag.messages(bag.topics)],
        lambda bag: list(bag.images('/image_raw')),
        lambda bag: bag.odometry('/odom'),
        lambda bag: bag.yaw_rate(),
        lambda bag: bag.trajectory('/ground_truth'),
        lambda bag: [bag.find(kind) for kind in KINDS],
    ]
    for use, strict in [(use, strict) for use in uses for strict in (False, True)]:
        try:
            with Bag(path, strict=strict) as bag:
                use(bag)
        except LocalizationError as error:
            assert '\n' not in str(error)
    with contextlib.suppress(LocalizationError):
        inspect(path)
    with contextlib.suppress(LocalizationError):
        load_run(path, cache=folder / 'cache', topics=TOPICS, want_truth=True)


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> None:
    """Keep warnings of thousands of damaged bags out of the report."""
    caplog.set_level(logging.ERROR, 'sfa_localization')


WHOLE = [
    *('version 5', 'version 9', 'lone mcap', 'lone mcap, zstd', 'lone mcap, lz4'),
    *('lone mcap, no index', 'lone mcap, neither', 'ROS 1', 'ROS 1 lz4'),
    *('sqlite3 zstd file', 'mcap zstd file', 'mcap zstd message'),
]


@pytest.fixture(scope='module')
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with one whole bag of every name."""
    folder = tmp_path_factory.mktemp('bags')
    messages = drive(folder)[:90]
    for name in WHOLE:
        FORMATS[name](folder / name, messages)
    return folder


@pytest.mark.parametrize('name', WHOLE)
@FUZZ
@given(edits=EDITS, with_metadata=st.booleans())
def test_damaged_files(name: str, edits: Edits, with_metadata: bool, bags: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(shutil.copytree(bags / name, Path(folder) / 'bag'))
        if not with_metadata:
            (bag / 'metadata.yaml').unlink(missing_ok=True)
        file = next(file for file in bag.iterdir() if file.suffix != '.yaml')
        file.write_bytes(damaged(file.read_bytes(), edits))
        read_all(bag, Path(folder))


@FUZZ
@given(edits=EDITS, text=st.text(alphabet=':-[]{}"\'#&*!|>%@ \n\tab01é\0', max_size=80))
def test_damaged_metadata(edits: Edits, text: str, bags: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(shutil.copytree(bags / 'version 9', Path(folder) / 'bag'))
        file = bag / 'metadata.yaml'
        for content in (damaged(file.read_bytes(), edits), text.encode()):
            file.write_bytes(content)
            read_all(bag, Path(folder))
