# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters from settings, message conversions, and the life cycle that all nodes share."""

import array
import dataclasses
import math

import pytest
import yaml

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.errors import ConfigError, LocalizationError, MessageError
from sfa_localization.data.messages import read_stamp, read_yaw
from sfa_localization.data.settings import Settings, setting

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter, parameter_dict_from_yaml_file
from ros_bench import until
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger

from sfa_localization.nodes import conversions as convert
from sfa_localization.nodes.lifecycle import LocalizationNode, sensor_qos

pytestmark = pytest.mark.ros


@dataclasses.dataclass(frozen=True, slots=True)
class Knobs(Settings):
    gain: float = setting(0.5, 'a gain', unit='m', low=0.0, high=2.0, live=True)
    offset: float = setting(0.0, 'unbounded', live=True)
    count: int = setting(3, 'a number', low=1, high=9, live=True)
    mode: str = setting('a', 'a choice', choices=('a', 'b'), live=True)
    fixed: float = setting(1.0, 'read only')
    corner: tuple[float, ...] = setting((1.0, 2.0), 'an array')
    path: tuple[float, ...] = setting((), 'an array that may be empty', live=True)

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.gain > self.count:
            raise ConfigError('gain must not exceed count')


class WithKnobs(LocalizationNode):
    def __init__(self, **options):
        super().__init__('knobs', [Knobs], **options)


@pytest.fixture
def knobs(bench):
    return lambda **given: bench.run(WithKnobs, start=False, **given)


def test_every_setting_is_a_described_ranged_parameter(knobs):
    node = knobs()
    for item in dataclasses.fields(Knobs):
        told = node.describe_parameter(item.name)
        assert told.description.startswith(item.metadata['doc'])
        assert told.read_only != item.metadata['live']
    gain = node.describe_parameter('gain')
    (bounds,) = gain.floating_point_range
    assert gain.description == 'a gain [m]' and (bounds.from_value, bounds.to_value) == (0, 2)
    assert node.describe_parameter('count').integer_range[0].from_value == 1
    assert 'a, b' in node.describe_parameter('mode').additional_constraints


def test_a_wrong_parameter_is_rejected_at_start_by_name(knobs):
    settings = knobs(gain=2, count=4, corner=[3, 4], mode='b').settings(Knobs)
    assert settings == Knobs(gain=2.0, count=4, corner=(3.0, 4.0), mode='b'), 'integers serve'
    for wrong in ({'gain': 3.0}, {'gain': 'x'}, {'mode': 'c'}, {'count': 0}, {'count': 1.5},
                  {'offset': math.nan}, {'corner': ['x']}, {'count': 1, 'gain': 1.5}):  # fmt: skip
        with pytest.raises(ConfigError, match=next(reversed(wrong))):
            knobs(**wrong)


def test_a_wrong_live_change_is_rejected_and_changes_nothing(knobs):
    """Changes are checked together, and integers serve."""
    node = knobs()
    wrong = {'fixed': 2.0, 'offset': math.nan, 'mode': 'c', 'gain': 'x', 'count': 2.0}
    for name, value in wrong.items():
        assert not node.set_parameters([Parameter(name, value=value)])[0].successful
    assert node.settings(Knobs) == Knobs()
    assert node.set_parameters([Parameter('gain', value=2)])[0].successful
    assert node.get_parameter('gain').type_ is Parameter.Type.DOUBLE
    refused = node.set_parameters([Parameter('count', value=1)])[0]
    assert not refused.successful and 'gain must not exceed count' in refused.reason
    assert node.settings(Knobs).count == node.get_parameter('count').value == 3
    both = [Parameter('count', value=1), Parameter('gain', value=0.5)]
    assert node.set_parameters_atomically(both).successful
    assert node.settings(Knobs) == Knobs(gain=0.5, count=1)


def test_a_list_has_real_numbers_also_while_it_is_empty(knobs):
    """Also once it was set as `ros2 param set` does it: an empty list of booleans."""
    doubles = ParameterType.PARAMETER_DOUBLE_ARRAY
    for node in (knobs(), knobs(path=[1.0]), knobs(path=None)):
        for value in ([], [3], [], array.array('d', [3.5])):
            kind = Parameter.Type.BOOL_ARRAY if value == [] else None
            assert node.set_parameters([Parameter('path', kind, value)])[0].successful
            assert node.settings(Knobs).path == tuple(value)
            told = node.get_parameter('path').get_parameter_value()
            assert told.type == node.describe_parameter('path').type == doubles


def test_what_ros2_param_dumps_can_be_loaded(bench, tmp_path):
    """Read-only parameters that keep their values are accepted, also those of qos_overrides."""
    node, path = bench.run(Echo), tmp_path / 'dump.yaml'
    names = [name for name in node.list_parameters([], 0).names if name != 'use_sim_time']
    assert sum(node.describe_parameter(name).read_only for name in names) == len(names) > 10
    values = {name: node.get_parameter(name).value for name in names}
    path.write_text(yaml.safe_dump({'/echo': {'ros__parameters': values}}))
    for name, told in parameter_dict_from_yaml_file(str(path), False, ['/echo']).items():
        assert node.set_parameters([Parameter.from_parameter_msg(told)])[0].successful, name
    both = [Parameter('autostart', value=value) for value in (True, False)]
    assert 'autostart' in node.set_parameters_atomically(both).reason


class Echo(LocalizationNode):
    """A node whose timers fail at first, also that of its health, and whose service always."""

    def __init__(self, **options):
        super().__init__('echo', [], **options)
        self.calls = self.looks = 0

    def setup(self):
        self.out = self.publisher(String, 'out')
        self.subscribe(Float64, 'in', self.hear, sensor_qos())
        self.every(0.01, self.tick)
        self.service(Trigger, '~/fail', self.fail)

    def hear(self, message):
        if message.data < 0:
            raise MessageError('negative')
        self.out.publish(String(data=str(1 / message.data)))

    def tick(self):
        self.calls += 1
        if self.calls < 3:
            raise LocalizationError('not ready') if self.calls == 1 else ZeroDivisionError

    def fail(self, request):
        raise LocalizationError('no model; give one')

    def health(self):
        self.looks += 1
        return super().health() if self.looks > 3 else 1 / 0


def test_what_fails_in_callbacks_timers_health_and_services_is_counted_and_ends_nothing(bench):
    node, heard = bench.run(Echo), bench.listen(String, 'out')
    told = bench.listen(DiagnosticArray, '/diagnostics')
    for value in (-1.0, 0.0, 2.0):
        bench.publish('in', Float64(data=value))
    assert until(lambda: heard and node.calls > 5)
    monitor = node.monitors['in']
    assert (monitor.received, monitor.used) == (3, 1)
    assert monitor.refused == {'negative': 1, 'internal error: ZeroDivisionError': 1}
    assert node.monitors['timer tick'].refused.keys() >= {'not ready'}
    assert until(lambda: told and 'running' in told[-1].status[0].message)
    keys = {value.key for value in told[-1].status[0].values}
    for timer in ('tick', 'publish_health'):
        assert f'timer {timer}: refused: internal error: ZeroDivisionError' in keys
    answer = bench.call(Trigger, 'echo/fail', Trigger.Request())
    assert not answer.success and answer.message == 'no model; give one'


def test_a_node_starts_itself_unless_told_not_to_and_survives_its_life_cycle_twice(bench):
    waiting = bench.run(Echo, start=False, autostart=False)
    assert waiting.start() and not waiting.active
    bench.end(waiting)
    node = bench.run(Echo)
    for _ in range(2):
        node.trigger_deactivate()
        assert not node.active
        node.trigger_cleanup()
        assert node.start() and node.active
    node.trigger_shutdown()
    assert not node.active


def test_stamps_yaws_and_panoramas_survive_the_round_trip():
    """Poses and odometry do in test_ekf_node.py."""
    for stamp_ns in (1, 999_999_999, 1_000_000_000, 1_700_000_000_123_456_789):
        assert read_stamp(convert.to_stamp(stamp_ns)) == stamp_ns
    for yaw in (0.0, 1.0, -3.0, math.pi, -math.pi + 1e-9):
        assert abs(math.remainder(read_yaw(convert.to_quaternion(yaw)) - yaw, math.tau)) < 1e-12
    panorama = PanoramaConfig(width=300, elevation_min=-7.25, clockwise=False)
    assert convert.read_info(convert.to_info(panorama)) == panorama
    for text in ('', '[1]', '{"width": "wide"}', '{"colour": 1}', f'{{"width": {10**400}}}'):
        with pytest.raises(MessageError):
            convert.read_info(String(data=text))


def test_nothing_that_is_not_finite_gets_out():
    for pose in ([math.nan, 0.0, 0.0], [0.0, math.inf, 0.0]):
        with pytest.raises(MessageError, match='output'):
            convert.to_pose(pose, 1, 'map')
    assert convert.to_pose([1.0, 2.0, math.nan], 1, 'map').pose.orientation.w == 1.0
