# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ROS 2 node: panoramas in; slow features, and the pose from each image, out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, QuaternionStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image as ImageMessage
from std_msgs.msg import Float64, Float64MultiArray, String
from std_srvs.srv import Trigger

from sfa_localization.camera.settings import PanoramaConfig, WatchConfig
from sfa_localization.camera.watch import NOVELTY_WARNING
from sfa_localization.data.errors import ConfigError, LocalizationError, MessageError
from sfa_localization.data.settings import Settings
from sfa_localization.localizer import Observation, Observer
from sfa_localization.nodes.conversions import (
    read_image,
    read_info,
    to_array,
    to_error_correlation,
    to_pose,
    to_pose_with_covariance,
    to_turned,
)
from sfa_localization.nodes.discovery import Discovery
from sfa_localization.nodes.lifecycle import LocalizationNode, latched_qos, run_node, sensor_qos
from sfa_localization.nodes.settings import SfaNodeConfig
from sfa_localization.place_model import PlaceModel

_FEATURE_FRAME, _TURNED_FRAME = 'slow_feature_space', 'first_image'
_OK, _WARN, _ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class SfaNode(LocalizationNode):
    """Locates each panorama with the trained model; the `model` parameter may change live."""

    def __init__(self, **options: Any) -> None:
        super().__init__('sfa_node', [SfaNodeConfig, WatchConfig], **options)
        self._config = self.settings(SfaNodeConfig)
        self._observer: Observer | None = None
        self._loaded: tuple[str, PlaceModel] | None = None
        self._last: Observation | None = None
        self._declared: PanoramaConfig | None = None
        self._undeclared_logged = False
        self.add_on_set_parameters_callback(self._check_model)

    def setup(self) -> None:
        self._config = self.settings(SfaNodeConfig)
        self._observer = Observer(self._load(self._config.model), self.settings(WatchConfig))
        self._last = None
        self._features = self.publisher(Float64MultiArray, 'sfa/slow_features')
        self._feature_pose = self.publisher(PoseStamped, 'sfa/slow_feature_pose')
        self._pose = self.publisher(PoseStamped, 'sfa/pose')
        self._uncertain = self.publisher(PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
        self._correlation = self.publisher(
            Float64MultiArray, 'sfa/error_correlation', latched_qos()
        )
        self._delay = self.publisher(Float64, 'sfa/camera_delay', latched_qos())
        self._turned = self.publisher(QuaternionStamped, 'sfa/turned')
        self.service(Trigger, '~/reload_model', self._reload)
        compressed = self._config.image_transport == 'compressed'
        kind = CompressedImage if compressed else ImageMessage
        self._topic = self.following('panorama/compressed') if compressed else 'panorama'
        self._declared, self._undeclared_logged = None, False
        self._info = self.following('panorama/info')
        self.subscribe(String, self._info, self._receive_info, latched_qos(), while_inactive=True)
        # Depth 1: when images come faster than they are located, the oldest is dropped.
        self.subscribe(kind, self._topic, self._receive, sensor_qos(1))
        kinds = [ImageMessage, CompressedImage]
        self._discovery = Discovery(self, self._topic, kinds, ['panorama'])

    def started(self) -> None:
        self._publish_correlation()

    def teardown(self) -> None:
        self._observer = None

    # The model.

    def _load(self, path: str) -> PlaceModel:
        """Read a model. Raises LocalizationError where it is missing or damaged."""
        if not path:
            raise ConfigError(
                "parameter 'model' is empty: name the file that the train command wrote "
                '(--ros-args -p model:=MODEL.npz)'
            )
        model = PlaceModel.load(Path(path))
        size = model.panorama
        self.get_logger().info(f'{path}: panoramas of {size.width}x{size.height}')
        return model

    def _check_model(self, changes: list[Parameter]) -> SetParametersResult:
        """Reject a model that cannot be loaded before anything changes, in any state."""
        for change in changes:
            if change.name == 'model':
                try:
                    self._loaded = str(change.value), self._load(str(change.value))
                except LocalizationError as error:
                    return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def settings_changed(self, settings: Settings) -> None:
        if isinstance(settings, WatchConfig) and self._observer is not None:
            self._observer.watch.config = settings
        if not isinstance(settings, SfaNodeConfig):
            return
        self._config = settings
        if self._loaded is not None and self._loaded[0] == settings.model:
            self._use(self._loaded[1])
        self._loaded = None

    def _use(self, model: PlaceModel) -> None:
        """Go on with another model; an unconfigured node reads its own when it is configured."""
        if self._observer is not None:
            self._observer.use(model)
            self._publish_correlation()

    def _reload(self, _: Any, response: Any) -> Any:
        self._use(self._load(self._config.model))
        response.success, response.message = True, f'loaded {self._config.model}'
        return response

    def _publish_correlation(self) -> None:
        """Publish how the model's errors correlate and how late images were: ekf_node needs it."""
        assert self._observer is not None
        correlation = self._observer.model.error_correlation
        self._correlation.publish(to_error_correlation(correlation))
        self._delay.publish(Float64(data=float(self._observer.model.camera_delay_s)))

    # Images.

    def _receive_info(self, message: String) -> None:
        self._declared = read_info(message)

    def _declared_problem(self, model: PlaceModel) -> str:
        """How the panoramas are declared to differ from those of training; '' when they do not."""
        if self._declared is None:
            self._log_undeclared(model.panorama)
            return ''
        differences = model.panorama.differences(self._declared)
        if not differences:
            return ''
        return (
            f'panorama is declared to differ from those of training: {differences}; '
            'set these parameters of omnicam_node'
        )

    def _log_undeclared(self, expected: PanoramaConfig) -> None:
        """Log once that elevations and direction of a foreign source's panoramas are assumed."""
        if self._undeclared_logged or self.count_publishers(self.resolve_topic_name(self._info)):
            return
        self._undeclared_logged = True
        self.get_logger().info(
            f'nobody publishes on {self.shown(self._info)} what the panoramas show: assumed are '
            f'{expected.elevation_min:g} to {expected.elevation_max:g} deg, '
            f'{"clockwise" if expected.clockwise else "counterclockwise"}, as in training'
        )

    def _receive(self, message: ImageMessage | CompressedImage) -> None:
        assert self._observer is not None
        problem = self._declared_problem(self._observer.model)
        if problem:
            raise MessageError(problem)
        self._last = observation = self._observer.observe(*read_image(message))
        self._publish(observation)
        if observation.problem:
            raise MessageError(observation.problem)

    def _publish(self, observation: Observation) -> None:
        """An unusable image gets no pose without covariance: it would look like a usable one."""
        frame, slow = self._config.map_frame, observation.estimate.slow_features
        stamp_ns, pose = observation.stamp_ns, observation.pose
        if np.all(np.isfinite(slow)):
            self._features.publish(to_array(slow, 'slow features'))
            self._feature_pose.publish(_feature_pose(slow, stamp_ns))
        if math.isfinite(observation.turned):
            self._turned.publish(to_turned(observation.turned, stamp_ns, _TURNED_FRAME))
        if not observation.problem:
            self._pose.publish(to_pose(pose, stamp_ns, frame))
        covariance = observation.covariance
        self._uncertain.publish(to_pose_with_covariance(pose, covariance, stamp_ns, frame))

    def health(self) -> tuple[int, str, dict[str, str]]:
        problem = self._last.problem if self._last is not None else ''
        novelty = self._last.estimate.novelty if self._last is not None else 0.0
        light = self._observer.other_light if self._observer is not None else 0.0
        values = {'model': self._config.model, 'novelty': f'{novelty:.2f}'}
        values['unlike by light'] = f'{100 * light:.0f} %'
        silent = self.monitor(self._topic).silent_for_s()
        if math.isinf(silent):
            waiting = f'waiting for images on {self.shown(self._topic)}'
            return _WARN, self._discovery.hint or waiting, values
        if silent > self._config.silence_timeout:
            return _ERROR, f'no image on {self.shown(self._topic)} for {silent:.0f} s', values
        declared = self._declared_problem(self._observer.model) if self._observer else ''
        if declared:
            return _ERROR, declared, values
        if self.monitor(self._topic).used == 0:
            return _ERROR, 'no image has been usable', values
        if problem:
            late = self._observer is not None and self._observer.watch.repeats
            return _WARN if late else _ERROR, problem, values
        if novelty > NOVELTY_WARNING:
            return _WARN, 'images are unlike those of training', values
        return _OK, 'locating', values


def _feature_pose(slow: Any, stamp_ns: int) -> PoseStamped:
    """The first three slow features as a position, as the paper draws them."""
    x, y, z = [*map(float, slow[:3]), 0.0, 0.0, 0.0][:3]
    message = to_pose([x, y, 0.0], stamp_ns, _FEATURE_FRAME)
    message.pose.position.z = z
    return message


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(SfaNode, args)
