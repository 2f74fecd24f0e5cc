# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ROS 2 node: odometry and poses from images in, the robot's pose in the map out."""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs import msg as geometry
from nav_msgs.msg import Odometry, Path
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Empty, SetBool, Trigger

from sfa_localization.data.errors import MessageError
from sfa_localization.data.events import DELAY_LIMIT_NS
from sfa_localization.data.files import require_outputs
from sfa_localization.data.geometry import Array, compose, invert
from sfa_localization.data.rejections import short_line
from sfa_localization.data.settings import Settings
from sfa_localization.fusion.belief import Pose
from sfa_localization.fusion.pose_filter import Level, PoseFilter, State, Status, Update
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import uncertainty
from sfa_localization.nodes import conversions as convert
from sfa_localization.nodes.discovery import Discovery
from sfa_localization.nodes.lifecycle import (
    ERROR,
    OK,
    WARN,
    LocalizationNode,
    TFMessage,
    latched_qos,
    sensor_qos,
)
from sfa_localization.nodes.monitor import steady_s
from sfa_localization.nodes.saved_pose import SAVE_PERIOD_S, SavedPose, load_pose, save_pose
from sfa_localization.nodes.settings import EkfNodeConfig

try:
    from nav2_msgs.srv import SetInitialPose
except ImportError:  # without Nav2 nobody calls it
    SetInitialPose = None

_LEVELS = dict(zip(Level, (WARN, OK, WARN, ERROR), strict=True))
PATH_PERIOD_S = 0.5
PATH_LENGTH = 2000
"""Time between the poses of ekf/path, and their largest number: 17 minutes."""
IMAGES_SILENCE = 3.0
"""Images may be silent this many times longer than odometry, because they come less often."""
_WATCH_PERIOD_S = 0.2
_BACKLOG_S = 0.2  # odometry that waited for longer is fused, but not published each time
_LOG_S = 60.0  # between equal warnings in the log
_REPEAT_STATE_S = 0.9  # between states of the same level with other reasons
_OFF_GRID_NS = 500  # added to transforms of the future: tf2 rejects a stamp that it has already
_BACKWARD_JUMP_NS = -500_000_000  # of simulated time; less is jitter
NO_POSE = 'its pose is not filled: only the twist is used, and map -> odom is not published'
_ODOM = 'odom'
_IMAGE_POSE = 'sfa/pose_with_covariance'


class EkfNode(LocalizationNode):
    """Feeds the pose filter; publishes its estimate, and how reliable that is."""

    def __init__(self, **options: Any) -> None:
        super().__init__('ekf_node', [EkfNodeConfig, FilterConfig], **options)
        self._jumps: Any = None
        self._odometry_input: Any = None
        self._begin()

    def _begin(self) -> None:
        self._config = self.settings(EkfNodeConfig)
        self.filter = PoseFilter(self.settings(FilterConfig))
        self._path: deque[geometry.PoseStamped] = deque(maxlen=PATH_LENGTH)
        self._path_ns = 0
        self._paused = False
        self._frames = self._config.odom_frame, self._config.base_frame
        self._published_state: tuple[Level | None, str, float] = None, '', 0.0
        self._last_change = 0, 0.0
        self._published_s = 0.0
        self._reliable: State | None = None
        self._moved = ''

    def setup(self) -> None:
        self._begin()
        if self._config.pose_file:
            self.attempt('pose_file', require_outputs, [FilePath(self._config.pose_file)], [])
        self.attempt('pose_file', self._restore_pose)
        self._make_publishers()
        self._subscribe_odometry()
        self.discovery = Discovery(
            self, _ODOM, ['nav_msgs/msg/Odometry'], ['odom'], self._subscribe_odometry
        )
        pose = geometry.PoseWithCovarianceStamped
        self.subscribe(pose, _IMAGE_POSE, self._receive_pose, sensor_qos(20))
        self.subscribe(
            geometry.QuaternionStamped,
            'sfa/turned',
            lambda message: self.filter.add_turned(*convert.read_turned(message)),
            sensor_qos(20),
        )
        self.subscribe(String, 'sfa/rig', self._receive_rig, latched_qos())
        self.subscribe(String, 'panorama/troubles', self._receive_missing, latched_qos())
        self.subscribe(String, 'sfa/troubles', self._receive_moved, latched_qos())
        for topic in ('initialpose', '~/set_pose'):
            self.subscribe(pose, topic, self._set_pose, QoSProfile(depth=1))
        self.service(Trigger, '~/reset', self._reset)
        self.service(SetBool, '~/pause', self._pause)
        # The services of nav2_amcl, by its names.
        self.order(Empty, 'reinitialize_global_localization', self._forget_pose)
        if SetInitialPose is not None:
            self.order(SetInitialPose, 'set_initial_pose', lambda it: self._set_pose(it.pose))
        self.every(_WATCH_PERIOD_S, self._publish_state)
        self.every(SAVE_PERIOD_S, self._save_pose)
        # A bag played in a loop steps simulated time back, before the stamps of messages do.
        back = Duration(nanoseconds=_BACKWARD_JUMP_NS)
        threshold = JumpThreshold(min_forward=None, min_backward=back, on_clock_change=False)
        self._jumps = self.get_clock().create_jump_callback(
            threshold, post_callback=self._clock_jumped
        )

    def _make_publishers(self) -> None:
        self._odometry = self.publisher(Odometry, 'ekf/odometry')
        self._pose = self.publisher(geometry.PoseWithCovarianceStamped, 'ekf/pose')
        self._trail = self.publisher(Path, 'ekf/path')
        self._state = self.publisher(String, 'ekf/state', latched_qos())
        self._verdict = self.publisher(DiagnosticArray, 'ekf/measurement_status')
        self._transform = self.publisher(geometry.TransformStamped, 'ekf/map_to_odom')
        self._tf = None
        if self._config.publish_tf and TFMessage is not None:
            self._tf = self.publisher(TFMessage, '/tf', 100)
        elif self._config.publish_tf:
            self.get_logger().warning(
                'tf2_msgs is not installed: map -> odom goes to ekf/map_to_odom only, not to /tf'
            )

    def started(self) -> None:
        self._publish_state()

    def teardown(self) -> None:
        self.attempt('pose_file', self._save_pose)
        if self._jumps is not None:
            self._jumps.unregister()
        self._jumps = self._odometry_input = None

    def settings_changed(self, settings: Settings) -> None:
        if isinstance(settings, EkfNodeConfig):
            self._config = settings
        if isinstance(settings, FilterConfig):
            self.filter.reconfigure(settings)

    # Inputs.

    def _subscribe_odometry(self, substitute: str = '', _: str = '') -> None:
        self.unsubscribe(self._odometry_input)
        receive = self._receive_odometry
        qos = sensor_qos(100)
        self._odometry_input = self.subscribe(Odometry, _ODOM, receive, qos, substitute)

    def _receive_odometry(self, message: Odometry) -> None:
        stamp_ns, (v, omega, *noise), pose = convert.read_odometry(message)
        frame = message.header.frame_id
        child_frame = message.child_frame_id
        self._frames = frame or self._config.odom_frame, child_frame or self._config.base_frame
        reason = self.filter.add_odometry(stamp_ns, v, omega, noise, pose)
        if reason:
            raise MessageError(reason)
        if pose is None:
            self.get_logger().warning(f'{self.full_name(_ODOM)}: {NO_POSE}', once=True)
        now_s = steady_s()
        if self.monitors[_ODOM].waited_s > _BACKLOG_S > now_s - self._published_s:
            return
        self._published_s = now_s
        state = self.filter.at(stamp_ns)
        if state is not None:
            self._publish_odometry(state)
            if pose is not None:
                self._publish_transform(state, pose)
            self._extend_path(state)

    def _receive_pose(self, message: geometry.PoseWithCovarianceStamped) -> None:
        stamp_ns, pose, covariance = self._read_in_map(message)
        if self._paused:
            self._publish_pose(stamp_ns)  # by odometry alone, as ekf/odometry and /tf
            raise MessageError('paused')
        if covariance.any() and not covariance[2].any():
            covariance[2, 2] = math.inf  # a source without heading leaves its variance 0
        update = self.filter.add_measurement(stamp_ns, pose, covariance)
        self._publish_verdict(update)
        self._publish_pose(update.stamp_ns)
        if not update.accepted:
            raise MessageError(update.reason)

    def _receive_rig(self, message: String) -> None:
        rig, correlation = convert.read_rig(message)
        self.filter.expect(rig)
        self.filter.reconfigure(correlation=correlation)
        for line in rig.as_text():
            self.get_logger().info(line)

    def _receive_missing(self, message: String) -> None:
        """Take why the panorama lacks some of several cameras; '' if it does not."""
        self.filter.lacking = short_line(message.data) if message.data else ''

    def _receive_moved(self, message: String) -> None:
        """Take where the camera sits otherwise than in training; '' if it does not."""
        self._moved = short_line(message.data) if message.data else ''

    def _set_pose(self, message: geometry.PoseWithCovarianceStamped) -> None:
        if message.header.stamp.sec == 0 and message.header.stamp.nanosec == 0:
            state = self.filter.state
            now_ns = int(self.get_clock().now().nanoseconds)
            stamp_ns = state.stamp_ns if state is not None else max(now_ns, 1)
            message.header.stamp = convert.to_stamp(stamp_ns)
        stamp_ns, pose, covariance = self._read_in_map(message)
        self.filter.set_pose(stamp_ns, pose, covariance if covariance.any() else None)
        self.get_logger().info(f'pose set to {pose[0]:.2f}, {pose[1]:.2f}, {pose[2]:.2f} rad')
        self._publish_state()

    def _read_in_map(self, message: geometry.PoseWithCovarianceStamped) -> tuple[int, Array, Array]:
        frame = message.header.frame_id.lstrip('/')
        if frame not in ('', self._config.map_frame):
            raise MessageError(f'frame is {frame!r}, not {self._config.map_frame!r}')
        return convert.read_pose(message)

    def _reset(self, _: Any) -> str:
        self._forget()
        self._publish_state()
        return self.status().level.name

    def _forget_pose(self, _: Any) -> None:
        self.filter.forget_pose()
        self._reliable = None
        self.get_logger().info('pose forgotten: images show where the robot is')
        self._publish_state()

    def _pause(self, request: Any) -> str:
        self._paused = bool(request.data)
        self._publish_state()
        return 'images are not fused' if self._paused else 'images are fused'

    def _clock_jumped(self, jump: TimeJump) -> None:
        self.get_logger().warning(
            f'the clock went back by {-jump.delta.nanoseconds * 1e-9:.1f} s: starting anew'
        )
        self._forget()

    def _restore_pose(self) -> None:
        """Begin with the pose before the restart as a hypothesis."""
        path = self._config.pose_file
        if not path or self.settings(FilterConfig).initial_pose:
            return
        saved = load_pose(FilePath(path), self._config.map_frame)
        if saved is not None:
            self.filter.set_pose(saved.stamp_ns, saved.pose, saved.moved())
            x, y, yaw = saved.pose
            self.get_logger().info(f'{path}: looking first at {x:.2f}, {y:.2f}, {yaw:.2f} rad')

    def _save_pose(self) -> None:
        """Write the last reliable pose, if it is new."""
        state = self._reliable
        self._reliable = None
        if state is not None and self._config.pose_file:
            pose = state.pose, state.pose_covariance
            saved = SavedPose(state.stamp_ns, self._config.map_frame, *pose)
            save_pose(FilePath(self._config.pose_file), saved)

    def defect(self, name: str, error: Exception) -> None:
        """Start anew after an internal error: the filter's state may cause it at every message."""
        super().defect(name, error)
        self._forget()

    def _forget(self) -> None:
        self.filter.reset()
        self._path.clear()

    # Outputs.

    def _publish_odometry(self, state: State) -> None:
        pose = (state.pose, state.pose_covariance)
        twist = (state.twist, state.twist_covariance)
        frames = self._config.map_frame, self._frames[1]
        self._odometry.publish(convert.to_odometry(*pose, *twist, state.stamp_ns, frames))

    def _publish_transform(self, state: State, odom: Pose) -> None:
        """Publish map -> odom at odometry's stamp; on /tf also transform_tolerance later.

        A lookup of the present needs a transform from the future.
        """
        frames = (self._config.map_frame, self._frames[0])
        stamp_ns = state.stamp_ns
        map_to_odom = compose(state.pose, invert(np.array(odom)))
        transforms = [convert.to_transform(map_to_odom, stamp_ns, frames)]
        self._transform.publish(transforms[0])
        if self._tf is not None:
            ahead_ns = round(self._config.transform_tolerance * 1e9)
            if ahead_ns:
                later_ns = stamp_ns + ahead_ns + _OFF_GRID_NS
                transforms.append(convert.to_transform(map_to_odom, later_ns, frames))
            self._tf.publish(TFMessage(transforms=transforms))

    def _publish_verdict(self, update: Update) -> None:
        """Publish whether a measurement was accepted: its d2, and the gate's threshold."""
        level = OK if update.accepted else WARN
        values = {'accepted': str(update.accepted).lower()}
        for name, value in (('d2', update.d2), ('threshold', update.threshold)):
            values[name] = f'{value:.6g}' if math.isfinite(value) else ''
        stamp = convert.to_stamp(max(update.stamp_ns, 0))
        message = self.diagnostic('measurement', level, update.reason, values, stamp)
        self._verdict.publish(message)

    def _publish_pose(self, stamp_ns: int) -> None:
        """Publish the estimate at the stamp of an image."""
        state = self.filter.at(stamp_ns)
        if state is not None:
            pose = (state.pose, state.pose_covariance)
            frame = self._config.map_frame
            self._pose.publish(convert.to_pose_with_covariance(*pose, stamp_ns, frame))

    def _extend_path(self, state: State) -> None:
        if abs(state.stamp_ns - self._path_ns) < PATH_PERIOD_S * 1e9:
            return
        self._path_ns = state.stamp_ns
        frame = self._config.map_frame
        self._path.append(convert.to_pose(state.pose, state.stamp_ns, frame))
        if self._trail.get_subscription_count():
            self._trail.publish(Path(header=self._path[-1].header, poses=list(self._path)))

    def status(self) -> Status:
        """The filter's status, with the reasons that the wall clock gives, as silent inputs."""
        self.filter.waited_s = self._waited_s()
        status = self.filter.status
        by_now = self._by_now()
        timeout_s = self._config.silence_timeout
        reasons = self._silent_inputs(timeout_s)
        name = self.full_name(_ODOM)
        if self.filter.odometry_in_turn and self.count_publishers(name) > 1:
            reasons.append(f'two publishers on {name}: stop one, or take another topic by odom:=')
            self.get_logger().warning(reasons[-1], throttle_duration_sec=_LOG_S)
        reasons += [reason for reason in (self._moved, self.twin) if reason]
        if self._paused:
            reasons.append('paused: images are not fused')
        lost = []
        behind_s = self._behind_s()
        if behind_s > timeout_s:
            busy = f'behind by {behind_s:.1f} s: this computer is too busy'
            self.get_logger().warning(busy, throttle_duration_sec=_LOG_S)
            return status.with_reasons([], reasons).because(busy)
        if by_now is not None and (reasons or status.level is Level.DEGRADED):
            # The filter knows the stamps of messages only; by the wall clock it may be lost.
            lost = [f'{reason} by now' for reason in uncertainty(by_now, self.filter.config)]
        return status.with_reasons(lost, reasons)

    def _silent_inputs(self, timeout_s: float) -> list[str]:
        """Which inputs have been silent for longer than this, images for longer, in words."""
        reasons = []
        running_s = steady_s() - self._configured_s
        for topic, limit in ((_ODOM, timeout_s), (_IMAGE_POSE, IMAGES_SILENCE * timeout_s)):
            silent = self.monitors[topic].silent_for_s()
            name = self.full_name(topic)
            if min(silent, running_s) > limit and not self.count_publishers(name):
                reasons.append(f'nobody publishes on {name}')
            elif limit < silent < math.inf:
                reasons.append(f'nothing on {name} for {silent:.0f} s')
        return reasons

    def _behind_s(self) -> float:
        """How long the last odometry waited for this node, s."""
        odometry = self.monitors[_ODOM]
        return odometry.waited_s if odometry.silent_for_s() < self._config.silence_timeout else 0.0

    def _waited_s(self) -> float:
        """How long messages have recently waited for this node, s; 0 where it hardly matters."""
        waits = [self.monitors[topic].longest_wait_s() for topic in (_ODOM, _IMAGE_POSE)]
        return max(waits) if max(waits) * 1e9 > DELAY_LIMIT_NS else 0.0

    def _by_now(self) -> State | None:
        """The estimate, predicted to the present by the wall clock after a long silence."""
        state = self.filter.state
        if state is None:
            return None
        if state.stamp_ns != self._last_change[0]:
            self._last_change = state.stamp_ns, steady_s()
        silent_s = steady_s() - self._last_change[1]
        received = self.monitors[_ODOM].received or self.monitors[_IMAGE_POSE].received
        if not received or silent_s <= self._config.silence_timeout:
            return state
        return self.filter.at(state.stamp_ns + round(silent_s * 1e9))

    def _publish_state(self) -> None:
        """Publish a change of the level at once, a change of the reasons at 1 Hz at most."""
        if not self.active:
            return
        status = self.status()
        if status.level is Level.LOCALISED:
            self._reliable = self.filter.state
        text = str(status)
        level, before, published_s = self._published_state
        changed = status.level is not level
        now_s = steady_s()
        if changed or (text != before and now_s > published_s + _REPEAT_STATE_S):
            self._published_state = status.level, text, now_s
            self._state.publish(String(data=text))
        if changed:
            self.get_logger().info(text)

    def health(self) -> tuple[int, str, dict[str, str]]:
        status = self.status()
        state = self._by_now()
        values = {'state': status.level.name, 'behind [s]': f'{self._behind_s():.2f}'}
        values.update({name: str(n) for name, n in sorted(self.filter.counts.items())})
        if state is not None:
            values['position std [m]'] = f'{state.position_std:.3f}'
            values['heading std [deg]'] = f'{math.degrees(state.yaw_std):.2f}'
            values['yaw-rate bias [rad/s]'] = f'{state.yaw_rate_bias:.5f}'
            values['wheel scale'] = f'{state.wheel_scale:.4f}'
            values['way lost in turns [m/rad]'] = f'{state.turn_loss:.3f}'
            values['turns over those counted'] = f'{state.turn_factor:.3f}'
        clock = self.filter.camera_clock
        if clock.is_estimated:
            values['camera delay [s]'] = f'{clock.delay_s:.3f}'
        return _LEVELS[status.level], '; '.join(status.reasons) or status.level.name, values
