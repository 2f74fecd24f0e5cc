# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The files of bags: mcap is read by the package mcap, sqlite3 and ROS 1 by rosbags.

A file that was cut off is read up to the cut, except for ROS 1. Files are never written to.
"""

from __future__ import annotations

import itertools
import os
import sqlite3
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.interfaces import ConnectionExtRosbag2, Qos
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2.metadata import parse_qos
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from sfa_localization.data.errors import BagError, MessageError
from sfa_localization.data.plain_yaml import load_yaml
from sfa_localization.data.rejections import short_line

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
_LARGEST = 1 << 28  # bytes of a chunk or a message: one image of the largest camera, and more
_QOS = 'offered_qos_profiles'
_LATEST = 1 << 63  # ns, the end of ROS time


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic: message type, wire format, offered QoS, and the number of its messages."""

    name: str
    kind: str
    serialization: str
    qos: tuple[Qos, ...]
    count: int


Record = tuple[Topic, int, bytes]
"""A message: its topic, its reception in nanoseconds, its serialized bytes."""


def make_topic(name: Any, kind: Any, serialization: Any, qos: Any, count: Any) -> Topic:
    """A topic from the fields of a file; older recorders omit the 'msg' of a type.

    `qos` are profiles, or the text or list of a recorder; unreadable ones are left out.
    """
    name, kind, serialization = (short_line(str(text)) for text in (name, kind, serialization))
    kind = kind.replace('/', '/msg/') if kind.count('/') == 1 else kind
    profiles: list[Qos] = []
    with suppress(Exception):  # a bag is not rejected because of its QoS
        listed = load_yaml(qos) if isinstance(qos, str) else qos
        profiles = [p if isinstance(p, Qos) else parse_qos([p])[0] for p in listed or ()]
    return Topic(name, kind, serialization, tuple(profiles), int(count))


def add_problem(problems: list[str], text: str) -> None:
    """Describe a problem once."""
    if text not in problems:
        problems.append(text)


def describe(error: Exception) -> str:
    """The text of an error, or its class."""
    text = getattr(error, 'strerror', None) or str(error)
    return short_line(text).rstrip('.') or type(error).__name__


class McapFile:
    """One .mcap file, chunk by chunk; `start_ns` and `end_ns` are the first and last reception.

    Raises BagError where it holds no message.
    """

    def __init__(self, path: Path, problems: list[str]) -> None:
        self._path = path
        self._problems = problems
        self._file = path.open('rb')
        self.start_ns = _LATEST
        self.end_ns = 0
        self.topics = dict[int, Topic]()
        is_whole = self._read_index()
        if not self.topics:
            self._scan()
        if not (is_whole or self.topics):
            self.close()
            raise BagError(f'{path}: holds no readable message; try `mcap recover`')
        if not is_whole:
            problems.append(f'{path.name}: was not closed, as where the power was cut: read as far '
                            'as it goes; `mcap recover` repairs it')  # fmt: skip

    def close(self) -> None:
        """Release the file."""
        self._file.close()

    def messages(self, names: Collection[str], start_ns: int) -> Iterator[Record]:
        """Messages in the order of the file: recorders write them as they receive them."""
        wanted = {key: topic for key, topic in self.topics.items() if topic.name in names}
        for records in self._parts(start_ns):
            for record in records:
                if type(record) is Message and (topic := wanted.get(record.channel_id)):
                    stamp_ns = record.log_time
                    if start_ns <= stamp_ns < _LATEST:
                        yield topic, stamp_ns, record.data

    def _read_index(self) -> bool:
        """Read the topics from the end of the file; return whether they are there."""
        try:
            summary = SeekingReader(self._file, record_size_limit=_LARGEST).get_summary()
        except Exception:  # a parser of foreign bytes fails in many ways
            return False
        if summary is not None and summary.statistics is not None:
            self.start_ns = summary.statistics.message_start_time
            self.end_ns = summary.statistics.message_end_time
            counts = summary.statistics.channel_message_counts
            self._define(summary.channels, summary.schemas, counts)
        return True

    def _scan(self) -> None:
        """Count the messages of a file without an index."""
        channels = dict[int, Channel]()
        schemas = dict[int, Schema]()
        counts: Counter[int] = Counter()
        for record in itertools.chain.from_iterable(self._parts(0)):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                counts[record.channel_id] += 1
                self.start_ns = min(self.start_ns, record.log_time)
                self.end_ns = max(self.end_ns, record.log_time)
        self._define(channels, schemas, counts)

    def _define(
        self, channels: dict[int, Channel], schemas: dict[int, Schema], counts: dict[int, int]
    ) -> None:
        for key, channel in channels.items():
            schema = schemas.get(channel.schema_id)
            qos = channel.metadata.get(_QOS, '')
            fields = channel.topic, schema.name if schema else '', channel.message_encoding, qos
            self.topics[key] = make_topic(*fields, counts.get(key, 0))

    def _parts(self, start_ns: int) -> Iterator[list[Any]]:
        """Records of each chunk that ends at or after `start_ns`, and of others, up to damage."""
        self._file.seek(0)
        reader = StreamReader(self._file, emit_chunks=True, record_size_limit=_LARGEST)
        with suppress(Exception):  # as above
            for record in reader.records:
                if not isinstance(record, Chunk):
                    yield [record]
                elif record.message_end_time >= start_ns:
                    try:
                        yield breakup_chunk(record, validate_crc=True)
                    except Exception as error:  # as above
                        text = f'a damaged chunk is skipped ({describe(error)})'
                        add_problem(self._problems, f'{self._path.name}: {text}')


class RosbagsFile:
    """One file of sqlite3 or ROS 1, read by rosbags; a damaged database is copied first."""

    def __init__(
        self, path: Path, problems: list[str], reader: Sqlite3Reader | Ros1Reader, start_ns: int
    ) -> None:
        self._path = path
        self._problems = problems
        self._reader = reader
        self.start_ns = start_ns
        self.topics = dict[int, Topic]()
        for key, name, kind, _, _, count, ext, _ in reader.connections:
            form = 'ros1'
            qos = list[Qos]()
            if isinstance(ext, ConnectionExtRosbag2):
                form = ext.serialization_format
                qos = ext.offered_qos_profiles
            self.topics[key] = make_topic(name, kind, form, qos, count)

    @classmethod
    def ros1(cls, path: Path, problems: list[str]) -> RosbagsFile:
        """Open a .bag file. Raises BagError."""
        reader = Ros1Reader(path)
        try:
            reader.open()
            return cls(path, problems, reader, reader.start_time)
        except Exception as error:  # as above
            raise BagError(f'{path}: no readable bag ({describe(error)}); '
                           'try `rosbag reindex`') from None  # fmt: skip

    @classmethod
    def sqlite(cls, path: Path, problems: list[str]) -> RosbagsFile:
        """Open a .db3 file; a damaged one up to the damage. Raises BagError."""
        try:
            reader = _sqlite_reader(path)
        except Exception as error:  # as above
            reader = _salvaging_reader(path)
            text = f'{path.name}: damaged database ({describe(error)}); read up to the damage'
            problems.append(f'{text}; `sqlite3 FILE .recover` repairs it')
        log = Path(f'{path}-wal')
        if log.is_file() and log.stat().st_size:
            problems.append(f'{log.name}: holds more messages; `sqlite3 FILE .recover` adds them')
        return cls(path, problems, reader, reader.metadata.start_time)

    def close(self) -> None:
        """Release the file."""
        self._reader.close()

    def messages(self, names: Collection[str], start_ns: int) -> Iterator[Record]:
        """Messages by reception."""
        topics = self.topics
        wanted = [c for c in self._reader.connections if topics[c.id].name in names]
        try:
            messages = self._reader.messages(wanted, start_ns) if wanted else ()
            for connection, stamp, data in messages:
                yield topics[connection.id], stamp, data
        except Exception as error:  # as above
            text = f'damaged ({describe(error)}); read up to the damage'
            add_problem(self._problems, f'{self._path.name}: {text}')


def _sqlite_reader(path: Path) -> Sqlite3Reader:
    reader = Sqlite3Reader(Path(quote(os.fsencode(path))))  # the path becomes part of an address
    reader.open()
    return reader


def _salvaging_reader(path: Path) -> Sqlite3Reader:
    """A reader of a copy of the topics and of the messages up to the damage. Raises BagError."""
    # The reader keeps the unnamed copy until it is closed.
    with TemporaryDirectory(prefix='bag-') as folder:
        try:
            return _sqlite_reader(_intact_rows(path, Path(folder) / 'copy.db3'))
        except Exception as error:  # as above
            raise BagError(f'{path}: no readable bag database ({describe(error)}); '
                           'try `sqlite3 FILE .recover`') from None  # fmt: skip


def _intact_rows(path: Path, copy: Path) -> Path:
    address = f'file:{quote(os.fsencode(path))}?immutable=1'
    with closing(sqlite3.connect(address, uri=True)) as old, closing(sqlite3.connect(copy)) as new:
        old.execute('PRAGMA writable_schema=ON')  # else a cut-off file is not read at all
        new.execute('CREATE TABLE topics(id, name, type, serialization_format)')
        new.execute('CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)')
        topics = old.execute('SELECT id, name, type, serialization_format FROM topics').fetchall()
        new.executemany('INSERT INTO topics VALUES(?, ?, ?, ?)', topics)
        rows = old.execute('SELECT id, topic_id, timestamp, data FROM messages ORDER BY id')
        with suppress(sqlite3.DatabaseError):
            for row in rows:
                new.execute('INSERT INTO messages VALUES(?, ?, ?, ?)', row)
        new.commit()
    return copy


StoredFile = McapFile | RosbagsFile
READERS: dict[bytes, Callable[[Path, list[str]], StoredFile]] = {
    b'SQLite format 3\0': RosbagsFile.sqlite,
    b'\x89MCAP0\r\n': McapFile,
    b'#ROSBAG V': RosbagsFile.ros1,
}
"""What opens a file, by its first bytes; takes the path and a list of problems."""


def inflate_message(data: bytes) -> bytes:
    """Undo the recorder's compression of a message. Raises MessageError."""
    try:
        if frame_content_size(data) <= _LARGEST:
            return ZstdDecompressor().decompress(data, max_output_size=_LARGEST)
    except ZstdError:
        pass
    raise MessageError('damaged compressed message')


def inflate_file(source: Path, target: Path) -> str:
    """Decompress a zstd file; return its damage ('' when there is none). Raises OSError."""
    with source.open('rb') as packed, target.open('wb') as plain:
        try:
            ZstdDecompressor().copy_stream(packed, plain)
        except ZstdError:
            return 'damaged zstd data; read up to the damage'
        return '' if plain.tell() else 'cut-off zstd data'
