# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ROS 2 node: images of an omnidirectional camera in, panoramas out, with the images' stamps.

Images come from a topic, a device, a video file or a folder. The node works only while somebody
subscribes, and uses only the newest of images that come too fast.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import numpy as np
from sensor_msgs.msg import CameraInfo, CompressedImage, Imu
from sensor_msgs.msg import Image as ImageMessage
from std_msgs.msg import String

from sfa_localization.camera.calibration_files import calibration_of_info
from sfa_localization.camera.capture import Feed, FeedStatus, opener
from sfa_localization.camera.encodings import JPEG_QUALITY
from sfa_localization.camera.leveling import leveled, tilts_at
from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.rim_watch import RimWatch
from sfa_localization.camera.sectors import MountedCamera
from sfa_localization.camera.settings import (
    CameraConfig,
    CaptureConfig,
    LensCalibration,
    PanoramaConfig,
    SurroundConfig,
)
from sfa_localization.camera.surround import Surround
from sfa_localization.camera.watch import FrozenWatch
from sfa_localization.data.errors import ConfigError, MessageError
from sfa_localization.data.image_topics import CAMERA_INFO
from sfa_localization.data.messages import read_stamp, read_tilt
from sfa_localization.data.run import Image
from sfa_localization.data.settings import Settings
from sfa_localization.nodes import conversions as convert
from sfa_localization.nodes import lifecycle
from sfa_localization.nodes.discovery import Discovery
from sfa_localization.nodes.image_input import ImageInput, calibration_topic
from sfa_localization.nodes.lifecycle import ERROR, OK, WARN
from sfa_localization.nodes.monitor import steady_s
from sfa_localization.nodes.parameters import Current
from sfa_localization.nodes.settings import OmnicamNodeConfig
from sfa_localization.nodes.surround_input import SurroundInput
from sfa_localization.place_model import camera_of, surround_of

_DEMAND_PERIOD_S = 0.1  # between checks for subscribers: a new one waits no longer for images
_LITTLE_VISIBLE = 0.5  # a smaller visible share of the panorama gives a warning
_IMU = 'imu/data'
_ORIENTATIONS = 500  # the number kept: those of a second or more


class OmnicamNode(lifecycle.LocalizationNode):
    """Unwraps each image and publishes it as `panorama` and `panorama/compressed`.

    Lens and panorama are those of the `model`; parameters that describe a lens replace its lens.
    `panorama/info`, latched, gives the elevations of the rows and the direction of the columns.
    """

    def __init__(self, **options: Any) -> None:
        groups = [OmnicamNodeConfig, CaptureConfig, CameraConfig, SurroundConfig, PanoramaConfig]
        super().__init__('omnicam_node', groups, **options)
        self._config = self.settings(OmnicamNodeConfig)
        self._size: tuple[int, int] | None = None
        self.hand_over: Callable[[int, Image, str], None] | None = None
        """Takes each panorama, with stamp and frame, in the same process."""
        self._begin()

    def _begin(self) -> None:
        self._feed: Feed | None = None
        self._losses = 0
        self._listening_since_s: float | None = None
        self._images: ImageInput | None = None
        self.around: SurroundInput | None = None
        self._told_troubles = ''
        self._calibrations: Any = None
        self._lens: LensCalibration | None = None
        self._trained: PanoramaConfig | None = None
        self._rim: RimWatch | None = None
        self._imu: Any = None
        self._unwrapper = self._new_unwrapper(self._settings)
        self._newest: deque[tuple[int, Image]] = deque(maxlen=1)
        self._tilts: deque[tuple[int, float, float]] = deque(maxlen=_ORIENTATIONS)
        self._is_level = True

    # Life cycle.

    def setup(self) -> None:
        if self._config.model:
            self._use(self._config.model)
        self._unwrapper.check(self._size)
        self._frozen = FrozenWatch()
        self._panoramas = self.publisher(ImageMessage, 'panorama', 2)
        compressed = self.following('panorama/compressed')
        self._compressed = self.publisher(CompressedImage, compressed, 2)
        info = self.following('panorama/info')
        self._info = self.publisher(String, info, lifecycle.latched_qos())
        transport = self._config.image_transport
        raw = transport == 'raw'
        self._input = 'image_raw' if raw else self.following(f'image_raw/{transport}')
        self.discovery: Discovery | None = None
        self._substitute = '', ''
        capture = self.settings(CaptureConfig)
        cameras = surround_of(self._config.model) if self._config.model else ()
        if cameras or self.settings(SurroundConfig).cameras:
            self._look_around(cameras)
        elif capture.source == 'topic':
            self.require_input(self._input)
            self._images = ImageInput(self, transport, self._input, self._unwrap)
            types = self._images.types
            arguments = ('image', 'panorama')
            self.discovery = Discovery(self, self._input, types, arguments, self._take)
        else:
            self._input = capture.source_path
            self._arrival = self.create_guard_condition(self._arrived)
            self._feed = Feed(opener(capture), self._deliver, capture, self._reject, self._wanted)
        if self.settings(CameraConfig).level_by_imu:
            self._listen_to_imu()
            types = ['sensor_msgs/msg/Imu']
            self._imus = Discovery(self, _IMU, types, ['imu'], self._listen_to_imu)
        self.every(_DEMAND_PERIOD_S, self._follow_demand)

    def _look_around(self, trained: Sequence[MountedCamera]) -> None:
        """Take images of several cameras. Raises ConfigError where parameters describe one."""
        camera = self.settings(CameraConfig)
        usual = CameraConfig(level_by_imu=camera.level_by_imu, blind_sectors=camera.blind_sectors)
        if camera != usual or self.settings(CaptureConfig).source != 'topic':
            raise ConfigError(
                'source, camera_model, calibration_file, mount_rpy and mask_file are for one '
                'camera, but there are several: leave these parameters out'
            )
        latched = lifecycle.latched_qos()
        self._troubles = self.publisher(String, self.following('panorama/troubles'), latched)
        self.around = SurroundInput(
            self,
            self._config.image_transport,
            self.settings(SurroundConfig),
            trained,
            partial(self._new_surround, self._settings),
            self._publish_joined,
        )
        self._input = next(iter(self.around.topics.values()))

    def _new_surround(self, settings: Current, cameras: Sequence[MountedCamera]) -> Surround:
        """What makes panoramas of cameras. Raises CameraError."""
        camera = cast(CameraConfig, settings[CameraConfig])
        panorama = self._trained or cast(PanoramaConfig, settings[PanoramaConfig])
        surround = Surround(cameras, panorama, camera.blind_sectors)
        surround.check()
        return surround

    def _use(self, model: str) -> None:
        """Take panorama and lens from a model. Raises ModelError, and ConfigError for parameters
        that ask for another panorama.
        """
        self._trained, lens = camera_of(model)
        differences = self._trained.asked_differences(self.settings(PanoramaConfig))
        if differences:
            raise ConfigError(
                f'the panorama of {model} differs from parameters of omnicam_node: {differences}; '
                'leave these out, or train with them'
            )
        self._lens = None if self.settings(CameraConfig).is_described else lens
        self._unwrapper = self._new_unwrapper(self._settings, self._lens)
        if self._lens is not None and self._lens.radius_max:
            self._rim = RimWatch(self._lens)

    @property
    def _panorama(self) -> PanoramaConfig:
        return self._trained or self.settings(PanoramaConfig)

    def started(self) -> None:
        self._info.publish(convert.to_info(self._panorama))
        self._follow_demand()
        if self._feed is not None and self._feed.status().state == 'new':
            self._feed.start()

    def teardown(self) -> None:
        if self._feed is not None:
            self._feed.stop()
            self.destroy_guard_condition(self._arrival)
        self._begin()

    # Without subscribers to panoramas no images are taken.

    def _wanted(self) -> bool:
        outputs = (self._panoramas, self._compressed)
        heard = any(output.get_subscription_count() for output in outputs)
        return self.active and (heard or self.hand_over is not None)

    def _follow_demand(self) -> None:
        if self._feed is not None:
            self._report_loss(self._feed.check())
        elif not self._wanted():
            self._stop_listening()
        elif self._listening_since_s is None:
            self._listening_since_s = steady_s()
            self._start_listening()

    def _start_listening(self) -> None:
        if self.around is not None:
            self.around.start()
        if self._images is not None:
            self._images.start(*self._substitute)
            if self._lens is None and not self.settings(CameraConfig).is_described:
                take = self._take_calibration
                qos = lifecycle.sensor_qos(1)
                topic = calibration_topic(self, CAMERA_INFO, self._input)
                self._calibrations = self.subscribe(CameraInfo, CAMERA_INFO, take, qos, topic)

    def _take_calibration(self, message: CameraInfo) -> None:
        """Use the first that describes a lens."""
        lens = calibration_of_info(message)
        if self._lens is None:
            unwrapper = self._new_unwrapper(self._settings, lens)
            unwrapper.check(self._size)
            self._lens = lens
            self._unwrapper = unwrapper
            camera = f'{lens.camera_model} camera of {lens.image_width} x {lens.image_height}'
            self.get_logger().info(f'{self.full_name(CAMERA_INFO)} describes a {camera} pixels')
        elif lens != self._lens:
            raise MessageError('another calibration than the first, which stays until a restart')

    def _report_loss(self, status: FeedStatus) -> None:
        """Log and count each time that the source could not be opened, or was lost."""
        if status.lost > self._losses:
            self._losses = status.lost
            problem = status.problem
            self._reject(f'lost: {problem}' if self._size else f'cannot open: {problem}')

    def _take(self, topic: str, kind: str) -> None:
        """Take images from a substitute for the input's topic, or again from that itself."""
        self._stop_listening()
        self.require_input(self._input, topic)
        self._substitute = topic, kind

    def _stop_listening(self) -> None:
        if self._images is not None:
            self._images.stop()
        if self.around is not None:
            self.around.stop()
        self.unsubscribe(self._calibrations)
        self._listening_since_s = self._calibrations = None

    def _deliver(self, image: Image) -> None:
        """Keep the newest image, and wake the executor; called by the feed's thread."""
        self._newest.append((self.get_clock().now().nanoseconds, image))
        self._arrival.trigger()

    def _reject(self, reason: str) -> None:
        self.refuse(self._input, reason)

    def _arrived(self) -> None:
        if self._newest and self._wanted():
            self.take(self._input, self._use_delivered, self._newest.pop())

    def _use_delivered(self, delivered: tuple[int, Image]) -> None:
        stamp_ns, image = delivered
        if stamp_ns <= 0:
            raise MessageError('the clock has not started')
        self._unwrap(stamp_ns, image, '')

    def _listen_to_imu(self, substitute: str = '', _: str = '') -> None:
        self.unsubscribe(self._imu)
        qos = lifecycle.sensor_qos(20)
        self._imu = self.subscribe(Imu, _IMU, self._take_orientation, qos, substitute)

    def _take_orientation(self, message: Imu) -> None:
        stamp_ns = read_stamp(message.header.stamp)
        tilt = read_tilt(message)
        if self._tilts and stamp_ns <= self._tilts[-1][0]:
            self._tilts.clear()  # time has stepped back
        self._tilts.append((stamp_ns, *tilt))

    def _leveled(self, panorama: Image, stamp_ns: int) -> Image:
        """The panorama, leveled by an orientation near its stamp if there is one."""
        if not self.settings(CameraConfig).level_by_imu:
            return panorama
        stamps_ns = np.array([stamp for stamp, *_ in self._tilts], np.int64)
        tilts = np.reshape([tilt for _, *tilt in self._tilts], (-1, 2))
        (tilt,) = tilts_at(np.array([stamp_ns]), stamps_ns, tilts)
        self._is_level = bool(np.isfinite(tilt).all())
        sphere = self._panorama.sphere
        return leveled(panorama, tilt, sphere) if self._is_level else panorama

    def _unwrap(self, stamp_ns: int, image: Image, frame: str) -> None:
        panorama = self._unwrapper(image)
        self._size = (image.shape[0], image.shape[1])
        self._publish(stamp_ns, panorama, frame)
        self._frozen.add(image)
        if self._rim is not None:
            self._rim.add(image)

    def _publish_joined(self, stamp_ns: int, panorama: Image) -> None:
        """Publish a panorama of several cameras, and what it lacks if that has changed."""
        assert self.around is not None and self.around.surround is not None
        self._publish(stamp_ns, panorama, '')
        self._frozen.add(panorama)
        troubles = '; '.join(self.around.surround.problems)
        if troubles != self._told_troubles:
            self._told_troubles = troubles
            self._troubles.publish(String(data=troubles))

    def _publish(self, stamp_ns: int, panorama: Image, frame: str) -> None:
        panorama = self._leveled(panorama, stamp_ns)
        frame = self._config.frame_id or frame or 'omnicam'
        if self.hand_over is not None:
            self.hand_over(stamp_ns, panorama, frame)
        if self._panoramas.get_subscription_count():
            self._panoramas.publish(convert.to_image(panorama, stamp_ns, frame))
        if self._compressed.get_subscription_count():
            compressed = convert.to_compressed(panorama, stamp_ns, frame, JPEG_QUALITY)
            self._compressed.publish(compressed)

    # Parameters that change while running.

    def check(self, settings: Current) -> None:
        """Raises LocalizationError for a mask, sector, mount or elevation that hides all."""
        if all(settings[kind] == self._settings[kind] for kind in (CameraConfig, PanoramaConfig)):
            return
        if self.around is not None and self.around.surround is not None:
            self._new_surround(settings, self.around.surround.cameras)
        else:
            self._new_unwrapper(settings, self._lens).check(self._size)

    def settings_changed(self, settings: Settings) -> None:
        if isinstance(settings, CaptureConfig) and self._feed is not None:
            self._feed.config = settings
        elif isinstance(settings, (CameraConfig, PanoramaConfig)):
            self._unwrapper = self._new_unwrapper(self._settings, self._lens)
            if self.around is not None:
                self.around.remake()
            if self.active:
                self._info.publish(convert.to_info(self._panorama))

    def _new_unwrapper(self, settings: Current, lens: LensCalibration | None = None) -> Unwrapper:
        camera = settings[CameraConfig]
        panorama = self._trained or settings[PanoramaConfig]
        return Unwrapper(cast(CameraConfig, camera), cast(PanoramaConfig, panorama), lens)

    def health(self) -> tuple[int, str, dict[str, str]]:
        details = {'camera model': self._unwrapper.model}
        if self._size is not None:
            details['image'] = f'{self._size[1]} x {self._size[0]}'
        level, text = self._judge_source(details)
        if not text:
            level, text = self._judge_images(details)
        return level, text or 'running', details

    def _judge_source(self, details: dict[str, str]) -> tuple[int, str]:
        if self._feed is not None:
            status = self._feed.status()
            details['source'] = status.state
            details['source lost'] = str(status.lost)
            if status.state == 'lost':
                return ERROR, f'camera lost, will be opened again: {status.problem}'
            if status.state == 'opening':
                return WARN, 'opening the camera'
            return OK, 'at the end of the images' if status.state == 'ended' else ''
        if self._listening_since_s is None:
            return OK, 'idle: nobody listens to the panorama'
        listening_s = steady_s() - self._listening_since_s
        patience_s = self.settings(CaptureConfig).silence_timeout
        if self.around is not None:
            return self.around.judge(details, patience_s, listening_s)
        silent_s = min(self.monitors[self._input].silent_for_s(), listening_s)
        if silent_s > patience_s:
            silent = f'no image on {self.full_name(self._input)} for {silent_s:.0f} s'
            return ERROR, (self.discovery and self.discovery.hint) or silent
        return OK, ''

    def _judge_images(self, details: dict[str, str]) -> tuple[int, str]:
        frozen_s = self._frozen.frozen_for_s()
        monitor = self.monitors[self._input]
        if frozen_s:
            return WARN, f'the camera has repeated its last image for {frozen_s:.0f} s'
        if monitor.received and not monitor.used:
            return ERROR, 'no image could be used so far'
        visible = 1.0 if self._size is None else self._unwrapper.visible(self._size).mean()
        details.setdefault('panorama visible [%]', f'{100 * visible:.0f}')
        if visible < _LITTLE_VISIBLE:
            return WARN, f'the camera sees only {100 * visible:.0f} % of the panorama'
        if self._rim is not None and self._rim.problem:
            return WARN, self._rim.problem
        if not self._is_level:
            topic = self.full_name(_IMU)
            missing = f'no orientation on {topic} near images: panoramas are not leveled'
            return WARN, '; '.join(filter(None, (missing, self._imus.hint)))
        return OK, ''
