# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Image sources: files in order, and a camera that disconnects, hangs or freezes."""

import queue
import threading
import time
from itertools import chain, repeat
from unittest import mock

import cv2
import numpy as np
import pytest

from sfa_localization.camera import capture as capture_module
from sfa_localization.camera import watch
from sfa_localization.camera.capture import Feed, Source, opener
from sfa_localization.camera.settings import CaptureConfig
from sfa_localization.data.errors import CameraError, ConfigError

PATIENCE_S = 10.0


def picture(level):
    return np.full((32, 48, 3), level % 256, np.uint8)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Wait for cameras no longer than a test should take."""
    monkeypatch.setattr(capture_module, '_REOPEN_FIRST_S', 0.01)
    monkeypatch.setattr(capture_module, '_REOPEN_LONGEST_S', 0.04)
    monkeypatch.setattr(watch, 'FROZEN_S', 0.05)


def config(**values):
    return CaptureConfig(**{'silence_timeout': 0.1, **values})


def camera(steps, live=True):
    """A source of pictures of these levels; an exception among them is raised."""

    def play():
        for step in steps:
            time.sleep(0.001)
            if isinstance(step, Exception):
                raise step
            yield picture(step)

    return Source(live, play())


def opening(*results):
    """Opens one source after the other; exceptions are raised."""
    return mock.Mock(side_effect=results)


@pytest.fixture
def run_feed():
    feeds = []

    def start(script, reject=lambda reason: None, wanted=lambda: True, **values):
        received = queue.Queue()

        def take(image):
            received.put(int(image[0, 0, 0]))

        feed = Feed(script, take, config(**values), reject, wanted=wanted)
        feeds.append(feed)
        feed.start()
        return feed, received

    yield start
    for feed in feeds:
        feed.stop()


def wait_for(condition, feed=None):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, 'waited in vain'
        if feed is not None:
            feed.check()
        time.sleep(0.002)


def arrived(received, count):
    return [received.get(timeout=PATIENCE_S) for _ in range(count)]


def test_files_wait_until_they_are_wanted_and_arrive_in_order_until_the_end(run_feed):
    """Equal ones are no fault."""
    wanted, open_ = threading.Event(), opening(camera([1, 2, *[7] * 60], live=False))
    feed, received = run_feed(open_, wanted=wanted.is_set)
    wait_for(lambda: open_.called)
    assert received.empty()
    wanted.set()
    assert arrived(received, 62) == [1, 2, *[7] * 60]
    wait_for(lambda: feed.check().state == 'ended')
    assert open_.call_count == 1 and feed.status().lost == 0


def test_a_disconnected_camera_is_opened_again(run_feed):
    unplugged = camera([1, 2, CameraError('unplugged')])
    open_ = opening(unplugged, CameraError('not there'), camera([3, 4, 5]))
    feed, received = run_feed(open_)
    assert arrived(received, 5) == [1, 2, 3, 4, 5]
    assert open_.call_count == 3 and feed.status().lost == 2
    feed, _ = run_feed(mock.Mock(side_effect=CameraError('not there')))
    wait_for(lambda: feed.status().state == 'lost')
    assert feed.status().problem == 'not there'


def test_a_silent_camera_is_abandoned_and_opened_again(run_feed):
    released, closed = threading.Event(), threading.Event()

    def hanging():
        try:
            yield picture(1)
            released.wait(PATIENCE_S)
            yield picture(255)
        finally:
            closed.set()

    open_ = opening(Source(True, hanging()), camera([2, 3]))
    feed, received = run_feed(open_)
    assert received.get(timeout=PATIENCE_S) == 1
    wait_for(lambda: open_.call_count == 2, feed)
    assert arrived(received, 2) == [2, 3]
    assert feed.status().lost == 1
    released.set()  # the read that hung returns a picture, which nobody wants any more
    assert closed.wait(PATIENCE_S) and received.empty()


def test_a_frozen_camera_is_opened_again_until_it_moves(run_feed):
    frozen = camera(chain([1], repeat(2))), camera(repeat(2)), camera(repeat(2))
    open_ = opening(*frozen, camera([3, 4, 5]))
    feed, received = run_feed(open_)
    wait_for(lambda: open_.call_count == 2)
    assert 'repeated' in feed.status().problem or feed.status().state == 'lost'
    wait_for(lambda: feed.status().state == 'ended')
    assert list(received.queue)[-3:] == [3, 4, 5]
    assert open_.call_count == 4 and feed.status().lost == 3


def test_a_defect_in_the_thread_is_reported_and_the_source_opened_again(run_feed):
    rejected, defect = [], ZeroDivisionError()
    files = (camera(steps, live=False) for steps in ([1, defect], [2, defect], [3]))
    feed, received = run_feed(opening(*files), rejected.append)
    assert arrived(received, 3) == [1, 2, 3]
    wait_for(lambda: feed.status().state == 'ended')
    assert feed.status().lost == 2
    assert rejected == ['internal error: ZeroDivisionError'] * 2


def test_nothing_is_delivered_after_stop(run_feed):
    open_ = opening(camera(range(10**5)))
    feed, received = run_feed(open_)
    received.get(timeout=PATIENCE_S)
    feed.stop()
    count = received.qsize()
    feed.check()
    assert open_.call_count == 1 and received.qsize() == count


def test_video(tmp_path, run_feed):
    path = str(tmp_path / 'drive.avi')
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*'MJPG'), 25.0, (48, 32))
    if not writer.isOpened():
        pytest.skip('this OpenCV writes no video')
    for level in (10, 100, 200):
        writer.write(picture(level))
    writer.release()
    values = {'source': 'video', 'source_path': path, 'source_rate': 500.0}
    feed, received = run_feed(opener(config(**values)), **values)
    assert arrived(received, 3) == pytest.approx([10, 100, 200], abs=3)
    wait_for(lambda: feed.status().state == 'ended')


def test_sources_that_are_not_there_are_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for source, path, words in (
        ('topic', '', 'topic'),
        ('device', '', 'source_path is empty'),
        ('device', '/dev/no_such_camera', 'no_such_camera'),
        ('video', 'no_such.mp4', r'no_such\.mp4'),
        ('folder', 'no_such_folder', 'no_such_folder'),
        ('folder', '.', 'no images'),
    ):
        with pytest.raises(CameraError, match=words):
            opener(config(source=source, source_path=path))()


def test_a_device_is_asked_for_a_size_and_a_rate(monkeypatch, tmp_path):
    """Where they are given; else it keeps its own."""
    capture = mock.Mock(return_value=mock.Mock(isOpened=lambda: True))
    monkeypatch.setattr(cv2, 'VideoCapture', capture)
    (tmp_path / 'video0').touch()
    given = {'source': 'device', 'source_path': str(tmp_path / 'video0')}
    wanted = {cv2.CAP_PROP_FRAME_WIDTH: 1280, cv2.CAP_PROP_FRAME_HEIGHT: 720, cv2.CAP_PROP_FPS: 15}
    for more, expected in (({}, {}), ({'source_size': (1280, 720), 'source_rate': 15.0}, wanted)):
        opener(config(**given, **more))()
        asked = dict(call.args for call in capture.return_value.set.call_args_list)
        assert {key: asked[key] for key in asked.keys() & wanted.keys()} == expected
    with pytest.raises(ConfigError, match='columns and rows'):
        config(source_size=(640.0,))
