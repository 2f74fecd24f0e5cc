# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bag files of ROS 1 (format 2.0), read by rosbags; without an index, see ros1_scan.py."""

from __future__ import annotations

from bz2 import BZ2Decompressor
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Chunk, ChunkInfo, IndexData, ReaderError, decompressors

from sfa_localization.bags.ros1_scan import ScannedRos1Storage
from sfa_localization.bags.storage import (
    MOST_TOPICS,
    Record,
    Storage,
    make_channel,
    one_line,
    pieces,
    room_for,
)
from sfa_localization.data.errors import BagError

MAGIC = b'#ROSBAG V'
_PACKERS: dict[Callable[[bytes], bytes], Callable[[], Any]] = {
    decompressors['bz2']: BZ2Decompressor,
    decompressors['lz4']: LZ4FrameDecompressor,
}


class BoundedReader(Reader):
    """Reads every chunk and message once, and decompresses at most `room` bytes.

    The index of a bag may list them any number of times. Errors are ReaderError or TooLargeError.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._size = path.stat().st_size
        self.room, self._index_room = room_for(self._size), self._size
        self._positions: set[int] = set()

    def read_chunk_info(self) -> ChunkInfo:
        """The entry of one chunk in the index."""
        info = super().read_chunk_info()
        if info.pos in self._positions:
            raise ReaderError('its index lists a chunk twice')
        self._positions.add(info.pos)
        return info

    def read_chunk(self) -> Chunk:
        """A chunk whose decompressor is bounded."""
        chunk = super().read_chunk()
        make = _PACKERS.get(chunk.decompressor)
        return chunk._replace(decompressor=lambda packed: self._inflated(make, packed))

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """The messages of a chunk."""
        assert self.bio
        start = self.bio.tell()
        super().read_index_data(pos, indexes)
        self._index_room -= self.bio.tell() - start
        if self._index_room < 0:
            raise ReaderError('its index lists messages twice')

    def _inflated(self, make: Callable[[], Any] | None, packed: bytes) -> bytes:
        """A chunk; all of them together may become `room` bytes."""
        data = b''.join(pieces(make().decompress, packed, self.room)) if make else packed
        self.room -= len(data)
        if self.room < 0:
            raise ReaderError('its chunks are read again and again')
        return data

    def keep_first(self) -> bool:
        """Forget all but the first entry of each message; True when there were more."""
        seen: set[tuple[int, int]] = set()
        for key, entries in self.indexes.items():
            places = {(entry.chunk_pos, entry.offset): entry for entry in entries}
            self.indexes[key] = [places[place] for place in places if place not in seen]
            seen.update(places)
        return len(seen) < sum(connection.msgcount for connection in self.connections)


def open_ros1(path: Path) -> Storage:
    """One .bag file, by its index or, without one, as far as it goes. Raises BagError."""
    reader = BoundedReader(path)
    try:
        reader.open()
    except Exception as error:  # a parser of foreign bytes fails in many ways
        return ScannedRos1Storage(path, _text(error))
    return Ros1Storage(path, reader)


class Ros1Storage:
    """One .bag file with an index. Raises BagError."""

    def __init__(self, path: Path, reader: BoundedReader) -> None:
        self._path, self.problems, self.notes = path, list[str](), list[str]()
        self._reader = reader
        if len(self._reader.connections) > MOST_TOPICS:
            raise BagError(f'{path}: has more than {MOST_TOPICS} topics')
        if self._reader.keep_first():
            self.problems.append(f'{path.name}: its index lists messages twice; each is read once')
        self._connections = list(self._reader.connections)
        self._channels = {
            c.id: make_channel(c.topic, c.msgtype, 'ros1', '') for c in self._connections
        }
        self.channels = list(self._channels.values())
        counts: Counter[str] = Counter()
        for connection in self._connections:
            counts[self._channels[connection.id].topic] += len(self._reader.indexes[connection.id])
        self.counts: dict[str, int] = dict(counts)
        self.start_ns = self._reader.start_time

    def messages(self, topics: Collection[str], start_ns: int) -> Iterator[Record]:
        """Messages by reception, up to the first damage."""
        wanted = [c for c in self._connections if self._channels[c.id].topic in topics]
        if not wanted:
            return
        room = self._reader.room = room_for(self._path.stat().st_size)
        try:
            for connection, stamp, data in self._reader.messages(wanted, start=start_ns):
                room -= len(data)
                if room < 0:
                    raise ReaderError('its messages lie within each other')
                yield self._channels[connection.id], stamp, data
        except Exception as error:  # as above
            self.problems.append(f'{self._path.name}: damaged ({_text(error)}); read up to there')

    def close(self) -> None:
        """Release the file."""
        self._reader.close()


def _text(error: Exception) -> str:
    return one_line(error).rstrip('.') or type(error).__name__
