# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The omnicam node on real messages: panoramas, demand, bad pictures, live parameters, sources."""

import array
import itertools
import sys
from collections import namedtuple
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import cv2
import numpy as np
import pytest
import test_video
from numpy.testing import assert_array_equal

from sfa_localization.camera import watch
from sfa_localization.camera.calibration_files import calibration_text
from sfa_localization.camera.encodings import decode_compressed
from sfa_localization.camera.leveling import leveled
from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.rim_watch import RimWatch
from sfa_localization.camera.settings import CameraConfig, LensCalibration, PanoramaConfig
from sfa_localization.config import load_settings

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Quaternion
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from ros_bench import until
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from std_msgs.msg import String

from sfa_localization.camera.video import ImageReader
from sfa_localization.data.errors import CameraError, ConfigError
from sfa_localization.data.messages import read_stamp
from sfa_localization.nodes.conversions import (
    read_info,
    to_compressed,
    to_image,
    to_stamp,
)
from sfa_localization.nodes.image_input import ImageInput
from sfa_localization.nodes.lifecycle import latched_qos
from sfa_localization.nodes.omnicam_node import OmnicamNode
from sfa_localization.place_model import PlaceModel

pytestmark = pytest.mark.ros
PANORAMA = PanoramaConfig(width=120, height=12)
SMALL = {'width': 120, 'height': 12, 'camera_model': 'mirror'}
MIRROR = CameraConfig(camera_model='mirror')
STAMP_NS = 12_000_000_034


def raw_picture(seed=1):
    noise = np.random.default_rng(seed).integers(0, 256, (40, 40, 3), np.uint8)
    return cv2.resize(noise, (640, 640), interpolation=cv2.INTER_CUBIC)


CompressedVideo = namedtuple('CompressedVideo', 'timestamp frame_id data format')
"""As in foxglove_msgs, which wheels of ROS lack."""


def message(seed=1, stamp_ns=STAMP_NS):
    return to_image(raw_picture(seed), stamp_ns, 'camera')


def start(bench, **parameters):
    """The node, and the list of the panoramas that it publishes from now on."""
    node = bench.run(OmnicamNode, **SMALL | parameters)
    return node, bench.listen(Image, 'panorama')


def answer(bench, heard, sent, topic='image_raw'):
    """Send until another panorama is heard; the last one."""
    count = len(heard)
    assert bench.publish_until(topic, sent, lambda: len(heard) > count)
    return heard[-1]


def pixels(sent):
    """The image of a message."""
    ((_, image),) = ImageReader(type(sent).__name__).add(1, sent)
    return image


def test_frame_and_quality_of_service_by_parameter(bench, tmp_path):
    """The panorama has the stamp and frame of the picture; the camera by a file of `calibrate`."""
    _, heard = start(bench)
    panorama = answer(bench, heard, message())
    assert (panorama.header.stamp.sec, panorama.header.stamp.nanosec) == (12, 34)
    assert panorama.header.frame_id == 'camera' and panorama.encoding == 'bgr8'
    assert (panorama.height, panorama.width, panorama.step) == (12, 120, 360)
    assert_array_equal(pixels(panorama), Unwrapper(MIRROR, PANORAMA)(raw_picture()))
    bench.end(bench.nodes[0])
    path, turned = tmp_path / 'camera.yaml', (0.0, 0.0, 40.0)
    path.write_text(calibration_text(LensCalibration(mount_rpy=turned)))
    given = {'calibration_file': str(path), 'camera_model': ''}
    node, heard = start(bench, frame_id='mast', **given)
    panorama = answer(bench, heard, message())
    assert panorama.header.frame_id == 'mast'
    camera = replace(MIRROR, mount_rpy=turned)
    assert_array_equal(pixels(panorama), Unwrapper(camera, PANORAMA)(raw_picture()))
    assert node.get_parameter('qos_overrides./image_raw.subscription.depth').value == 1


def test_panoramas_are_leveled_by_an_imu(bench):
    """Or it is reported that they are not."""
    node, heard = start(bench, level_by_imu=True, silence_timeout=3600.0)
    plain, monitor = Unwrapper(MIRROR, PANORAMA)(raw_picture()), node.monitors['imu/data']

    def unwrapped(roll, pitch, after_s=0):
        (a, b), (c, d) = np.cos([roll / 2, pitch / 2]), np.sin([roll / 2, pitch / 2])
        sent = Imu(orientation=Quaternion(w=a * b, x=c * b, y=a * d, z=-c * d))
        sent.header.stamp = to_stamp(STAMP_NS + after_s * 10**9)
        count = monitor.received
        assert bench.publish_until('imu/data', sent, lambda: monitor.received > count)
        return pixels(answer(bench, heard, message()))

    assert_array_equal(pixels(answer(bench, heard, message())), plain)
    assert_array_equal(unwrapped(0.1, 0.0, after_s=1), plain)
    level, text, _ = node.health()
    assert level == DiagnosticStatus.WARN and '/imu/data near images: panoramas are not' in text
    tilt = np.array([0.1, -0.05])
    off = unwrapped(*tilt).astype(int) - leveled(plain, tilt, PANORAMA.sphere)
    assert np.abs(off).max() <= 1 and node.health()[1] == 'running'


def test_compressed_pictures_in_and_out(bench):
    bench.run(OmnicamNode, image_transport='compressed', **SMALL)
    heard = bench.listen(CompressedImage, 'panorama/compressed')
    sent = to_compressed(raw_picture(), STAMP_NS, 'camera', 95)
    told = answer(bench, heard, sent, 'image_raw/compressed')
    assert told.header.stamp.sec == 12
    expected = Unwrapper(MIRROR, PANORAMA)(pixels(sent))
    decoded = decode_compressed(told.data.tobytes())
    assert np.corrcoef(decoded.ravel(), expected.ravel())[0, 1] > 0.6


def test_video_in_of_which_some_packets_may_wait(bench):
    _, heard = start(bench, image_transport='compressed')
    (node,), topic = bench.nodes, 'image_raw/compressed'
    for number, data in itertools.cycle(test_video.encoded()):
        sent = CompressedImage(format='h264', data=array.array('B', data))
        sent.header.stamp = to_stamp(STAMP_NS + number)
        bench.publish(topic, sent)
        if until(lambda: len(heard) >= 12, 0.02):
            break
    for told in heard:
        number = read_stamp(told.header.stamp) - STAMP_NS
        expected = Unwrapper(MIRROR, PANORAMA)(test_video.scene(number))
        assert np.abs(pixels(told) - expected.astype(int)).mean() < 12
    entity = f'qos_overrides./{topic}.subscription_video.depth'
    assert node.get_parameter(entity).value == 30


def test_messages_of_video_of_other_packages(monkeypatch):
    """Their packages are no dependencies."""
    package, node, heard = SimpleNamespace(CompressedVideo=CompressedVideo), mock.Mock(), []
    monkeypatch.setitem(sys.modules, 'foxglove_msgs', package)
    monkeypatch.setitem(sys.modules, 'foxglove_msgs.msg', package)
    images = ImageInput(node, 'foxglove', 'image_raw/foxglove', lambda *seen: heard.append(seen))
    images.start()
    receive = node.subscribe.call_args.args[2]
    packets = test_video.encoded(key_every=12)[8:]
    for number, data in packets:
        with suppress(CameraError):
            receive(CompressedVideo(to_stamp(number), 'camera', data, 'h264'))
    expected = [(number, 'camera') for number, _ in packets if number >= 12]
    assert [(stamp, frame) for stamp, _, frame in heard] == expected


def test_nobody_listens_nothing_is_done(bench):
    node = bench.run(OmnicamNode, **SMALL)
    level, text, _ = node.health()
    assert level == DiagnosticStatus.OK and text.startswith('idle')
    assert node.count_subscribers('image_raw') == 0
    for _ in range(2):
        listener = bench.node.create_subscription(Image, 'panorama', lambda _: None, 1)
        assert until(lambda: node.count_subscribers('image_raw') == 1)
        bench.do(bench.node.destroy_subscription, listener)
        assert until(lambda: node.count_subscribers('image_raw') == 0)


FISHEYE = LensCalibration(
    camera_model='fisheye', fx=200.0, fy=200.0, distortion=(0.1, 0.0, 0.0, 0.0), radius_min=0.0,
    radius_max=0.0,
)  # fmt: skip


def camera_info(model='equidistant', focal=200.0, coefficients=FISHEYE.distortion):
    k = [focal, 0.0, 319.5, 0.0, focal, 319.5, 0.0, 0.0, 1.0]
    return CameraInfo(width=640, height=640, distortion_model=model, k=k, d=coefficients)


@pytest.mark.parametrize(('rule', 'images', 'infos'), [
    ('__node:=omnicam_node', 'image_raw', 'camera_info'),
    ('image_raw:=/front/image', '/front/image', '/front/camera_info'),
    ('camera_info:=/calibration', 'image_raw', '/calibration'),
])  # fmt: skip
def test_camera_info_beside_the_images_describes_the_camera(bench, rule, images, infos):
    """The first that can be used; one that cannot is refused with the remedy."""
    given = {'cli_args': ['--ros-args', '-r', rule]}
    node = bench.run(OmnicamNode, options=given, **SMALL | {'camera_model': ''})
    heard, monitor = bench.listen(Image, 'panorama'), node.monitors['camera_info']
    wrong = camera_info('fov'), camera_info('rational_polynomial', 200.0, [0.1] * 8)
    for number, bad in enumerate([*wrong, camera_info(focal=0.0)], 1):
        assert bench.publish_until(infos, bad, lambda n=number: len(monitor.refused) == n)
    assert all(why.endswith('by a calibration_file') for why in monitor.refused)
    assert bench.publish_until(infos, camera_info(), lambda: monitor.used)
    assert bench.publish_until(infos, camera_info(focal=90.0), lambda: len(monitor.refused) == 4)
    expected = Unwrapper(CameraConfig(), PANORAMA, FISHEYE)(raw_picture())
    assert_array_equal(pixels(answer(bench, heard, message(), images)), expected)
    assert node.health()[2]['camera model'] == 'fisheye'


def test_lens_and_panorama_are_those_of_the_model(bench, trained, tmp_path):
    """Unless the parameters describe a lens; a panorama asked otherwise is refused, and images of
    another shape are.
    """
    lens = replace(FISHEYE, image_width=640, image_height=640, mount_rpy=(0, 0, 40.0))
    model, path = replace(PlaceModel.load(trained.model), lens=lens), tmp_path / 'm.npz'
    model.save(path)
    node = bench.run(OmnicamNode, model=str(path))
    heard, monitor = bench.listen(Image, 'panorama'), node.monitors['image_raw']
    expected = Unwrapper(CameraConfig(), model.panorama, lens)(raw_picture())
    assert_array_equal(pixels(answer(bench, heard, message())), expected)
    cropped = to_image(raw_picture()[:480], STAMP_NS, 'camera')
    assert bench.publish_until('image_raw', cropped, lambda: monitor.refused)
    assert 'set the camera to the size of the training' in ' '.join(monitor.refused)
    bench.end(node)
    node = bench.run(OmnicamNode, model=str(path), camera_model='mirror')
    heard = bench.listen(Image, 'panorama')
    expected = Unwrapper(MIRROR, model.panorama)(raw_picture())
    assert_array_equal(pixels(answer(bench, heard, message())), expected)
    bench.end(node)
    node = bench.run(OmnicamNode, autostart=False, model=str(path), elevation_min=-20.0)
    with pytest.raises(ConfigError, match=r'elevation_min -20\.0 instead of -12\.0; leave'):
        node.setup()


def test_a_calibration_file_lies_beside_the_parameter_file_that_names_it(bench, tmp_path):
    (tmp_path / 'camera.yaml').write_text(calibration_text(FISHEYE))
    file, text = tmp_path / 'robot.yaml', 'calibration_file: camera.yaml'
    file.write_text(f'/**/omnicam_node:\n  ros__parameters:\n    {text}\n')
    for more, found in (([], True), (['-p', 'calibration_file:=camera.yaml'], False)):
        node = bench.run(OmnicamNode, autostart=False, calibration_file='camera.yaml')
        node.find_files(['--ros-args', '--params-file', str(file), *more])
        path = node.settings(CameraConfig).calibration_file
        assert path == (str(tmp_path / 'camera.yaml') if found else 'camera.yaml')
        bench.end(node)
    assert load_settings(file, 'omnicam_node', CameraConfig).calibration_file == str(
        tmp_path / 'camera.yaml'
    )


@pytest.mark.parametrize('crop', [0, 40])
def test_a_rim_elsewhere_than_in_training_is_named(crop):
    """Once the robot has moved enough for twelve images that differ."""
    lens = LensCalibration(
        image_width=640, image_height=640, cx=319.5, cy=319.5, radius_max=300.0, radius_min=0.0
    )
    rows, columns = np.mgrid[:640, :640]
    inside = np.hypot(columns - 319.5, rows - 319.5)[..., None] < 300
    watched = RimWatch(lens)
    for number in range(130):
        image = np.maximum(raw_picture(number // 10), 60) * inside.astype(np.uint8)
        watched.add(np.ascontiguousarray(image[crop : 640 - crop, crop : 640 - crop]))
    assert until(lambda: watched.done)
    assert bool(watched.problem) == bool(crop)
    if crop:
        assert 'px, in training 320, 320 and 300: was its image cropped' in watched.problem


def test_it_outlives_every_bad_image_and_counts_each(bench):
    """What is wrong with images is tested in test_pictures.py."""
    node, heard = start(bench)
    told, monitor = bench.listen(DiagnosticArray, '/diagnostics'), node.monitors['image_raw']
    empty = message()
    empty.height = 0
    cropped = to_image(raw_picture()[:480], 1, 'camera')
    answer(bench, heard, message())
    for kinds, bad in enumerate([empty, cropped, message(stamp_ns=0)], 1):
        assert bench.publish_until('image_raw', bad, lambda n=kinds: len(monitor.refused) == n)
    assert 'internal' not in ' '.join(monitor.refused)
    answer(bench, heard, message())
    key = '/image_raw: refused: empty image'
    assert until(lambda: key in {pair.key for pair in told[-1].status[0].values})


def changed(node, **values):
    changes = [Parameter(name, value=value) for name, value in values.items()]
    return node.set_parameters_atomically(changes)


def test_masks_elevation_and_mount_change_while_running_and_are_declared(bench):
    node, heard = start(bench)
    declared = bench.listen(String, 'panorama/info', latched_qos())
    assert until(lambda: declared) and read_info(declared[0]) == PANORAMA
    answer(bench, heard, message())
    turned = {'blind_sectors': [170.0, 190.0], 'mount_rpy': [0.0, 0.0, 30.0]}
    assert changed(node, elevation_max=10.0, **turned).successful
    lower = replace(PANORAMA, elevation_max=10.0)
    assert until(lambda: read_info(declared[-1]) == lower)
    camera = replace(MIRROR, **{k: tuple(v) for k, v in turned.items()})
    expected = Unwrapper(camera, lower)(raw_picture())
    assert until(lambda: np.array_equal(pixels(answer(bench, heard, message())), expected))


def test_panoramas_of_the_camera_are_mounted_and_masked(bench):
    """Also those that need no description."""
    given = {'camera_model': '', 'blind_sectors': [100.0, 140.0], 'mount_rpy': [5.0, 0.0, 30.0]}
    _, heard = start(bench, **given)
    camera = CameraConfig(**{k: tuple(v) if k != 'camera_model' else v for k, v in given.items()})
    strip = raw_picture()[:120]
    panorama = answer(bench, heard, to_image(strip, STAMP_NS, 'camera'))
    expected = Unwrapper(camera, PANORAMA)(strip)
    assert_array_equal(pixels(panorama), expected)
    assert not np.array_equal(expected, Unwrapper(CameraConfig(), PANORAMA)(strip))


def with_rules(*rules):
    return {'cli_args': ['--ros-args', *(word for rule in rules for word in ('-r', rule))]}


def test_impossible_cameras_do_not_start_and_impossible_changes_are_rejected(bench, monkeypatch):
    """Nor one that would hear itself."""
    monkeypatch.setitem(sys.modules, 'ffmpeg_image_transport_msgs', None)
    loop = {'options': with_rules('image_raw:=panorama')}
    for parameters, words in (
        ({'calibration_file': 'nowhere.yaml'}, 'nowhere.yaml'),
        ({'elevation_min': 60.0, 'elevation_max': 80.0}, 'sees no part'),
        ({'camera_model': '', 'mask_file': 'nowhere.png'}, 'mask_file is missing'),
        ({'camera_model': '', 'blind_sectors': [-180.0, 180.0]}, 'sees no part'),
        (loop, 'which this node itself publishes: remap'),
        ({'image_transport': 'ffmpeg'}, 'apt install ros-$ROS_DISTRO-ffmpeg-image-transport-msgs'),
    ):
        node = bench.run(OmnicamNode, start=False, **SMALL | parameters)
        assert not node.start() and words in node.failure
        bench.end(node)
    node, _ = start(bench)
    before = node.get_parameter('elevation_max').value
    for change, words in (
        ({'elevation_max': -40.0}, 'elevation_min'),
        ({'mask_file': 'nowhere.png'}, 'nowhere.png'),
        ({'blind_sectors': [10.0]}, 'a start and an end'),
    ):
        result = changed(node, **change)
        assert not result.successful and words in result.reason
    assert node.get_parameter('elevation_max').value == before


@pytest.mark.parametrize(('rules', 'heard'), [
    ([], '/image_raw/compressed'),
    (['image_raw:=/cam/image_raw', 'image_raw/compressed:=/jpegs'], '/jpegs'),
    (['__ns:=/robot1', 'image_raw:=front', 'panorama:=/panorama'], '/robot1/front/compressed'),
])  # fmt: skip
def test_a_remap_of_the_base_topic_holds_for_its_transports(bench, rules, heard):
    bench.run(OmnicamNode, image_transport='compressed', options=with_rules(*rules), **SMALL)
    bench.node.create_subscription(CompressedImage, '/panorama/compressed', lambda _: None, 1)
    assert until(lambda: bench.node.count_subscribers(heard) == 1)


def test_a_silent_camera_shows_in_diagnostics(bench, monkeypatch):
    """And one that is frozen, or masked."""
    monkeypatch.setattr(watch, 'FROZEN_S', 0.2)
    node, heard = start(bench, silence_timeout=0.2, blind_sectors=[-100.0, 100.0])
    told = bench.listen(DiagnosticArray, '/diagnostics')

    def is_told(text):
        return any(text in m.status[0].message for m in [*told])

    assert until(lambda: is_told('no image'))
    answer(bench, heard, message())
    assert until(lambda: is_told('sees only 4'))
    assert bench.publish_until('image_raw', message(), lambda: 'repeated' in node.health()[1])


def test_a_folder_of_pictures_in_order_of_their_names(bench, tmp_path):
    """What cannot be read is counted, and other files are ignored."""
    for name, seed in (('b.png', 1), ('a.png', 0), ('d.bmp', 2)):
        cv2.imwrite(str(tmp_path / name), raw_picture(seed))
    (tmp_path / 'c.png').write_bytes(b'no picture')
    (tmp_path / 'notes.txt').write_text('ignored')
    heard = []
    bench.node.create_subscription(Image, 'panorama', heard.append, QoSProfile(depth=10))
    node = bench.run(
        OmnicamNode, source='folder', source_path=str(tmp_path), source_rate=20.0, **SMALL
    )
    assert until(lambda: len(heard) >= 3)
    unwrap = Unwrapper(MIRROR, PANORAMA)
    for number, told in enumerate(heard[:3]):
        assert_array_equal(pixels(told), unwrap(raw_picture(number)))
        assert told.header.frame_id == 'omnicam'
    stamps = [read_stamp(told.header.stamp) for told in heard]
    assert stamps == sorted(stamps) and stamps[0] > 10**18
    (reason,) = node.monitors[str(tmp_path)].refused
    assert 'c.png' in reason


def test_a_source_that_is_not_there_is_logged(bench, tmp_path, capfd):
    path = str(tmp_path / 'missing')
    node = bench.run(OmnicamNode, source='folder', source_path=path)
    why = f'cannot open: folder {path} is missing'
    assert until(lambda: node.monitors[path].refused == {why: 1})
    bench.do(lambda: None)  # the callback that counts it has ended
    assert f'{path}: {why}' in capfd.readouterr().err
