# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ekf_node on real messages: what it publishes, what it survives, how it tells its state."""

import math
from pathlib import Path as FilePath

import numpy as np
import pytest
from filter_drives import START_NS, Drive, from_rest, winding
from ros_domains import free_domain
from transform_buffer import TransformBuffer

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import compose
from sfa_localization.fusion import motion
from sfa_localization.fusion.pose_filter import Level, PoseFilter
from sfa_localization.fusion.settings import FilterConfig

pytest.importorskip('rclpy')
pytestmark = pytest.mark.ros

from builtin_interfaces.msg import Time as Stamp  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState, GetState  # noqa: E402
from nav_msgs.msg import Odometry, Path  # noqa: E402
from rcl_interfaces.msg import Parameter as ParameterMessage  # noqa: E402
from rcl_interfaces.msg import ParameterValue  # noqa: E402
from rcl_interfaces.srv import SetParameters, SetParametersAtomically  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.time import Time  # noqa: E402
from ros_bench import Bench, until  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from std_msgs.msg import Float64MultiArray, String  # noqa: E402
from std_srvs.srv import SetBool, Trigger  # noqa: E402

from sfa_localization.data.messages import read_stamp, read_yaw  # noqa: E402
from sfa_localization.nodes import ekf_node, lifecycle  # noqa: E402
from sfa_localization.nodes.conversions import (  # noqa: E402
    read_pose,
    to_error_correlation,
    to_odometry,
    to_pose_with_covariance,
    to_turned,
)
from sfa_localization.nodes.ekf_node import EkfNode  # noqa: E402
from sfa_localization.nodes.lifecycle import latched_qos  # noqa: E402
from sfa_localization.nodes.monitor import steady_s  # noqa: E402

DOMAIN = free_domain()

IMAGE_POSE = 'sfa/pose_with_covariance'
AT_ORIGIN = [0.0, 0.0, 0.0]
SPREAD = np.diag([0.04, 0.04, 0.0025])
NOISY = {'position_std': 0.1, 'yaw_std': 0.03, 'v_std': 0.02, 'omega_std': 0.01}


@pytest.fixture
def bench():
    made = Bench(DOMAIN)
    yield made
    made.close()


def odometry(drive, i, stamp_ns=None):
    spread = np.diag(drive.variances())
    stamp_ns = int(drive.stamps_ns[i]) if stamp_ns is None else stamp_ns
    frames = ('odom', 'base_link')
    return to_odometry(drive.reckoned[i], np.eye(3), drive.read[i], spread, stamp_ns, frames)


def picture(drive, k, spread=SPREAD, frame='map'):
    stamp_ns = int(drive.stamps_ns[drive.pictures[k]])
    return to_pose_with_covariance(drive.seen[k], spread, stamp_ns, frame)


def play(bench, node, drive, events=None):
    """Send a drive and wait until the node has dealt with it."""
    events = drive.events() if events is None else events
    counts = node.monitor('odom'), node.monitor(IMAGE_POSE)
    for _, kind, index in events:
        before = counts[kind].received
        if kind == 0:
            bench.publish('odom', odometry(drive, index))
        else:
            bench.publish(IMAGE_POSE, picture(drive, index))
        # One at a time: the order between topics is then the drive's.
        assert until(lambda b=before, k=kind: counts[k].received > b)


def pose_of(message):
    p = message.pose.pose
    return np.array([p.position.x, p.position.y, read_yaw(p.orientation)])


def test_live_is_offline_and_stamps_are_the_inputs(bench):
    drive = Drive(seconds=3, **NOISY)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    heard = bench.listen(Odometry, 'ekf/odometry')
    poses = bench.listen(PoseWithCovarianceStamped, 'ekf/pose')
    offline = PoseFilter(FilterConfig(initial_pose=(0.0, 0.0, 0.0)))
    play(bench, node, drive)
    assert until(lambda: len(heard) == len(drive.stamps_ns) and len(poses) == len(drive.pictures))
    for event in drive.events():
        stamp_ns, kind, index = event
        if kind == 0:
            offline.add_odometry(stamp_ns, *drive.read[index], drive.variances())
            told = heard[index]
            assert read_stamp(told.header.stamp) == stamp_ns
            assert np.allclose(pose_of(told), offline.at(stamp_ns).pose, atol=1e-9)
        else:
            offline.add_measurement(stamp_ns, drive.seen[index], SPREAD)
            assert np.allclose(pose_of(poses[index]), offline.at(stamp_ns).pose, atol=1e-9)
            told = np.array(poses[index].pose.covariance).reshape(6, 6)
            spread = offline.at(stamp_ns).pose_covariance
            assert np.allclose(told[np.ix_([0, 1, 5], [0, 1, 5])], spread, atol=1e-12)
    assert heard[-1].header.frame_id == 'map' and heard[-1].child_frame_id == 'base_link'


def test_map_to_odom_makes_odometry_the_pose_in_the_map(bench):
    drive = Drive(seconds=1, **NOISY)
    node = bench.run(EkfNode, initial_pose=[5.0, 0.0, 2.0])
    heard = bench.listen(TransformStamped, 'ekf/map_to_odom')
    told = bench.listen(Odometry, 'ekf/odometry')
    play(bench, node, drive, [e for e in drive.events() if e[1] == 0])
    assert until(lambda: len(heard) == len(told) == len(drive.stamps_ns))
    for i, (transform, message) in enumerate(zip(heard, told, strict=True)):
        t = transform.transform
        map_to_odom = [t.translation.x, t.translation.y, read_yaw(t.rotation)]
        miss = compose(map_to_odom, drive.reckoned[i]) - pose_of(message)
        assert np.hypot(*miss[:2]) < 1e-9 and abs(math.remainder(miss[2], 2 * math.pi)) < 1e-9
        assert read_stamp(transform.header.stamp) == int(drive.stamps_ns[i])
        assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'odom')


def test_the_transform_is_broadcast_where_tf2_msgs_is_installed(bench):
    tf2_msgs = pytest.importorskip('tf2_msgs.msg')
    drive = Drive(seconds=0.2)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    heard = bench.listen(tf2_msgs.TFMessage, '/tf')
    play(bench, node, drive)
    assert until(lambda: len(heard) == 10)
    assert heard[0].transforms[0].child_frame_id == 'odom'


@pytest.mark.parametrize('tolerance_s', [0.1, 0.25, 0.0])
def test_a_lookup_in_tf_is_the_pose_of_ekf_odometry_and_there_is_one_ahead(
    bench, monkeypatch, tolerance_s
):
    """Images correct the pose; at odometry's 50 Hz, 0.1 s is a whole number of its periods."""
    drive = Drive(seconds=4, **NOISY)
    node = bench.run(EkfNode, initial_pose=[0.3, -0.3, 0.1], transform_tolerance=tolerance_s)
    # tf2_msgs is not in the pip wheels: what would go to /tf is caught here instead.
    monkeypatch.setattr(ekf_node, 'TFMessage', lambda transforms: transforms)
    buffer = TransformBuffer()
    node._tf = type('Publisher', (), {'publish': lambda _, sent: buffer.add(sent)})()
    told = bench.listen(Odometry, 'ekf/odometry')
    play(bench, node, drive)
    assert until(lambda: len(told) == len(drive.stamps_ns))
    corrections = []
    for i, message in enumerate(told):
        found = buffer.lookup(int(drive.stamps_ns[i]))
        miss = compose(found, drive.reckoned[i]) - pose_of(message)
        assert np.hypot(*miss[:2]) < 1e-6 and abs(math.remainder(miss[2], 2 * math.pi)) < 1e-6
        corrections.append(found)
    assert np.ptp(np.array(corrections), axis=0)[:2].max() > 0.1, 'nothing was corrected'
    ahead_ns = int(drive.stamps_ns[-1]) + round(tolerance_s * 1e9)
    assert np.allclose(buffer.lookup(ahead_ns), corrections[-1], atol=0.1)
    assert buffer.newest_ns - ahead_ns in (0, 500)


def test_without_tf2_msgs_the_node_runs_and_says_so(bench, monkeypatch):
    monkeypatch.setattr(ekf_node, 'TFMessage', None)
    said = []
    monkeypatch.setattr(
        ekf_node.EkfNode, 'get_logger', lambda _: type('L', (), {
            'info': lambda *a, **k: None, 'warning': lambda _, text, **k: said.append(text)})()
    )  # fmt: skip
    assert bench.run(EkfNode).active
    assert len(said) == 1 and 'tf2_msgs is not installed' in said[0]


def test_every_measurement_gets_its_verdict(bench):
    drive = Drive(seconds=2, **NOISY)
    drive.seen[10, :2] += 9.0
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    heard = bench.listen(DiagnosticArray, 'ekf/measurement_status')
    play(bench, node, drive)
    assert until(lambda: len(heard) == len(drive.pictures))
    values = [{v.key: v.value for v in m.status[0].values} for m in heard]
    assert {m.status[0].hardware_id for m in heard} == {'sfa_localization'}
    assert values[3]['accepted'] == 'true' and values[10]['accepted'] == 'false'
    assert float(values[10]['d2']) > float(values[10]['threshold'])
    assert heard[10].status[0].message == 'outside the gate'
    assert read_stamp(heard[10].header.stamp) == int(drive.stamps_ns[drive.pictures[10]])


def test_the_state_is_latched_and_tells_why(bench):
    drive = Drive(seconds=4, **NOISY)
    node = bench.run(EkfNode)
    early = bench.listen(String, 'ekf/state', latched_qos())
    assert until(lambda: early and early[-1].data.startswith('UNINITIALISED: no odometry'))
    play(bench, node, drive)
    assert until(lambda: early[-1].data.startswith('LOCALISED'))
    late = []
    bench.node.create_subscription(String, 'ekf/state', late.append, latched_qos())
    assert until(lambda: late and late[0].data.startswith('LOCALISED'))


def test_initialpose_and_set_pose_set_the_pose(bench):
    drive = Drive(seconds=1)
    node = bench.run(EkfNode)
    for topic, x in (('initialpose', 7.0), ('ekf_node/set_pose', -3.0)):
        message = to_pose_with_covariance([x, 1.0, math.pi], SPREAD, 1, 'map')
        message.header.stamp = Time(nanoseconds=0).to_msg()
        bench.publish(topic, message)
        assert until(lambda x=x: node._filter.state and node._filter.state.pose[0] == x)
    play(bench, node, drive, [e for e in drive.events() if e[1] == 0])
    # Before the first odometry the pose was given; it has survived the start.
    assert abs(node._filter.state.pose[0] - (-3.0 - drive.poses[-1, 0])) < 0.1


def test_a_pose_in_another_frame_is_refused(bench):
    node = bench.run(EkfNode)
    bench.publish('initialpose', to_pose_with_covariance([1, 1, 0], SPREAD, 5, 'odom'))
    assert until(lambda: "frame is 'odom', not 'map'" in node.monitor('initialpose').refused)
    assert node._filter.state is None


def test_reset_and_pause(bench):
    drive = Drive(seconds=6, **NOISY)
    node = bench.run(EkfNode)
    first = [e for e in drive.events() if e[0] < START_NS + 10**9]
    second = [e for e in drive.events() if 10**9 <= e[0] - START_NS < 2 * 10**9]
    third = [e for e in drive.events() if e[0] - START_NS >= 2 * 10**9]
    play(bench, node, drive, first)
    assert node._filter.state is not None
    assert bench.call(SetBool, 'ekf_node/pause', SetBool.Request(data=True)).success
    accepted = node._filter.counts['measurement: accepted']
    odometries = bench.listen(Odometry, 'ekf/odometry')
    poses = bench.listen(PoseWithCovarianceStamped, 'ekf/pose')
    transforms = bench.listen(TransformStamped, 'ekf/map_to_odom')
    play(bench, node, drive, second)
    # The estimate goes on by odometry, on every topic.
    assert until(lambda: len(poses) == len([e for e in second if e[1]]))
    assert until(lambda: len(odometries) == len(transforms) == len([e for e in second if not e[1]]))
    assert until(
        lambda: node.monitor(IMAGE_POSE).refused['paused'] == len([e for e in second if e[1]])
    )
    assert node._filter.counts['measurement: accepted'] == accepted
    assert 'paused' in ' '.join(node._status().reasons)
    bench.call(SetBool, 'ekf_node/pause', SetBool.Request(data=False))
    answer = bench.call(Trigger, 'ekf_node/reset', Trigger.Request())
    assert answer.success and answer.message == 'UNINITIALISED'
    play(bench, node, drive, third)
    assert until(lambda: node._status().level.name == 'LOCALISED')


def set_state(bench, transition):
    request = ChangeState.Request(transition=Transition(id=transition))
    assert bench.call(ChangeState, 'ekf_node/change_state', request).success


def test_a_pause_ends_with_the_configuration(bench):
    drive = Drive(seconds=1, **NOISY)
    node = bench.run(EkfNode)
    assert bench.call(SetBool, 'ekf_node/pause', SetBool.Request(data=True)).success
    for transition in (
        Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP,
        Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE,
    ):  # fmt: skip
        set_state(bench, transition)
    assert 'paused' not in ' '.join(node._status().reasons)
    bench._publishers.clear()
    play(bench, node, drive)
    assert until(lambda: node._filter.counts['measurement: accepted'] > 0)


def test_a_refused_pose_is_not_used_too(bench):
    drive = Drive(seconds=2, **NOISY)
    drive.seen[10, :2] += 9.0
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    heard = bench.listen(DiagnosticArray, 'ekf/measurement_status')
    play(bench, node, drive)
    count = len(drive.pictures)
    assert until(lambda: len(heard) == count)
    monitor = node.monitor(IMAGE_POSE)
    assert until(lambda: monitor.used + sum(monitor.refused.values()) == count)
    assert monitor.refused == {'outside the gate': 1}


def test_what_senders_write_does_not_fill_the_diagnostics(bench):
    node = bench.run(EkfNode)
    told = bench.listen(DiagnosticArray, '/diagnostics')
    for number in range(200):
        message = to_pose_with_covariance([1, 1, 0], SPREAD, 5, f'frame_{number}' + 'x' * 2000)
        bench.publish(IMAGE_POSE, message)
        assert until(lambda n=number: node.monitor(IMAGE_POSE).received > n)
    assert until(lambda: sum(node.monitor(IMAGE_POSE).refused.values()) == 200)
    told.clear()
    assert until(lambda: told)
    values = told[-1].status[0].values
    assert len(values) < 100 and max(len(value.key) for value in values) < 320


def malformed():
    """Broken messages, each a change of a good one, with the topic it goes to."""
    drive = Drive(seconds=1)

    def broken(make, change):
        message = make()
        change(message)
        return message

    def odom():
        return odometry(drive, 40)

    def pose():
        return picture(drive, 8)

    def fill(name, value):
        def change(message):
            covariance = getattr(message, name).covariance
            covariance[:] = value

        return change

    nan, inf = math.nan, math.inf
    changes = [
        (odom, lambda m: setattr(m.twist.twist.linear, 'x', nan)),
        (odom, lambda m: setattr(m.twist.twist.angular, 'z', inf)),
        (odom, lambda m: setattr(m.twist.twist.linear, 'x', 1e200)),
        (odom, lambda m: setattr(m.pose.pose.orientation, 'w', nan)),
        (odom, lambda m: (setattr(m.pose.pose.orientation, 'w', 0.0),
                          setattr(m.pose.pose.orientation, 'z', 0.0))),
        (odom, lambda m: setattr(m.pose.pose.orientation, 'z', 1e200)),
        (odom, lambda m: setattr(m.header.stamp, 'sec', 0)
         or setattr(m.header.stamp, 'nanosec', 0)),
        (odom, lambda m: setattr(m.header.stamp, 'nanosec', 2_000_000_000)),
        (odom, lambda m: setattr(m.header.stamp, 'sec', 2_000_000_000)),
        (pose, lambda m: setattr(m.pose.pose.position, 'x', nan)),
        (pose, lambda m: setattr(m.pose.pose.position, 'y', 1e300)),
        (pose, lambda m: setattr(m.pose.pose.orientation, 'w', inf)),
        (pose, lambda m: (setattr(m.pose.pose.orientation, 'w', 0.0),
                          setattr(m.pose.pose.orientation, 'z', 0.0))),
        (pose, fill('pose', nan)),
        (pose, fill('pose', -1.0)),
        (pose, fill('pose', 1e308)),
        (pose, lambda m: m.pose.covariance.__setitem__(1, 0.03)),
        (pose, lambda m: setattr(m.header, 'frame_id', 'elsewhere')),
        (pose, lambda m: setattr(m.header.stamp, 'sec', 0)
         or setattr(m.header.stamp, 'nanosec', 0)),
        (pose, lambda m: setattr(m.header.stamp, 'sec', 2_000_000_000)),
    ]  # fmt: skip
    return [
        ('odom' if make is odom else IMAGE_POSE, broken(make, change)) for make, change in changes
    ]


def test_malformed_messages_are_counted_and_change_nothing(bench):
    drive = Drive(seconds=1, **NOISY)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    odometries = bench.listen(Odometry, 'ekf/odometry')
    play(bench, node, drive)
    assert until(lambda: len(odometries) == len(drive.stamps_ns))
    before = node._filter.state
    for topic, message in malformed():
        refused = sum(node.monitor(topic).refused.values())
        bench.publish(topic, message)
        assert until(lambda t=topic, r=refused: sum(node.monitor(t).refused.values()) > r), message
        after = node._filter.state
        assert np.array_equal(before.mean, after.mean), message
        assert np.array_equal(before.covariance, after.covariance), message
    internal = [w for m in node.monitors.values() for w in m.refused if 'internal' in w]
    assert not internal
    assert all(np.all(np.isfinite(pose_of(message))) for message in odometries)
    again = Drive(seconds=0.4)
    again.stamps_ns = again.stamps_ns + 10**9
    play(bench, node, again, [(int(s), 0, i) for i, s in enumerate(again.stamps_ns)])
    assert until(lambda: len(odometries) == len(drive.stamps_ns) + len(again.stamps_ns))


def test_diagnostics_hold_rates_latencies_and_counts(bench):
    drive = Drive(twists=from_rest(winding(2)), **NOISY)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    heard = bench.listen(DiagnosticArray, '/diagnostics')
    assert until(lambda: any(m.status[0].level == DiagnosticStatus.WARN for m in heard))
    play(bench, node, drive)

    def told():
        return {v.key: v.value for v in heard[-1].status[0].values}

    assert until(lambda: told().get('odometry: used') == '100')
    values = told()
    assert values['state'] == 'LOCALISED' and heard[-1].status[0].message == 'LOCALISED'
    assert values['/odom: received'] == '100' and float(values['/odom: rate [Hz]']) > 0
    assert float(values['/odom: latency p99 [ms]']) >= float(values['/odom: latency p50 [ms]']) > 0
    assert 'measurement: accepted' in values and 'position std [m]' in values


def test_silence_is_reported_without_any_clock_moving(bench):
    drive = Drive(twists=from_rest(winding(2)), **NOISY)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN, silence_timeout=0.2)
    states = bench.listen(String, 'ekf/state', latched_qos())
    play(bench, node, drive)
    assert until(lambda: any(s.data.startswith('DEGRADED: nothing on /odom') for s in states))
    assert until(lambda: any(f'nothing on /{IMAGE_POSE}' in s.data for s in states))


def test_an_input_that_nobody_publishes_is_named(bench):
    """As when sfa_node has died, at the start or later."""
    drive = Drive(seconds=2, **NOISY)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN, silence_timeout=0.2)
    states = bench.listen(String, 'ekf/state', latched_qos())
    odometry, images = 'nobody publishes on /odom', f'nobody publishes on /{IMAGE_POSE}'
    assert until(lambda: states and odometry in states[-1].data and images in states[-1].data)
    play(bench, node, drive)
    assert until(lambda: odometry not in states[-1].data and images not in states[-1].data)
    bench.node.destroy_publisher(bench._publishers.pop(IMAGE_POSE))
    assert until(lambda: images in states[-1].data and images in node.health()[1])
    assert odometry not in states[-1].data


def test_what_nothing_moves_on_is_lost_in_the_end_by_the_wall_clock(bench):
    """Messages have stopped for good: only the wall clock shows how unsure the pose is by now."""
    drive = Drive(seconds=2, **NOISY)
    node = bench.run(EkfNode, silence_timeout=0.2, lost_std=0.5, degraded_std=0.4)
    states = bench.listen(String, 'ekf/state', latched_qos())
    play(bench, node, drive)
    assert until(lambda: states[-1].data.startswith('LOST: position known to'))
    assert node._filter.status.level.name != 'LOST', 'by the stamps of the messages it is not'
    assert float(node.health()[2]['position std [m]']) > 0.5
    further = Drive(seconds=4, **NOISY)
    play(bench, node, further, [e for e in further.events() if e[0] > drive.stamps_ns[-1]])
    assert node._status().level.name != 'LOST'


def test_a_pose_set_before_the_first_message_waits_for_it(bench, monkeypatch):
    monkeypatch.setattr(motion, 'UNKNOWN_SPEED', 50.0)
    node = bench.run(EkfNode, silence_timeout=0.1, lost_std=0.5, degraded_std=0.4)
    bench.publish('initialpose', to_pose_with_covariance([1, 1, 0], SPREAD, START_NS, 'map'))
    assert until(lambda: node._filter.state is not None)
    since = steady_s()
    assert until(lambda: steady_s() - since > 1.0)
    assert node._status().level.name == 'DEGRADED'


def test_simulated_time_that_steps_back_starts_anew(bench):
    node = bench.run(EkfNode, use_sim_time=True, initial_pose=AT_ORIGIN)
    drive = Drive(seconds=0.5)
    bench.publish('/clock', Clock(clock=Time(nanoseconds=START_NS).to_msg()))
    assert until(lambda: node.get_clock().now().nanoseconds == START_NS)
    play(bench, node, drive)
    bench.publish('/clock', Clock(clock=Time(nanoseconds=START_NS - 10**10).to_msg()))
    assert until(lambda: node._filter.counts['reset'] == 1)


def test_simulated_time_that_never_comes_is_named(bench, monkeypatch):
    monkeypatch.setattr(lifecycle, 'PATIENCE_S', 0.0)
    bench.run(EkfNode, use_sim_time=True)
    told = bench.listen(DiagnosticArray, '/diagnostics')
    assert until(lambda: told and 'there is no time on /clock' in told[-1].status[0].message)
    assert told[-1].status[0].level == DiagnosticStatus.WARN
    bench.publish('/clock', Clock(clock=Stamp(sec=100)))
    assert until(lambda: '/clock' not in told[-1].status[0].message)


@pytest.mark.parametrize('kind', [77, 200, 10])
def test_a_parameter_of_an_unknown_type_is_refused_and_ends_nothing(bench, kind):
    node = bench.run(EkfNode)
    odd = ParameterMessage(name='speed_std', value=ParameterValue(type=kind))
    fine = ParameterMessage(name='rate_std', value=ParameterValue(type=3, double_value=0.03))
    answer = bench.call(
        SetParameters, '/ekf_node/set_parameters', SetParameters.Request(parameters=[fine, odd])
    )
    assert [result.successful for result in answer.results] == [True, False]
    assert str(kind) in answer.results[1].reason
    request = SetParametersAtomically.Request(parameters=[fine, odd])
    answer = bench.call(SetParametersAtomically, '/ekf_node/set_parameters_atomically', request)
    assert not answer.result.successful
    assert node.get_parameter('rate_std').value == 0.03


def test_a_negative_clock_ends_nothing(bench):
    node = bench.run(EkfNode, use_sim_time=True)
    bench.publish('/clock', Clock(clock=Stamp(sec=-1)))
    assert until(lambda: sum(node.monitor('/clock').refused.values()) == 1)
    bench.publish('/clock', Clock(clock=Stamp(sec=100)))
    assert until(lambda: node.get_clock().now().nanoseconds == 100 * 10**9)


@pytest.mark.parametrize(('number', 'label'), [(3, ''), (2, ''), (200, ''), (0, 'nonsense')])
def test_a_transition_that_does_not_fit_is_answered(bench, number, label):
    bench.run(EkfNode)
    request = ChangeState.Request(transition=Transition(id=number, label=label))
    assert not bench.call(ChangeState, '/ekf_node/change_state', request).success
    state = bench.call(GetState, '/ekf_node/get_state', GetState.Request()).current_state
    assert state.label == 'active'


def test_live_parameters_reach_the_filter_and_keep_the_pose(bench):
    drive = Drive(seconds=1, **NOISY)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    play(bench, node, drive)
    before = node._filter.state.pose
    assert node.set_parameters([Parameter('measurement_factor', value=4.0)])[0].successful
    assert node._filter.config.measurement_factor == 4.0
    assert np.array_equal(before, node._filter.state.pose)
    refused = node.set_parameters([Parameter('degraded_std', value=50.0)])[0]
    assert not refused.successful and 'degraded_std' in refused.reason


def test_the_path_is_thinned_and_bounded(bench, monkeypatch):
    monkeypatch.setattr(ekf_node, 'PATH_LENGTH', 3)
    drive = Drive(seconds=4, rate_hz=20)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    heard = bench.listen(Path, 'ekf/path')
    play(bench, node, drive, [e for e in drive.events() if e[1] == 0])
    assert until(lambda: heard and len(heard[-1].poses) == 3)
    stamps = [read_stamp(pose.header.stamp) for pose in heard[-1].poses]
    assert np.all(np.diff(stamps) >= 500_000_000)


def test_it_obeys_a_lifecycle_manager(bench):
    node = bench.run(EkfNode, autostart=False)
    assert not node.active
    for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert bench.call(ChangeState, 'ekf_node/change_state', request).success
    assert node.active
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    assert bench.call(ChangeState, 'ekf_node/change_state', request).success
    assert not node.active


def test_overrides_of_quality_of_service_are_taken(bench):
    overrides = {
        'qos_overrides./odom.subscription.reliability': 'reliable',
        'qos_overrides./ekf/odometry.publisher.depth': 3,
    }
    bench.run(EkfNode, **overrides)
    assert until(lambda: bench.node.get_subscriptions_info_by_topic('/odom'))
    profile = bench.node.get_subscriptions_info_by_topic('/odom')[0].qos_profile
    assert profile.reliability.name == 'RELIABLE'


def test_measurements_without_heading_are_taken_as_positions(bench):
    drive = Drive(seconds=1)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    play(bench, node, drive, [e for e in drive.events() if e[1] == 0])
    spread = np.diag([0.04, 0.04, 0.0])
    message = picture(drive, 5, spread)
    _, _, told = read_pose(message)
    assert told[2, 2] < 1e-5
    message.pose.covariance[35] = 0.0
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = 1.0, 0.0  # 180 deg off
    bench.publish(IMAGE_POSE, message)
    assert until(lambda: node._filter.counts['measurement: accepted'] == 1)


def test_the_models_error_correlation_is_what_an_offline_filter_uses(bench):
    drive = Drive(seconds=4, **NOISY)
    known = ErrorCorrelation(0.1, 3.0)
    node = bench.run(EkfNode, start=False)
    node.trigger_configure()
    heard = node.monitor('sfa/error_correlation')
    bench.publish('sfa/error_correlation', to_error_correlation(known), latched_qos())
    # It is published once, perhaps before the node is active.
    assert until(lambda: heard.received == 1)
    node.trigger_activate()
    play(bench, node, drive)
    told = {}
    for name, fused in (('knows', PoseFilter(correlation=known)), ('ignores', PoseFilter())):
        for event in drive.events():
            if event[1]:
                fused.add_measurement(event[0], drive.seen[event[2]], SPREAD)
            else:
                drive.give(fused, event)
        told[name] = fused.state.position_std
    assert node._filter.state.position_std == pytest.approx(told['knows'], rel=1e-3)
    assert told['knows'] < 0.9 * told['ignores']


def test_after_an_error_inside_it_starts_anew_and_goes_on(bench, monkeypatch):
    """An error that every message would raise again does not leave the last state standing."""
    drive = Drive(seconds=8, **NOISY)
    node, events = bench.run(EkfNode), drive.events()
    states = bench.listen(String, 'ekf/state', latched_qos())
    play(bench, node, drive, events[: len(events) // 2])
    assert until(lambda: states and states[-1].data.startswith('LOCALISED'))
    works, resets = node._filter.add_odometry, []

    def add_odometry(*given):
        if not resets:
            raise OverflowError
        return works(*given)

    anew = node._filter.reset
    monkeypatch.setattr(node._filter, 'add_odometry', add_odometry)
    monkeypatch.setattr(node._filter, 'reset', lambda: (resets.append(1), anew()))
    begun = len(states)
    play(bench, node, drive, events[len(events) // 2 :])
    assert node.monitor('odom').refused == {'internal error: OverflowError': 1} and resets == [1]
    assert until(lambda: states[-1].data.startswith('LOCALISED'))
    assert any(not state.data.startswith('LOCALISED') for state in states[begun:])


def test_turns_of_images_reach_the_filter(bench, monkeypatch):
    """They show how late images are stamped."""
    taken = []
    monkeypatch.setattr(PoseFilter, 'add_turned', lambda _, *turned: taken.append(turned))
    node = bench.run(EkfNode)
    bench.publish('sfa/turned', to_turned(0.5, START_NS, 'first_image'))
    assert until(lambda: node.monitor('sfa/turned').used == 1), node.monitor('sfa/turned').refused
    assert taken == [(START_NS, pytest.approx(0.5))]


@pytest.mark.parametrize(
    'numbers', [[], [0.5], [1.5, 1.0], [0.5, -1.0], [math.nan, 1.0], [0.3, 1e-308]]
)
def test_a_malformed_error_correlation_is_rejected(bench, numbers):
    node = bench.run(EkfNode)
    message = Float64MultiArray(data=numbers)
    bench.publish('sfa/error_correlation', message, latched_qos())
    assert until(lambda: node.monitor('sfa/error_correlation').received == 1)
    assert node._filter.correlation == ErrorCorrelation()


def test_frames_are_parameters(bench):
    """The map's always; those of odometry and robot where the messages leave them empty."""
    frames = {'map_frame': 'garden', 'odom_frame': 'wheels', 'base_frame': 'robot'}
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN, publish_tf=False, **frames)
    assert bench.node.count_publishers('/tf') == 0, 'others may broadcast the transform'
    fused = bench.listen(Odometry, 'ekf/odometry')
    transforms = bench.listen(TransformStamped, 'ekf/map_to_odom')
    drive = Drive(seconds=1)
    message = odometry(drive, 0)
    message.header.frame_id = message.child_frame_id = ''
    bench.publish('odom', message)
    assert until(lambda: fused and transforms)
    assert (fused[0].header.frame_id, fused[0].child_frame_id) == ('garden', 'robot')
    header, child = transforms[0].header, transforms[0].child_frame_id
    assert (header.frame_id, child) == ('garden', 'wheels')
    bench.publish(IMAGE_POSE, picture(drive, 0, frame='garden'))
    assert until(lambda: node.monitor(IMAGE_POSE).used == 1)


def test_after_a_restart_it_looks_where_it_was_first(bench, tmp_path):
    pose_file = tmp_path / 'pose.json'
    drive = Drive(seconds=8, **NOISY)
    patient = {'pose_file': str(pose_file), 'silence_timeout': 60.0}
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN, **patient)
    play(bench, node, drive)
    last = node._filter.state
    assert until(lambda: node._sure is not None and node._sure.stamp_ns == last.stamp_ns)
    assert not pose_file.exists(), 'the period has not passed'
    bench.end(node)
    assert pose_file.exists()
    again = bench.run(EkfNode, **patient)
    heard = bench.listen(PoseWithCovarianceStamped, 'ekf/pose')
    assert np.allclose(again._filter.state.pose, last.pose)
    assert 0.5 < again._filter.state.position_std < 1.0
    assert again._status().level is Level.DEGRADED, 'no image has confirmed it yet'
    # Switched on elsewhere: the second image that says so is believed.
    elsewhere = Drive(seconds=4, start=(30.0, 0.0, 1.0), **NOISY)
    play(bench, again, elsewhere)
    assert until(lambda: len(heard) == len(elsewhere.pictures))
    assert np.hypot(*(pose_of(heard[-1]) - elsewhere.poses[elsewhere.pictures[-1]])[:2]) < 0.5


@pytest.mark.parametrize('given', [{'initial_pose': AT_ORIGIN}, {}])
def test_a_given_start_and_a_damaged_file_come_before_a_saved_pose(bench, tmp_path, given):
    pose_file = tmp_path / 'pose.json'
    pose_file.write_text('{}')
    node = bench.run(EkfNode, pose_file=str(pose_file), **given)
    assert node._filter.state is None
    assert node._status().level is Level.UNINITIALISED


def test_the_state_is_on_diagnostics_for_programs(bench):
    """With the level, and the keys that config/problems.md names."""
    drive = Drive(seconds=3, **NOISY)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN, silence_timeout=60.0)
    play(bench, node, drive)
    level, text, values = node.health()
    assert (level, text, values['state']) == (DiagnosticStatus.OK, 'LOCALISED', 'LOCALISED')
    page = (FilePath(__file__).parents[1] / 'config/problems.md').read_text('utf-8')
    for key in values:
        kind, _, reason = key.partition(': ')
        assert f'`{kind}: REASON`' in page if reason else f'`{key}`' in page, key
    for expected, settings in (
        ((DiagnosticStatus.WARN, 'DEGRADED'), FilterConfig(degraded_std=1e-3)),
        ((DiagnosticStatus.ERROR, 'LOST'), FilterConfig(degraded_std=1e-3, lost_std=1e-3)),
    ):
        node._filter.reconfigure(settings)
        level, text, values = node.health()
        assert (level, values['state']) == expected
        assert 'position known to' in text
