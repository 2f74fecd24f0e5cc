# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bag files of ROS 1 without an index, as of a recorder that was cut off (`.bag.active` renamed).

Format: http://wiki.ros.org/Bags/Format/2.0. The index stands at the end of a file, and rosbags
(0.11.9) opens none without it. Its chunks are whole up to the cut, and each names its topics.
"""

from __future__ import annotations

import struct
from bz2 import BZ2Decompressor
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from lz4.frame import LZ4FrameDecompressor

from sfa_localization.bags.storage import (
    MOST_TOPICS,
    Channel,
    Record,
    TooLargeError,
    add_problem,
    make_channel,
    one_line,
    pieces,
    room_for,
)
from sfa_localization.data.errors import BagError

MESSAGE, CHUNK, CONNECTION = 2, 5, 7
_VERSION_LINE = b'#ROSBAG V2.0\n'
_DECOMPRESSORS: dict[bytes, Callable[[], Any]] = {
    b'bz2': BZ2Decompressor,
    b'lz4': LZ4FrameDecompressor,
}
# Bytes of the fields before the data of a record: those of a connection hold two names.
_LONGEST_HEADER = 1 << 16


class Part(NamedTuple):
    """A record: its fields, its data, and whether the file ends inside of it."""

    fields: dict[bytes, bytes]
    data: bytes
    cut_off: bool

    @property
    def kind(self) -> int:
        """What it holds, -1 where it does not say so."""
        value = self.fields.get(b'op', b'')
        return value[0] if len(value) == 1 else -1


class ScannedRos1Storage:
    """One .bag file, read from its start to the first damage. Raises BagError where that is all."""

    def __init__(self, path: Path, reason: str) -> None:
        self.problems, self.notes = list[str](), list[str]()
        self._path, self._size = path, path.stat().st_size
        self._known: dict[int, Channel] = {}
        counts: Counter[str] = Counter()
        self.start_ns = 0
        for channel, stamp_ns, _ in self._messages():
            self.start_ns = self.start_ns or stamp_ns
            counts[channel.topic] += 1
        self.channels, self.counts = list(self._known.values()), dict(counts)
        if not counts:
            raise BagError(
                f'{path}: unreadable ROS 1 bag ({reason}); repair it with `rosbag reindex`'
            )
        text = f'{path.name}: has no index, recording cut off? ({reason}); rebuilt'
        self.problems.insert(0, text)

    def messages(self, topics: Collection[str], start_ns: int) -> Iterator[Record]:
        """Messages in the order of the file, which is that of reception, up to the damage."""
        for record in self._messages():
            if record[0].topic in topics and record[1] >= start_ns:
                yield record

    def close(self) -> None:
        """Nothing is open between two readings."""

    def _messages(self) -> Iterator[Record]:
        """All of the file; what is missing is noted once."""
        room = room_for(self._size)
        with self._path.open('rb') as file:
            file.seek(len(_VERSION_LINE))
            for part in _parts(file.read, self._size - len(_VERSION_LINE)):
                if part.kind == CHUNK:
                    plain = self._inflated(part, room)
                    room -= len(plain)
                    yield from self._inside(plain)
                elif part.kind == CONNECTION:
                    self._define(part)

    def _inflated(self, chunk: Part, room: int) -> bytes:
        """The records of a chunk; of a damaged or cut-off one those before the damage."""
        method = chunk.fields.get(b'compression', b'none')
        if method == b'none':
            return chunk.data
        make, plain = _DECOMPRESSORS.get(method), []
        try:
            if make is None:
                raise ValueError(f'unknown compression {one_line(method.decode(errors="replace"))}')
            for piece in pieces(make().decompress, chunk.data, room):
                plain.append(piece)
        except (OSError, EOFError, RuntimeError, MemoryError, ValueError, TooLargeError) as error:
            if not chunk.cut_off:
                add_problem(self.problems, f'{self._path.name}: a chunk is damaged ({error})')
        return b''.join(plain)

    def _inside(self, plain: bytes) -> Iterator[Record]:
        """The messages of a chunk."""
        position = 0

        def read(count: int) -> bytes:
            nonlocal position
            position += count
            return plain[position - count : position]

        for part in _parts(read, len(plain)):
            if part.kind == CONNECTION:
                self._define(part)
            elif part.kind == MESSAGE and not part.cut_off:
                channel = self._known.get(_number(part.fields.get(b'conn')))
                stamp = part.fields.get(b'time', b'')
                if channel is not None and len(stamp) == 8:
                    seconds, rest = struct.unpack('<II', stamp)
                    yield channel, seconds * 1_000_000_000 + rest, part.data

    def _define(self, part: Part) -> None:
        """Take a connection: its number, topic and type."""
        key, names = _number(part.fields.get(b'conn')), _fields(part.data)
        if part.cut_off or key < 0 or names is None or key in self._known:
            return
        if len(self._known) >= MOST_TOPICS:
            raise BagError(f'{self._path}: has more than {MOST_TOPICS} topics')
        topic, kind = part.fields.get(b'topic', b''), names.get(b'type', b'')
        name, title = (text.decode(errors='replace') for text in (topic, kind))
        self._known[key] = make_channel(name, title, 'ros1', '')


def _number(value: bytes | None) -> int:
    """A 32 bit number; -1 where it is none."""
    return int(struct.unpack('<I', value)[0]) if value is not None and len(value) == 4 else -1


def _parts(read: Callable[[int], bytes], left: int) -> Iterator[Part]:
    """Records one after the other, until the `left` bytes are read or make no sense."""
    while left >= 4:
        length = _number(read(4))
        left -= 4
        if not 0 < length <= min(left - 4, _LONGEST_HEADER):
            return
        fields, size = _fields(read(length)), _number(read(4))
        left -= length + 4
        if fields is None or size < 0:
            return
        yield Part(fields, read(min(size, left)), size > left)
        left -= min(size, left)


def _fields(header: bytes) -> dict[bytes, bytes] | None:
    """Names and values of a header; None where it is damaged."""
    found, at = dict[bytes, bytes](), 0
    while at < len(header):
        length = _number(header[at : at + 4])
        name, equals, value = header[at + 4 : at + 4 + length].partition(b'=')
        if length < 1 or not equals or at + 4 + length > len(header):
            return None
        found[name] = value
        at += 4 + length
    return found
