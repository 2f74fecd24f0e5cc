# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures from a V4L2 device, a video file or a folder, and a watch over the camera.

A camera that disconnects, goes silent or repeats its last picture is closed and opened again,
with pauses that double. Knows nothing of ROS; time is the steady clock's.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from sfa_localization.camera.encodings import decode_compressed
from sfa_localization.camera.settings import OmnicamNodeConfig
from sfa_localization.data.errors import CameraError
from sfa_localization.data.run import Image

logger = logging.getLogger(__name__)

_SUFFIXES = ('.png', '.jpg', '.jpeg', '.bmp', '.ppm', '.pgm', '.tif', '.tiff', '.webp')
_USUAL_RATE = 10.0
_OPENING_S = 10.0  # devices may take so long
_IDLE_PAUSE_S = 0.02
_SAMPLES = 32  # rows, and as densely columns, that are compared to find a repeated picture


class Capture(Protocol):
    """An opened source of pictures."""

    live: bool
    """Whether it goes on by itself: a device, as opposed to files."""

    def read(self) -> Image | None:
        """The next picture (H, W, 3) uint8 BGR; None at the end of files.

        Blocks until there is one. Raises CameraError when there will be no more, or when one
        picture of several is unusable.
        """

    def close(self) -> None:
        """Let go of the device or file."""


def opener(config: OmnicamNodeConfig) -> Callable[[], Capture]:
    """What opens the source named by the parameters; raises CameraError where none is named."""
    if config.source == 'topic':
        raise CameraError('pictures from a topic need no source to be opened')
    if not config.source_path:
        raise CameraError(f'source_path is empty: name the {config.source} to take pictures from')
    kinds: dict[str, Callable[[OmnicamNodeConfig], Capture]] = {
        'device': Device,
        'video': Video,
        'folder': Folder,
    }
    return lambda: kinds[config.source](config)


class Device:
    """A V4L2 device, through OpenCV."""

    live = True

    def __init__(self, config: OmnicamNodeConfig) -> None:
        self._path = path = config.source_path
        if not path.isdigit() and not Path(path).exists():
            raise CameraError(f'device {path} is not there')
        self._capture = cv2.VideoCapture(int(path) if path.isdigit() else path, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise CameraError(f'device {path} cannot be opened: is it there, and not in use?')
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        for prop, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, config.source_width),
            (cv2.CAP_PROP_FRAME_HEIGHT, config.source_height),
            (cv2.CAP_PROP_FPS, config.source_rate),
        ):
            if value:
                self._capture.set(prop, value)

    def read(self) -> Image | None:
        done, picture = self._capture.read()
        if not done or picture is None:
            raise Lost(f'device {self._path} is disconnected')
        return _bgr(picture)

    def close(self) -> None:
        self._capture.release()


class Lost(CameraError):
    """The source has to be opened again."""


class _Pacer:
    """Waits so that pictures come at a rate; a reader that is late does not catch up."""

    def __init__(self, rate_hz: float) -> None:
        self._period = 1.0 / rate_hz
        self._due = time.monotonic()

    def wait(self) -> None:
        now = time.monotonic()
        if self._due > now:
            time.sleep(self._due - now)
        self._due = max(self._due, now) + self._period


class Video:
    """A video file, at its own rate or another."""

    live = False

    def __init__(self, config: OmnicamNodeConfig) -> None:
        self._path, self._loop = config.source_path, config.source_loop
        self._capture = cv2.VideoCapture(self._path)
        if not Path(self._path).is_file() or not self._capture.isOpened():
            raise CameraError(f'video {self._path} is missing, or of a kind OpenCV cannot read')
        own = self._capture.get(cv2.CAP_PROP_FPS)
        self._pacer = _Pacer(config.source_rate or (own if 0.1 < own < 1000 else _USUAL_RATE))

    def read(self) -> Image | None:
        self._pacer.wait()
        done, picture = self._capture.read()
        if not done and self._loop:
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
            done, picture = self._capture.read()
        return _bgr(picture) if done else None

    def close(self) -> None:
        self._capture.release()


class Folder:
    """The pictures of a folder in the order of their names."""

    live = False

    def __init__(self, config: OmnicamNodeConfig) -> None:
        folder = Path(config.source_path)
        if not folder.is_dir():
            raise CameraError(f'folder {folder} is missing')
        self._files = sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES)
        if not self._files:
            raise CameraError(f'folder {folder} holds no pictures ({" ".join(_SUFFIXES)})')
        self._next, self._loop = 0, config.source_loop
        self._pacer = _Pacer(config.source_rate or _USUAL_RATE)

    def read(self) -> Image | None:
        if self._next == len(self._files):
            if not self._loop:
                return None
            self._next = 0
        path = self._files[self._next]
        self._next += 1
        self._pacer.wait()
        try:
            return decode_compressed(path.read_bytes())
        except (CameraError, OSError) as error:
            raise CameraError(f'picture {path.name}: {error}') from None

    def close(self) -> None:
        self._next = 0


def _bgr(picture: Any) -> Image:
    """What OpenCV captured as BGR: some devices deliver grey."""
    if picture.ndim == 2 or picture.shape[2] == 1:
        picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    return np.asarray(picture, np.uint8)


class FrozenWatch:
    """Tells for how long the pictures have been equal."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._sample: Image | None = None
        self._since = 0.0
        self._repeats = 0

    def see(self, picture: Image) -> bool:
        """Note a picture; True when it differs from the last one."""
        step = max(min(picture.shape[:2]) // _SAMPLES, 1)
        sample = picture[::step, ::step]
        if self._sample is not None and np.array_equal(sample, self._sample):
            self._repeats += 1
            return False
        self._sample, self._since, self._repeats = sample.copy(), self._clock(), 0
        return True

    def frozen_for_s(self) -> float:
        """Seconds since the last picture that was new; 0 while there are no repetitions."""
        return self._clock() - self._since if self._repeats > 1 else 0.0


@dataclass(frozen=True, slots=True)
class FeedStatus:
    """How a feed is: new, opening, running, lost (will be opened again) or ended.

    `lost` counts how often it was lost.
    """

    state: str = 'new'
    problem: str = ''
    lost: int = 0


class Feed:
    """Reads a capture in a thread of its own and opens it again when it fails.

    `deliver` takes each picture and `refuse` the reason why one is unusable, both in that thread.
    Files wait while `wanted` returns False. `check` must be called now and then from elsewhere:
    only there a read that never returns can be noticed.
    """

    def __init__(
        self,
        open_capture: Callable[[], Capture],
        deliver: Callable[[Image], None],
        config: OmnicamNodeConfig,
        refuse: Callable[[str], None] = lambda reason: None,
        wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        self.config = config
        self._open, self._deliver = open_capture, deliver
        self._refuse, self._wanted = refuse, wanted
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._generation = 0
        self._status = FeedStatus()
        self._defect = ''
        self._pause_s = config.reopen_min
        self._deadline_s = np.inf  # when a read or an opening in progress counts as hanging
        self._frozen = FrozenWatch()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Open the source and deliver pictures until `stop`."""
        self._begin(pause=False)

    def stop(self) -> None:
        """Deliver nothing more; a read that hangs is left behind."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join(timeout=1.0)

    def status(self) -> FeedStatus:
        """How the feed is, as far as its thread knows."""
        with self._lock:
            return self._status

    def check(self) -> FeedStatus:
        """Abandon an opening or a read that hangs; return the status."""
        if time.monotonic() > self._deadline_s and not self._stopped.is_set():
            self._lose(f'silent for {self.config.silence_timeout:g} s')
            self._begin(pause=True)
        return self.status()

    def _begin(self, pause: bool) -> None:
        with self._lock:
            self._generation += 1
            generation = self._generation
        self._deadline_s = np.inf
        self._thread = threading.Thread(target=self._run, args=(generation, pause), daemon=True)
        self._thread.start()

    def _lose(self, problem: str) -> None:
        with self._lock:
            self._status = FeedStatus('lost', problem, self._status.lost + 1)

    def _tell(self, state: str) -> None:
        with self._lock:
            self._status = FeedStatus(state, '', self._status.lost)

    def _is_current(self, generation: int) -> bool:
        with self._lock:
            return generation == self._generation and not self._stopped.is_set()

    def _run(self, generation: int, pause: bool) -> None:
        if pause:
            self._back_off()
        while self._is_current(generation):
            try:
                self._read_all(generation)
                return
            except Exception as error:  # whatever it is, the camera is to be opened again
                if not self._is_current(generation):
                    return
                self._lose(self._problem(error))
            self._back_off()

    def _problem(self, error: Exception) -> str:
        """What went wrong; what is no trouble of a camera is a defect, and is shown as one."""
        if isinstance(error, (CameraError, cv2.error, OSError)):
            return str(error)
        text = f'internal error: {type(error).__name__}'
        self._refuse(text)
        if text != self._defect:
            self._defect = text
            logger.error('%s', text, exc_info=error)
        return text

    def _back_off(self) -> None:
        self._deadline_s = np.inf
        pause, self._pause_s = self._pause_s, min(2 * self._pause_s, self.config.reopen_max)
        self._stopped.wait(pause)

    def _expect(self, within_s: float) -> None:
        self._deadline_s = time.monotonic() + within_s

    def _read_all(self, generation: int) -> None:
        """Open, and read to the end; raises CameraError when the source has to be opened again."""
        self._expect(_OPENING_S + self.config.silence_timeout)
        if self.status().state == 'new':
            self._tell('opening')
        capture = self._open()
        try:
            while self._is_current(generation) and self._read_one(capture, generation):
                pass
        finally:
            capture.close()

    def _read_one(self, capture: Capture, generation: int) -> bool:
        """Deliver one picture; False at the end."""
        self._expect(self.config.silence_timeout if capture.live else np.inf)
        if not capture.live and not self._wanted():
            return not self._stopped.wait(_IDLE_PAUSE_S)
        try:
            picture = capture.read()
        except Lost:
            raise
        except CameraError as error:
            self._refuse(str(error))
            return True
        return self._is_current(generation) and self._accept(picture, capture.live)

    def _accept(self, picture: Image | None, live: bool) -> bool:
        if picture is None:
            self._deadline_s = np.inf
            self._tell('ended')
            return False
        if live:
            self._require_new(picture)
        elif self.status().state != 'running':
            self._tell('running')
        self._deliver(picture)
        return True

    def _require_new(self, picture: Image) -> None:
        """Raise Lost when the device repeats its last picture, also when it was opened again."""
        if self._frozen.see(picture):
            if self.status().state == 'running':
                self._pause_s = self.config.reopen_min
            self._tell('running')
        limit = self.config.frozen_timeout
        if 0.0 < limit < self._frozen.frozen_for_s():
            raise Lost(f'the last picture has been repeated for {limit:g} s')
