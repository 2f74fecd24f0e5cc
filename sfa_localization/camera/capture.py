# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Images from a V4L2 device, a video file or a folder.

A camera that disconnects, goes silent or repeats its last image is opened again, after pauses that
double. Independent of ROS; time is that of the steady clock.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from sfa_localization.camera.encodings import read_image
from sfa_localization.camera.settings import CaptureConfig
from sfa_localization.camera.watch import FROZEN_S, FrozenWatch
from sfa_localization.data.errors import CameraError
from sfa_localization.data.run import Image

logger = logging.getLogger(__name__)

_SUFFIXES = ('.png', '.jpg', '.jpeg', '.bmp', '.ppm', '.pgm', '.tif', '.tiff', '.webp')
_USUAL_RATE_HZ = 10.0  # of a folder, and of a video that names none
_OPENING_S = 10.0  # a device may need this long to open
_IDLE_PAUSE_S = 0.02  # of a file while no image is wanted: shorter than a frame
# pauses before a source is reopened; they double
_REOPEN_FIRST_S = 0.5
_REOPEN_LONGEST_S = 30.0


CapturedImages = Generator[Image | CameraError, None, None]
"""Images (H, W, 3) uint8 BGR in order; errors in place of unusable ones."""


class Source(NamedTuple):
    """An opened source and its images; a device is `live`, a file is not.

    At the end of its images a live source raises CameraError. Closing the images closes it.
    """

    live: bool
    images: CapturedImages


def opener(config: CaptureConfig) -> Callable[[], Source]:
    """A function that opens the configured source. Raises CameraError where none is configured."""
    if config.source == 'topic':
        raise CameraError('images from a topic need no source to be opened')
    if not config.source_path:
        raise CameraError(f'source_path is empty: name the {config.source} to take images from')
    kinds = {'device': _device, 'video': _video, 'folder': _folder}
    return lambda: kinds[config.source](config)


def _device(config: CaptureConfig) -> Source:
    """A V4L2 device, through OpenCV."""
    path = config.source_path
    if not path.isdigit() and not os.path.exists(path):
        raise CameraError(f'device {path} is not there')
    capture = cv2.VideoCapture(int(path) if path.isdigit() else path, cv2.CAP_V4L2)
    if not capture.isOpened():
        raise CameraError(f'device {path} cannot be opened: is it there, and not in use?')
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    if config.source_size:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, config.source_size[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, config.source_size[1])
    if config.source_rate:
        capture.set(cv2.CAP_PROP_FPS, config.source_rate)
    return Source(True, _frames(capture, f'device {path} is disconnected'))


def _video(config: CaptureConfig) -> Source:
    """A video file, at its own rate or another."""
    path = config.source_path
    # A pipe would never end, and OpenCV would print a warning about a missing file.
    capture = cv2.VideoCapture(path) if os.path.isfile(path) else None
    if capture is None or not capture.isOpened():
        raise CameraError(f'video {path} is missing, or of a kind OpenCV cannot read')
    recorded_hz = capture.get(cv2.CAP_PROP_FPS)
    usual_hz = recorded_hz if 0.1 < recorded_hz < 1000 else _USUAL_RATE_HZ
    rate_hz = config.source_rate or usual_hz
    return Source(False, _paced(_frames(capture), rate_hz))


def _folder(config: CaptureConfig) -> Source:
    """The images of a folder in the order of their names."""
    folder = Path(config.source_path)
    if not os.path.isdir(folder):
        raise CameraError(f'folder {folder} is missing')
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES)
    if not files:
        raise CameraError(f'folder {folder} holds no images ({" ".join(_SUFFIXES)})')
    return Source(False, _paced(map(_read, files), config.source_rate or _USUAL_RATE_HZ))


def _read(path: Path) -> Image | CameraError:
    try:
        return read_image(path)
    except CameraError as error:
        return error


def _frames(capture: cv2.VideoCapture, at_end: str = '') -> CapturedImages:
    """Captured images; the end of them raises CameraError with the text `at_end`, if any."""
    try:
        while True:
            done, image = capture.read()
            if not done or image is None:
                break
            gray = image.ndim == 2 or image.shape[2] == 1
            yield np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if gray else image, np.uint8)
        if at_end:
            raise CameraError(at_end)
    finally:
        capture.release()


def _paced(images: Iterable[Image | CameraError], rate_hz: float) -> CapturedImages:
    """Yield images at a rate; a late reader skips the lost time."""
    due = time.monotonic()
    for image in images:
        now = time.monotonic()
        time.sleep(max(due - now, 0.0))
        due = max(due, now) + 1.0 / rate_hz
        yield image


@dataclass(frozen=True, slots=True)
class FeedStatus:
    """State of a feed: new, opening, running, lost (to be reopened) or ended; `lost` counts the
    losses.
    """

    state: str = 'new'
    problem: str = ''
    lost: int = 0


class Feed:
    """Reads a source in a thread, and opens it again when it fails.

    The thread calls `deliver` with each image, and `reject` with the reason why one is unusable.
    Files wait while `wanted` returns False. Call `check` regularly from another thread: it detects
    a read that never returns.
    """

    def __init__(
        self,
        open_source: Callable[[], Source],
        deliver: Callable[[Image], None],
        config: CaptureConfig,
        reject: Callable[[str], None] = lambda reason: None,
        wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        self.config = config
        self._open = open_source
        self._deliver = deliver
        self._reject = reject
        self._wanted = wanted
        self._stopped = threading.Event()
        self._status = FeedStatus()
        self._pause_s = _REOPEN_FIRST_S
        self._deadline_s = np.inf  # when a read or an opening in progress counts as hanging
        self._frozen = FrozenWatch()
        self._thread: threading.Thread | None = None

    def start(self, pause: bool = False) -> None:
        """Open the source, at once or after a pause, and deliver images until `stop`."""
        self._deadline_s = np.inf
        self._thread = threading.Thread(target=self._run, args=(pause,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Deliver nothing more; a read that hangs is abandoned."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join(timeout=1.0)

    def status(self) -> FeedStatus:
        """The status that the feed's thread set last."""
        return self._status

    def check(self) -> FeedStatus:
        """Abandon an opening or a read that hangs; return the status."""
        if time.monotonic() > self._deadline_s and not self._stopped.is_set():
            self._lose(f'silent for {self.config.silence_timeout:g} s')
            self.start(pause=True)
        return self._status

    def _lose(self, problem: str) -> None:
        self._status = FeedStatus('lost', problem, self._status.lost + 1)

    def _set_state(self, state: str) -> None:
        self._status = FeedStatus(state, '', self._status.lost)

    def _goes_on(self) -> bool:
        """Whether the calling thread is neither abandoned nor stopped."""
        return threading.current_thread() is self._thread and not self._stopped.is_set()

    def _run(self, pause: bool) -> None:
        if pause:
            self._back_off()
        while self._goes_on():
            try:
                self._read_all()
                return
            except Exception as error:  # any failure reopens the camera
                if not self._goes_on():
                    return
                self._lose(self._problem(error))
            self._back_off()

    def _problem(self, error: Exception) -> str:
        """Describe an error; one that no camera causes is logged as a defect."""
        if isinstance(error, (CameraError, cv2.error, OSError)):
            return str(error)
        text = f'internal error: {type(error).__name__}'
        self._reject(text)
        logger.error('%s', text, exc_info=error)
        return text

    def _back_off(self) -> None:
        self._deadline_s = np.inf
        pause = self._pause_s
        self._pause_s = min(2 * self._pause_s, _REOPEN_LONGEST_S)
        self._stopped.wait(pause)

    def _read_all(self) -> None:
        """Open, and read to the end. Raises CameraError when the source must be reopened."""
        self._deadline_s = time.monotonic() + _OPENING_S + self.config.silence_timeout
        if self._status.state == 'new':
            self._set_state('opening')
        source = self._open()
        try:
            while self._goes_on() and self._read_next(source):
                pass
        finally:
            source.images.close()

    def _read_next(self, source: Source) -> bool:
        """Deliver one image; False at the end."""
        silence = self.config.silence_timeout if source.live else np.inf
        self._deadline_s = time.monotonic() + silence
        if not source.live and not self._wanted():
            return not self._stopped.wait(_IDLE_PAUSE_S)
        image = next(source.images, None)
        if not self._goes_on():
            return False
        if image is None:
            self._deadline_s = np.inf
            self._set_state('ended')
            return False
        if isinstance(image, CameraError):
            self._reject(str(image))
            return True
        if not source.live or self._frozen.add(image):
            if self._status.state == 'running':
                self._pause_s = _REOPEN_FIRST_S
            self._set_state('running')
        # A device may repeat its last image even after it was reopened.
        if source.live and self._frozen.frozen_for_s():
            raise CameraError(f'the last image has been repeated for {FROZEN_S:g} s')
        self._deliver(image)
        return True
