# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bag files of the mcap storage, intact or damaged. Format: https://mcap.dev/spec

Our own reader, because a recording that was cut off (battery, Ctrl-\\, full disk) has no index, and
a damaged block in the middle must cost one chunk and not the drive. Intact and damaged files are
read alike: a list of blocks, from the index or from a scan of the file, and each block decoded on
its own. Of 13200 messages in zstd chunks (`salvage` in test/benchmarks/bench_bag.py) are read:

=========================  ==============  ===========  ======
file                       rosbags 0.11.9  mcap 1.6.0   here
=========================  ==============  ===========  ======
cut off at 60 %            0               7998         7998
4096 bytes overwritten     6853            6854         12914
intact: time               2.7             4.7          1
=========================  ==============  ===========  ======
"""

from __future__ import annotations

import struct
from binascii import crc32
from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterator
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

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
from sfa_localization.bags.zstd import ZstdError, decompressor
from sfa_localization.data.errors import BagError
from sfa_localization.data.rejections import short_line

MAGIC = b'\x89MCAP0\r\n'
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX, STATISTICS = 2, 3, 4, 5, 6, 8, 11
DATA_END = 15
SPAN = 1 << 20
"""Bytes of bare records that make one block."""
LARGEST_CHUNK = 1 << 28
"""Bytes of a decompressed chunk: one message of the largest camera, and room for others."""
MOST_PENDING = 1 << 29
"""Bytes of messages that wait because chunks overlap in time: a recorder's overlap by a second."""
MOST_QOS = 1 << 22
"""Characters of the QoS profiles of a file: ten thousand publishers."""
_RECORD, _MESSAGE = struct.Struct('<BQ'), struct.Struct('<HIQQ')
_FOOTER_SIZE = _RECORD.size + 20 + len(MAGIC)
_reception = itemgetter(1)


class Damage(Exception):
    """Bytes that contradict the format; the text describes how."""


class Block(NamedTuple):
    """A chunk, or a series of bare records, and the first and last time of reception in it."""

    start_ns: int
    end_ns: int
    offset: int
    length: int


class Fields:
    """Reads the fields of one record in order. Raises Damage where they end early."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def numbers(self, layout: str) -> tuple[int, ...]:
        """Integers by a struct layout."""
        form = struct.Struct('<' + layout)
        return form.unpack(self.take(form.size))

    def take(self, size: int) -> bytes:
        """The next `size` bytes."""
        if size > len(self._data) - self._at:
            raise Damage('a record ends early')
        self._at += size
        return self._data[self._at - size : self._at]

    def rest(self) -> bytes:
        """All bytes that are left."""
        return self._data[self._at :]

    def sized(self) -> bytes:
        """Bytes with their length in front."""
        return self.take(self.numbers('I')[0])

    def text(self) -> str:
        """Text with its length in front."""
        return self.sized().decode('utf-8', 'replace')

    def __bool__(self) -> bool:
        return self._at < len(self._data)


class McapStorage:
    """One .mcap file. Raises BagError when nothing in it can be read."""

    def __init__(self, path: Path) -> None:
        self._path, self.problems, self.notes = path, list[str](), list[str]()
        self._size = path.stat().st_size
        self._room = room_for(self._size)  # what chunks may become in one reading of the file
        self._file = path.open('rb')
        self._clear()
        if not self._read_index():
            self._rebuild_index()
        self._blocks.sort()
        self.channels = list(self._channels.values())
        self.counts: dict[str, int] = {channel.topic: 0 for channel in self.channels}
        for key, channel in self._channels.items():
            self.counts[channel.topic] += self._counts[key]
        self.start_ns = self._blocks[0].start_ns if self._blocks else 0

    def close(self) -> None:
        """Release the file."""
        self._file.close()

    def _clear(self) -> None:
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}
        self._blocks: list[Block] = []
        self._counts: Counter[int] = Counter()
        self._qos_room = MOST_QOS

    def _read_index(self) -> bool:
        """Read channels, chunks and counts from the summary; False when it lacks some."""
        try:
            statistics = self._parse_summary(self._summary())
            if statistics and self._blocks and self._channels:
                return True
        except Damage as damage:
            text = f'{self._path.name}: has no index, recording cut off? ({damage}); rebuilt'
            self.problems.append(text)
        self._clear()
        return False

    def _summary(self) -> bytes:
        self._file.seek(max(self._size - _FOOTER_SIZE, 0))
        footer = self._file.read()
        if len(footer) < _FOOTER_SIZE or footer[-len(MAGIC) :] != MAGIC or footer[0] != FOOTER:
            raise Damage('no footer')
        (start,) = struct.unpack_from('<Q', footer, _RECORD.size)
        if start == 0:
            return b''
        if not len(MAGIC) < start <= self._size - _FOOTER_SIZE:
            raise Damage('its footer points outside the file')
        self._file.seek(start)
        return self._file.read(self._size - _FOOTER_SIZE - start)

    def _parse_summary(self, summary: bytes) -> bool:
        """Read the records of the summary; True when the statistics are among them."""
        statistics = False
        for opcode, body in _records(summary):
            if opcode == CHUNK_INDEX:
                self._blocks.append(Block(*Fields(body).numbers('QQQQ')))
            elif opcode == STATISTICS:
                statistics = True
                self._read_counts(Fields(body))
            else:
                self._define(opcode, Fields(body))
        self._check_blocks()
        return statistics

    def _check_blocks(self) -> None:
        """Every chunk of the index must lie in the file, and there once."""
        end = 0
        for block in sorted(self._blocks, key=itemgetter(2)):
            if block.offset < end:
                raise Damage('its index lists bytes twice')
            end = block.offset + max(block.length, 1)
        if end > self._size:
            raise Damage('its index points outside the file')

    def _read_counts(self, fields: Fields) -> None:
        fields.numbers('QHIIIIQQ')
        counts = Fields(fields.sized())
        while counts:
            key, count = counts.numbers('HQ')
            self._counts[key] = count

    def _define(self, opcode: int, fields: Fields) -> None:
        """Register a schema or a channel."""
        if opcode == SCHEMA:
            (key,) = fields.numbers('H')
            self._schemas[key] = one_line(fields.text())
        elif opcode == CHANNEL:
            key, schema = fields.numbers('HH')
            if key in self._channels:
                return  # repeated in every chunk, and the same by the format
            topic, encoding, metadata = fields.text(), fields.text(), Fields(fields.sized())
            kind, qos = self._schemas.get(schema, ''), self._bounded(_qos_text(metadata))
            self._channels[key] = make_channel(topic, kind, encoding, qos)
            if len(self._channels) > MOST_TOPICS:
                raise BagError(f'{self._path}: has more than {MOST_TOPICS} topics')

    def _bounded(self, qos: str) -> str:
        """QoS profiles; none once those of the file are too many."""
        self._qos_room -= len(qos)
        return qos if self._qos_room >= 0 else ''

    def _rebuild_index(self) -> None:
        """Decode every block of the file once, for its channels, counts and times of reception."""
        self._room = room_for(self._size)
        for offset, end in self._block_bounds():
            try:
                self._index_block(offset, end - offset)
            except Damage as damage:
                self._skip_damaged(offset, damage)
        if not self._blocks:
            self.close()
            raise BagError(f'{self._path}: holds no readable message; record it again')

    def _block_bounds(self) -> Iterator[tuple[int, int]]:
        """Start and end of each chunk and of each series of bare records, by a scan of the file."""
        start = position = len(MAGIC)
        while position + _RECORD.size <= self._size:
            self._file.seek(position)
            opcode, length = _RECORD.unpack(self._file.read(_RECORD.size))
            end = position + _RECORD.size + length
            if position > start and (opcode == CHUNK or position - start >= SPAN):
                yield start, position
                start = position
            if opcode == CHUNK:
                yield position, min(end, self._size)
                start = end
            if end > self._size or opcode in (0, FOOTER, DATA_END):
                break
            position = end
        if position > start:
            yield start, position

    def _index_block(self, offset: int, length: int) -> None:
        first, last = 2**64, -1
        for opcode, body in _records(self._content(offset, length)):
            if opcode == MESSAGE and len(body) >= _MESSAGE.size:
                key, _, stamp, _ = _MESSAGE.unpack_from(body)
                self._counts[key] += 1
                first, last = min(first, stamp), max(last, stamp)
            elif opcode in (SCHEMA, CHANNEL):
                self._define(opcode, Fields(body))
        if last >= 0:
            self._blocks.append(Block(first, last, offset, length))

    def _skip_damaged(self, offset: int, damage: Damage) -> None:
        text = f'{self._path.name}: the chunk at byte {offset} is damaged ({damage}); skipped'
        add_problem(self.problems, text)

    def messages(self, topics: Collection[str], start_ns: int) -> Iterator[Record]:
        """Messages in order of reception; a damaged chunk is skipped."""
        wanted = {
            key: channel for key, channel in self._channels.items() if channel.topic in topics
        }
        self._room = room_for(self._size)
        pending: list[Record] = []
        for block in self._blocks:
            if block.end_ns < start_ns:
                continue
            ready = bisect_left(pending, block.start_ns, key=_reception)
            yield from pending[:ready]
            pending = pending[ready:] + self._block_messages(block, wanted, start_ns)
            pending.sort(key=_reception)
            if sum(len(data) for _, _, data in pending) > MOST_PENDING:
                raise BagError(
                    f'{self._path}: more than {MOST_PENDING} bytes of messages in chunks of the '
                    'same time; record it again'
                )
        yield from pending

    def _block_messages(
        self, block: Block, wanted: dict[int, Channel], start_ns: int
    ) -> list[Record]:
        try:
            content = self._content(block.offset, block.length)
        except Damage as damage:
            self._skip_damaged(block.offset, damage)
            return []
        return _messages(content, wanted, start_ns)

    def _content(self, offset: int, length: int) -> bytes:
        """The records of a block, decompressed; of a cut-off chunk those before the cut."""
        self._file.seek(offset)
        data = self._file.read(length)
        if data[:1] != bytes([CHUNK]):
            return data
        _, length = _RECORD.unpack_from(data.ljust(_RECORD.size, b'\0'))
        cut_off = length > len(data) - _RECORD.size
        fields = Fields(data[_RECORD.size :])
        _, _, size, checksum = fields.numbers('QQQI')
        compression = fields.text()
        (packed_size,) = fields.numbers('Q')
        packed = fields.rest() if cut_off else fields.take(packed_size)
        if size > LARGEST_CHUNK:
            raise Damage(f'it has {size} bytes, more than {LARGEST_CHUNK}')
        plain = _inflated(packed, compression, cut_off, min(size, self._room))
        self._room -= len(plain)
        if not cut_off and (len(plain) != size or (checksum and crc32(plain) != checksum)):
            raise Damage('checksum or size is wrong')
        return plain


def _qos_text(metadata: Fields) -> str:
    """The QoS profiles among a channel's metadata, as text."""
    while metadata:
        name, value = metadata.text(), metadata.text()
        if name == 'offered_qos_profiles':
            return value
    return ''


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and body of every complete record."""
    position = 0
    while position + _RECORD.size <= len(data):
        opcode, length = _RECORD.unpack_from(data, position)
        position += _RECORD.size + length
        if position > len(data):
            return
        yield opcode, data[position - length : position]


def _messages(data: bytes, wanted: dict[int, Channel], start_ns: int) -> list[Record]:
    """The wanted messages among the records; without calls, because it runs per message."""
    found: list[Record] = []
    position, end = 0, len(data)
    record, message = _RECORD.unpack_from, _MESSAGE.unpack_from
    while position + 9 <= end:
        opcode, length = record(data, position)
        position += 9
        if opcode == MESSAGE and 22 <= length <= end - position:
            key, _, stamp, _ = message(data, position)
            channel = wanted.get(key)
            if channel is not None and stamp >= start_ns:
                found.append((channel, stamp, data[position + 22 : position + length]))
        position += length
    return found


def _inflated(packed: bytes, compression: str, cut_off: bool, room: int) -> bytes:
    """Decompressed chunk; of a cut-off one the bytes before the cut. Raises Damage."""
    if not compression:
        return packed
    if compression not in ('zstd', 'lz4'):
        raise Damage(f'unknown compression {short_line(compression)!r}')
    inflater = decompressor() if compression == 'zstd' else LZ4FrameDecompressor()
    plain: list[bytes] = []
    try:
        for piece in pieces(inflater.decompress, packed, room):
            plain.append(piece)
    except TooLargeError:
        raise Damage(f'it becomes larger than {room} bytes') from None
    except (ZstdError, RuntimeError, EOFError, MemoryError):
        if not cut_off:
            raise Damage(f'{compression} cannot decompress it') from None
    return b''.join(plain)
