# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bag files of the mcap storage, read by the package mcap. Format: https://mcap.dev/spec"""

from __future__ import annotations

import struct
from binascii import crc32
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from io import BytesIO

from mcap import records
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader, breakup_chunk

from sfa_localization.bags.blocks import Block, BlockStorage
from sfa_localization.bags.storage import LARGEST_CHUNK, DamageError, one_line

MAGIC = b'\x89MCAP0\r\n'
_FOOTER_SIZE = 29 + len(MAGIC)
_HEAD = struct.Struct('<BQ')
_READ = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK}


class McapStorage(BlockStorage):
    """One .mcap file."""

    remedy = '`mcap recover`'
    _kinds: dict[int, str]

    def read_index(self) -> bool:
        """Take the index at the end of the file."""
        self._kinds = {}
        end = self.size - _FOOTER_SIZE
        footer = next(self._records(max(end, 0), _FOOTER_SIZE), None)
        if not isinstance(footer, records.Footer):
            raise DamageError('no footer')
        if footer.summary_start == 0:
            return False
        length = end - footer.summary_start
        if not 0 <= length <= LARGEST_CHUNK:
            raise DamageError('its footer points elsewhere')
        chunks = 0
        for record in self._records(footer.summary_start, length):
            if isinstance(record, records.ChunkIndex):
                times = record.message_start_time, record.message_end_time
                block = Block(*times, record.chunk_start_offset, record.chunk_length)
                self.blocks.append(block)
            elif isinstance(record, records.Statistics):
                chunks = record.chunk_count
                self.message_counts.update(record.channel_message_counts)
        if chunks and chunks != len(self.blocks):
            raise DamageError('its index is incomplete')
        return chunks > 0

    def scan(self) -> None:
        """Read record after record."""
        self._kinds, at = {}, len(MAGIC)
        while at + _HEAD.size <= self.size:
            self.file.seek(at)
            opcode, length = _HEAD.unpack(self.file.read(_HEAD.size))
            length += _HEAD.size
            if opcode in (0, Opcode.DATA_END, Opcode.FOOTER):
                return
            if opcode in _READ and length <= LARGEST_CHUNK:
                self.add_block(at, length)
            at += length

    def read_messages(self, offset: int, length: int) -> Iterator[tuple[int, int, bytes]]:
        """Of chunks, and outside of them."""
        for record in self._records(offset, length):
            if isinstance(record, records.Message):
                yield record.channel_id, record.log_time, record.data

    def _records(self, offset: int, length: int) -> Iterator[records.McapRecord]:
        """The records in a part of the file, and in its chunks, up to the first damage."""
        self.file.seek(offset)
        data = self.file.read(length)
        lacking = length - len(data)  # after a cut: zeros, for the sake of the chunk's beginning
        for record in _stream(data.ljust(length, b'\0')):
            if not isinstance(record, records.Chunk):
                if not lacking:
                    self._define(record)
                    yield record
                continue
            try:
                plain = self._plain(record, lacking)
                whole = replace(record, compression='', data=plain)
                parts = _stream(plain) if lacking else breakup_chunk(whole)
            except Exception as damage:  # a parser of foreign bytes fails in many ways
                self.skip_chunk(offset, one_line(damage))
                continue
            for part in parts:
                if not isinstance(part, records.Message):
                    self._define(part)
                yield part

    def _plain(self, chunk: records.Chunk, lacking: int) -> bytes:
        """The data of a chunk, of a cut-off one those before the cut. Raises DamageError."""
        size, checksum = chunk.uncompressed_size, chunk.uncompressed_crc
        packed = chunk.data[: max(len(chunk.data) - lacking, 0)]
        plain = self.inflate(packed, chunk.compression, size)
        if not lacking and (len(plain) != size or (checksum and crc32(plain) != checksum)):
            raise DamageError('checksum or size is wrong')
        return plain

    def _define(self, record: records.McapRecord) -> None:
        """Register what a record defines, if it is of a type or a topic."""
        if isinstance(record, records.Schema):
            self._kinds[record.id] = record.name
        elif isinstance(record, records.Channel):
            kind, qos = self._kinds.get(record.schema_id, ''), 'offered_qos_profiles'
            encoding = record.message_encoding
            self.define(record.id, record.topic, kind, encoding, record.metadata.get(qos, ''))


def _stream(data: bytes) -> Iterator[records.McapRecord]:
    """Records one after the other, until the data end or make no sense."""
    with suppress(Exception):  # as above
        yield from StreamReader(BytesIO(data), skip_magic=True, emit_chunks=True).records
