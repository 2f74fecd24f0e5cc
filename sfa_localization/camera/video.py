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
from typing import Any

from sfa_localization.camera.encodings import decode_compressed, read_raw
from sfa_localization.data.errors import CameraError
from sfa_localization.data.run import Image

StampedImage = tuple[int, Image | CameraError]
"""Stamp, ns, and image (H, W, 3) uint8 BGR; an error in place of an unusable one."""
NO_IMAGE = 'parameters of a video, without an image'
TOO_EARLY = 'video before its first key frame'
AFTER_LOSS = 'video after a lost or damaged packet, before the next key frame'
_CODECS = {'h264|x264|avc': 'h264', 'h265|x265|hevc': 'hevc'}
"""FFmpeg's decoders by the names of codecs in formats."""
_OTHERS = 'av1|vp8|vp9|mpeg4'  # a loss would not be noticed in them
# in FFmpeg's log
_GAP = 'Frame num gap'
_ONLY_PARAMETERS = 'no frame!'


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
        if not codec:
            self._video = None
            return [(stamp_ns, decode_compressed(message.data, format))]
        if len(message.data) == 0:
            raise CameraError('empty image')
        if self._video is None or self._video.codec != codec:
            self._video = _Video(codec)
        return self._video.add(stamp_ns, bytes(message.data))

    def finish(self) -> list[StampedImage]:
        """The images that a video has delayed, at its end."""
        return self._video.finish() if self._video is not None else []


def _codec_of(format: str) -> str:
    """FFmpeg's decoder of a format such as 'h264', 'H.265' or 'libx264;yuv420p'; '' for image
    files. Raises CameraError for another codec.
    """
    name = re.sub('[^a-z0-9]', '', format.lower().partition(';')[0])
    if re.search(_OTHERS, name):
        raise CameraError(f'video of format {format!r} cannot be read: record h264')
    return next((codec for names, codec in _CODECS.items() if re.search(names, name)), '')


class _Video:
    """Decodes packets that are whole images, with start codes (Annex B).

    Images come out in the order in which they are shown, and take the stamps of packets in
    increasing order: a publisher stamps packets by their image, or as it sends them. Raises
    CameraError where PyAV is not installed.
    """

    def __init__(self, codec: str) -> None:
        try:
            import av
        except ImportError:
            raise CameraError(f'{codec} video needs PyAV: pip install av') from None
        self.codec = codec
        self._av = av
        self._decoder: Any = av.CodecContext.create(codec, 'r')
        self._decoder.options = {'err_detect': 'explode'}  # else FFmpeg paints over damage
        self._number = 0
        self._waiting: dict[int, int] = {}
        """Stamps, ns, of the packets whose images have not come out, by number of packet."""
        self._first = 1
        self._why = TOO_EARLY

    def add(self, stamp_ns: int, data: bytes) -> list[StampedImage]:
        """The images that are complete with a packet, and errors for those that are lost."""
        packet = self._av.Packet(data)
        self._number += 1
        self._waiting[self._number] = stamp_ns
        packet.pts = self._number
        return self._decode(packet)

    def finish(self) -> list[StampedImage]:
        """The delayed images, and errors for those that are lost."""
        return self._decode(None) + self._reject(self._waiting, self._why)

    def _decode(self, packet: Any) -> list[StampedImage]:
        """The images that are complete with a packet, or with the end."""
        frames = None
        logging = self._av.logging
        level = logging.get_level()
        logging.set_level(logging.DEBUG)  # only its log tells that a packet of H.264 is missing
        with logging.Capture(local=False) as log, contextlib.suppress(self._av.FFmpegError):
            frames = self._decoder.decode(packet)
        logging.set_level(level)
        told = ''.join(text for *_, text in log)
        if _ONLY_PARAMETERS in told:
            return self._reject([self._number], NO_IMAGE)
        is_missing = _GAP in told and self._number > self._first
        if frames is None or is_missing or any(frame.is_corrupt for frame in frames):
            self._decoder.flush_buffers()  # until a key frame, FFmpeg shows nothing
            self._first = self._number + 1
            return self._reject(self._waiting, self._why)
        return [result for frame in frames for result in self._shown(frame)]

    def _shown(self, frame: Any) -> list[StampedImage]:
        """A frame's image, and errors for those that should have been shown before it."""
        number = frame.pts
        waiting = self._waiting
        lost = list[int]()
        if frame.key_frame or not self._decoder.has_b_frames:
            lost = [n for n in waiting if n < number]
        results = self._reject(lost, self._why)
        self._why = AFTER_LOSS
        if number in waiting:
            first = min(waiting, key=waiting.__getitem__)
            stamp_ns = waiting[first]
            waiting[first] = waiting[number]
            del waiting[number]
            results.append((stamp_ns, frame.to_ndarray(format='bgr24')))
        return results

    def _reject(self, numbers: Iterable[int], why: str) -> list[StampedImage]:
        return [(self._waiting.pop(number), CameraError(why)) for number in [*numbers]]
