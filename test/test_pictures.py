# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Decoding of picture messages: every encoding, padding, and every way to be wrong."""

from __future__ import annotations

import array

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from sfa_localization.camera.encodings import (
    ENCODINGS,
    decode_compressed,
    decode_image,
    encode_jpeg,
    encode_png,
)
from sfa_localization.data.errors import CameraError

BLUE, GREEN, RED = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def noise():
    return np.random.default_rng(1).integers(0, 256, (6, 8, 3), np.uint8)


PIXELS = {
    'mono8': ([7], (7, 7, 7)), '8UC1': ([7], (7, 7, 7)), 'bgr8': ([1, 2, 3], (1, 2, 3)),
    '8UC3': ([1, 2, 3], (1, 2, 3)), 'rgb8': ([1, 2, 3], (3, 2, 1)),
    'bgra8': ([1, 2, 3, 4], (1, 2, 3)), '8UC4': ([1, 2, 3, 4], (1, 2, 3)),
    'rgba8': ([1, 2, 3, 4], (3, 2, 1)), '16UC1': ([9, 200], (200, 200, 200)),
    'rgb16': ([0, 64, 0, 2, 0, 3], (3, 2, 64)), 'bgra16': ([0, 64, 0, 2, 0, 3, 0, 4], (64, 2, 3)),
}  # fmt: skip
"""Bytes of one pixel, and the blue, green and red that they are."""


def test_pixels_arrive_where_they_belong_from_every_kind_of_buffer_with_padded_rows():
    for encoding, (pixel, expected) in PIXELS.items():
        row = [*pixel * 5, 0, 0, 0, 0]
        data = array.array('B', row * 3)
        for buffer in (bytes(data), data, np.array(data)):
            image = decode_image(buffer, 3, 5, len(row), encoding)
            assert (image.shape, image.dtype) == ((3, 5, 3), np.uint8)
            assert (image == expected).all(), encoding


def test_packed_and_planar_yuv():
    for encoding, order in {
        'yuv422': 'UYVY', 'uyvy': 'UYVY', 'yuv422_yuy2': 'YUYV', 'yuyv': 'YUYV',
    }.items():  # fmt: skip
        for level, u, v, expected in ((126, 128, 128, (128, 128, 128)), (81, 90, 240, (0, 0, 254))):
            data = bytes([{'Y': level, 'U': u, 'V': v}[name] for name in order] * 2)
            image = decode_image(data, 1, 4, 8, encoding)
            assert_allclose(image, np.full((1, 4, 3), expected), atol=2)
    for encoding, chroma in {'nv12': (90, 240), 'nv21': (240, 90)}.items():
        image = decode_image(bytes([81] * 8 + list(chroma) * 2), 2, 4, 4, encoding)
        assert_allclose(image, np.full((2, 4, 3), (0, 0, 254)), atol=2)


@pytest.mark.parametrize('bits', [10, 12, 14, 16])
def test_of_16_bits_those_count_that_the_sensor_has(bits):
    """In a message and in a PNG, gray and in color; a dark image stays dark."""
    picture = noise()
    picture[0, 0] = 255
    words = picture.astype(np.uint16) << (bits - 8)
    color = decode_image(words.tobytes(), 6, 8, 48, 'bgr16')
    swapped = decode_image(words.byteswap().tobytes(), 6, 8, 48, 'bgr16', True)
    packed = decode_compressed(encode_png(words), 'bgr16; png compressed bgr16')
    for image in (color, swapped, packed):
        assert_array_equal(image, picture)
    gray = np.repeat(picture[..., :1], 3, 2)
    mono = np.ascontiguousarray(words[..., 0])
    assert_array_equal(decode_image(mono.tobytes(), 6, 8, 16, 'mono16'), gray)
    assert_array_equal(decode_compressed(encode_png(mono), 'mono16; png'), gray)
    assert decode_image((mono // mono.max() * 40).tobytes(), 6, 8, 16, 'mono16').max() <= 10


@pytest.mark.parametrize('depth', [8, 16])
def test_bayer_patterns(depth):
    for pattern in ('rggb', 'bggr', 'gbrg', 'grbg'):
        for letter, color in {'r': RED, 'g': GREEN, 'b': BLUE}.items():
            tile = np.array([255 * (c == letter) for c in pattern], np.uint8).reshape(2, 2)
            mosaic = np.tile(tile, (4, 4))
            if depth == 16:
                mosaic = np.stack([np.zeros_like(mosaic), mosaic], -1)
            image = decode_image(mosaic.tobytes(), 8, 8, depth, f'bayer_{pattern}{depth}')
            assert_array_equal(image[2:6, 2:6], np.broadcast_to(color, (4, 4, 3)))


def test_wrong_pictures_are_refused_with_the_reason():
    good = {'data': b'1' * 144, 'height': 6, 'width': 8, 'step': 24, 'encoding': 'bgr8'}
    for change, reason in (
        ({'encoding': 'hsv9'}, 'unsupported encoding'), ({'width': 0}, 'empty'),
        ({'step': 0, 'width': 7}, 'step is 0'), ({'data': b'1' * 143}, 'data size'),
        ({'data': b'1' * 145}, 'data size'), ({'height': 2**63}, 'data size'),
        ({'width': 9}, 'step is shorter'),
        ({'encoding': 'yuv422', 'width': 7, 'step': 24}, 'unusable'),
    ):  # fmt: skip
        with pytest.raises(CameraError, match=reason):
            decode_image(**{**good, **change})
    assert_array_equal(decode_image(**{**good, 'step': 0}), decode_image(**good))


def test_no_encoding_dies_of_a_tiny_or_odd_picture():
    for encoding in ENCODINGS:
        for height, width in ((1, 1), (3, 5), (1, 2), (2, 1)):
            step = 8 * width
            for rows in (height, height * 3 // 2):
                try:
                    image = decode_image(bytes(rows * step), height, width, step, encoding)
                except CameraError:
                    continue
                assert image.shape == (height, width, 3)


def test_files_of_every_kind():
    smooth = cv2.resize(np.random.default_rng(2).integers(0, 256, (4, 4, 3), np.uint8), (64, 48))
    for suffix in ('.png', '.bmp', '.ppm', '.tiff', '.jpg', '.webp'):
        image = decode_compressed(cv2.imencode(suffix, smooth)[1].tobytes())
        assert np.abs(image.astype(int) - smooth).mean() < (3 if suffix == '.jpg' else 1), suffix
    jpeg = decode_compressed(encode_jpeg(smooth, 95), 'bgr8; jpeg compressed bgr8')
    assert np.abs(jpeg.astype(int) - smooth).mean() < 3
    assert len(encode_jpeg(smooth, 20)) < len(encode_jpeg(smooth, 95))
    mosaic = np.tile(np.array([[255, 0], [0, 0]], np.uint8), (4, 4))
    image = decode_compressed(encode_png(mosaic), 'bayer_rggb8; png compressed ')
    assert (image[2:6, 2:6] == RED).all(), 'a mosaic'
    plain = decode_compressed(encode_png(mosaic), 'bayer_rggb8; png compressed bgr8')
    assert plain[2, 2].tolist() == [255, 255, 255]


def test_wrong_files_are_refused_with_the_reason():
    whole = encode_jpeg(noise(), 90)
    for data, kind, reason in (
        (b'', 'jpeg', 'empty'), (b'hello, not a picture', 'jpeg', 'not an image file'),
        (whole[: len(whole) // 2], 'jpeg', 'cut-off'),
        (b'1234', '16UC1; compressedDepth', 'depth'),
    ):  # fmt: skip
        with pytest.raises(CameraError, match=reason):
            decode_compressed(data, kind)


@pytest.mark.parametrize('restart_interval', [0, 1, 7])
def test_a_jpeg_whose_data_are_lost_is_refused_and_a_gray_one_is_not(restart_interval):
    """Data are lost between the markers of begin and end; cameras may add some at the end."""
    rng = np.random.default_rng(3)
    scene = cv2.resize(rng.integers(0, 256, (12, 40, 3), np.uint8), (250, 100))
    masked, below, dark = scene.copy(), scene.copy(), scene // 20
    masked[:, 150:], below[60:] = 128, 0
    complete = [scene, scene[..., 0], masked, below, dark, np.full_like(scene, 128)]
    for image in complete:
        options = [cv2.IMWRITE_JPEG_RST_INTERVAL, restart_interval]
        jpeg = cv2.imencode('.jpg', image, options)[1].tobytes()
        for whole in (jpeg, jpeg[:-2] + b'extra' + jpeg[-2:]):
            assert decode_compressed(whole).shape == (100, 250, 3)
    jpeg = cv2.imencode('.jpg', scene, options)[1].tobytes()
    for start, length in rng.uniform((0.3, 0.1), (0.7, 0.3), (20, 2)):
        first, end = int(start * len(jpeg)), int((start + length) * len(jpeg))
        with pytest.raises(CameraError, match='cut-off JPEG'):
            decode_compressed(jpeg[:first] + jpeg[end:])
