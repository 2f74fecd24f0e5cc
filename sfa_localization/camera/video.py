# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Images of a topic in the order of its messages: single ones, or H.264 and H.265 video.

A packet of a video holds what has changed since the images before it: decoding starts at a key
frame, and after a lost or damaged packet again at the next one. PyAV decodes.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable
from typing import Any, NamedTuple

from sfa_localization.camera.encodings import decode_compressed, read_raw
from sfa_localization.data.errors import CameraError
from sfa_localization.data.run import Image

StampedImage = tuple[int, Image | CameraError]
"""Stamp, ns, and image (H, W, 3) uint8 BGR; an error in place of an unusable one."""
NO_IMAGE = 'parameters of a video, without an image'
TOO_EARLY = 'video before its first key frame'
AFTER_LOSS = 'video after a lost or damaged packet, before the next key frame'


class _Codec(NamedTuple):
    """A codec: its name in formats and in FFmpeg, and the type of a unit (7.3.1 of ITU-T H.264 and
    H.265), in `bits` of its first byte, for images and for key frames.
    """

    names: str
    decoder: str
    bits: slice
    images: range
    keys: range


_H264 = _Codec('h264|x264|avc', 'h264', slice(3, 8), range(1, 6), range(5, 6))
_HEVC = _Codec('h265|x265|hevc', 'hevc', slice(1, 7), range(32), range(16, 24))
_OTHERS = 'av1|vp8|vp9|mpeg4'  # a loss would not be noticed in them
_PARAMETERS_SIZE = 10_000  # bytes before an image that publishers may send alone: some hundred
_PARAMETERS = 7  # type of a unit of H.264 with the parameters of the images after it
_HIGH_PROFILES = (44, 83, 86, 100, 110, 118, 122, 128, 138, 139, 244)
"""Profiles of H.264 whose parameters begin with those of colors (7.3.2.1.1)."""


class ImageReader:
    """Reads the messages of one topic in their order.

    `kind` is the name of their type: Image, CompressedImage, FFMPEGPacket (ffmpeg_image_transport)
    or CompressedVideo (Foxglove).
    """

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._video: _Video | None = None

    @property
    def is_video(self) -> bool:
        """Whether the last message was a packet of a video."""
        return self._video is not None

    def add(self, stamp_ns: int, message: Any) -> list[StampedImage]:
        """The images that are complete with a message: of a video, those of earlier messages too,
        and none while it delays them. Raises CameraError for an unusable message.
        """
        if self._kind == 'Image':
            return [(stamp_ns, read_raw(message))]
        format = message.encoding if self._kind == 'FFMPEGPacket' else message.format
        codec = _codec_of(format)
        if codec is None:
            self._video = None
            return [(stamp_ns, decode_compressed(message.data, format))]
        if len(message.data) == 0:
            raise CameraError('empty image')
        if self._video is None or self._video.codec is not codec:
            self._video = _Video(codec)
        return self._video.add(stamp_ns, bytes(message.data))

    def finish(self) -> list[StampedImage]:
        """The images that a video has delayed, at its end."""
        return self._video.finish() if self._video is not None else []


def _codec_of(format: str) -> _Codec | None:
    """The codec of a format such as 'h264', 'H.265' or 'libx264;yuv420p'; None of image files.

    Raises CameraError for another codec.
    """
    name = re.sub('[^a-z0-9]', '', format.lower().partition(';')[0])
    if re.search(_OTHERS, name):
        raise CameraError(f'video of format {format!r} cannot be read: record h264')
    return next((codec for codec in (_H264, _HEVC) if re.search(codec.names, name)), None)


class _Video:
    """Decodes packets that are whole images, with start codes (Annex B).

    Images come out in the order in which they are shown, and take the stamps of packets in
    increasing order: a publisher stamps packets by their image, or as it sends them. Raises
    CameraError where PyAV is not installed.
    """

    def __init__(self, codec: _Codec) -> None:
        try:
            import av
        except ImportError:
            raise CameraError(f'{codec.decoder} video needs PyAV: pip install av') from None
        self.codec, self._av = codec, av
        self._decoder: Any = av.CodecContext.create(codec.decoder, 'r')
        self._decoder.options = {'err_detect': 'explode'}  # else FFmpeg paints over damage
        self._frames = _FrameNumbers()
        self._data, self._packets, self._last_ns = b'', 0, 0
        self._waiting: dict[int, int] = {}
        """Stamps, ns, of the packets whose images have not come out, by number of packet."""
        self._started, self._why = False, TOO_EARLY

    def add(self, stamp_ns: int, data: bytes) -> list[StampedImage]:
        """The images that are complete with a packet, and errors for those that are lost."""
        units = [_bits(unit) for unit in data.split(b'\0\0\1')[1:]]
        kinds = [int(unit[self.codec.bits], 2) for unit in units]
        lost: list[StampedImage] = []
        if self.codec is _H264 and self._frames.are_missing(zip(kinds, units, strict=True)):
            lost = self._restart()
        self._data = self._data[-_PARAMETERS_SIZE:] + data
        if units and not any(kind in self.codec.images for kind in kinds):
            return [*lost, (stamp_ns, CameraError(NO_IMAGE))]
        self._packets += 1
        self._waiting[self._packets] = stamp_ns
        self._started |= any(kind in self.codec.keys for kind in kinds)
        results, self._data = lost + self._decode(self._data), b''
        return results if self._started else results + self._reject(self._waiting, self._why)

    def finish(self) -> list[StampedImage]:
        """The delayed images, and errors for those that are lost."""
        return self._decode(None) + self._reject(self._waiting, AFTER_LOSS)

    def _decode(self, data: bytes | None) -> list[StampedImage]:
        packet, results = None if data is None else self._av.Packet(data), list[StampedImage]()
        if packet is not None:
            packet.pts = self._packets
        try:
            for frame in self._decoder.decode(packet):
                if frame.is_corrupt:
                    return results + self._restart()
                results += self._shown(frame)
        except self._av.FFmpegError:
            results += self._restart()
        return results

    def _shown(self, frame: Any) -> list[StampedImage]:
        """A frame's image, and errors for those that should have been shown before a key frame."""
        number, waiting = frame.pts, self._waiting
        lost = [n for n in waiting if n < number] if frame.key_frame else []
        results = self._reject(lost, self._why)
        self._started, self._why = True, AFTER_LOSS
        if number in waiting:
            later = [n for n in waiting if waiting[n] > self._last_ns] or [number]
            first = min(later, key=waiting.__getitem__)
            waiting[first], self._last_ns = waiting[number], waiting[first]
            del waiting[number]
            results.append((self._last_ns, frame.to_ndarray(format='bgr24')))
        return results

    def _restart(self) -> list[StampedImage]:
        """Wait for a key frame; errors for the images that are lost."""
        self._decoder.flush_buffers()
        self._started = False
        return self._reject(self._waiting, self._why)

    def _reject(self, numbers: Iterable[int], why: str) -> list[StampedImage]:
        return [(self._waiting.pop(number), CameraError(why)) for number in [*numbers]]


class _FrameNumbers:
    """Notices lost frames of H.264: FFmpeg shows others in their place, without an error.

    The frame_num of an image (7.4.3) is that of the last reference, or the next.
    """

    def __init__(self) -> None:
        self._length = 0
        self._last: int | None = None

    def are_missing(self, units: Iterable[tuple[int, str]]) -> bool:
        """Whether references are missing before a packet, by the types and bits of its units."""
        missing = False
        with contextlib.suppress(ValueError, IndexError):  # in damaged packets
            for kind, bits in units:
                if kind == _PARAMETERS:
                    self._length = _frame_num_length(bits)
                elif kind in (1, 5) and self._length:
                    number = int(_skip(bits[8:], 3)[: self._length], 2)
                    step = 0 if self._last is None else (number - self._last) % (1 << self._length)
                    missing |= step > 1 and kind not in _H264.keys
                    self._last = number if '1' in bits[1:3] else self._last
        return missing


def _frame_num_length(bits: str) -> int:
    """Bits of frame_num by the bits of a parameter set; 0 where they are not found."""
    rest = _skip(bits[32:], 1)
    if int(bits[8:16], 2) in _HIGH_PROFILES:
        has_planes = rest.startswith('00100')
        rest = _skip(_skip(rest, 1)[has_planes:], 2)
        if rest[1] == '1':  # matrices of different lengths
            return 0
        rest = rest[2:]
    zeros = rest.index('1')
    return 3 + int(rest[zeros : 2 * zeros + 1], 2)


def _skip(bits: str, count: int) -> str:
    """The bits after `count` numbers in the Exp-Golomb code (9.1)."""
    for _ in range(count):
        bits = bits[2 * bits.index('1') + 1 :]
    return bits


def _bits(unit: bytes) -> str:
    """The first bits of a unit, without the bytes that prevent start codes in it."""
    start = unit[:40].replace(b'\0\0\3', b'\0\0').ljust(64, b'\xff')
    return ''.join(f'{byte:08b}' for byte in start)
