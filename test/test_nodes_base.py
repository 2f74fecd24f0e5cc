# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters from settings, message conversions, and the life cycle that all nodes share."""

import array
import dataclasses
import gc
import math
from dataclasses import dataclass

import numpy as np
import pytest
from ros_domains import free_domain

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.errors import ConfigError, LocalizationError, MessageError
from sfa_localization.data.messages import read_stamp, read_yaw
from sfa_localization.data.settings import Settings, setting
from sfa_localization.nodes.settings import NodeConfig

rclpy = pytest.importorskip('rclpy')
pytestmark = pytest.mark.ros

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rcl_interfaces.msg import ParameterType  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from ros_bench import Bench, until  # noqa: E402
from std_msgs.msg import Float64, String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from sfa_localization.nodes import conversions as convert  # noqa: E402
from sfa_localization.nodes.ekf_node import EkfNode  # noqa: E402
from sfa_localization.nodes.lifecycle import LocalizationNode  # noqa: E402

DOMAIN = free_domain()


@dataclass(frozen=True, slots=True)
class Knobs(Settings):
    gain: float = setting(0.5, 'a gain', unit='m', low=0.0, high=2.0, live=True)
    offset: float = setting(0.0, 'unbounded', live=True)
    count: int = setting(3, 'a number', low=1, live=True)
    mode: str = setting('a', 'a choice', choices=('a', 'b'), live=True)
    fixed: float = setting(1.0, 'read only')
    corner: tuple[float, ...] = setting((1.0, 2.0), 'an array')
    path: tuple[float, ...] = setting((), 'an array that may be empty', live=True)

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.gain > self.count:
            raise ConfigError('gain must not exceed count')


DOUBLES = ParameterType.PARAMETER_DOUBLE_ARRAY


@pytest.fixture
def context():
    made = rclpy.Context()
    rclpy.init(
        context=made, domain_id=DOMAIN, signal_handler_options=rclpy.signals.SignalHandlerOptions.NO
    )
    yield made
    rclpy.try_shutdown(context=made)


@pytest.fixture
def make(context):
    nodes = []

    def build(kind=LocalizationNode, *arguments, **overrides):
        values = [Parameter(name, value=value) for name, value in overrides.items()]
        nodes.append(kind(*arguments, context=context, parameter_overrides=values))
        return nodes[-1]

    yield build
    for node in nodes:
        node.destroy_node()


def knobs(make, **overrides):
    return make(LocalizationNode, 'knobs', [Knobs], **overrides)


def test_every_setting_is_a_described_ranged_parameter(make):
    node = knobs(make)
    for item in dataclasses.fields(Knobs):
        told = node.describe_parameter(item.name)
        assert told.description.startswith(item.metadata['doc'])
        assert told.read_only != item.metadata['live']
    gain = node.describe_parameter('gain')
    assert gain.description == 'a gain [m]'
    assert (gain.floating_point_range[0].from_value, gain.floating_point_range[0].to_value) == (
        0,
        2,
    )
    assert node.describe_parameter('count').integer_range[0].from_value == 1
    assert 'a, b' in node.describe_parameter('mode').additional_constraints


def test_a_wrong_parameter_is_rejected_at_start_by_name(make):
    settings = knobs(make, gain=2, count=4, corner=[3, 4], mode='b').settings(Knobs)
    assert settings == Knobs(gain=2.0, count=4, corner=(3.0, 4.0), mode='b'), 'integers serve'
    for wrong in ({'gain': 3.0}, {'gain': 'x'}, {'mode': 'c'}, {'count': 0}, {'count': 1.5},
                  {'offset': math.nan}, {'corner': ['x']}, {'count': 1, 'gain': 1.5}):  # fmt: skip
        with pytest.raises(ConfigError, match=next(reversed(wrong))):
            knobs(make, **wrong)


def test_live_changes_are_checked_together_and_applied(make):
    node = knobs(make)
    assert node.set_parameters([Parameter('gain', value=1.5)])[0].successful
    assert node.settings(Knobs).gain == 1.5
    refused = node.set_parameters([Parameter('count', value=1)])[0]
    assert not refused.successful and 'gain must not exceed count' in refused.reason
    assert node.settings(Knobs).count == 3 and node.get_parameter('count').value == 3
    both = [Parameter('count', value=1), Parameter('gain', value=0.5)]
    assert node.set_parameters_atomically(both).successful
    assert node.settings(Knobs) == Knobs(gain=0.5, count=1)


def test_an_integer_serves_as_a_real_also_while_running(make):
    node = knobs(make)
    assert node.set_parameters([Parameter('gain', value=2)])[0].successful
    assert node.set_parameters_atomically([Parameter('path', value=[1, 2])]).successful
    assert node.settings(Knobs) == Knobs(gain=2.0, path=(1.0, 2.0))
    assert node.get_parameter('gain').type_ is Parameter.Type.DOUBLE
    assert not node.set_parameters([Parameter('count', value=2.0)])[0].successful


def test_a_list_has_real_numbers_also_while_it_is_empty(make):
    """Also once it was set as `ros2 param set` does it: an empty list of booleans."""
    for node in (knobs(make), knobs(make, path=[1.0]), knobs(make, path=None)):
        for value in ([], [3], [], array.array('d', [3.5]), []):
            kind = Parameter.Type.BOOL_ARRAY if value == [] else None
            assert node.set_parameters([Parameter('path', kind, value)])[0].successful
            assert node.settings(Knobs).path == tuple(value)
            told = node.get_parameter('path').get_parameter_value()
            assert told.type == node.describe_parameter('path').type == DOUBLES
            assert list(told.double_array_value) == list(value)
    assert node.describe_parameter('corner').type == DOUBLES


def test_a_wrong_live_change_is_rejected_and_changes_nothing(make):
    node = knobs(make)
    for name, value in (('fixed', 2.0), ('offset', math.nan), ('mode', 'c'), ('gain', 'x')):
        assert not node.set_parameters([Parameter(name, value=value)])[0].successful
        assert node.settings(Knobs) == Knobs()


def test_a_misspelt_or_older_parameter_is_warned_of_with_the_nearest_name(make, monkeypatch):
    said = []
    monkeypatch.setattr(LocalizationNode, 'get_logger', lambda _: type('L', (), {
        'warning': lambda *a, **k: said.append(a[1])})())  # fmt: skip
    given = {'gian': 0.7, 'zzz': 1, 'use_sim_time': False, 'qos_overrides./in.depth': 3}
    # Another node's: a section `/**` of the parameter file is given to all.
    knobs(make, publish_tf=False, **given)
    make(EkfNode, set_initial_pose=True)
    assert said == [
        "unknown parameter 'gian'; did you mean 'gain'?", "unknown parameter 'zzz'",
        "unknown parameter 'set_initial_pose'; did you mean 'initial_pose'?",
    ]  # fmt: skip


class Echo(LocalizationNode):
    def __init__(self, **options):
        super().__init__('echo', [], **options)

    def setup(self):
        self.out = self.publisher(String, 'out')
        self.subscribe(Float64, 'in', self.take)

    def take(self, message):
        if message.data < 0:
            raise MessageError('negative')
        self.out.publish(String(data=str(1 / message.data)))


def test_a_node_starts_itself_unless_told_not_to(make):
    node = make(Echo)
    assert node.start() and node.active
    waiting = make(Echo, autostart=False)
    assert waiting.start() and not waiting.active


def test_rejected_messages_and_defects_are_counted_and_end_nothing():
    bench = Bench(DOMAIN)
    try:
        node, heard = bench.run(Echo), bench.listen(String, 'out')
        for value in (-1.0, 0.0, 2.0):
            bench.publish('in', Float64(data=value))
        assert until(lambda: heard)
        monitor = node.monitor('in')
        assert (monitor.received, monitor.used) == (3, 1)
        assert monitor.refused == {'negative': 1, 'internal error: ZeroDivisionError': 1}
        assert math.isfinite(monitor.silent_for_s()) and monitor.latency_ms(50) >= 0
    finally:
        bench.close()


class Timed(LocalizationNode):
    """A node whose timer, health and service fail at first."""

    def __init__(self, **options):
        super().__init__('timed', [], **options)
        self.calls = 0

    def setup(self):
        self.every(0.01, self._tick)
        self.service(Trigger, '~/fail', self._fail)

    def _tick(self):
        self.calls += 1
        if self.calls == 1:
            raise LocalizationError('not ready')
        if self.calls == 2:
            raise ZeroDivisionError

    def _fail(self, request, response):
        raise KeyError('a defect')

    def health(self):
        raise ZeroDivisionError


def test_defects_in_timers_health_and_services_are_shown_and_end_nothing():
    bench = Bench(DOMAIN)
    try:
        node = bench.run(Timed)
        heard = bench.listen(DiagnosticArray, '/diagnostics')
        assert until(lambda: node.calls > 5)
        assert node.monitor('timer tick').refused == {
            'not ready': 1, 'internal error: ZeroDivisionError': 1,
        }  # fmt: skip
        # What the node cannot say of itself is an error, with the counts beside it.
        assert until(lambda: heard)
        status = heard[-1].status[0]
        assert status.level == DiagnosticStatus.ERROR and 'cannot be determined' in status.message
        keys = {value.key for value in status.values}
        assert 'timer tick: refused: internal error: ZeroDivisionError' in keys
        for _ in range(2):
            answer = bench.call(Trigger, 'timed/fail', Trigger.Request())
            assert not answer.success and 'KeyError' in answer.message
        assert until(lambda: len(heard) > 2)
    finally:
        bench.close()


def test_a_node_survives_its_whole_life_cycle_twice(make):
    node = make(Echo)
    node.start()
    for _ in range(2):
        node.trigger_deactivate()
        assert not node.active
        node.trigger_cleanup()
        assert node.start() and node.active
    node.trigger_shutdown()
    assert not node.active


def test_a_node_that_ends_leaves_ros_without_waiting_for_the_garbage_collection():
    """Else it is listed on, and the middleware ends it at any moment, while others start."""
    domain = free_domain()
    watching, running = Bench(domain), Bench(domain)
    gc.disable()
    try:
        node = running.run(EkfNode)
        assert until(lambda: 'ekf_node' in watching.node.get_node_names())
        running.end(node)
        assert until(lambda: 'ekf_node' not in watching.node.get_node_names())
        node.destroy_node()
    finally:
        gc.enable()
        running.close()
        watching.close()


class Failing(LocalizationNode):
    def setup(self):
        self.publisher(String, 'out')
        raise ConfigError('no model; give one')


def test_a_node_that_cannot_start_says_why_and_leaves_nothing(make):
    node = make(Failing, 'failing', [NodeConfig][1:])
    assert not node.start()
    assert node.failure == 'no model; give one'
    assert node.count_publishers('/out') == 0


# Conversions.


def odometry(**changes):
    message = Odometry()
    message.header.stamp.sec = 5
    message.pose.pose.orientation.w = 1.0
    for path, value in changes.items():
        *parents, name = path.split('__')
        target = message
        for parent in parents:
            target = getattr(target, parent)
        setattr(target, name, value)
    return message


def test_stamps_headings_and_turns_survive_the_round_trip():
    for stamp_ns in (1, 999_999_999, 1_000_000_000, 1_700_000_000_123_456_789):
        assert read_stamp(convert.to_stamp(stamp_ns)) == stamp_ns
        for yaw in (0.0, 1.0, -3.0, math.pi, -math.pi + 1e-9):
            back = read_yaw(convert.to_quaternion(yaw))
            assert abs(math.remainder(back - yaw, 2 * math.pi)) < 1e-12
            read_ns, read = convert.read_turned(convert.to_turned(yaw, stamp_ns, 'map'))
            assert read_ns == stamp_ns and abs(math.remainder(read - yaw, 2 * math.pi)) < 1e-9


def test_odometry_is_read():
    message = odometry(twist__twist__linear__x=0.5, twist__twist__angular__z=-0.2)
    message.twist.covariance[0], message.twist.covariance[35] = 4e-4, -1.0
    motion = convert.read_odometry(message)
    assert motion.stamp_ns == 5_000_000_000
    assert motion.twist == (0.5, -0.2) and motion.variances == (4e-4, 0.0)


MALFORMED = [
    ({'twist__twist__linear__x': math.nan}, 'twist is not finite'),
    ({'twist__twist__angular__z': math.inf}, 'twist is not finite'),
    ({'pose__pose__orientation__w': 0.0}, 'quaternion is zero'),
    ({'pose__pose__orientation__w': 1e200}, 'quaternion is absurdly large'),
    ({'pose__pose__orientation__w': math.nan}, 'quaternion is not finite'),
    ({'pose__pose__position__x': math.inf}, 'pose is not finite'),
    ({'header__stamp__sec': 0}, 'zero or negative stamp'),
    ({'header__stamp__nanosec': 1_000_000_000}, 'impossible stamp'),
    ({'twist__twist__linear__x': 1e308}, 'twist is absurdly large'),
]


def test_malformed_odometry_is_named():
    for changes, reason in MALFORMED:
        with pytest.raises(MessageError, match=reason):
            convert.read_odometry(odometry(**changes))


def test_pose_and_covariance_survive_the_round_trip():
    covariance = np.array([[0.2, 0.05, 0.01], [0.05, 0.3, 0.02], [0.01, 0.02, 0.1]])
    message = convert.to_pose_with_covariance([1.0, -2.0, 3.0], covariance, 7, 'map')
    stamp_ns, pose, back = convert.read_pose(message)
    assert stamp_ns == 7 and message.header.frame_id == 'map'
    assert np.allclose(pose, [1, -2, 3]) and np.allclose(back, covariance)


def test_a_malformed_covariance_is_named():
    for index, value, reason in ((0, math.nan, 'not finite'), (0, -1.0, 'negative'),
                                 (1, 0.5, 'symmetric'), (35, 1e308, 'absurdly')):  # fmt: skip
        message = PoseWithCovarianceStamped()
        message.header.stamp.sec = 1
        message.pose.pose.orientation = Quaternion(w=1.0)
        message.pose.covariance[index] = value
        with pytest.raises(MessageError, match=reason):
            convert.read_pose(message)


def test_the_declaration_of_a_panorama_survives_the_round_trip_and_bad_ones_are_named():
    panorama = PanoramaConfig(width=300, elevation_min=-7.25, clockwise=False)
    assert convert.read_info(convert.to_info(panorama)) == panorama
    bad = '{"width": "wide"}', '{"colour": 1}', f'{{"width": {10**400}}}'
    for text in ('', 'no JSON', '[1]', '"x"', '[' * 100_000, *bad):
        with pytest.raises(MessageError):
            convert.read_info(String(data=text))


def test_nothing_that_is_not_finite_gets_out():
    with pytest.raises(MessageError, match='output'):
        convert.to_pose([math.nan, 0.0, 0.0], 1, 'map')
    assert convert.to_pose([1.0, 2.0, math.nan], 1, 'map').pose.orientation.w == 1.0
