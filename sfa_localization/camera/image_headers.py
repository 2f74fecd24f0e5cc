# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The size of an image file from its first bytes: some kB can announce GBs of pixels."""

from __future__ import annotations

import re
import struct

from sfa_localization.data.errors import CameraError

MOST_PIXELS = 1 << 26
"""Pixels of an image: 8192 x 8192, four times the largest cameras; in color 192 MB."""
MOST_SCANS = 64
"""Parts of a JPEG that each cover the whole image: encoders write twelve at most. Decoding takes
as long for each of them, however few bytes it has."""

_PNG, _JPEG, _BMP = b'\x89PNG\r\n\x1a\n', b'\xff\xd8', b'BM'
# Markers with which a JPEG frame of any coding begins; C4, C8 and CC are others.
_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_ALONE = {0x01, *range(0xD0, 0xD9)}
_SCAN, _END = 0xDA, 0xD9
_SCAN_MARK = bytes((0xFF, _SCAN))
_PNM = re.compile(rb'P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s')
_TIFF_SIZES = {256: 0, 257: 1, 322: 2, 323: 3}
"""Tags of width, height, width of a tile, height of a tile."""


def check_size(data: bytes) -> None:
    """Require a known kind of file of at most MOST_PIXELS pixels, and of a JPEG at most MOST_SCANS.

    Raises CameraError.

    Known are JPEG, PNG, BMP, PNM, TIFF and WebP.
    """
    try:
        size = image_size(data)
    except (struct.error, IndexError):
        size = None
    if size is None:
        raise CameraError('not an image file that OpenCV reads')
    width, height = size
    if width * height > MOST_PIXELS:
        raise CameraError(f'an image of {width} x {height} pixels exceeds {MOST_PIXELS}')
    # FF is no byte of a scan itself, where a zero follows it.
    if data.startswith(_JPEG) and data.count(_SCAN_MARK) > MOST_SCANS:
        raise CameraError(f'a JPEG of more than {MOST_SCANS} scans')


def image_size(data: bytes) -> tuple[int, int] | None:
    """Columns and rows that an image file announces; None where its kind is unknown.

    Raises struct.error or IndexError where the file ends in its header.
    """
    if data.startswith(_PNG):
        return _two('>II', data, 16)
    if data.startswith(_JPEG):
        return _jpeg_size(data)
    if data.startswith(_BMP):
        old = struct.unpack_from('<I', data, 14)[0] == 12
        width, height = struct.unpack_from('<HH' if old else '<ii', data, 18)
        return abs(width), abs(height)
    if data[:4] in (b'II*\0', b'MM\0*'):
        return _tiff_size(data, '<' if data[:1] == b'I' else '>')
    if data[:4] == b'RIFF' and data[8:12] == b'WEBP':
        return _webp_size(data)
    found = _PNM.match(data[:4096])
    return (int(found[1]), int(found[2])) if found else None


def _two(layout: str, data: bytes, at: int) -> tuple[int, int]:
    first, second = struct.unpack_from(layout, data, at)
    return first, second


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """The size in the first frame header, found as libjpeg finds it."""
    at = 2
    while True:
        # Bytes between two markers are skipped, and a marker may be filled with FF.
        at = data.find(b'\xff', at)
        if at < 0:
            return None
        while data[at] == 0xFF:
            at += 1
        marker, at = data[at], at + 1
        if marker in _FRAMES:
            height, width = _two('>HH', data, at + 3)
            return width, height
        if marker in (_SCAN, _END):
            return None
        if marker and marker not in _ALONE:
            at += max(struct.unpack_from('>H', data, at)[0], 2)


def _tiff_size(data: bytes, order: str) -> tuple[int, int] | None:
    """The larger of the image and its tiles, in the first directory."""
    (start,) = struct.unpack_from(f'{order}I', data, 4)
    (count,) = struct.unpack_from(f'{order}H', data, start)
    sizes = [0, 0, 0, 0]
    for at in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(f'{order}HH', data, at)
        if tag in _TIFF_SIZES:
            value = struct.unpack_from(f'{order}{"H" if kind == 3 else "I"}', data, at + 8)[0]
            sizes[_TIFF_SIZES[tag]] = max(sizes[_TIFF_SIZES[tag]], value)
    width, height, tile_width, tile_height = sizes
    if not width or not height:
        return None
    return max(width, tile_width), max(height, tile_height)


def _webp_size(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b'VP8X':
        numbers = [int.from_bytes(data[at : at + 3], 'little') + 1 for at in (24, 27)]
        return numbers[0], numbers[1]
    if kind == b'VP8L':
        (packed,) = struct.unpack_from('<I', data, 21)
        return (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
    if kind == b'VP8 ':
        width, height = _two('<HH', data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None
