# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Images of H.264 and H.265 video: each with its stamp, and none with what a lost packet leaves."""

import sys
from collections import Counter
from fractions import Fraction
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from sfa_localization.bags.drives import ReadingRecipe, images_at, read_drive
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.writer import BagWriter, blank
from sfa_localization.camera import video
from sfa_localization.camera.video import ImageReader
from sfa_localization.data.errors import BagError, CameraError
from sfa_localization.inspection import inspect

START, STEP = 1_700_000_000_000_000_000, 100_000_000
SIZE = 320, 32
KINDS = {
    'sensor_msgs/msg/CompressedImage': '/camera/compressed',
    'foxglove_msgs/msg/CompressedVideo': '/video',
    'ffmpeg_image_transport_msgs/msg/FFMPEGPacket': '/camera/image_raw/ffmpeg',
}


def scene(number):
    """A panorama that turns by 8 columns from image to image."""
    noise = np.random.default_rng(0).integers(0, 256, (4, 40, 3), np.uint8)
    return np.roll(cv2.resize(noise, SIZE, interpolation=cv2.INTER_CUBIC), 8 * number, 1)


def encoded(count=24, codec='libx264', between=0, key_every=8):
    """Number of the image and bytes of each packet, with `between` images out of order."""
    av = pytest.importorskip('av')
    encoder = av.CodecContext.create(codec, 'w')
    encoder.width, encoder.height = SIZE
    encoder.pix_fmt, encoder.time_base = 'yuv420p', Fraction(1, 10)
    hevc = f'log-level=none:keyint={key_every}:min-keyint={key_every}:bframes={between}:b-adapt=0'
    encoder.options = {'preset': 'ultrafast', 'crf': '10', 'g': str(key_every), 'bf': str(between)}
    encoder.options |= {'x265-params': hevc} if codec == 'libx265' else {}
    encoder.options |= {} if between else {'tune': 'zerolatency'}
    packets = []
    for number in range(count):
        frame = av.VideoFrame.from_ndarray(scene(number), format='bgr24').reformat(format='yuv420p')
        frame.pts = number
        packets += encoder.encode(frame)
    return [(packet.pts, bytes(packet)) for packet in [*packets, *encoder.encode(None)]]


def read(packets, format='h264', stamps=None):
    """Numbers of the images that packets show, by stamp; and the numbers of reasons without one."""
    reader, results = ImageReader('CompressedImage'), []
    for stamp, (_, data) in zip(stamps or [n for n, _ in packets], packets, strict=True):
        results += reader.add(stamp + 1, SimpleNamespace(format=format, data=data))
    results += reader.finish()
    shown, reasons = {}, Counter()
    for stamp_ns, image in results:
        if isinstance(image, CameraError):
            reasons[str(image)] += 1
            continue
        errors = [np.abs(image.astype(int) - scene(n)).mean() for n in range(24)]
        assert min(errors) < 12, 'smeared'
        shown[stamp_ns - 1] = int(np.argmin(errors))
    assert len(results) == len(packets)
    return shown, reasons


CODECS = [('libx264', 'h264'), ('libx265', 'H.265'), ('libx264', 'libx264;yuv420p;bgr8')]


@pytest.mark.parametrize(('codec', 'format'), CODECS)
@pytest.mark.parametrize('between', [0, 2])
def test_each_image_has_its_stamp(codec, format, between):
    """Whether packets are stamped by their images, or as they are sent: then the order counts."""
    packets = encoded(codec=codec, between=between)
    assert ([n for n, _ in packets] != sorted(n for n, _ in packets)) == bool(between)
    for stamps in (None, range(24)):
        assert read(packets, format, stamps) == ({n: n for n in range(24)}, {})


@pytest.mark.parametrize(('codec', 'format'), CODECS[:2])
def test_images_after_a_lost_or_damaged_packet_wait_for_the_next_key_frame(codec, format):
    packets = encoded(codec=codec)
    damaged = [(n, data[: len(data) // 2] if n == 10 else data) for n, data in packets]
    for received, hidden, reasons in (
        (damaged, range(10, 16), {video.AFTER_LOSS: 6}),
        (packets[:11] + packets[13:], range(11, 16), {video.AFTER_LOSS: 3}),
        (packets[:11] + packets[16:], range(11, 16), {}),
        (packets[3:], range(8), {video.TOO_EARLY: 5}),
    ):
        if codec == 'libx264' or received is not damaged:  # H.265 is decoded past its end
            assert read(received, format) == ({n: n for n in range(24) if n not in hidden}, reasons)


def test_parameters_of_a_video_may_come_alone():
    messages = []
    for number, data in encoded(key_every=12):
        start = data.find(b'\0\0\1\x65') if number % 12 == 0 else 0
        messages += [(number, part) for part in (data[:start], data[start:]) if part]
    shown, reasons = read(messages)
    assert shown == {n: n for n in range(24)} and reasons == {video.NO_IMAGE: 2}


def test_no_damage_raises_another_error():
    rng, packets = np.random.default_rng(0), encoded()
    for _ in range(30):
        reader = ImageReader('CompressedImage')
        for number, data in packets:
            bytes_ = np.frombuffer(data, np.uint8).copy()
            bytes_[rng.integers(0, len(bytes_), rng.integers(0, 4))] = rng.integers(256)
            part = bytes_[: rng.integers(len(bytes_) + 1)].tobytes() or b'\0'
            reader.add(number + 1, SimpleNamespace(format='h264', data=part))
        reader.finish()


def test_without_the_library_or_a_codec_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'av', None)
    for format, words in (('h264', 'pip install av'), ('av1', "'av1' cannot be read: record h264")):
        with pytest.raises(CameraError, match=words):
            ImageReader('CompressedImage').add(1, SimpleNamespace(format=format, data=b'0'))


def record(path, kind, packets, also=()):
    """A bag whose images are packets, with odometry and images on other topics."""
    with BagWriter(path) as bag:
        for topic in also:
            bag.image(topic, START, scene(0), 'camera', 'jpeg')
        for number, data in packets:
            at = START + STEP * number
            message = blank(bag._types, kind)
            message.data = np.frombuffer(data, np.uint8)
            if 'Video' in kind:
                message.timestamp.sec, message.timestamp.nanosec = divmod(at, 10**9)
            else:
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(at, 10**9)
            setattr(message, 'encoding' if 'FFMPEG' in kind else 'format', 'h264')
            bag.odometry('/odom', at, (0.1 * number, 0, 0), (1, 0), (0, 0))
            bag.message(KINDS[kind], at, message)
    return path


def test_single_images_are_preferred_to_video_beside_them(tmp_path):
    kind = 'foxglove_msgs/msg/CompressedVideo'
    with Bag(record(tmp_path / 'bag', kind, [(0, b'0')], ['/camera/compressed'])) as bag:
        assert bag.find('image') == '/camera/compressed'
        assert bag.find('image', '/video') == '/video'


@pytest.mark.parametrize('kind', KINDS)
def test_bags_of_each_type_are_read_and_reported(tmp_path, kind, monkeypatch):
    """Also a single image, which needs all packets before it."""
    path = record(tmp_path / 'bag', kind, encoded()[3:])
    with Bag(path) as bag:
        read = {(at - START) // STEP: image for at, image in bag.images()}
        assert bag.counts[KINDS[kind]].skipped == {video.TOO_EARLY: 5}
    assert list(read) == list(range(8, 24))
    assert len(read_drive(path, tmp_path).panoramas) == 16
    (report,) = (topic for topic in inspect(path).topics if topic.name == KINDS[kind])
    assert report.problems == [f'5 of 21 messages: {video.TOO_EARLY}']
    (alone,) = images_at(path, [START + 13 * STEP], ReadingRecipe()).values()
    assert_array_equal(alone, read[13])
    monkeypatch.setitem(sys.modules, 'av', None)
    with pytest.raises(BagError, match=r'21 h264 video needs PyAV: pip install av'):
        read_drive(path, tmp_path)
