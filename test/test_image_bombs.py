# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The size of an image is judged before it is decoded."""

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfa_localization.camera import encodings
from sfa_localization.camera.calibration_files import read_calibration
from sfa_localization.camera.capture import Device, Folder, Video
from sfa_localization.camera.encodings import decode_compressed
from sfa_localization.camera.image_headers import MOST_PIXELS, MOST_SCANS, image_size
from sfa_localization.camera.panorama import read_mask
from sfa_localization.camera.settings import CaptureConfig
from sfa_localization.data.errors import CameraError

SMALL = np.random.default_rng(0).integers(0, 256, (37, 53, 3), np.uint8)
SUFFIXES = {
    'png': [],
    'jpg': [],
    'progressive.jpg': [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
    'bmp': [],
    'ppm': [],
    'tiff': [],
    'webp': [cv2.IMWRITE_WEBP_QUALITY, 80],
    'lossless.webp': [cv2.IMWRITE_WEBP_QUALITY, 101],
}


def encoded(suffix: str, image: np.ndarray = SMALL) -> bytes:
    done, data = cv2.imencode('.' + suffix.rpartition('.')[2], image, SUFFIXES[suffix])
    assert done
    return data.tobytes()


@pytest.mark.parametrize('suffix', SUFFIXES)
def test_the_size_is_that_of_the_decoded_image(suffix):
    data = encoded(suffix)
    assert image_size(data) == (53, 37)
    assert decode_compressed(data).shape == SMALL.shape


def test_the_size_of_a_jpeg_with_metadata_and_fill_bytes():
    data = encoded('jpg')
    comment = b'\xff\xfe' + struct.pack('>H', 20) + b'\xff\xc0' * 9
    spread = data[:2] + comment + b'\x00\xff\xff' + b'\xff' + data[3:]
    assert image_size(spread) == (53, 37)


def png(width: int, height: int) -> bytes:
    """A PNG of any size whose pixels are zeros: 1000 times smaller."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack('>I', len(data)) + name + data + struct.pack('>I', zlib.crc32(name + data))
        )

    packer = zlib.compressobj(9)
    pixels = b''.join(packer.compress(bytes(1 + 3 * width)) for _ in range(height))
    header = struct.pack('>IIBBBBB', width, height, 8, 2, 0, 0, 0)
    return (
        b'\x89PNG\r\n\x1a\n'
        + chunk(b'IHDR', header)
        + chunk(b'IDAT', pixels + packer.flush())
        + chunk(b'IEND', b'')
    )


def patched_jpeg(width: int, height: int) -> bytes:
    data = encoded('jpg')
    at = data.index(struct.pack('>HH', 37, 53))
    return data[:at] + struct.pack('>HH', height, width) + data[at + 4 :]


def patched_bmp(width: int, height: int) -> bytes:
    data = encoded('bmp')
    return data[:18] + struct.pack('<ii', width, height) + data[26:]


def patched_tiff(width: int, height: int) -> bytes:
    data = bytearray(encoded('tiff'))
    (start,) = struct.unpack_from('<I', data, 4)
    for tag, value in ((256, width), (257, height)):
        at = data.index(struct.pack('<H', tag), start)
        struct.pack_into('<HHII', data, at, tag, 4, 1, value)
    return bytes(data)


BOMBS = {
    'png': png(20_000, 4_000),
    'jpeg': patched_jpeg(65_000, 65_000),
    'bmp': patched_bmp(30_000, -30_000),
    'ppm': b'P6 # comment\n30000 30000 255\n' + bytes(100),
    'tiff': patched_tiff(40_000, 40_000),
    'webp': encoded('webp')[:12] + b'VP8X' + struct.pack('<I', 10) + bytes(4) + b'\xff' * 6,
}


@pytest.mark.parametrize('kind', BOMBS)
@pytest.mark.parametrize('format', ['', 'bayer_rggb8; jpeg compressed '])
def test_a_bomb_is_rejected_without_being_decoded(kind, format, monkeypatch):
    def decode(*_):
        raise AssertionError('it was decoded')

    monkeypatch.setattr(encodings.cv2, 'imdecode', decode)
    with pytest.raises(CameraError, match=f'pixels exceeds {MOST_PIXELS}'):
        decode_compressed(BOMBS[kind], format)


@pytest.mark.parametrize(
    'data',
    [
        b'\x89PNG\r\n\x1a\n',
        b'\xff\xd8\xff\xd9',
        b'\xff\xd8' + b'\xff' * 9 + b'\xd9',
        b'\xff\xd8\xff\xc0\xff\xd9',
        b'II*\0' + b'\xff' * 9,
        b'II*\0\x08\0\0\0\xff\xff',
        b'RIFF....WEBP????',
        b'BM',
        b'P6',
        b'#?RADIANCE\n',
        b'GIF89a' + b'\xff' * 100,
    ],
)
def test_headers_that_end_early_or_are_unknown(data):
    with pytest.raises(CameraError, match='not an image file'):
        decode_compressed(data)


@pytest.mark.parametrize('height', [2**32 - 1, 2**63])
def test_raw_images_of_any_height_without_data(height):
    with pytest.raises(CameraError, match='empty image'):
        encodings.decode_image(b'', height, 4, 0, 'mono8')


@pytest.mark.parametrize('kind', ['pipe', 'long name', 'bomb'])
def test_masks_that_cannot_be_used(kind, tmp_path):
    path = tmp_path / 'mask.png'
    if kind == 'pipe':
        os.mkfifo(path)
    elif kind == 'bomb':
        path.write_bytes(BOMBS['png'])
    with pytest.raises(CameraError, match='is missing or is no image'):
        read_mask(300 * 'x' if kind == 'long name' else str(path), (10, 10))


@pytest.mark.parametrize('source', [Device, Video, Folder])
@pytest.mark.parametrize('path', [300 * 'x', 4000 * 'y'])
def test_sources_with_a_path_that_cannot_be(source, path):
    with pytest.raises(CameraError):
        source(CaptureConfig(source_path=path))


def test_a_pipe_is_no_video_and_no_calibration(tmp_path):
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    with pytest.raises(CameraError, match='missing'):
        Video(CaptureConfig(source_path=str(pipe)))
    with pytest.raises(CameraError, match='no regular file'):
        read_calibration(pipe)


@pytest.mark.parametrize('name', [300 * 'x', 'a\0b'])
def test_a_calibration_whose_path_cannot_be(name):
    with pytest.raises(CameraError):
        read_calibration(Path(name))


def with_scans(scans: int) -> bytes:
    """A progressive JPEG that repeats its last scan, as some bytes that cost a whole image each."""
    data = encoded('progressive.jpg')
    last = data[data.rindex(b'\xff\xda') : -2]
    return data[:-2] + last * (scans - data.count(b'\xff\xda')) + data[-2:]


def test_a_jpeg_of_many_scans_is_not_decoded(monkeypatch):
    """At 8192 x 8192, 480 scans in 600 kB took 19 s."""
    assert decode_compressed(with_scans(MOST_SCANS)).shape == SMALL.shape
    monkeypatch.setattr(encodings.cv2, 'imdecode', None)
    with pytest.raises(CameraError, match='a JPEG of more than 64 scans'):
        decode_compressed(with_scans(MOST_SCANS + 1))
