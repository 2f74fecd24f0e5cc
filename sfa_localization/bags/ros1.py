# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bag files of ROS 1, read by rosbags. Format: http://wiki.ros.org/Bags/Format/2.0

rosbags reads only intact files, and decompresses a chunk for every message where topics were
written one after the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO

from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Header, IndexData, RecordType, read_uint32
from rosbags.typesys.msg import normalize_msgtype

from sfa_localization.bags.blocks import Block, BlockStorage
from sfa_localization.bags.storage import LARGEST_CHUNK, DamageError, one_line
from sfa_localization.data.errors import BagError

MAGIC = b'#ROSBAG V'
_VERSION_LINE = b'#ROSBAG V2.0\n'


class _ChunkIndex(Reader):
    """The topics and chunks of a file, without the index of their messages."""

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Skip it: the time and the place of every message would fill the memory."""


class Ros1Storage(BlockStorage):
    """One .bag file."""

    remedy = '`rosbag reindex`'

    def read_index(self) -> bool:
        """Take the index at the end of the file."""
        try:
            with _ChunkIndex(self.path) as reader:
                for connection in reader.connections:
                    self.define(connection.id, connection.topic, connection.msgtype, 'ros1')
                for info in reader.chunk_infos:
                    chunk = reader.chunks[info.pos]
                    length = chunk.datapos + chunk.datasize - info.pos
                    self.blocks.append(Block(info.start_time, info.end_time, info.pos, length))
                    self.message_counts.update(info.connection_counts)
        except BagError:
            raise
        except Exception as error:  # a parser of foreign bytes fails in many ways
            raise DamageError(one_line(error).rstrip('.')) from None
        return True

    def scan(self) -> None:
        """Read record after record."""
        at = len(_VERSION_LINE)
        while at < self.size:
            self.file.seek(at)
            try:
                Header.read(self.file)
                size = read_uint32(self.file)
            except Exception:  # as above
                return
            length = self.file.tell() + size - at
            if length <= LARGEST_CHUNK:
                self.add_block(at, length)
            at += length

    def read_messages(self, offset: int, length: int) -> Iterator[tuple[int, int, bytes]]:
        """Of chunks, and outside of them."""
        self.file.seek(offset)
        try:
            for header, data in _records(self.file.read(length)):
                if header.get_uint8('op') != RecordType.CHUNK:
                    yield from self._message(header, data)
                    continue
                method, size = header.get_string('compression'), header.get_uint32('size')
                for part in _records(self.inflate(data, method, size)):
                    yield from self._message(*part)
        except BagError:
            raise
        except Exception as error:  # as above
            self.skip_chunk(offset, one_line(error))

    def _message(self, header: Header, data: bytes) -> Iterator[tuple[int, int, bytes]]:
        """The message in a record, if it holds one; a topic in it is defined."""
        kind = header.get_uint8('op')
        if kind == RecordType.MSGDATA:
            yield header.get_uint32('conn'), header.get_time('time'), data
        elif kind == RecordType.CONNECTION:
            text = Header.read(BytesIO(len(data).to_bytes(4, 'little') + data))
            message_type = normalize_msgtype(text.get_string('type'))
            topic = header.get_string('topic')
            self.define(header.get_uint32('conn'), topic, message_type, 'ros1')


def _records(data: bytes) -> Iterator[tuple[Header, bytes]]:
    """Fields and data of the records, up to where they make no sense; a chunk may be cut off."""
    file = BytesIO(data)
    with suppress(Exception):  # as above
        while True:
            header, size = Header.read(file), read_uint32(file)
            content = file.read(size)
            if len(content) == size or header.get_uint8('op') == RecordType.CHUNK:
                yield header, content
