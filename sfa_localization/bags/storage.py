# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the files of a bag have in common, and the limits that the libraries do not have."""

from __future__ import annotations

import functools
from bz2 import BZ2Decompressor
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from lz4.frame import LZ4FrameDecompressor
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from sfa_localization.data.plain_yaml import load_yaml

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
LARGEST_CHUNK = 1 << 28
"""Bytes of a decompressed chunk: one message of the largest camera, and room for others."""
ALWAYS_ALLOWED, LARGEST_RATIO = 1 << 24, 1000
"""A bag may always decompress to 16 MB, and to 1000 times its size: a camera that stands still in
the dark compresses less, and a bomb more."""
MOST_TOPICS = 10_000
"""Topics of a file: a hundred times those of a large robot."""
LONGEST_QOS, MOST_QOS = 1 << 16, 1 << 20
"""Characters of the QoS profiles of one topic and of a file: two hundred publishers, and all."""
LONGEST_NAME = 1000
"""Characters of the name of a topic or type: ROS allows 255."""
MOST_PROBLEMS = 50
"""Problems of a file that are described; more are mentioned."""


class Channel(NamedTuple):
    """The source of the messages of one topic: message type, wire format and offered QoS."""

    topic: str
    kind: str
    serialization: str
    qos: tuple[Qos, ...]


Record = tuple[Channel, int, bytes]
"""A message: its channel, its reception in nanoseconds, its serialized bytes."""


class DamageError(Exception):
    """Bytes that contradict their format, or a limit; the text says how."""


def add_problem(problems: list[str], text: str) -> None:
    """Describe a problem of a file, once, among at most MOST_PROBLEMS."""
    if len(problems) <= MOST_PROBLEMS and text not in problems:
        problems.append(text if len(problems) < MOST_PROBLEMS else 'there are more problems')


def one_line(text: object) -> str:
    """Text of a bag, perhaps damaged, as one printable line of at most LONGEST_NAME characters.

    Of an error without a text its class.
    """
    text = type(text).__name__ if isinstance(text, Exception) and not str(text) else text
    return ''.join(c if c.isprintable() else '?' for c in str(text)[:LONGEST_NAME])


def make_channel(topic: object, kind: object, serialization: object, qos: Any) -> Channel:
    """A channel from the fields of a file; older recorders leave out the 'msg' of a type.

    `qos` are profiles, or the text or list of a recorder; none where it is unreadable.
    """
    parts = one_line(kind).split('/')
    full = '/'.join([parts[0], 'msg', parts[1]] if len(parts) == 2 else parts)
    profiles = _read_qos(qos) if isinstance(qos, str) else _parsed_qos(qos)
    return Channel(one_line(topic), full, one_line(serialization), profiles)


@functools.lru_cache(maxsize=256)
def _read_qos(text: str) -> tuple[Qos, ...]:
    """QoS profiles of a text, which many topics repeat."""
    with suppress(ValueError):
        return _parsed_qos(load_yaml(text) if len(text) <= LONGEST_QOS else ())
    return ()


def _parsed_qos(profiles: Any) -> tuple[Qos, ...]:
    with suppress(Exception):  # anything; a bag is not rejected because of its QoS
        whole = all(isinstance(profile, Qos) for profile in profiles)
        return tuple(profiles if whole else parse_qos(profiles))
    return ()


def room_for(packed_size: int) -> int:
    """Bytes that data of this compressed size may become."""
    return ALWAYS_ALLOWED + LARGEST_RATIO * packed_size


def inflate(packed: bytes, method: str, room: int) -> bytes:
    """Decompressed data of at most `room` bytes; of cut-off data those before the cut.

    Raises DamageError.
    """
    try:
        if method in ('', 'none'):
            return packed
        if method == 'zstd':
            plain = ZstdDecompressor().stream_reader(packed).read(room + 1)
        elif method in ('lz4', 'bz2'):
            inflater = LZ4FrameDecompressor() if method == 'lz4' else BZ2Decompressor()
            plain = inflater.decompress(packed, room + 1)
        else:
            raise DamageError(f'unknown compression {one_line(method)!r}')
    except (ZstdError, RuntimeError, OSError, EOFError, MemoryError):
        raise DamageError(f'{method} cannot decompress it') from None
    if len(plain) > room:
        raise DamageError(f'it becomes larger than {room} bytes when decompressed')
    return bytes(plain)


def inflate_message(data: bytes) -> bytes:
    """Undo the recorder's compression of a message. Raises DamageError."""
    room = min(room_for(len(data)), LARGEST_CHUNK)
    try:
        if frame_content_size(data) > room:
            raise DamageError(f'it becomes larger than {room} bytes when decompressed')
        return ZstdDecompressor().decompress(data, max_output_size=room)
    except ZstdError:
        raise DamageError('zstd cannot decompress it') from None


def inflate_file(source: Path, target: Path) -> str:
    """Decompress a zstd file; return its damage ('' when there is none). Raises OSError."""
    room = room_for(source.stat().st_size)
    with source.open('rb') as packed, target.open('wb') as plain:
        reader = ZstdDecompressor().stream_reader(packed, read_across_frames=True)
        try:
            while piece := reader.read(1 << 20):
                room -= plain.write(piece)
                if room < 0:
                    return f'becomes more than {LARGEST_RATIO} times as large; read up to there'
        except ZstdError:
            return 'damaged zstd data; read up to the damage'
        return '' if plain.tell() else 'cut-off zstd data'
