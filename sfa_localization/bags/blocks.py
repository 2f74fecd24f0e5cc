# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A bag file as blocks, each with its first and last reception: in order whatever the file's order.

The blocks come from the index of the file or, where a recording was cut off, from a scan. Each is
read on its own: a damaged one costs itself alone, and memory holds only those of one time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterator
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

from sfa_localization.bags.storage import (
    LARGEST_CHUNK,
    MOST_QOS,
    MOST_TOPICS,
    Channel,
    DamageError,
    Record,
    add_problem,
    inflate,
    make_channel,
    room_for,
)
from sfa_localization.data.errors import BagError

SPAN = 1 << 20
"""Bytes of messages outside of chunks that make one block."""
MOST_PENDING = 1 << 29
"""Bytes of messages that wait because blocks overlap in time: a recorder's overlap by a second."""
_LAST_NS = 1 << 63
"""The end of the times that ROS has."""
_reception = itemgetter(1)


class Block(NamedTuple):
    """A chunk, or a series of messages outside of one, and its first and last reception."""

    start_ns: int
    end_ns: int
    offset: int
    length: int


class BlockStorage(ABC):
    """One file, never written to; a format reads its index, scans it, and reads its messages.

    Raises BagError when nothing in it can be read.
    """

    remedy: str
    """What repairs a file of this format."""

    def __init__(self, path: Path) -> None:
        self.path, self.size, self.problems = path, path.stat().st_size, list[str]()
        self.file = path.open('rb')
        try:
            self._find_blocks()
        except BaseException:
            self.close()
            raise
        self.channels = list(self._channels.values())
        self.counts: dict[str, int] = {channel.topic: 0 for channel in self.channels}
        for key, channel in self._channels.items():
            self.counts[channel.topic] += self.message_counts[key]
        self.blocks.sort()
        self.start_ns = self.blocks[0].start_ns if self.blocks else 0

    def close(self) -> None:
        """Release the file."""
        self.file.close()

    @abstractmethod
    def read_index(self) -> bool:
        """Define topics, and fill `blocks` and `message_counts`; False where there is no index.

        Raises DamageError.
        """

    @abstractmethod
    def scan(self) -> None:
        """Call `add_block` for the parts of the file, up to where it makes no sense."""

    @abstractmethod
    def read_messages(self, offset: int, length: int) -> Iterator[tuple[int, int, bytes]]:
        """Key of the topic, reception and bytes of the messages in a part of the file.

        Topics on the way are defined. What a cut-off file lacks of the part is left out.
        """

    def _find_blocks(self) -> None:
        """Fill channels, blocks and counts. Raises BagError."""
        reason = ''
        self._clear()
        try:
            if self.read_index():
                self._check_index()
                return
        except DamageError as damage:
            reason = f' ({damage})'
        self._clear()
        self.scan()
        if not self.blocks:
            raise BagError(f'{self.path}: holds no readable message{reason}; try {self.remedy}')
        if reason:
            text = f'{self.path.name}: has no index, recording cut off?{reason}; read to the cut'
            self.problems.insert(0, f'{text}; {self.remedy} repairs it')

    def _clear(self) -> None:
        self._room = room_for(self.size)  # what chunks may become in one reading of the file
        self._qos_room, self._channels = MOST_QOS, dict[int, Channel]()
        self.blocks: list[Block] = []
        self.message_counts: Counter[int] = Counter()

    def _check_index(self) -> None:
        """Raise DamageError unless each block lies in the file, and there once."""
        end = 0
        for block in sorted(self.blocks, key=itemgetter(2)):
            if block.offset < end:
                raise DamageError('its index lists bytes twice')
            end = block.offset + max(block.length, 1)
        if end > self.size:
            raise DamageError('its index points outside the file')

    def add_block(self, offset: int, length: int) -> None:
        """Count the messages of a part of the file, and note where they are."""
        stamps = []
        for key, stamp, _ in self.read_messages(offset, length):
            self.message_counts[key] += 1
            stamps.append(stamp)
        before = self.blocks[-1] if self.blocks else Block(0, 0, 0, 0)
        if stamps and before.offset + before.length == offset and before.length < SPAN:
            stamps += self.blocks.pop()[:2]
            offset, length = before.offset, before.length + length
        if stamps:
            self.blocks.append(Block(min(stamps), max(stamps), offset, length))

    def define(self, key: int, topic: str, kind: str, serialization: str, qos: str = '') -> None:
        """Register a topic by the fields of its channel. Raises BagError for too many."""
        if key not in self._channels:  # else repeated, and the same by the format
            self._qos_room -= len(qos)
            profiles = qos if self._qos_room >= 0 else ''
            if len(self._channels) >= MOST_TOPICS:
                raise BagError(f'{self.path}: has more than {MOST_TOPICS} topics')
            self._channels[key] = make_channel(topic, kind, serialization, profiles)

    def messages(self, topics: Collection[str], start_ns: int) -> Iterator[Record]:
        """Messages received at or after `start_ns`, by reception; damaged blocks are skipped."""
        wanted = {key: c for key, c in self._channels.items() if c.topic in topics}
        self._room = room_for(self.size)
        pending: list[Record] = []
        for block in self.blocks:
            if block.end_ns < start_ns:
                continue
            ready = bisect_left(pending, block.start_ns, key=_reception)
            yield from pending[:ready]
            pending = pending[ready:] + [
                (wanted[key], stamp, data)
                for key, stamp, data in self.read_messages(block.offset, block.length)
                if key in wanted and start_ns <= stamp < _LAST_NS
            ]
            pending.sort(key=_reception)
            if sum(len(data) for _, _, data in pending) > MOST_PENDING:
                raise BagError(f'{self.path}: more than {MOST_PENDING} bytes of messages in chunks '
                               'of the same time; record it again')  # fmt: skip
        yield from pending

    def inflate(self, packed: bytes, method: str, size: int) -> bytes:
        """A chunk of at most `size` bytes. Raises DamageError."""
        if size > LARGEST_CHUNK:
            raise DamageError(f'it has {size} bytes, more than {LARGEST_CHUNK}')
        plain = inflate(packed, method, min(size, max(self._room, 0)))
        self._room -= len(plain)
        return plain

    def skip_chunk(self, offset: int, reason: object) -> None:
        """Note that a chunk cannot be read."""
        text = f'the chunk at byte {offset} is damaged ({reason}); skipped'
        add_problem(self.problems, f'{self.path.name}: {text}')
