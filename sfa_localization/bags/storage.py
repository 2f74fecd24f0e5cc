# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The interface of a bag file of any format, and the parts that the formats share."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple, Protocol

from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

from sfa_localization.bags.zstd import ZstdError, decompressor
from sfa_localization.data.errors import BagError
from sfa_localization.data.plain_yaml import load_yaml

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
PIECE = 1 << 20
"""Bytes that are decompressed at a time."""


class Channel(NamedTuple):
    """The source of the messages of one topic: message type, wire format and offered QoS."""

    topic: str
    kind: str
    serialization: str
    qos: tuple[Qos, ...]


Record = tuple[Channel, int, bytes]
"""A message: its channel, its reception in nanoseconds, its serialized bytes."""


def one_line(text: object) -> str:
    """Text of a bag, perhaps damaged, as one printable line."""
    return ''.join(c if c.isprintable() else '?' for c in str(text))


def make_channel(topic: object, kind: object, serialization: object, qos: Any) -> Channel:
    """A channel from the fields of a file."""
    return Channel(
        one_line(topic), message_type(one_line(kind)), one_line(serialization), offered_qos(qos)
    )


class Storage(Protocol):
    """One file of a bag, open for reading and never written to."""

    channels: list[Channel]
    counts: dict[str, int]
    """Messages per topic by the index of the file; without a topic whose count is unknown."""
    start_ns: int
    problems: list[str]
    """Damage found so far; reading may add to it."""
    notes: list[str]
    """Unusual findings that are no damage."""

    def messages(self, topics: Collection[str], start_ns: int) -> Iterator[Record]:
        """Messages of the topics received at or after `start_ns`, in order of reception."""

    def close(self) -> None:
        """Release the file."""


def message_type(name: str) -> str:
    """Full name of a message type: older recorders leave out the 'msg' in the middle."""
    parts = name.split('/')
    return f'{parts[0]}/msg/{parts[1]}' if len(parts) == 2 else name


def offered_qos(profiles: Any) -> tuple[Qos, ...]:
    """QoS profiles from the text or list of a recorder; none where it is unreadable."""
    try:
        return tuple(parse_qos(load_yaml(profiles) if isinstance(profiles, str) else profiles))
    except Exception:  # foreign text; a bag is not rejected because of its QoS
        return ()


def inflate_message(data: bytes) -> bytes:
    """Undo the recorder's compression of single messages. Raises BagError."""
    if data[:4] != ZSTD_MAGIC:
        return data
    inflater = decompressor()
    try:
        plain = bytes(inflater.decompress(data))
    except ZstdError:
        raise BagError('a compressed message is damaged') from None
    if not inflater.eof:
        raise BagError('a compressed message is cut off')
    return plain


def inflate_file(source: Path, target: Path) -> str:
    """Decompress a file; return its damage ('' when there is none). Raises OSError."""
    with source.open('rb') as packed, target.open('wb') as plain:
        return _inflate(packed, plain)


def _inflate(packed: IO[bytes], plain: IO[bytes]) -> str:
    inflater = decompressor()
    while piece := packed.read(PIECE):
        while piece:
            if inflater.eof:
                inflater = decompressor()
            try:
                plain.write(inflater.decompress(piece))
            except ZstdError:
                return 'damaged zstd data; read up to the damage'
            piece = inflater.unused_data
    return '' if inflater.eof else 'cut-off zstd data; read up to the cut'
