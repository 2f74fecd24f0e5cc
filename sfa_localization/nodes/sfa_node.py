# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ROS 2 node: panoramas in; slow features, and the pose from each image, out."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, QuaternionStamped
from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.settings import (
    CameraConfig,
    LensCalibration,
    PanoramaConfig,
    WatchConfig,
)
from sfa_localization.camera.watch import DROWNED_WARNING, EXPLAINED_WARNING, drowned_text
from sfa_localization.data.errors import ConfigError, MessageError
from sfa_localization.data.run import Image
from sfa_localization.data.settings import Settings
from sfa_localization.data.transforms import TOPIC, TransformTree
from sfa_localization.fusion.camera_clock import NEAR_NS
from sfa_localization.mapping.settings import GroundConfig
from sfa_localization.nodes import conversions as convert
from sfa_localization.nodes.discovery import Discovery
from sfa_localization.nodes.image_input import ImageInput
from sfa_localization.nodes.lifecycle import (
    ERROR,
    OK,
    WARN,
    LocalizationNode,
    TFMessage,
    latched_qos,
    static_qos,
)
from sfa_localization.nodes.parameters import Current
from sfa_localization.nodes.settings import SfaNodeConfig
from sfa_localization.observer import Observation, Observer
from sfa_localization.place_model import PlaceModel

_FEATURE_FRAME = 'slow_feature_space'
_TURNED_FRAME = 'first_image'
_MOSTLY = 0.9
"""Share of the images that come in the order of their stamps where the driver is right: a bag that
is played in a loop steps back once in hundreds."""


class SfaNode(LocalizationNode):
    """Locates each panorama with the trained model; the `model` parameter may change live."""

    def __init__(self, **options: Any) -> None:
        super().__init__('sfa_node', [SfaNodeConfig, WatchConfig], **options)
        self._config = self.settings(SfaNodeConfig)
        self._observer: Observer | None = None
        self._loaded: PlaceModel | None = None
        self.takes_panoramas = True
        """From a topic; or omnicam_node, in the same process, hands them over."""

    def setup(self) -> None:
        self._observer = Observer(self._load(self._config.model), self.settings(WatchConfig))
        self._last: Observation | None = None
        self._turned_ns = 0
        self._located = 0
        self._in_order = 0
        self._features = self.publisher(Float64MultiArray, 'sfa/slow_features')
        self._feature_pose = self.publisher(PoseStamped, 'sfa/slow_feature_pose')
        self._pose = self.publisher(PoseStamped, 'sfa/pose')
        self._uncertain = self.publisher(PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
        latched = latched_qos()
        self._rig = self.publisher(String, 'sfa/rig', latched)
        self._map = self.publisher(OccupancyGrid, 'sfa/map', latched)
        self._paths = self.publisher(MarkerArray, 'sfa/map_paths', latched)
        self._turned = self.publisher(QuaternionStamped, 'sfa/turned')
        self._troubles = self.publisher(String, 'sfa/troubles', latched)
        self._told_troubles = ''
        self.service(Trigger, '~/reload_model', self._reload)
        self._declared: PanoramaConfig | None = None
        self._frames = TransformTree()
        self._camera_frame = ''
        if TFMessage is not None:
            self.subscribe(TFMessage, TOPIC, self._frames.add, static_qos())
        self._info = self.following('panorama/info')
        self.subscribe(String, self._info, self._receive_info, latched)
        transport = self._config.image_transport if self.takes_panoramas else 'raw'
        self._topic = 'panorama' if transport == 'raw' else self.following(f'panorama/{transport}')
        images = ImageInput(self, transport, self._topic, self._locate)
        if self.takes_panoramas:
            images.start()
        self.discovery = Discovery(self, self._topic, images.types, ['panorama'])

    def started(self) -> None:
        self._publish_map()

    def teardown(self) -> None:
        self._observer = None

    def _load(self, path: str) -> PlaceModel:
        """Load a model. Raises LocalizationError if it is missing or damaged."""
        if not path:
            raise ConfigError(
                "parameter 'model' is empty: name the file that the train command wrote "
                '(--ros-args -p model:=MODEL.npz)'
            )
        return PlaceModel.load(Path(path))

    def check(self, settings: Current) -> None:
        """Load a new model, in any state. Raises LocalizationError if that fails."""
        path = cast(SfaNodeConfig, settings[SfaNodeConfig]).model
        if path != self._config.model:
            self._loaded = self._load(path)

    def settings_changed(self, settings: Settings) -> None:
        if isinstance(settings, WatchConfig) and self._observer is not None:
            self._observer.watch.config = settings
        if isinstance(settings, SfaNodeConfig):
            before = self._config
            self._config = settings
            if settings.model != before.model and self._loaded is not None:
                self._use(self._loaded)
            self._loaded = None

    def _use(self, model: PlaceModel) -> None:
        """Switch to another model; an unconfigured node loads its model when configured."""
        if self._observer is not None:
            self._observer.use(model)
            self._publish_map()

    def _reload(self, _: Any) -> str:
        self._use(self._load(self._config.model))
        return f'loaded {self._config.model}'

    def _publish_map(self) -> None:
        """Publish where the robot drove in training, and what ekf_node needs to know."""
        assert self._observer is not None
        model = self._observer.model
        frame = self._config.map_frame
        now_ns = self.get_clock().now().nanoseconds
        self._rig.publish(convert.to_rig(model.rig, model.error_correlation))
        self._map.publish(convert.to_grid(model.ground.cells(GroundConfig()), now_ns, frame))
        self._paths.publish(convert.to_lines(model.ground, now_ns, frame))

    def _receive_info(self, message: String) -> None:
        self._declared = convert.read_info(message)

    def _declared_problem(self, expected: PanoramaConfig) -> str:
        """The differences between declared panoramas and those of training; '' without any."""
        differences = expected.differences(self._declared) if self._declared is not None else ''
        if not differences:
            return ''
        return (
            f'panorama is declared to differ from those of training: {differences}; '
            'set these parameters of omnicam_node'
        )

    def receive(self, stamp_ns: int, image: Image, frame: str) -> None:
        """Take a panorama as if it had come from its topic."""
        if self.active:
            self.take(
                self._topic, lambda panorama: self._locate(*panorama), (stamp_ns, image, frame)
            )

    def _camera_problem(self) -> str:
        """Where /tf_static has the camera otherwise than the model; '' where it has not."""
        assert self._observer is not None
        lever = self._frames.lever(self._camera_frame, self._config.base_frame)
        return '' if lever is None else self._observer.model.rig.displaced(lever)

    def _tell_troubles(self) -> None:
        """Publish where the camera is otherwise than in training, if that has changed."""
        problem = self._camera_problem()
        if problem != self._told_troubles:
            self._told_troubles = problem
            self._troubles.publish(String(data=problem))

    def _order_problem(self) -> str:
        """That the camera's driver sends images in another order than it took them; '' if not."""
        if self._in_order + 1 >= _MOSTLY * self._located:
            return ''
        late = f'{self._located - self._in_order} of {self._located} images come after later ones'
        return f'{late}: the driver must send images in the order in which it takes them'

    def _locate(self, stamp_ns: int, image: Image, frame: str) -> None:
        assert self._observer is not None
        self._camera_frame = frame
        self._tell_troubles()
        model = self._observer.model
        if problem := self._declared_problem(model.panorama):
            raise MessageError(problem)
        of_panoramas = model.lens is not None and model.lens.camera_model == 'panorama'
        if self._declared is None and of_panoramas:  # omnicam_node would have mounted it
            image = _unwrapper(model.lens, model.panorama)(image)
        self._located += 1
        self._in_order += self._last is None or stamp_ns >= self._last.stamp_ns
        self._last = observation = self._observer.observe(stamp_ns, image)
        self._publish(observation)
        if observation.problem:
            raise MessageError(observation.problem)

    def _publish(self, seen: Observation) -> None:
        """Publish an observation; a pose of an unusable image only with its large covariance."""
        frame = self._config.map_frame
        slow = seen.slow_features
        stamp_ns = seen.stamp_ns
        if np.all(np.isfinite(slow)):
            self._features.publish(convert.to_array(slow, 'slow features'))
            self._feature_pose.publish(_feature_pose(slow, stamp_ns))
        if math.isfinite(seen.turned) and not 0 <= stamp_ns - self._turned_ns < NEAR_NS:
            self._turned_ns = stamp_ns
            self._turned.publish(convert.to_turned(seen.turned, stamp_ns, _TURNED_FRAME))
        if not seen.problem:
            self._pose.publish(convert.to_pose(seen.pose, stamp_ns, frame))
        located = seen.pose, seen.covariance, stamp_ns, frame
        self._uncertain.publish(convert.to_pose_with_covariance(*located))

    def health(self) -> tuple[int, str, dict[str, str]]:
        assert self._observer is not None
        values = {'model': self._config.model}
        explained = 1.0
        drowned = 0.0
        if self._last is not None:
            drowned = self._last.drowned
            explained = self._last.explained
            factor = self._observer.slow_error_factor
            values['explained'] = f'{100 * explained:.0f} %'
            values['slow feature errors'] = f'{factor:.1f} times as in training'
        monitor = self.monitors[self._topic]
        topic = self.full_name(self._topic)
        silent = monitor.silent_for_s()
        if math.isinf(silent):
            return WARN, self.discovery.hint or f'waiting for images on {topic}', values
        if silent > self._config.silence_timeout:
            return ERROR, f'no image on {topic} for {silent:.0f} s', values
        if problem := self._declared_problem(self._observer.model.panorama):
            return ERROR, problem, values
        if monitor.used == 0:
            return ERROR, 'no image has been usable', values
        if self._last is not None and self._last.problem:
            return WARN if self._observer.watch.repeats else ERROR, self._last.problem, values
        if problem := self._camera_problem() or self._order_problem():
            self.get_logger().warning(problem, once=True)
            return WARN, problem, values
        if drowned > DROWNED_WARNING:
            return WARN, drowned_text(drowned), values
        if explained < EXPLAINED_WARNING:
            return WARN, 'images are unlike those of training', values
        return OK, 'locating', values


@lru_cache(maxsize=1)
def _unwrapper(lens: LensCalibration, panorama: PanoramaConfig) -> Unwrapper:
    return Unwrapper(CameraConfig(), panorama, lens)


def _feature_pose(slow: Any, stamp_ns: int) -> PoseStamped:
    """The first three slow features as a position, as the paper draws them."""
    x, y, z = [*map(float, slow[:3]), 0.0, 0.0, 0.0][:3]
    message = convert.to_pose([x, y, 0.0], stamp_ns, _FEATURE_FRAME)
    message.pose.position.z = z
    return message
