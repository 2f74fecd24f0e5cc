# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Image sources: files in order, and a camera that disconnects, hangs or freezes."""

from __future__ import annotations

import queue
import threading
import time
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


class Script:
    """Captures that play given steps: a level is a picture, an exception is raised, None ends, an
    Event blocks until it is set. `forever` repeats the last step of a capture.
    """

    def __init__(self, *captures, live=True, forever=False):
        self.captures, self.live, self.forever = list(captures), live, forever
        self.opened = self.closed = 0

    def __call__(self):
        self.opened += 1
        steps = self.captures.pop(0) if len(self.captures) > 1 else self.captures[0]
        if isinstance(steps, Exception):
            raise steps
        return Source(self.live, self.play(list(steps)))

    def play(self, steps):
        try:
            while True:
                time.sleep(0.001)
                step = steps[0] if self.forever and len(steps) == 1 else steps.pop(0)
                if isinstance(step, Exception):
                    raise step
                if step is None:
                    return
                if isinstance(step, threading.Event):
                    step.wait(PATIENCE_S)
                    step = 255
                yield picture(step)
        finally:
            self.closed += 1


@pytest.fixture
def run_feed():
    """Start a feed; its pictures come by a queue."""
    feeds = []

    def start(script, reject=lambda reason: None, wanted=lambda: True, **values):
        received = queue.Queue()
        take = lambda image: received.put(int(image[0, 0, 0]))  # noqa: E731
        feeds.append(Feed(script, take, config(**values), reject, wanted=wanted))
        feeds[-1].start()
        return feeds[-1], received

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


def arrived(feed, received):
    """All pictures until the end."""
    wait_for(lambda: feed.status().state == 'ended')
    return list(received.queue)


def test_a_disconnected_camera_is_opened_again(run_feed):
    script = Script([1, 2, CameraError('unplugged')], CameraError('not there'), [3, 4, 5, None])
    feed, received = run_feed(script)
    assert arrived(feed, received) == [1, 2, 3, 4, 5]
    assert script.opened == 3 and feed.status().lost == 2
    feed, _ = run_feed(Script(CameraError('not there')))
    wait_for(lambda: feed.status().state == 'lost')
    assert feed.status().problem == 'not there'


def test_a_silent_camera_is_abandoned_and_opened_again(run_feed):
    released = threading.Event()
    script = Script([1, released], [2, 3, None])
    feed, received = run_feed(script)
    wait_for(lambda: script.opened == 2, feed)
    assert arrived(feed, received) == [1, 2, 3]
    assert feed.status().lost == 1
    released.set()  # the read that hung returns a picture, which nobody wants any more
    wait_for(lambda: script.closed == 2)
    assert received.qsize() == 3


def test_a_frozen_camera_is_opened_again_until_it_moves(run_feed):
    script = Script([1, 2], [2], [2], [3, 4, 5, None], forever=True)
    feed, received = run_feed(script)
    wait_for(lambda: script.opened == 2)
    assert 'repeated' in feed.status().problem or feed.status().state == 'lost'
    assert arrived(feed, received)[-3:] == [3, 4, 5]
    assert script.opened == 4 and feed.status().lost == 3


def test_a_defect_in_the_thread_is_reported_and_the_source_opened_again(run_feed):
    rejected = []
    script = Script([1, ZeroDivisionError()], [2, ZeroDivisionError()], [3, None], live=False)
    feed, received = run_feed(script, rejected.append)
    assert arrived(feed, received) == [1, 2, 3]
    assert feed.status().lost == 2
    assert rejected == ['internal error: ZeroDivisionError'] * 2


def test_files_wait_until_they_are_wanted_and_come_in_order_until_the_end(run_feed):
    """Equal ones of a file are no fault."""
    wanted, script = threading.Event(), Script([1, 2, *[7] * 60, None], live=False)
    feed, received = run_feed(script, wanted=wanted.is_set)
    wait_for(lambda: script.opened == 1)
    assert received.empty()
    wanted.set()
    assert arrived(feed, received) == [1, 2, *[7] * 60]
    wait_for(lambda: feed.check().state == 'ended' and script.closed == 1)
    assert script.opened == 1 and feed.status().lost == 0


def test_nothing_is_delivered_after_stop(run_feed):
    script = Script(list(range(100000)))
    feed, received = run_feed(script)
    received.get(timeout=PATIENCE_S)
    feed.stop()
    assert script.closed == 1
    count = received.qsize()
    feed.check()
    assert script.opened == 1 and received.qsize() == count


def test_a_folder_in_order_of_names_with_the_unreadable_named(tmp_path, run_feed):
    for name, level in (('b.png', 2), ('a.png', 1), ('d.bmp', 4)):
        cv2.imwrite(str(tmp_path / name), picture(level))
    (tmp_path / 'c.png').write_bytes(b'no picture')
    (tmp_path / 'notes.txt').write_text('ignored')
    rejected = []
    values = {'source': 'folder', 'source_path': str(tmp_path), 'source_rate': 1000.0}
    assert arrived(*run_feed(opener(config(**values)), rejected.append, **values)) == [1, 2, 4]
    assert len(rejected) == 1 and 'c.png' in rejected[0]


def test_video(tmp_path, run_feed):
    path = str(tmp_path / 'drive.avi')
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*'MJPG'), 25.0, (48, 32))
    if not writer.isOpened():
        pytest.skip('this OpenCV writes no video')
    for level in (10, 100, 200):
        writer.write(picture(level))
    writer.release()
    values = {'source': 'video', 'source_path': path, 'source_rate': 500.0}
    levels = arrived(*run_feed(opener(config(**values)), **values))
    assert levels == pytest.approx([10, 100, 200], abs=3)


def test_sources_that_are_not_there_are_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for source, path, words in (
        ('topic', '', 'topic'), ('device', '', 'source_path is empty'),
        ('device', '/dev/no_such_camera', 'no_such_camera'), ('folder', '.', 'no images'),
        ('video', 'no_such.mp4', r'no_such\.mp4'), ('folder', 'no_such_folder', 'no_such_folder'),
    ):  # fmt: skip
        with pytest.raises(CameraError, match=words):
            opener(config(source=source, source_path=path))()


def test_a_device_is_asked_for_a_size_and_a_rate(monkeypatch, tmp_path):
    """Where they are given; else it keeps its own."""
    capture = mock.Mock(return_value=mock.Mock(isOpened=lambda: True))
    monkeypatch.setattr(cv2, 'VideoCapture', capture)
    (tmp_path / 'video0').touch()
    given = {'source': 'device', 'source_path': str(tmp_path / 'video0')}
    wanted = {cv2.CAP_PROP_FRAME_WIDTH: 1280, cv2.CAP_PROP_FRAME_HEIGHT: 720, cv2.CAP_PROP_FPS: 15}
    for more, expected in (({'source_size': (1280, 720), 'source_rate': 15.0}, wanted), ({}, {})):
        opener(config(**given, **more))()
        asked = {call.args[0]: call.args[1] for call in capture.return_value.set.call_args_list}
        assert asked.items() >= expected.items() and (asked.keys() & wanted.keys()) == set(expected)
        capture.return_value.set.reset_mock()
    with pytest.raises(ConfigError, match='columns and rows'):
        config(source_size=(640.0,))
