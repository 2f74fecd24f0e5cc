# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A bag from a stranger: bounded depth, size, number and time, and a message that says which."""

import os
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from bag_formats import (
    COUNTS,
    Message,
    _bodies,
    _definitions,
    _record,
    _text,
    drive,
    write_database,
    write_mcap,
    write_ros1,
    write_version,
    zstd,
)

from sfa_localization.bags import mcap as bag_mcap
from sfa_localization.bags import ros1 as bag_ros1
from sfa_localization.bags import sqlite as bag_sqlite
from sfa_localization.bags import storage as bag_storage
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.recording import METADATA, MOST_FILES
from sfa_localization.data.errors import BagError
from sfa_localization.inspection import inspect

NESTED = '[' * 30_000


@pytest.fixture(scope='module')
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    """Return the drive that the bags hold."""
    return drive(tmp_path_factory.mktemp('drive'))


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


def changed_metadata(path: Path, change: Callable[[str], str]) -> None:
    file = path / METADATA
    file.write_text(change(file.read_text()))


@pytest.mark.parametrize('text', [NESTED, f'rosbag2_bagfile_information: {NESTED}'])
def test_nested_metadata_is_replaced_by_the_files(text, messages, tmp_path):
    bag = write_version(tmp_path / 'bag', messages, 5)
    (bag / METADATA).write_text(text)
    counts, problems = read(bag)
    assert counts == COUNTS
    assert 'nested deeper than 32' in problems or 'maximum nesting depth' in problems


@pytest.mark.parametrize('qos', [NESTED, '- ' * 30_000, '{a: ' * 30_000])
def test_nested_profiles_are_none(qos, messages, tmp_path):
    bag = write_version(tmp_path / 'metadata', messages, 5)
    lines = f'      offered_qos_profiles: "{qos}"\n      other:'
    changed_metadata(bag, lambda text: text.replace('      offered_qos_profiles:', lines))
    assert read(bag) == (COUNTS, '')
    database = write_database(tmp_path / 'bag.db3', messages, qos=qos)
    assert read(database)[0] == COUNTS


def test_profiles_of_any_number_are_left_out(messages, tmp_path, monkeypatch):
    monkeypatch.setattr(bag_mcap, 'MOST_QOS', 10)
    parsed: list[object] = []
    monkeypatch.setattr(
        bag_mcap, 'make_channel', lambda *f: parsed.append(f[-1]) or bag_storage.make_channel(*f)
    )
    assert read(write_mcap(tmp_path / 'a.mcap', messages)) == (COUNTS, '')
    assert parsed and set(parsed) == {''}


@pytest.mark.parametrize('name', ['bag.mcap', 'bag', 'bag/metadata.yaml'])
def test_a_pipe_is_no_bag(name, messages, tmp_path):
    if name == 'bag/metadata.yaml':
        bag = write_version(tmp_path / 'bag', messages, 5)
        (bag / METADATA).unlink()
        os.mkfifo(bag / METADATA)
        rejected(bag, 'no regular file')
        return
    os.mkfifo(tmp_path / name)
    rejected(tmp_path / name, 'neither a file nor a folder')


def test_a_pipe_among_the_files_is_left_out(messages, tmp_path):
    write_mcap(tmp_path / 'bag' / 'a.mcap', messages)
    os.mkfifo(tmp_path / 'bag' / 'b.mcap')
    counts, problems = read(tmp_path / 'bag')
    assert counts == COUNTS
    assert 'b.mcap: is no regular file' in problems


@pytest.mark.parametrize('path', ['x' * 300, 'a\0b', '/dev/zero', '/dev/null'])
def test_paths_that_are_no_bag(path):
    rejected(Path(path), 'no such bag|neither a file nor a folder')


# sqlite


def altered(path: Path, script: str) -> Path:
    with closing(sqlite3.connect(path)) as database:
        database.executescript(script)
    return path


ENDLESS = (
    'WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) '
    'SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(1000000) AS data FROM n'
)
SCRIPTS = {
    'view of messages': (
        f'DROP TABLE messages; CREATE VIEW messages AS {ENDLESS}',
        'messages is a view',
    ),
    'view of topics': (
        'ALTER TABLE topics RENAME TO hidden; CREATE VIEW topics AS SELECT * FROM hidden',
        'topics is a view',
    ),
    'generated blobs': (
        'DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, '
        'data AS (zeroblob(1000000000)))',
        'messages has columns that are not stored',
    ),
    'default blobs': (
        'DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, '
        "timestamp, data DEFAULT x'00')",
        'messages has columns that are not stored',
    ),
    'virtual table': (
        'DROP TABLE messages; CREATE VIRTUAL TABLE messages USING fts5(id, timestamp, data)',
        'messages is a table without rows of its own',
    ),
    'no messages': ('DROP TABLE messages', 'no tables of topics and messages'),
}


@pytest.mark.parametrize('name', SCRIPTS)
def test_tables_that_hold_more_than_the_file(name, messages, tmp_path):
    script, reason = SCRIPTS[name]
    rejected(altered(write_database(tmp_path / 'bag.db3', messages), script), reason)


def test_more_topics_than_robots_have(messages, tmp_path):
    many = 'WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT 10001) '
    script = f"INSERT INTO topics {many} SELECT i + 100, '/t' || i, 'a/b', 'cdr', '' FROM n"
    rejected(
        altered(write_database(tmp_path / 'bag.db3', messages), script), 'more than 10000 topics'
    )


def test_a_query_ends_when_it_takes_too_long(messages, tmp_path, monkeypatch):
    """Pages that lead in circles are intact, one by one: only the number of steps ends a query."""
    monkeypatch.setattr(bag_sqlite, '_STEPS', 0)
    monkeypatch.setattr(bag_sqlite, '_STEPS_PER_BYTE', 0)
    monkeypatch.setattr(bag_sqlite, '_STEPS_AT_ONCE', 100)
    path = write_database(tmp_path / 'bag.db3', messages)
    assert 'damaged database (interrupted)' in read(path)[1]


def test_pages_that_several_others_lead_to(messages, tmp_path):
    """Their rows are read once, by number: sorting all paths to them would fill any disk."""
    storage = bag_sqlite.SqliteStorage(write_database(tmp_path / 'bag.db3', messages))
    storage._size //= 2
    with pytest.raises(sqlite3.DatabaseError, match='more than the file holds'):
        storage._read_counts()
    storage._size *= 2
    found = list(storage.messages(COUNTS, 0))
    storage.close()
    assert storage._repeats
    assert len(found) == len(messages)


def test_rows_of_more_bytes_than_the_file(messages, tmp_path):
    storage = bag_sqlite.SqliteStorage(write_database(tmp_path / 'bag.db3', messages))
    whole = len(list(storage.messages(COUNTS, 0)))
    storage._size = 3000
    found = list(storage.messages(COUNTS, 0))
    storage.close()
    assert sum(len(data) for _, _, data in found) <= 6000
    assert len(found) < whole and 'more than the file holds' in storage.problems[0]


# mcap and compression


def bomb(size: int) -> bytes:
    return zstd.compress(bytes(size))


def chunk(packed: bytes, size: int, compression: str = 'zstd', start: int = 0) -> bytes:
    head = struct.pack('<QQQI', start, start, size, 0) + _text(compression)
    return _record(6, head + struct.pack('<Q', len(packed)) + packed)


def with_chunks(path: Path, messages: list[Message], chunks: list[bytes]) -> Path:
    """An .mcap without index whose last chunk is a whole drive."""
    plain = _definitions(messages, 'cdr') + _bodies(messages, messages)
    start = b'\x89MCAP0\r\n' + _record(1, _text('ros2') + _text('test'))
    path.write_bytes(start + b''.join(chunks) + chunk(plain, len(plain), ''))
    return path


@pytest.mark.parametrize('told', [1 << 32, 1 << 27, 100])
def test_a_chunk_bomb_costs_that_chunk(told, messages, tmp_path):
    """128 MB in 4 kB: whatever size the chunk declares, no more than the limit is made."""
    path = with_chunks(tmp_path / 'a.mcap', messages, [chunk(bomb(1 << 27), told)])
    counts, problems = read(path)
    assert counts == COUNTS
    assert 'more than 268435456' in problems or 'larger than' in problems


def test_many_small_bombs_are_bounded_together(messages, tmp_path, monkeypatch):
    made = [0]
    inflate = bag_mcap._inflated

    def counted(*arguments: object) -> bytes:
        plain = inflate(*arguments)  # type: ignore[arg-type]
        made[0] += len(plain)
        return plain

    monkeypatch.setattr(bag_mcap, '_inflated', counted)
    monkeypatch.setattr(bag_mcap, 'room_for', lambda size: 1 << 22)
    bombs = [chunk(bomb(1 << 20), 1 << 20)] * 100
    assert 'larger than' in read(with_chunks(tmp_path / 'a.mcap', messages, bombs))[1]
    assert 0 < made[0] <= 2 << 22, 'for the index, and for the messages'


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_message_bomb_costs_that_message(storage, messages, tmp_path):
    first = next(i for i, m in enumerate(messages) if m.topic == '/odom')
    spoilt = list(messages)
    spoilt[first] = messages[first]._replace(data=bomb(1 << 27))
    write = write_mcap if storage == 'mcap' else write_database
    counts, problems = read(write(tmp_path / f'a.{storage[:4]}', spoilt))
    assert counts == {**COUNTS, '/odom': COUNTS['/odom'] - 1}
    assert '/odom: a compressed message is a bomb' in problems


def test_a_file_bomb_is_read_up_to_the_limit(messages, tmp_path):
    whole = write_mcap(tmp_path / 'a.mcap', messages).read_bytes()
    file = tmp_path / 'bag' / 'a.mcap.zstd'
    file.parent.mkdir()
    file.write_bytes(zstd.compress(whole + bytes(1 << 28)))
    counts, problems = read(file.parent)
    assert counts == COUNTS
    assert 'more than 1000 times as large' in problems


def test_entries_of_the_index_that_repeat_a_chunk(messages, tmp_path):
    path = write_mcap(tmp_path / 'a.mcap', messages, compression='zstd', per_chunk=1000)
    data = path.read_bytes()
    start = data.rindex(_record(8, b'')[:1] + struct.pack('<Q', 68), 0)
    entry = data[start : start + 9 + 68]
    path.write_bytes(data[:start] + entry * 1000 + data[start + len(entry) :])
    counts, problems = read(path)
    assert counts == COUNTS
    assert 'lists bytes twice' in problems


def test_chunks_of_the_same_time_wait_in_bounded_memory(messages, tmp_path, monkeypatch):
    monkeypatch.setattr(bag_mcap, 'MOST_PENDING', 10_000)
    path = tmp_path / 'a.mcap'
    plain = _definitions(messages, 'cdr') + _bodies(messages, messages)
    same = [chunk(plain, len(plain), '')] * 2
    path.write_bytes(b'\x89MCAP0\r\n' + b''.join(same))
    rejected(path, 'chunks of the same time')


def test_channels_of_any_number_and_length(messages, tmp_path):
    def channel(key: int, topic: str) -> bytes:
        body = struct.pack('<HH', key, 0) + _text(topic) + _text('cdr') + _text('')
        return _record(4, body)

    long = with_chunks(tmp_path / 'long.mcap', messages, [channel(99, '/' + 'x' * 10**6)])
    assert max(map(len, read(long)[0])) == bag_storage.LONGEST_NAME
    many = b''.join(channel(100 + key, f'/{key}') for key in range(bag_storage.MOST_TOPICS))
    rejected(with_chunks(tmp_path / 'many.mcap', messages, [many]), 'more than 10000 topics')


def test_problems_of_any_number_are_described_in_part(messages, tmp_path):
    damaged = [chunk(b'', 7, 'zstd')] * 5000
    with Bag(with_chunks(tmp_path / 'a.mcap', messages, damaged)) as bag:
        assert len(list(bag.messages(bag.topics))) == len(messages)
        assert len(bag.problems) == bag_storage.MOST_PROBLEMS + 1
        assert bag.problems[-1] == 'there are more problems'


# Files, and ROS 1


def test_files_listed_again_and_again_are_read_once(messages, tmp_path):
    bag = write_version(tmp_path / 'bag', messages, 3)
    changed_metadata(
        bag, lambda text: text.replace('  - bag/bag_0.db3\n', '  - bag/bag_0.db3\n' * 2000)
    )
    counts, problems = read(bag)
    assert counts == COUNTS
    assert 'lists files twice' in problems


def test_files_of_any_number(messages, tmp_path):
    bag = write_version(tmp_path / 'bag', messages, 3)
    names = ''.join(f'  - {number}.db3\n' for number in range(MOST_FILES + 1))
    changed_metadata(bag, lambda text: text.replace('  - bag/bag_0.db3\n', names))
    rejected(bag, 'more than 10000')


def test_a_file_outside_the_bag_is_not_read(messages, tmp_path):
    bag = write_version(tmp_path / 'bag', messages, 3)
    (bag / 'bag_0.db3').rename(tmp_path / 'other.db3')
    changed_metadata(bag, lambda text: text.replace('bag/bag_0.db3', '../other.db3'))
    rejected(bag, 'other.db3: is missing')


@pytest.mark.parametrize('compression', ['bz2', 'lz4'])
def test_a_chunk_bomb_in_ros_1(compression, messages, tmp_path, monkeypatch):
    path = write_ros1(tmp_path / 'a.bag', messages, compression)
    assert read(path) == (COUNTS, '')
    monkeypatch.setattr(bag_ros1, 'room_for', lambda size: 5000)
    counts, problems = read(path)
    assert sum(counts.values()) < sum(COUNTS.values())
    assert 'when decompressed' in problems


def test_an_index_of_ros_1_that_lists_messages_twice(messages, tmp_path):
    path = write_ros1(tmp_path / 'a.bag', messages)
    reader = bag_ros1.BoundedReader(path)
    reader.open()
    assert not reader.keep_first()
    key = next(iter(reader.indexes))
    size = len(reader.indexes[key])
    reader.indexes[key] *= 3
    connections = [c._replace(msgcount=len(reader.indexes[c.id])) for c in reader.connections]
    reader.connections = connections
    assert reader.keep_first()
    assert len(reader.indexes[key]) == size
    reader.close()


def test_an_index_of_ros_1_that_lists_a_chunk_twice(messages, tmp_path):
    path = write_ros1(tmp_path / 'a.bag', messages)
    data = bytearray(path.read_bytes())
    (count,) = struct.unpack_from('<I', data, data.index(b'chunk_count=') + 12)
    info = data.index(b'op=\x06') if data.rindex(b'op=\x06') == data.index(b'op=\x06') else None
    assert count == 1 and info is not None
    struct.pack_into('<I', data, data.index(b'chunk_count=') + 12, 2)
    start = max(data.rindex(struct.pack('<I', n), 0, info) for n in range(60, 120)
                if struct.pack('<I', n) in data[info - 120 : info])  # fmt: skip
    path.write_bytes(data + data[start:])
    with Bag(path) as bag:
        assert 'lists a chunk twice' in bag.problems[0]
        assert len(list(bag.messages(bag.topics))) == len(messages)


def test_images_serialized_otherwise_are_inspected_by_their_times(messages, tmp_path):
    path = write_database(tmp_path / 'bag.db3', messages, serialization='protobuf')
    report = inspect(path)
    (images,) = [topic for topic in report.topics if topic.name == '/image_raw']
    assert images.count == len(images.stamps_ns) == COUNTS['/image_raw']
    assert report.images is None and report.lacks


def test_random_bytes_of_every_format_end(tmp_path):
    random = np.random.default_rng(0)
    for start in (bag_sqlite.MAGIC, bag_mcap.MAGIC, b'#ROSBAG V2.0\n', bag_storage.ZSTD_MAGIC):
        for _ in range(20):
            path = tmp_path / 'bag'
            path.write_bytes(start + random.bytes(int(random.integers(0, 3000))))
            rejected(path, str(path))
