# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ROS 2 node: odometry and poses from images in, the robot's pose in the map out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import (
    PoseStamped,
    PoseWithCovarianceStamped,
    QuaternionStamped,
    TransformStamped,
)
from nav_msgs.msg import Odometry, Path
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64, Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger

from sfa_localization.data.errors import DataError, MessageError
from sfa_localization.data.geometry import Array, compose, invert
from sfa_localization.data.messages import require_sane
from sfa_localization.data.settings import Settings
from sfa_localization.fusion.pose_filter import Level, PoseFilter, State, Status, Update
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import uncertainty
from sfa_localization.nodes.broadcast import Broadcast
from sfa_localization.nodes.conversions import (
    Motion,
    read_error_correlation,
    read_odometry,
    read_pose,
    read_turned,
    to_odometry,
    to_pose,
    to_pose_with_covariance,
    to_stamp,
    to_transform,
)
from sfa_localization.nodes.discovery import Discovery
from sfa_localization.nodes.lifecycle import (
    LocalizationNode,
    latched_qos,
    reliable_qos,
    run_node,
    sensor_qos,
)
from sfa_localization.nodes.monitor import steady_s
from sfa_localization.nodes.saved_pose import SAVE_PERIOD_S, SavedPose, load_pose, save_pose
from sfa_localization.nodes.settings import EkfNodeConfig

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the pip wheels of ROS have none
    TFMessage = None

_LEVELS = {
    Level.UNINITIALISED: DiagnosticStatus.WARN,
    Level.LOCALISED: DiagnosticStatus.OK,
    Level.DEGRADED: DiagnosticStatus.WARN,
    Level.LOST: DiagnosticStatus.ERROR,
}
PATH_PERIOD_S, PATH_LENGTH = 0.5, 2000
"""Time between the poses of ekf/path, and how many it keeps: those of 17 minutes."""
IMAGES_SILENCE = 3.0
"""Images may be silent for so many times silence_timeout: they come less often than odometry."""
_WATCH_PERIOD_S = 0.2
_REPEAT_STATE_S = 1.0
_BACKWARD_JUMP_NS = -500_000_000  # of simulated time: less is jitter
_ODOM, _IMAGE_POSE = 'odom', 'sfa/pose_with_covariance'


class EkfNode(LocalizationNode):
    """Feeds the pose filter; publishes its estimate and how far that can be trusted."""

    def __init__(self, **options: Any) -> None:
        super().__init__('ekf_node', [EkfNodeConfig, FilterConfig], **options)
        self._jumps: Any = None
        self._begin()

    def _begin(self) -> None:
        self._config = self.settings(EkfNodeConfig)
        self._filter = PoseFilter(self.settings(FilterConfig))
        self._paused = False
        self._broadcast = Broadcast()
        self._path: deque[PoseStamped] = deque(maxlen=PATH_LENGTH)
        self._path_ns = 0
        self._frames = self._config.odom_frame, self._config.base_frame
        self._state_text = ''
        self._state_level: Level | None = None
        self._ticks_since_state = 0
        self._last_moved = (0, 0.0)
        self._sure: State | None = None

    def setup(self) -> None:
        self._begin()
        self._restore_pose()
        self._make_publishers()
        self._subscribe_odometry()
        self._discovery = Discovery(self, _ODOM, [Odometry], ['odom'], self._subscribe_odometry)
        self.subscribe(PoseWithCovarianceStamped, _IMAGE_POSE, self._receive_pose, sensor_qos(20))
        self.subscribe(QuaternionStamped, 'sfa/turned', self._receive_turned, sensor_qos(20))
        for kind, topic, receive in (
            (Float64, 'sfa/camera_delay', self._receive_delay),
            (Float64MultiArray, 'sfa/error_correlation', self._receive_correlation),
        ):
            self.subscribe(kind, topic, receive, latched_qos(), while_inactive=True)
        for topic in ('initialpose', '~/set_pose'):
            self.subscribe(PoseWithCovarianceStamped, topic, self._set_pose, reliable_qos(1))
        self.service(Trigger, '~/reset', self._reset)
        self.service(SetBool, '~/pause', self._pause)
        self.every(_WATCH_PERIOD_S, self._publish_state)
        self.every(SAVE_PERIOD_S, self._save_pose)
        # Looped playback steps simulated time back; stamps alone would show it only later.
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None,
                min_backward=Duration(nanoseconds=_BACKWARD_JUMP_NS),
                on_clock_change=False,
            ),
            post_callback=self._clock_jumped,
        )

    def _make_publishers(self) -> None:
        self._odometry = self.publisher(Odometry, 'ekf/odometry')
        self._pose = self.publisher(PoseWithCovarianceStamped, 'ekf/pose')
        self._trail = self.publisher(Path, 'ekf/path')
        self._state = self.publisher(String, 'ekf/state', latched_qos())
        self._verdict = self.publisher(DiagnosticArray, 'ekf/measurement_status')
        self._transform = self.publisher(TransformStamped, 'ekf/map_to_odom')
        self._tf = None
        if self._config.publish_tf and TFMessage is not None:
            self._tf = self.publisher(TFMessage, '/tf', QoSProfile(depth=100))
        elif self._config.publish_tf:
            self.get_logger().warning(
                'tf2_msgs is not installed: map -> odom goes to ekf/map_to_odom only, not to /tf'
            )

    def started(self) -> None:
        self._publish_state()

    def destroy_node(self) -> None:
        """End the node; the last sure pose is kept."""
        self._attempt('pose_file', self._save_pose)
        super().destroy_node()

    def teardown(self) -> None:
        self._attempt('pose_file', self._save_pose)
        if self._jumps is not None:
            self._jumps.unregister()
            self._jumps = None

    def settings_changed(self, settings: Settings) -> None:
        if isinstance(settings, EkfNodeConfig):
            self._config = settings
        if isinstance(settings, FilterConfig):
            self._filter.reconfigure(settings)

    # Inputs.

    def _subscribe_odometry(self, instead: str = '') -> None:
        self.unsubscribe(_ODOM)
        receive = self._receive_odometry
        self.subscribe(Odometry, _ODOM, receive, sensor_qos(100), instead=instead)

    def _receive_odometry(self, message: Odometry) -> None:
        motion = read_odometry(message)
        self._frames = (
            motion.frame or self._config.odom_frame,
            motion.child_frame or self._config.base_frame,
        )
        reason = self._filter.add_odometry(
            motion.stamp_ns, *motion.twist, motion.variances, motion.pose.tolist()
        )
        if reason:
            raise MessageError(reason)
        state = self._filter.at(motion.stamp_ns)
        if state is not None:
            self._publish_odometry(state, motion)
            self._extend_path(state)

    def _receive_pose(self, message: PoseWithCovarianceStamped) -> None:
        stamp_ns, pose, covariance = self._read_in_map(message)
        if self._paused:
            # The estimate goes on by odometry: ekf/pose as well as ekf/odometry and /tf.
            self._publish_pose(stamp_ns)
            raise MessageError('paused')
        if covariance.any() and not covariance[2].any():
            covariance[2, 2] = math.inf  # a source without heading leaves its variance 0
        update = self._filter.add_measurement(stamp_ns, pose, covariance)
        self._publish_verdict(update)
        self._publish_pose(stamp_ns)
        if not update.accepted:
            raise MessageError(update.reason)

    def _receive_turned(self, message: QuaternionStamped) -> None:
        self._filter.add_turned(*read_turned(message))

    def _receive_delay(self, message: Float64) -> None:
        require_sane('camera delay', message.data)
        self._filter.expect_delay(float(message.data))

    def _receive_correlation(self, message: Float64MultiArray) -> None:
        self._filter.reconfigure(correlation=read_error_correlation(message))

    def _set_pose(self, message: PoseWithCovarianceStamped) -> None:
        if message.header.stamp.sec == 0 and message.header.stamp.nanosec == 0:
            message.header.stamp = to_stamp(max(self._newest_ns(), 1))
        stamp_ns, pose, covariance = self._read_in_map(message)
        self._filter.set_pose(stamp_ns, pose, covariance if covariance.any() else None)
        self.get_logger().info(f'pose set to {pose[0]:.2f}, {pose[1]:.2f}, {pose[2]:.2f} rad')
        self._publish_state()

    def _read_in_map(self, message: PoseWithCovarianceStamped) -> tuple[int, Any, Any]:
        frame = message.header.frame_id.lstrip('/')
        if frame not in ('', self._config.map_frame):
            raise MessageError(f'frame is {frame!r}, not {self._config.map_frame!r}')
        return read_pose(message)

    def _newest_ns(self) -> int:
        state = self._filter.state
        return state.stamp_ns if state is not None else int(self.get_clock().now().nanoseconds)

    def _reset(self, _: Any, response: Any) -> Any:
        self._forget()
        self._publish_state()
        response.success, response.message = True, self._status().level.name
        return response

    def _pause(self, request: Any, response: Any) -> Any:
        self._paused = bool(request.data)
        self._publish_state()
        response.success = True
        response.message = 'images are not fused' if self._paused else 'images are fused'
        return response

    def _clock_jumped(self, jump: TimeJump) -> None:
        self.get_logger().warning(
            f'the clock went back by {-jump.delta.nanoseconds * 1e-9:.1f} s: starting anew'
        )
        self._attempt('clock', self._forget)

    def _restore_pose(self) -> None:
        """Begin at the pose of before the restart: a hypothesis, which images confirm or not."""
        path = self._config.pose_file
        if not path or self.settings(FilterConfig).initial_pose:
            return
        try:
            saved = load_pose(FilePath(path), self._config.map_frame)
        except DataError as error:
            self.get_logger().warning(f'{error}: waiting for images that show where')
            return
        if saved is not None:
            self._filter.set_pose(saved.stamp_ns, saved.pose, saved.moved())
            x, y, yaw = saved.pose
            self.get_logger().info(f'{path}: looking first at {x:.2f}, {y:.2f}, {yaw:.2f} rad')

    def _save_pose(self) -> None:
        """Write the last sure pose, if it is new."""
        state, self._sure = self._sure, None
        if state is not None and self._config.pose_file:
            frame = self._config.map_frame
            saved = SavedPose(state.stamp_ns, frame, state.pose, state.pose_covariance)
            save_pose(FilePath(self._config.pose_file), saved)

    def _defect(self, name: str, error: Exception) -> str:
        """What failed inside may fail at every message from now on: the filter starts anew."""
        reason = super()._defect(name, error)
        self._forget()
        return reason

    def _forget(self) -> None:
        self._filter.reset()
        self._broadcast.reset()
        self._path.clear()

    # Outputs.

    def _publish_odometry(self, state: State, motion: Motion) -> None:
        frame = self._config.map_frame
        self._odometry.publish(
            to_odometry(
                state.pose,
                state.pose_covariance,
                state.twist,
                state.twist_covariance,
                motion.stamp_ns,
                (frame, self._frames[1]),
            )
        )
        self._publish_transform(motion.stamp_ns, compose(state.pose, invert(motion.pose)))

    def _publish_transform(self, stamp_ns: int, map_to_odom: Array) -> None:
        """Publish map -> odom at a stamp of odometry; on /tf also for transform_tolerance after."""
        frames = self._config.map_frame, self._frames[0]
        self._transform.publish(to_transform(map_to_odom, stamp_ns, frames))
        if self._tf is not None:
            ahead_ns = round(self._config.transform_tolerance * 1e9)
            dated = self._broadcast.add(stamp_ns, map_to_odom, ahead_ns)
            transforms = [to_transform(pose, at_ns, frames) for at_ns, pose in dated]
            self._tf.publish(TFMessage(transforms=transforms))

    def _publish_verdict(self, update: Update) -> None:
        """What became of a measurement: header.stamp is its own, values hold d2 and threshold."""
        level = DiagnosticStatus.OK if update.accepted else DiagnosticStatus.WARN
        values = {
            'accepted': str(update.accepted).lower(),
            'd2': _number(update.d2),
            'threshold': _number(update.threshold),
        }
        stamp = to_stamp(max(update.stamp_ns, 0))
        self._verdict.publish(self.diagnostic('measurement', level, update.reason, values, stamp))

    def _publish_pose(self, stamp_ns: int) -> None:
        """Publish the estimate at the stamp of an image."""
        state = self._filter.at(stamp_ns)
        if state is not None:
            self._pose.publish(
                to_pose_with_covariance(
                    state.pose, state.pose_covariance, stamp_ns, self._config.map_frame
                )
            )

    def _extend_path(self, state: State) -> None:
        if abs(state.stamp_ns - self._path_ns) < PATH_PERIOD_S * 1e9:
            return
        self._path_ns = state.stamp_ns
        self._path.append(to_pose(state.pose, state.stamp_ns, self._config.map_frame))
        if self._trail.get_subscription_count():
            path = Path(poses=list(self._path))
            path.header.stamp = to_stamp(state.stamp_ns)
            path.header.frame_id = self._config.map_frame
            self._trail.publish(path)

    def _status(self) -> Status:
        """The filter's status, and what the wall clock adds: inputs that do not arrive."""
        status, added = self._filter.status, []
        by_now, running_s = self._by_now(), steady_s() - self._configured_s
        timeout_s = self._config.silence_timeout
        for topic, limit in ((_ODOM, timeout_s), (_IMAGE_POSE, IMAGES_SILENCE * timeout_s)):
            silent, shown = self.monitor(topic).silent_for_s(), self.shown(topic)
            if min(silent, running_s) > limit and not self.count_publishers(shown):
                added.append(f'nobody publishes on {shown}')
            elif limit < silent < math.inf:
                added.append(f'nothing on {shown} for {silent:.0f} s')
        if self._paused:
            added.append('paused: images are not fused')
        lost = []
        if by_now is not None and (added or status.level is Level.DEGRADED):
            # The filter's time is that of its messages: by the wall clock it may be lost.
            lost = [f'{reason} by now' for reason in uncertainty(by_now, self._filter.config)]
        return status.with_reasons(lost, added)

    def _by_now(self) -> State | None:
        """The estimate; after a long silence, predicted to the present by the wall clock."""
        state = self._filter.state
        if state is None:
            return None
        if state.stamp_ns != self._last_moved[0]:
            self._last_moved = state.stamp_ns, steady_s()
        silent_s = steady_s() - self._last_moved[1]
        heard = self.monitor(_ODOM).received or self.monitor(_IMAGE_POSE).received
        if not heard or silent_s <= self._config.silence_timeout:
            return state
        return self._filter.at(state.stamp_ns + round(silent_s * 1e9))

    def _publish_state(self) -> None:
        """Publish the state when its level changes at once, when its reasons do at most at 1 Hz."""
        if not self.active:
            return
        status = self._status()
        if status.level is Level.LOCALISED:
            self._sure = self._filter.state
        text = ': '.join([status.level.name, '; '.join(status.reasons)]).rstrip(': ')
        self._ticks_since_state += 1
        changed = status.level is not self._state_level
        waited_s = self._ticks_since_state * _WATCH_PERIOD_S
        if not changed and (text == self._state_text or waited_s < _REPEAT_STATE_S):
            return
        self._ticks_since_state = 0
        if changed:
            self.get_logger().info(text)
        self._state_text, self._state_level = text, status.level
        self._state.publish(String(data=text))

    def health(self) -> tuple[int, str, dict[str, str]]:
        status, state = self._status(), self._by_now()
        values = {'state': status.level.name}
        values.update({name: str(n) for name, n in sorted(self._filter.counts.items())})
        if state is not None:
            values['position std [m]'] = f'{state.position_std:.3f}'
            values['heading std [deg]'] = f'{math.degrees(state.yaw_std):.2f}'
            values['yaw-rate bias [rad/s]'] = f'{state.yaw_rate_bias:.5f}'
            values['wheel scale'] = f'{state.wheel_scale:.4f}'
            values['way lost in turns [m/rad]'] = f'{state.turn_loss:.3f}'
        clock = self._filter.camera_clock
        if clock.known:
            values['camera delay [s]'] = f'{clock.delay_s:.3f}'
        return _LEVELS[status.level], '; '.join(status.reasons) or status.level.name, values


def _number(value: float) -> str:
    return f'{value:.6g}' if np.isfinite(value) else ''


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(EkfNode, args)
