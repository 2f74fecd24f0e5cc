# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Image data as cameras and bags deliver it, to and from BGR uint8 arrays (H, W, 3).

The encodings are those of ``sensor_msgs/image_encodings``. 16-bit images keep the upper 8 of
their significant bits, an alpha channel is dropped, gray becomes three equal channels.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import CameraError
from sfa_localization.data.files import read_regular
from sfa_localization.data.run import Image


@dataclass(frozen=True, slots=True)
class _Layout:
    """How an encoding stores a row: channels of `depth` bytes, then a conversion to BGR."""

    channels: int
    depth: int = 1
    code: int | None = None
    rows: tuple[int, int] = (1, 1)  # rows of data per row of image, as a fraction


# OpenCV names a Bayer pattern by its second row's middle pixels, ROS by its first four.
_COLORS = {
    'mono': _Layout(1, code=cv2.COLOR_GRAY2BGR),
    'bgr': _Layout(3),
    'rgb': _Layout(3, code=cv2.COLOR_RGB2BGR),
    'bgra': _Layout(4, code=cv2.COLOR_BGRA2BGR),
    'rgba': _Layout(4, code=cv2.COLOR_RGBA2BGR),
    'bayer_rggb': _Layout(1, code=cv2.COLOR_BayerBG2BGR),
    'bayer_bggr': _Layout(1, code=cv2.COLOR_BayerRG2BGR),
    'bayer_gbrg': _Layout(1, code=cv2.COLOR_BayerGR2BGR),
    'bayer_grbg': _Layout(1, code=cv2.COLOR_BayerGB2BGR),
}
_LAYOUTS = {
    f'{name}{8 * depth}': replace(layout, depth=depth)
    for name, layout in _COLORS.items()
    for depth in (1, 2)
}
for _depth in ('8', '16'):
    for _channels, _name in (('1', 'mono'), ('3', 'bgr'), ('4', 'bgra')):
        _LAYOUTS[f'{_depth}uc{_channels}'] = _LAYOUTS[f'{_name}{_depth}']
_LAYOUTS |= dict.fromkeys(('uyvy', 'yuv422'), _Layout(2, code=cv2.COLOR_YUV2BGR_UYVY))
_LAYOUTS |= dict.fromkeys(('yuyv', 'yuv422_yuy2'), _Layout(2, code=cv2.COLOR_YUV2BGR_YUY2))
_LAYOUTS['nv12'] = _Layout(1, code=cv2.COLOR_YUV2BGR_NV12, rows=(3, 2))
_LAYOUTS['nv21'] = _Layout(1, code=cv2.COLOR_YUV2BGR_NV21, rows=(3, 2))
_SENSOR_BITS = (10, 12, 14, 16)  # depths of pixels that are sent as two bytes
_CUT_OFF = 'cut-off JPEG: the data of a part of it are lost'
_FILL = 128  # gray level of blocks for which libjpeg has no data
# in a JPEG, and the last one
_MARKER = re.compile(rb'\xff[\x01-\xfe]')
_END = b'\xff\xd9'
_RESTARTS = range(0xD0, 0xD8)  # markers between parts of a JPEG, numbered in a circle
_MORE_DATA = bytes(range(1, 65))
_LARGEST_FILE = 1 << 28  # bytes of an image file
JPEG_QUALITY = 90
"""Percent: no visible artifacts, a tenth of the raw size."""
ENCODINGS = tuple(_LAYOUTS)
"""The encodings that `decode_image` understands, in lower case."""


def decode_image(
    data: Any, height: int, width: int, step: int, encoding: str, is_bigendian: bool = False
) -> Image:
    """Decode raw image data, as in ``sensor_msgs/Image``, to BGR (height, width, 3) uint8.

    `data` is any buffer of bytes, `step` the bytes per row: 0, as of drivers that leave it out,
    where rows follow each other without a gap. The result may be a read-only view of `data`. Raises
    CameraError with the reason in a few words.
    """
    layout = _LAYOUTS.get(encoding.lower())
    if layout is None:
        raise CameraError(f'unsupported encoding {encoding!r}')
    if min(height, width) <= 0 or step < 0:
        raise CameraError('empty image')
    buffer = _bytes(data)
    rows = height * layout.rows[0] // layout.rows[1]
    used = width * layout.channels * layout.depth
    if not step and buffer.size != rows * used:
        raise CameraError(
            f'step is 0, but a row has {used} bytes or more: the driver leaves it out'
        )
    step = step or used
    if buffer.size != rows * step:
        raise CameraError('data size is not rows times step')
    if step < used:
        raise CameraError('step is shorter than a row')
    pixels = buffer.reshape(rows, step)[:, :used]
    if layout.depth == 2:
        pixels = _to_8_bits(np.ascontiguousarray(pixels).view('>u2' if is_bigendian else '<u2'))
    if layout.channels > 1:
        pixels = pixels.reshape(rows, width, layout.channels)
    pixels = np.ascontiguousarray(pixels)
    return pixels if layout.code is None else _checked(cv2.cvtColor, pixels, layout.code)


def _bytes(data: Any) -> NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8) if len(data) else np.empty(0, np.uint8)


def _to_8_bits(words: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """The upper 8 of the significant bits: those of the smallest depth that holds the image.

    No message names the depth. Each image is judged alone, so that training and nodes agree.
    """
    needed = int(words.max(initial=0)).bit_length()
    bits = next(bits for bits in _SENSOR_BITS if needed <= bits)
    return (words >> (bits - 8)).astype(np.uint8)


def _checked(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call OpenCV; its error becomes a CameraError."""
    try:
        return function(*arguments)
    except cv2.error as error:
        raise CameraError(f'unusable image data ({error.err})') from None


def decode_compressed(data: Any, format: str = '') -> Image:
    """Decode a JPEG, PNG, BMP, PNM, TIFF or WebP file to BGR (H, W, 3) uint8.

    `format` is that of ``sensor_msgs/CompressedImage``; only a compressed Bayer mosaic needs it. A
    cut-off JPEG is rejected: OpenCV would fill it with gray. Raises CameraError.
    """
    if 'compresseddepth' in format.lower():
        raise CameraError('a depth image is no camera image')
    buffer = _bytes(data)
    if buffer.size == 0:
        raise CameraError('empty image')
    is_jpeg = buffer[:2].tobytes() == b'\xff\xd8'
    if is_jpeg and _END not in buffer.tobytes():
        raise CameraError(_CUT_OFF)
    original, _, packed = format.lower().partition(';')
    mosaic = original.startswith('bayer_') and 'bgr' not in packed and 'rgb' not in packed
    color = cv2.IMREAD_GRAYSCALE if mosaic else cv2.IMREAD_COLOR
    flags = color | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH
    image = _checked(cv2.imdecode, buffer, flags)
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise CameraError('not an image file that OpenCV reads')
    if is_jpeg and _lacks_data(buffer.tobytes(), image, flags):
        raise CameraError(_CUT_OFF)
    image = _to_8_bits(image) if image.dtype == np.uint16 else np.asarray(image)
    if not mosaic:
        return image
    height, width = image.shape
    name = f'{original.strip().rstrip("0123456789")}8'
    return decode_image(image.tobytes(), height, width, width, name)


def _lacks_data(data: bytes, image: Image, flags: int) -> bool:
    """Whether libjpeg had no data for blocks of an image (H, W) or (H, W, 3): it makes them gray.

    They may be gray in the camera's image, too. But more data, before each marker that ends a part
    of the file, change only blocks without data. Lost markers leave a gap in their numbers.
    """
    gray = (image[3::8, ::2] == _FILL).reshape(len(image[3::8]), -1, image[0, 0].size).all(2)
    if not (np.packbits(gray, axis=1) == 255).any():  # eight samples in a row of a block
        return False
    head, start, rest = data.rpartition(b'\xff\xda')
    parts, end, rest = rest.partition(_END)
    restarts = [marker[1] for marker in _MARKER.findall(parts) if marker[1] in _RESTARTS]
    if restarts != [_RESTARTS[k % 8] for k in range(len(restarts))]:
        return True
    parts = _MARKER.sub(lambda marker: _MORE_DATA + marker[0], parts) + _MORE_DATA
    parts += bytes([0xFF, _RESTARTS[len(restarts) % 8]]) + _MORE_DATA if restarts else b''
    longer = np.frombuffer(head + start + parts + end + rest, np.uint8)
    return not np.array_equal(image, _checked(cv2.imdecode, longer, flags))


def read_image(path: Path | str) -> Image:
    """Read an image file as BGR (H, W, 3) uint8. Raises CameraError naming it."""
    try:
        return decode_compressed(read_regular(path, _LARGEST_FILE))
    except (OSError, CameraError) as error:
        raise CameraError(f'{path}: {getattr(error, "strerror", None) or error}') from None


def encode_jpeg(image: Image, quality: int = JPEG_QUALITY) -> bytes:
    """Encode a BGR image (H, W, 3) as JPEG of `quality` 1..100."""
    return _encoded('.jpg', image, cv2.IMWRITE_JPEG_QUALITY, int(quality))


def encode_png(image: Image) -> bytes:
    """Encode a BGR image (H, W, 3) as PNG, without loss."""
    return _encoded('.png', image)


def _encoded(suffix: str, image: Image, *options: int) -> bytes:
    done, buffer = _checked(cv2.imencode, suffix, image, options)
    if not done:
        raise CameraError(f'an image of shape {image.shape} cannot be written as {suffix}')
    return bytes(buffer.tobytes())


def read_raw(message: Any) -> Image:
    """Image (H, W, 3) uint8 BGR of a ``sensor_msgs/Image``. Raises CameraError."""
    size = message.height, message.width, message.step
    return decode_image(message.data, *size, message.encoding, bool(message.is_bigendian))
