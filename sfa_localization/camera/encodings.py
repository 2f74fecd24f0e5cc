# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Image data as cameras and bags deliver it, to and from BGR uint8 arrays (H, W, 3).

The encodings are those of ``sensor_msgs/image_encodings``. 16-bit images keep the upper 8 of
their significant bits, an alpha channel is dropped, gray becomes three equal channels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.camera.image_headers import check_size
from sfa_localization.data.errors import CameraError, MessageError
from sfa_localization.data.run import Image


@dataclass(frozen=True, slots=True)
class _Layout:
    """How an encoding stores a row: channels of `depth` bytes, then a conversion to BGR."""

    channels: int
    depth: int = 1
    code: int | None = None
    rows: tuple[int, int] = (1, 1)  # rows of data per row of image, as a fraction


_GREY, _RGB, _BGRA, _RGBA = (
    cv2.COLOR_GRAY2BGR,
    cv2.COLOR_RGB2BGR,
    cv2.COLOR_BGRA2BGR,
    cv2.COLOR_RGBA2BGR,
)
# OpenCV names a Bayer pattern by its second row's middle pixels, ROS by its first four.
_BAYER = {
    'bayer_rggb': cv2.COLOR_BayerBG2BGR,
    'bayer_bggr': cv2.COLOR_BayerRG2BGR,
    'bayer_gbrg': cv2.COLOR_BayerGR2BGR,
    'bayer_grbg': cv2.COLOR_BayerGB2BGR,
}
_UYVY, _YUYV = _Layout(2, code=cv2.COLOR_YUV2BGR_UYVY), _Layout(2, code=cv2.COLOR_YUV2BGR_YUY2)
_LAYOUTS = {
    'mono8': _Layout(1, code=_GREY),
    'mono16': _Layout(1, 2, _GREY),
    'bgr8': _Layout(3),
    'rgb8': _Layout(3, code=_RGB),
    'bgra8': _Layout(4, code=_BGRA),
    'rgba8': _Layout(4, code=_RGBA),
    'bgr16': _Layout(3, 2),
    'rgb16': _Layout(3, 2, _RGB),
    'bgra16': _Layout(4, 2, _BGRA),
    'rgba16': _Layout(4, 2, _RGBA),
    '8uc1': _Layout(1, code=_GREY),
    '8uc3': _Layout(3),
    '8uc4': _Layout(4, code=_BGRA),
    '16uc1': _Layout(1, 2, _GREY),
    '16uc3': _Layout(3, 2),
    '16uc4': _Layout(4, 2, _BGRA),
    'yuv422': _UYVY,
    'uyvy': _UYVY,
    'yuv422_yuy2': _YUYV,
    'yuyv': _YUYV,
    'nv12': _Layout(1, code=cv2.COLOR_YUV2BGR_NV12, rows=(3, 2)),
    'nv21': _Layout(1, code=cv2.COLOR_YUV2BGR_NV21, rows=(3, 2)),
    **{f'{name}8': _Layout(1, 1, code) for name, code in _BAYER.items()},
    **{f'{name}16': _Layout(1, 2, code) for name, code in _BAYER.items()},
}
_SENSOR_BITS = (10, 12, 14, 16)  # of the pixels of cameras that send two bytes for each
LARGEST_FILE = 1 << 28
"""Bytes of a file that a camera or its operator writes: as many as its pixels may have."""
ENCODINGS = tuple(_LAYOUTS)
"""The encodings that `decode_image` understands, in lower case."""


def decode_image(
    data: Any,
    height: int,
    width: int,
    step: int,
    encoding: str,
    is_bigendian: bool = False,
) -> Image:
    """Decode raw image data, as in ``sensor_msgs/Image``, to BGR (height, width, 3) uint8.

    `data` is any buffer of bytes, `step` the bytes from one row to the next. The result may be
    a read-only view of `data`. Raises CameraError with the reason in a few words.
    """
    layout = _LAYOUTS.get(encoding.lower())
    if layout is None:
        raise CameraError(f'unsupported encoding {encoding!r}')
    if min(height, width, step) <= 0:
        raise CameraError('empty image')
    rows = _rows(data, height * layout.rows[0] // layout.rows[1], step)
    return _to_bgr(_pixels(rows, width, layout, is_bigendian), layout)


def _rows(data: Any, rows: int, step: int) -> NDArray[np.uint8]:
    """Bytes as (rows, step), or CameraError when their number is another."""
    buffer = np.frombuffer(data, np.uint8) if len(data) else np.empty(0, np.uint8)
    if buffer.size != rows * step:
        raise CameraError('data size is not rows times step')
    return buffer.reshape(rows, step)


def _pixels(
    rows: NDArray[np.uint8], width: int, layout: _Layout, is_bigendian: bool
) -> NDArray[np.uint8]:
    """Pixels (rows, width[, channels]) without the rows' padding, reduced to 8 bits."""
    used = width * layout.channels * layout.depth
    if rows.shape[1] < used:
        raise CameraError('step is shorter than a row')
    packed = rows[:, :used]
    if layout.depth == 2:
        words = np.ascontiguousarray(packed).view('>u2' if is_bigendian else '<u2')
        packed = _to_8_bits(words)
    if layout.channels == 1:
        return packed
    return packed.reshape(len(rows), width, layout.channels)


def _to_8_bits(words: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """The upper 8 of the significant bits, which no message names: as many as the image needs.

    Of each image alone, so that training and nodes see the same. Fewer than the 10 of the coarsest
    sensors it never has: an image of a few levels is dark.
    """
    need = int(words.max(initial=0)).bit_length()
    bits = next(bits for bits in _SENSOR_BITS if need <= bits)
    return (words >> (bits - 8)).astype(np.uint8)


def _to_bgr(pixels: NDArray[np.uint8], layout: _Layout) -> Image:
    if layout.code is None:
        return np.ascontiguousarray(pixels)
    return np.asarray(_checked(cv2.cvtColor, np.ascontiguousarray(pixels), layout.code))


def _checked(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call OpenCV; its error becomes a CameraError."""
    try:
        return function(*arguments)
    except cv2.error as error:
        raise CameraError(f'unusable image data ({error.err})') from None


def decode_compressed(data: Any, format: str = '') -> Image:
    """Decode a JPEG, PNG, BMP, PNM, TIFF or WebP file to BGR (H, W, 3) uint8.

    `format` is that of ``sensor_msgs/CompressedImage``; it matters only for a Bayer mosaic that
    was compressed as it is. A truncated JPEG is rejected, because OpenCV would fill it with gray,
    and an image of more than MOST_PIXELS before it is decoded.
    Raises CameraError with the reason in a few words.
    """
    if 'compresseddepth' in format.lower():
        raise CameraError('a depth image is no camera image')
    buffer = np.frombuffer(data, np.uint8) if len(data) else np.empty(0, np.uint8)
    if buffer.size == 0:
        raise CameraError('empty image')
    if _is_truncated_jpeg(buffer):
        raise CameraError('truncated JPEG')
    original, _, packed = format.lower().partition(';')
    if original.startswith('bayer_') and 'bgr' not in packed and 'rgb' not in packed:
        return _demosaiced(buffer, original.strip())
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    return _decoded(buffer, flags)


def _is_truncated_jpeg(buffer: NDArray[np.uint8]) -> bool:
    data = buffer.tobytes()
    return data[:2] == b'\xff\xd8' and data.rfind(b'\xff\xd9') < 0


def _decoded(buffer: NDArray[np.uint8], flags: int) -> Image:
    check_size(buffer.tobytes())
    image = _checked(cv2.imdecode, buffer, flags | cv2.IMREAD_ANYDEPTH)
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise CameraError('not an image file that OpenCV reads')
    return _to_8_bits(image) if image.dtype == np.uint16 else np.asarray(image)


def _demosaiced(buffer: NDArray[np.uint8], encoding: str) -> Image:
    mosaic = _decoded(buffer, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    name = f'{encoding.rstrip("0123456789")}8'
    height, width = mosaic.shape
    return decode_image(mosaic.tobytes(), height, width, width, name)


def encode_jpeg(image: Image, quality: int) -> bytes:
    """Encode a BGR image (H, W, 3) as JPEG of `quality` 1..100."""
    return _encoded('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, int(quality)])


def encode_png(image: Image) -> bytes:
    """Encode a BGR image (H, W, 3) as PNG, without loss."""
    return _encoded('.png', image, [])


def _encoded(suffix: str, image: Image, options: list[int]) -> bytes:
    done, buffer = _checked(cv2.imencode, suffix, image, options)
    if not done:
        raise CameraError(f'an image of shape {image.shape} cannot be written as {suffix}')
    return bytes(buffer.tobytes())


def read_raw(message: Any) -> Image:
    """Image (H, W, 3) uint8 BGR of an Image."""
    try:
        return decode_image(
            message.data,
            message.height,
            message.width,
            message.step,
            message.encoding,
            bool(message.is_bigendian),
        )
    except CameraError as error:
        raise MessageError(str(error)) from None


def read_compressed(message: Any) -> Image:
    """Image (H, W, 3) uint8 BGR of a CompressedImage."""
    try:
        return decode_compressed(message.data, message.format)
    except CameraError as error:
        raise MessageError(str(error)) from None
