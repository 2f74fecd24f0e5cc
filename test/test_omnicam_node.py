# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The omnicam node on real messages: panoramas, demand, bad pictures, live parameters, sources."""

import array
import contextlib
import dataclasses
import threading
import time

import cv2
import numpy as np
import pytest
import yaml
from ros_domains import free_domain

from sfa_localization.camera import watch
from sfa_localization.camera.encodings import decode_compressed, encode_jpeg
from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.settings import CameraConfig, CaptureConfig, PanoramaConfig
from sfa_localization.config import load_settings, write_config

rclpy = pytest.importorskip('rclpy')
pytestmark = pytest.mark.ros

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from omnicam_bench import (  # noqa: E402
    PATIENCE_S,
    RELIABLE,
    Bench,
    image_message,
    new_context,
    pixels,
    send_until,
)
from rclpy.parameter import Parameter, parameter_value_to_python  # noqa: E402
from sensor_msgs.msg import CompressedImage, Image  # noqa: E402
from std_msgs.msg import String  # noqa: E402

from sfa_localization.nodes.conversions import read_info  # noqa: E402
from sfa_localization.nodes.lifecycle import latched_qos  # noqa: E402
from sfa_localization.nodes.omnicam_node import OmnicamNode  # noqa: E402
from sfa_localization.nodes.settings import OmnicamNodeConfig  # noqa: E402

DOMAIN = free_domain()

PANORAMA = PanoramaConfig(width=120, height=12)
GROUPS = (OmnicamNodeConfig, CaptureConfig, CameraConfig, PanoramaConfig)


def raw_picture(seed=1):
    noise = np.random.default_rng(seed).integers(0, 256, (40, 40, 3), np.uint8)
    return cv2.resize(noise, (640, 640), interpolation=cv2.INTER_CUBIC)


@pytest.fixture
def bench(monkeypatch, tmp_path):
    monkeypatch.setenv('ROS_PYTHON_CHECK_FIELDS', '1')
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    context = new_context(DOMAIN)
    made = []

    def build(**parameters):
        made.append(Bench(context, **parameters))
        return made[-1]

    yield build
    for each in made:
        each.close()
    rclpy.try_shutdown(context=context)


def test_the_panorama_has_the_stamp_and_frame_of_the_picture(bench):
    run = bench().start()
    run.hear('panorama')
    message = send_until(run, run.speak(), image_message(raw_picture()))
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 34)
    assert message.header.frame_id == 'camera'
    assert (message.height, message.width, message.step) == (12, 120, 360)
    assert message.encoding == 'bgr8'
    expected = Unwrapper(CameraConfig(camera_model='mirror'), PANORAMA)(raw_picture())
    np.testing.assert_array_equal(pixels(message), expected)


def test_what_the_panorama_shows_is_declared_for_those_who_come_late_and_after_a_change(bench):
    run = bench().start()
    heard = []
    run.peer.create_subscription(String, 'panorama/info', heard.append, latched_qos())
    run.wait(lambda: heard)
    assert read_info(heard[0]) == PANORAMA
    assert run.set(elevation_max=30.0).successful
    run.wait(lambda: len(heard) == 2)
    assert read_info(heard[1]) == dataclasses.replace(PANORAMA, elevation_max=30.0)


def test_frame_and_quality_of_service_by_parameter(bench):
    run = bench(frame_id='mast').start()
    run.hear('panorama')
    message = image_message(raw_picture())
    assert send_until(run, run.speak(), message).header.frame_id == 'mast'
    assert run.node.get_parameter('qos_overrides./image_raw.subscription.depth').value == 1


def test_compressed_pictures_in_and_out(bench):
    run = bench(image_transport='compressed').start()
    run.hear('panorama/compressed', CompressedImage)
    message = CompressedImage(format='jpeg')
    message.header.stamp.sec = 5
    data = encode_jpeg(raw_picture(), 95)
    message.data = array.array('B', data)
    publisher = run.speak('image_raw/compressed', CompressedImage)
    heard = send_until(run, publisher, message, 'panorama/compressed')
    assert heard.header.stamp.sec == 5
    expected = Unwrapper(CameraConfig(camera_model='mirror'), PANORAMA)(decode_compressed(data))
    shown = decode_compressed(heard.data.tobytes())
    assert np.corrcoef(shown.ravel(), expected.ravel())[0, 1] > 0.6
    message.data = array.array('B', b'no picture')
    monitor = run.node.monitor('image_raw/compressed')
    run.wait(lambda: publisher.publish(message) or monitor.refused)
    message.data = array.array('B', data)
    send_until(run, publisher, message, 'panorama/compressed')


def test_nobody_listens_nothing_is_done(bench):
    run = bench().start()
    publisher = run.peer.create_publisher(Image, 'image_raw', RELIABLE)
    run.hear('/diagnostics', DiagnosticArray)
    status = run.wait_for('/diagnostics', 3).status[0]
    assert 'idle' in status.message
    assert status.level == DiagnosticStatus.OK
    assert publisher.get_subscription_count() == 0
    listener = run.hear('panorama')
    run.wait(lambda: publisher.get_subscription_count() == 1)
    send_until(run, publisher, image_message(raw_picture()))
    run.peer.destroy_subscription(listener)
    run.wait(lambda: publisher.get_subscription_count() == 0)
    listener = run.hear('panorama')
    run.wait(lambda: publisher.get_subscription_count() == 1)
    send_until(run, publisher, image_message(raw_picture()))


def test_it_outlives_every_bad_image_and_counts_each(bench):
    """What is wrong with images is tested in test_pictures.py."""
    run = bench().start()
    run.hear('panorama')
    run.hear('/diagnostics', DiagnosticArray)
    publisher, good = run.speak(), image_message(raw_picture())
    send_until(run, publisher, good)
    count, monitor = len(run.received['panorama']), run.node.monitor('image_raw')
    empty = image_message(raw_picture())
    empty.height = 0
    bad = [empty, image_message(raw_picture()[:480]), image_message(raw_picture(), stamp=(0, 0))]
    for message in bad:
        before = sum(monitor.refused.values())
        run.wait(lambda m=message, b=before: (
            publisher.publish(m) or sum(monitor.refused.values()) > b
        ))  # fmt: skip
    assert len(monitor.refused) == 3 and not any('internal' in why for why in monitor.refused)
    assert len(run.received['panorama']) == count
    send_until(run, publisher, good)
    run.wait(lambda: '/image_raw: refused: empty image' in {
        pair.key for pair in run.received['/diagnostics'][-1].status[0].values
    })  # fmt: skip


def test_masks_elevation_and_mount_change_while_running(bench):
    run = bench().start()
    run.hear('panorama')
    publisher = run.speak()
    message = image_message(raw_picture())
    send_until(run, publisher, message)
    assert run.set(
        elevation_max=10.0, blind_sectors=[170.0, 190.0], mount_rpy=[0.0, 0.0, 30.0]
    ).successful
    camera = CameraConfig(
        camera_model='mirror', blind_sectors=(170.0, 190.0), mount_rpy=(0.0, 0.0, 30.0)
    )
    panorama = PanoramaConfig(width=120, height=12, elevation_max=10.0)
    expected = Unwrapper(camera, panorama)(raw_picture())
    deadline = time.monotonic() + PATIENCE_S
    while not np.array_equal(pixels(send_until(run, publisher, message)), expected):
        assert time.monotonic() < deadline


def test_sectors_are_set_by_message_and_taken_away_but_not_removed(bench):
    """As `ros2 param set` does: numbers arrive as array.array, or as integers."""
    run = bench(blind_sectors=[10.0, 20.0])
    assert run.node.start()
    for sent in ([170.0, 190.0], [10, 20]):
        message = Parameter('blind_sectors', value=sent).to_parameter_msg()
        (answer,) = run.node.set_parameters([Parameter.from_parameter_msg(message)])
        assert answer.successful, answer.reason
        assert run.node.settings(CameraConfig).blind_sectors == tuple(sent)
    assert run.set(blind_sectors=[]).successful
    assert run.node.settings(CameraConfig).blind_sectors == ()
    (answer,) = run.node.set_parameters([Parameter('blind_sectors', Parameter.Type.NOT_SET)])
    assert not answer.successful and 'cannot be undeclared' in answer.reason


@pytest.fixture
def remapped():
    """Return a function that makes the node with remaps; `parameters` by name."""
    made = []

    def build(*rules, **parameters):
        words = [word for rule in rules for word in ('-r', rule)]
        given = [Parameter(name, value=value) for name, value in parameters.items()]
        context = new_context(DOMAIN, ['--ros-args', *words])
        made.append(OmnicamNode(context=context, parameter_overrides=given))
        return made[-1]

    yield build
    for node in made:
        node.destroy_node()
        rclpy.try_shutdown(context=node.context)


def test_a_remap_of_the_base_topic_holds_for_its_transports(remapped):
    for rules, heard in (
        ([], '/image_raw/compressed'),
        (['image_raw:=/cam/image_raw'], '/cam/image_raw/compressed'),
        (['image_raw:=/cam/image_raw', 'image_raw/compressed:=/jpegs'], '/jpegs'),
        (['__ns:=/robot1', 'image_raw:=front'], '/robot1/front/compressed'),
    ):
        node = remapped(*rules, image_transport='compressed')
        assert node.start(), node.failure
        assert node.shown(node._input) == heard
    node = remapped('panorama:=/top/view')
    assert node.start(), node.failure
    made = {publisher.topic_name for publisher in node.publishers}
    assert {'/top/view', '/top/view/compressed', '/top/view/info'} <= made


def test_a_node_that_would_hear_itself_is_not_configured(remapped):
    for rule, transport in (
        ('image_raw:=panorama', 'raw'), ('panorama:=/image_raw', 'raw'),
        ('image_raw:=panorama', 'compressed'),
        ('image_raw/compressed:=panorama/compressed', 'compressed'),
    ):  # fmt: skip
        node = remapped(rule, image_transport=transport)
        assert not node.start()
        assert 'which this node itself publishes' in node.failure and 'remap' in node.failure


@contextlib.contextmanager
def from_file(path):
    """Run the node with a parameter file."""
    context = new_context(DOMAIN, ['--ros-args', '--params-file', str(path)])
    node = OmnicamNode(context=context)
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def dumped(node):
    """What `ros2 param dump` writes."""
    values = {name: entry.get_parameter_value() for name, entry in node._parameters.items()}
    return {name: parameter_value_to_python(value) for name, value in values.items()}


def test_what_ros2_param_dump_writes_can_be_loaded_again(tmp_path):
    path = tmp_path / 'omnicam_node.yaml'
    write_config(path, {'omnicam_node': {'source_rate': 7.5}})
    with from_file(path) as node:
        first = dumped(node)
        settings = [node.settings(k) for k in GROUPS]
    assert first['blind_sectors'] == [] and first['source_rate'] == 7.5
    path.write_text(yaml.safe_dump({'/omnicam_node': {'ros__parameters': first}}))
    with from_file(path) as node:
        assert [node.settings(type(each)) for each in settings] == settings
        assert dumped(node) == first
    assert [load_settings(path, 'omnicam_node', type(each)) for each in settings] == settings


def test_impossible_changes_are_rejected_with_the_reason(bench):
    run = bench()
    assert run.node.start()
    before = run.node.get_parameter('elevation_max').value
    for change, words in (
        ({'elevation_max': -40.0}, 'elevation_min'),
        ({'mask_file': 'nowhere.png'}, 'nowhere.png'),
        ({'blind_sectors': [10.0]}, 'a start and an end'),
        ({'mount_rpy': [1.0, 2.0]}, 'roll, pitch and yaw'),
    ):
        result = run.set(**change)
        assert not result.successful and words in result.reason
    assert run.node.get_parameter('elevation_max').value == before


@pytest.mark.parametrize(
    ('parameters', 'words'),
    [
        ({'source': 'video'}, 'source_path'),
        ({'calibration_file': 'nowhere.yaml'}, 'nowhere.yaml'),
        ({'elevation_min': 60.0, 'elevation_max': 80.0}, 'sees no part'),
    ],
)
def test_an_impossible_camera_says_so_and_does_not_start(bench, parameters, words):
    run = bench(**parameters)
    assert not run.node.start()
    assert words in run.node.failure


def shown(run, *words, level=None):
    """Wait until a diagnosis says something."""
    run.wait(lambda: any(
        all(word in each.status[0].message for word in words)
        and level in (None, each.status[0].level)
        for each in run.received['/diagnostics']
    ))  # fmt: skip


def test_a_silent_camera_shows_in_diagnostics(bench):
    run = bench(silence_timeout=0.2).start()
    run.hear('panorama')
    run.hear('/diagnostics', DiagnosticArray)
    shown(run, 'no image')
    send_until(run, run.speak(), image_message(raw_picture()))


def test_a_frozen_and_a_masked_camera_show_in_diagnostics(bench, monkeypatch):
    monkeypatch.setattr(watch, 'FROZEN_S', 0.2)
    run = bench(blind_sectors=[-100.0, 100.0]).start()
    run.hear('panorama')
    run.hear('/diagnostics', DiagnosticArray)
    publisher, message = run.speak(), image_message(raw_picture())
    send_until(run, publisher, message)
    shown(run, 'sees only 4')
    run.wait(lambda: publisher.publish(message) or any(
        'repeated' in each.status[0].message for each in run.received['/diagnostics']
    ))  # fmt: skip


def test_a_folder_of_pictures(bench, tmp_path):
    for number in range(3):
        cv2.imwrite(str(tmp_path / f'{number}.png'), raw_picture(number))
    (tmp_path / '3.png').write_bytes(b'no picture')
    run = bench(source='folder', source_path=str(tmp_path), source_rate=20.0)
    run.hear('panorama')
    run.start()
    run.wait_for('panorama', 3)
    unwrap = Unwrapper(CameraConfig(camera_model='mirror'), PANORAMA)
    for number, message in enumerate(run.received['panorama'][:3]):
        np.testing.assert_array_equal(pixels(message), unwrap(raw_picture(number)))
        assert message.header.frame_id == 'omnicam'
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in run.received['panorama']]
    assert stamps == sorted(stamps)
    assert stamps[0] > 10**18
    run.wait(lambda: sum(run.node.monitor(str(tmp_path)).refused.values()) == 1)


def test_a_device_that_is_not_there_is_shown_and_awaited(bench):
    run = bench(source='device', source_path='/dev/no_such_camera')
    run.hear('/diagnostics', DiagnosticArray)
    run.start()
    assert run.started
    shown(run, 'no_such_camera', level=DiagnosticStatus.ERROR)


def test_of_images_that_come_too_fast_the_newest_is_used(bench):
    """A burst while the node is busy: no more than the depth of one waits for it."""
    run = bench()
    run.hear('panorama')
    run.start()
    publisher = run.speak()
    send_until(run, publisher, image_message(raw_picture()))
    run.wait(lambda: publisher.get_subscription_count() == 1)
    run.spinning = False
    run.thread.join(PATIENCE_S)
    run.received['panorama'].clear()
    for second in range(100, 120):
        publisher.publish(image_message(raw_picture(), stamp=(second, 0)))
    time.sleep(1.0)  # nothing is waited for: the burst only has to be over
    run.spinning = True
    run.thread = threading.Thread(target=run._spin, daemon=True)
    run.thread.start()
    run.wait(lambda: any(m.header.stamp.sec == 119 for m in run.received['panorama']))
    assert len([m for m in run.received['panorama'] if m.header.stamp.sec >= 100]) <= 2
