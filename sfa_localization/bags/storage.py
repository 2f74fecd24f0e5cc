# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The interface of a bag file of any format, and the parts that the formats share."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple, Protocol

from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

from sfa_localization.bags.zstd import ZstdError, decompressor
from sfa_localization.data.errors import BagError
from sfa_localization.data.plain_yaml import load_yaml

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
STEP = 1 << 12
"""Compressed bytes that are decompressed at a time: of zstd they become 128 MB at most."""
ALWAYS_ALLOWED, LARGEST_RATIO = 1 << 24, 1000
"""A bag may always decompress to 16 MB, and to 1000 times its size: a camera that stands still in
the dark compresses less, and a bomb more."""
MOST_TOPICS = 10_000
"""Topics of a file: a hundred times those of a large robot."""
LONGEST_QOS = 1 << 16
"""Characters of the QoS profiles of one topic: two hundred publishers."""
LONGEST_NAME = 1000
"""Characters of the name of a topic or type: ROS allows 255."""
MOST_PROBLEMS = 50
"""Problems of a file that are described; more are mentioned."""


def add_problem(problems: list[str], text: str) -> None:
    """Describe a problem of a file, once, among at most MOST_PROBLEMS."""
    if len(problems) <= MOST_PROBLEMS and text not in problems:
        problems.append(text if len(problems) < MOST_PROBLEMS else 'there are more problems')


class Channel(NamedTuple):
    """The source of the messages of one topic: message type, wire format and offered QoS."""

    topic: str
    kind: str
    serialization: str
    qos: tuple[Qos, ...]


Record = tuple[Channel, int, bytes]
"""A message: its channel, its reception in nanoseconds, its serialized bytes."""


def one_line(text: object) -> str:
    """Text of a bag, perhaps damaged, as one printable line of at most LONGEST_NAME characters."""
    return ''.join(c if c.isprintable() else '?' for c in str(text)[:LONGEST_NAME])


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
    if isinstance(profiles, str):
        return _read_qos(profiles) if len(profiles) <= LONGEST_QOS else ()
    try:
        return tuple(parse_qos(profiles))
    except Exception:  # foreign text; a bag is not rejected because of its QoS
        return ()


@functools.lru_cache(maxsize=256)
def _read_qos(text: str) -> tuple[Qos, ...]:
    """QoS profiles from text, which many topics and chunks repeat."""
    try:
        return tuple(parse_qos(load_yaml(text)))
    except Exception:  # as above
        return ()


class TooLargeError(Exception):
    """Compressed data becomes larger than any recording does; the text says the limit."""


def room_for(packed_size: int) -> int:
    """Bytes that data of this compressed size may become."""
    return ALWAYS_ALLOWED + LARGEST_RATIO * packed_size


def pieces(decompress: Callable[[bytes], bytes], packed: bytes, room: int) -> Iterator[bytes]:
    """Decompress in small steps. Raises TooLargeError beyond `room` bytes."""
    for start in range(0, len(packed), STEP):
        plain = decompress(packed[start : start + STEP])
        room -= len(plain)
        if room < 0:
            raise TooLargeError(
                f'it becomes more than {LARGEST_RATIO} times as large when decompressed'
            )
        yield plain


def inflate_message(data: bytes, room: int) -> bytes:
    """Undo the recorder's compression of a message, to at most `room` bytes. Raises BagError."""
    if data[:4] != ZSTD_MAGIC:
        return data
    inflater = decompressor()
    try:
        plain = b''.join(pieces(inflater.decompress, data, room))
    except (ZstdError, EOFError):
        raise BagError('a compressed message is damaged') from None
    except TooLargeError as error:
        raise BagError(f'a compressed message is a bomb: {error}') from None
    if not inflater.eof:
        raise BagError('a compressed message is cut off')
    return plain


def inflate_file(source: Path, target: Path) -> str:
    """Decompress a file; return its damage ('' when there is none). Raises OSError."""
    with source.open('rb') as packed, target.open('wb') as plain:
        return _inflate(packed, plain, room_for(source.stat().st_size))


def _inflate(packed: IO[bytes], plain: IO[bytes], room: int) -> str:
    inflater = decompressor()
    while piece := packed.read(STEP):
        while piece:
            if inflater.eof:
                inflater = decompressor()
            try:
                written = plain.write(inflater.decompress(piece))
            except ZstdError:
                return 'damaged zstd data; read up to the damage'
            room -= written
            if room < 0:
                return f'becomes more than {LARGEST_RATIO} times as large; read up to there'
            piece = inflater.unused_data
    return '' if inflater.eof else 'cut-off zstd data; read up to the cut'
