# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A bag from a stranger: bounded depth, size, number and time, and a message that says which."""

import os
import resource
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard
from bag_formats import (
    COUNTS,
    Message,
    drive,
    write_database,
    write_mcap,
    write_ros1,
    write_version,
)
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import StreamReader

from sfa_localization.bags import blocks
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.recording import METADATA, MOST_FILES
from sfa_localization.bags.storage import MOST_PROBLEMS
from sfa_localization.data.errors import BagError
from sfa_localization.inspection import inspect

NESTED = '[' * 30_000


@pytest.fixture(scope='module')
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    """Return the drive that the bags hold."""
    return drive(tmp_path_factory.mktemp('drive'))


@pytest.fixture(autouse=True)
def little_memory():
    """Let what a bomb would fill be refused: two gigabytes more than what is in use."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (2 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def read(path: Path) -> tuple[dict[str, int], str]:
    """Messages per topic that a bag yields, and its problems."""
    with Bag(path) as bag:
        found = dict.fromkeys(bag.topics, 0)
        for channel, _, _ in bag.messages(bag.topics):
            found[channel.topic] += 1
        return found, '; '.join(bag.problems)


def rejected(path: Path, reason: str) -> None:
    with pytest.raises(BagError, match=reason) as raised:
        read(path)
    assert '\n' not in str(raised.value) and len(str(raised.value)) < 1000


def changed_metadata(path: Path, old: str, new: str) -> None:
    file = path / METADATA
    file.write_text(file.read_text().replace(old, new))


@pytest.mark.parametrize('qos', [NESTED, '- ' * 30_000, '{a: ' * 30_000, 'x' * 1_500_000])
def test_profiles_that_cannot_be_are_none(qos, messages, tmp_path, monkeypatch):
    bag = write_version(tmp_path / 'metadata', messages, 5)
    new = f'      offered_qos_profiles: "{qos}"\n      other:'
    changed_metadata(bag, '      offered_qos_profiles:', new)
    assert read(bag) == (COUNTS, '')
    monkeypatch.setattr('bag_formats.QOS_TEXT', qos)
    assert read(write_mcap(tmp_path / 'bag.mcap', messages)) == (COUNTS, '')
    rejected(write_database(tmp_path / 'bag.db3', messages, qos=qos), 'no readable bag database')


@pytest.mark.parametrize('name', ['bag.mcap', 'bag', 'bag/metadata.yaml', 'bag/b.mcap'])
def test_a_pipe_is_no_bag(name, messages, tmp_path):
    if '/' in name:
        write_mcap(tmp_path / 'bag' / 'a.mcap', messages)
    os.mkfifo(tmp_path / name)
    if name == 'bag/b.mcap':
        counts, problems = read(tmp_path / 'bag')
        assert counts == COUNTS and 'b.mcap: is no regular file' in problems
    elif name == 'bag/metadata.yaml':
        rejected(tmp_path / 'bag', 'no regular file')
    else:
        rejected(tmp_path / name, 'neither a file nor a folder')


@pytest.mark.parametrize('path', ['x' * 300, 'a\0b', '/dev/zero', '/dev/null'])
def test_paths_that_are_no_bag(path):
    rejected(Path(path), 'no such bag|neither a file nor a folder')


# sqlite


ENDLESS = (
    'WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) '
    'SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(1000000) AS data FROM n'
)
MANY = 'WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT 10001) '
NEW = 'DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data'
SCRIPTS = {
    'view of messages': (f'DROP TABLE messages; CREATE VIEW messages AS {ENDLESS}', 'messages'),
    'view of topics': (
        'ALTER TABLE topics RENAME TO hidden; CREATE VIEW topics AS SELECT * FROM hidden',
        'topics',
    ),
    'generated blobs': (f'{NEW} AS (zeroblob(1000000000)))', 'messages'),
    'default blobs': (f"{NEW} DEFAULT x'00')", 'messages'),
    'virtual table': (
        'DROP TABLE messages; CREATE VIRTUAL TABLE messages USING fts5(id, timestamp, data)',
        'messages',
    ),
    'no messages': ('DROP TABLE messages', 'messages'),
    'many topics': (
        f"INSERT INTO topics {MANY} SELECT i + 100, '/t' || i, 'a/b', 'cdr', '' FROM n",
        'more than 10000 topics',
    ),
}


@pytest.mark.parametrize('name', SCRIPTS)
def test_tables_that_hold_more_than_the_file(name, messages, tmp_path):
    script, reason = SCRIPTS[name]
    path = write_database(tmp_path / 'bag.db3', messages)
    with closing(sqlite3.connect(path)) as database:
        database.executescript(script)
    rejected(path, reason)


def test_pages_that_several_others_lead_to_are_read_once(messages, tmp_path):
    path = write_database(tmp_path / 'bag.db3', messages)
    with closing(sqlite3.connect(path)) as database:
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
        (root,) = database.execute(query).fetchone()
    data = bytearray(path.read_bytes())
    start = (root - 1) * 4096
    kind, cells = data[start], int.from_bytes(data[start + 3 : start + 5], 'big')
    assert kind == 5 and cells > 1, 'an inner page, of several leaves'
    places = struct.unpack_from(f'>{cells}H', data, start + 12)
    for place in places:
        data[start + place : start + place + 4] = data[start + places[0] : start + places[0] + 4]
    path.write_bytes(data)
    counts, problems = read(path)
    assert 0 < sum(counts.values()) < len(messages) and 'damaged database' in problems


# mcap and compression


def bomb(size: int) -> bytes:
    return zstandard.compress(bytes(size))


def chunk(packed: bytes, size: int) -> bytes:
    builder = RecordBuilder()
    Chunk('zstd', packed, 0, 0, 0, size).write(builder)
    return builder.end()


def after_chunks(path: Path, messages: list[Message], chunks: list[bytes]) -> Path:
    """An .mcap without index whose first chunks are given; a whole drive follows."""
    data = write_mcap(path, messages, index=False).read_bytes()
    first = data.index(b'\x06', 8)
    path.write_bytes(data[:first] + b''.join(chunks) + data[first:])
    return path


@pytest.mark.parametrize('told', [1 << 32, 1 << 27, 100])
def test_a_chunk_bomb_costs_that_chunk(told, messages, tmp_path):
    """128 MB in 4 kB: whatever size the chunk declares, no more than the limit is made."""
    path = after_chunks(tmp_path / 'a.mcap', messages, [chunk(bomb(1 << 27), told)])
    counts, problems = read(path)
    assert counts == COUNTS
    assert 'more than 268435456' in problems or 'larger than' in problems


def test_many_small_bombs_are_bounded_together(messages, tmp_path, monkeypatch):
    monkeypatch.setattr(blocks, 'room_for', lambda size: 1 << 22)
    bombs = [chunk(bomb(1 << 20), 1 << 20)] * 100
    counts, problems = read(after_chunks(tmp_path / 'a.mcap', messages, bombs))
    assert counts == COUNTS and 'larger than' in problems


HOSTILE = {
    'a bomb': bomb(1 << 27),
    'a size that no memory has': b'\x28\xb5\x2f\xfd\xe0' + struct.pack('<Q', 1 << 40) + bytes(9),
    'cut off': zstandard.compress(bytes(range(256)) * 40)[:-4],
}


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('name', HOSTILE)
def test_a_compressed_message_that_cannot_be_costs_itself(name, storage, messages, tmp_path):
    first = next(i for i, m in enumerate(messages) if m.topic == '/odom')
    spoilt = list(messages)
    spoilt[first] = messages[first]._replace(data=HOSTILE[name])
    write = write_mcap if storage == 'mcap' else write_database
    counts, problems = read(write(tmp_path / f'a.{storage[:4]}', spoilt))
    assert counts == {**COUNTS, '/odom': COUNTS['/odom'] - 1}
    assert '/odom: a compressed message is damaged' in problems


def test_a_file_bomb_is_read_up_to_the_limit(messages, tmp_path):
    whole = write_mcap(tmp_path / 'a.mcap', messages).read_bytes()
    file = tmp_path / 'bag' / 'a.mcap.zstd'
    file.parent.mkdir()
    file.write_bytes(zstandard.compress(whole + bytes(1 << 28)))
    counts, problems = read(file.parent)
    assert counts == COUNTS
    assert 'more than 1000 times as large' in problems


def test_entries_of_the_index_that_repeat_a_chunk(messages, tmp_path):
    path = write_mcap(tmp_path / 'a.mcap', messages, compression='zstd', chunk_size=1 << 20)
    with path.open('rb') as file:
        (entry,) = [r for r in StreamReader(file).records if isinstance(r, ChunkIndex)]
    builder = RecordBuilder()
    entry.write(builder)
    record = builder.end()
    assert record in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(record, record * 1000))
    counts, problems = read(path)
    assert counts == COUNTS and 'its index is incomplete' in problems


def test_chunks_of_the_same_time_wait_in_bounded_memory(messages, tmp_path, monkeypatch):
    monkeypatch.setattr(blocks, 'MOST_PENDING', 1000)
    rejected(write_mcap(tmp_path / 'a.mcap', messages, chunk_size=1 << 20), 'chunks of the same')


@pytest.mark.parametrize('write', [write_mcap, write_ros1])
def test_more_topics_than_robots_have(write, messages, tmp_path):
    many = [messages[0]._replace(topic=f'/{number}') for number in range(10_001)]
    path = write(tmp_path / 'many.mcap', many)
    rejected(path, 'more than 10000 topics')
    os.truncate(path, path.stat().st_size - 1)
    rejected(path, 'more than 10000 topics')


def test_times_that_ros_does_not_have(messages, tmp_path):
    spoilt = [m._replace(receive_ns=(1 << 64) - 1) if m.topic == '/imu' else m for m in messages]
    path = write_mcap(tmp_path / 'a.mcap', spoilt)
    assert read(path)[0] == {**COUNTS, '/imu': 0}
    assert inspect(path).drive is not None


def test_problems_of_any_number_are_described_in_part(messages, tmp_path):
    path = after_chunks(tmp_path / 'a.mcap', messages, [chunk(b'', 7)] * 5000)
    with Bag(path) as bag:
        assert len(list(bag.messages(bag.topics))) == len(messages)
        assert len(bag.problems) <= MOST_PROBLEMS + 2
        assert bag.problems[-1] == 'there are more problems'


# Files, and ROS 1


def test_files_listed_again_and_again_are_read_once(messages, tmp_path):
    bag = write_version(tmp_path / 'bag', messages, 3)
    changed_metadata(bag, '  - bag/bag_0.db3\n', '  - bag/bag_0.db3\n' * 2000)
    assert read(bag)[0] == COUNTS


def test_files_of_any_number(messages, tmp_path):
    bag = write_version(tmp_path / 'bag', messages, 3)
    names = ''.join(f'  - {number}.db3\n' for number in range(MOST_FILES + 1))
    changed_metadata(bag, '  - bag/bag_0.db3\n', names)
    rejected(bag, 'more than 10000')


def test_a_file_outside_the_bag_is_not_read(messages, tmp_path):
    bag = write_version(tmp_path / 'bag', messages, 3)
    (bag / 'bag_0.db3').rename(tmp_path / 'other.db3')
    changed_metadata(bag, 'bag/bag_0.db3', '../other.db3')
    rejected(bag, 'other.db3: is missing')


@pytest.mark.parametrize('compression', ['bz2', 'lz4'])
def test_a_chunk_bomb_in_ros_1(compression, messages, tmp_path, monkeypatch):
    path = write_ros1(tmp_path / 'a.bag', messages, compression)
    assert read(path) == (COUNTS, '')
    monkeypatch.setattr(blocks, 'room_for', lambda size: 5000)
    counts, problems = read(path)
    assert sum(counts.values()) == 0 and 'larger than 5000' in problems


def test_an_index_of_ros_1_that_lists_a_chunk_again_and_again(messages, tmp_path):
    path = write_ros1(tmp_path / 'a.bag', messages)
    data = bytearray(path.read_bytes())
    struct.pack_into('<I', data, data.index(b'chunk_count=') + 12, 1000)
    end = data.rindex(b'op=\x06')
    places = range(end - 200, end)
    start = next(at for at in places if end - at < struct.unpack_from('<I', data, at)[0] < 120)
    path.write_bytes(data + data[start:] * 999)
    counts, problems = read(path)
    assert counts == COUNTS and 'lists bytes twice' in problems


def test_images_serialized_otherwise_are_inspected_by_their_times(messages, tmp_path):
    report = inspect(write_database(tmp_path / 'bag.db3', messages, serialization='protobuf'))
    (images,) = [topic for topic in report.topics if topic.name == '/image_raw']
    assert images.count == len(images.stamps_ns) == COUNTS['/image_raw']
    assert report.images is None and report.lacks


def test_random_bytes_of_every_format_end(tmp_path):
    random = np.random.default_rng(0)
    for start in (b'SQLite format 3\0', b'\x89MCAP0\r\n', b'#ROSBAG V2.0\n', b'\x28\xb5\x2f\xfd'):
        for _ in range(20):
            path = tmp_path / 'bag'
            path.write_bytes(start + random.bytes(int(random.integers(0, 3000))))
            rejected(path, str(path))
