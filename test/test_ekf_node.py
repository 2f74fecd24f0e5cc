# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ekf_node on real messages: what it publishes, what it survives, how it tells its state."""

import copy
import json
import math
from operator import attrgetter
from unittest import mock

import numpy as np
import pytest
from filter_drives import START_NS, FilterDrive, from_rest, seconds_of, winding
from page_tables import ROOT
from places import distances

pytest.importorskip('rclpy')

from builtin_interfaces.msg import Time as Stamp
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion, TransformStamped
from nav_msgs.msg import Odometry, Path
from nav_msgs.srv import SetMap
from rclpy.parameter import Parameter
from ros_bench import SEEN, AsText, message_of, play, until
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Empty, SetBool, Trigger

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import compose
from sfa_localization.data.messages import read_planar, read_stamp
from sfa_localization.data.rig import Rig
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.nodes import conversions as convert
from sfa_localization.nodes import ekf_node, lifecycle
from sfa_localization.nodes.ekf_node import EkfNode
from sfa_localization.nodes.lifecycle import latched_qos

pytestmark = pytest.mark.ros
AT_ORIGIN = [0.0, 0.0, 0.0]
NOISY = {'position_std': 0.1, 'yaw_std': 0.02, 'v_std': 0.02, 'omega_std': 0.01, 'claimed_m': 0.2}


def part(drive, begin=0.0, end=math.inf, kinds=(0, 1)):
    """The events of some seconds of a drive."""
    return [e for e in drive.events() if e[1] in kinds and begin <= seconds_of(e) < end]


def pose_of(message):
    return np.array(read_planar(message.pose.pose.position, message.pose.pose.orientation))


def near(pose, expected, atol):
    error = np.subtract(pose, expected)
    return np.hypot(*error[:2]) < atol and abs(math.remainder(error[2], 2 * math.pi)) < atol


def stamps_of(messages):
    return [read_stamp(message.header.stamp) for message in messages]


def refused(node, topic):
    return sum(node.monitors[topic].refused.values())


def test_outputs_agree_and_have_the_stamps_of_inputs(bench, monkeypatch):
    """A lookup in tf at odometry is the pose of ekf/odometry, and there is a transform ahead.

    Images correct the pose; at odometry's 50 Hz, 0.1 s is a whole number of its periods.
    """
    monkeypatch.setattr(ekf_node, 'TFMessage', AsText)
    drive = FilterDrive(seconds=2, **NOISY)
    node = bench.run(EkfNode, initial_pose=[0.3, -0.3, 0.1], transform_tolerance=0.1)
    fused, sent = bench.listen(Odometry, 'ekf/odometry'), bench.listen(String, '/tf')
    poses = bench.listen(PoseWithCovarianceStamped, 'ekf/pose')
    transforms = bench.listen(TransformStamped, 'ekf/map_to_odom')
    play(bench, node, drive)
    assert until(lambda: len(fused) == len(sent) == len(transforms) == len(drive.stamps_ns))
    assert until(lambda: len(poses) == len(drive.pictures))
    assert stamps_of(fused) == stamps_of(transforms) == drive.stamps_ns.tolist()
    assert stamps_of(poses) == drive.stamps_ns[drive.pictures].tolist()
    held = {}
    for stamp_ns, pose in (pair for message in sent for pair in json.loads(message.data)):
        held.setdefault(stamp_ns, pose)  # tf2 rejects a stamp that it has already
    found = np.array([held[stamp_ns] for stamp_ns in drive.stamps_ns.tolist()])
    assert np.ptp(found, axis=0)[:2].max() > 0.1, 'nothing was corrected'
    for lookup, reckoned, message, stamped in zip(
        found, drive.reckoned, fused, transforms, strict=True
    ):
        assert near(compose(lookup, reckoned), pose_of(message), 1e-6)
        transform = stamped.transform
        assert near(read_planar(transform.translation, transform.rotation), lookup, 1e-9)
    assert max(held) - drive.stamps_ns[-1] == 100_000_500
    last = node.filter.at(read_stamp(poses[-1].header.stamp))
    _, pose, covariance = convert.read_pose(poses[-1])
    assert near(pose, last.pose, 1e-9) and np.allclose(covariance, last.pose_covariance, rtol=0.2)
    assert (fused[-1].header.frame_id, fused[-1].child_frame_id) == ('map', 'base_link')
    assert (transforms[-1].header.frame_id, transforms[-1].child_frame_id) == ('map', 'odom')
    assert node.set_parameters([Parameter('transform_tolerance', value=0.0)])[0].successful
    later = FilterDrive(seconds=2.02)
    play(bench, node, later, part(later, 2.0, kinds=[0]))
    assert until(lambda: len(sent) == len(drive.stamps_ns) + 1)
    assert len(json.loads(sent[-1].data)) == 1, 'none ahead'


def test_every_measurement_gets_its_verdict(bench):
    drive = FilterDrive(seconds=1.5, **NOISY)
    drive.seen[10, :2] += 9.0
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    heard = bench.listen(DiagnosticArray, 'ekf/measurement_status')
    play(bench, node, drive)
    assert until(lambda: len(heard) == len(drive.pictures))
    assert stamps_of(heard) == drive.stamps_ns[drive.pictures].tolist()
    values = [{v.key: v.value for v in m.status[0].values} for m in heard]
    assert values[3]['accepted'] == 'true' and values[10]['accepted'] == 'false'
    assert float(values[10]['d2']) > float(values[10]['threshold'])
    assert heard[10].status[0].message == 'outside the gate'
    assert heard[10].status[0].hardware_id == 'sfa_localization'
    monitor = node.monitors[SEEN]
    assert until(lambda: monitor.used == len(drive.pictures) - 1)
    assert monitor.refused == {'outside the gate': 1}


def test_the_state_is_on_diagnostics_for_programs(bench):
    """With the level, and the keys that config/diagnostics.md names."""
    drive = FilterDrive(twists=from_rest(winding(4)), **NOISY)
    node = bench.run(EkfNode, silence_timeout=60.0)
    states = bench.listen(String, 'ekf/state', latched_qos())
    heard = bench.listen(DiagnosticArray, '/diagnostics')
    assert until(lambda: states and states[-1].data.startswith('UNINITIALISED: no odometry'))
    assert until(lambda: any(m.status[0].level == DiagnosticStatus.WARN for m in heard))
    play(bench, node, drive)
    assert until(lambda: states[-1].data.startswith('LOCALISED'))
    level, text, values = node.health()
    assert (level, text, values['state']) == (DiagnosticStatus.OK, 'LOCALISED', 'LOCALISED')
    page = (ROOT / 'config/diagnostics.md').read_text('utf-8')
    for key in values:
        kind, _, reason = key.partition(': ')
        assert f'`{kind}: REASON`' in page if reason else f'`{key}`' in page, key

    def told():
        return {v.key: v.value for v in heard[-1].status[0].values}

    assert until(lambda: told().get('/odom: received') == str(len(drive.stamps_ns)))
    values = told()
    assert float(values['/odom: rate [Hz]']) > 0 and 'position std [m]' in values
    assert float(values['/odom: latency p99 [ms]']) >= float(values['/odom: latency p50 [ms]']) > 0


@pytest.mark.parametrize('topic', ['panorama/troubles', 'sfa/troubles'])
def test_what_other_nodes_find_of_the_cameras_is_a_reason_until_it_is_mended(bench, topic):
    drive = FilterDrive(twists=from_rest(winding(4)), **NOISY)
    node = bench.run(EkfNode, silence_timeout=60.0)
    states = bench.listen(String, 'ekf/state', latched_qos())
    play(bench, node, drive)
    assert until(lambda: states[-1].data.startswith('LOCALISED'))
    bench.publish(topic, String(data='camera left: silent'), latched_qos())
    assert until(lambda: states[-1].data == 'DEGRADED: camera left: silent')
    bench.publish(topic, String(), latched_qos())
    assert until(lambda: states[-1].data.startswith('LOCALISED'))


def test_initialpose_and_set_pose_set_the_pose(bench):
    drive = FilterDrive(seconds=1)
    node = bench.run(EkfNode, silence_timeout=0.1, lost_std=0.5, degraded_std=0.4)
    spread = np.diag([0.04, 0.04, 0.0025])
    for topic, x in (('initialpose', 7.0), ('ekf_node/set_pose', -3.0)):
        message = convert.to_pose_with_covariance([x, 1.0, math.pi], spread, 1, 'map')
        message.header.stamp = Stamp()
        bench.publish(topic, message)
        assert until(lambda x=x: node.filter.state and node.filter.state.pose[0] == x)
    assert not until(lambda: node.status().level.name != 'DEGRADED', 0.5), 'it waits for messages'
    bench.publish('initialpose', convert.to_pose_with_covariance([1, 1, 0], spread, 5, 'odom'))
    assert until(lambda: "frame is 'odom', not 'map'" in node.monitors['initialpose'].refused)
    play(bench, node, drive, part(drive, kinds=[0]))
    assert abs(node.filter.state.pose[0] - (-3.0 - drive.poses[-1, 0])) < 0.1


def test_the_services_of_nav2_amcl_set_and_forget_the_pose(bench, monkeypatch):
    """SetMap, whose request also holds a pose, stands in for nav2_msgs, which no wheel has."""
    given = property(attrgetter('initial_pose'))
    monkeypatch.setattr(SetMap.Request, 'pose', given, raising=False)
    monkeypatch.setattr(ekf_node, 'SetInitialPose', SetMap)
    drive, node = FilterDrive(seconds=2, **NOISY), bench.run(EkfNode, initial_pose=AT_ORIGIN)
    everywhere = Empty, 'reinitialize_global_localization', Empty.Request()
    name, now_ns = 'set_initial_pose', START_NS + 580_000_000

    def set_pose(frame, spread):
        message = convert.to_pose_with_covariance([7.0, 1.0, 0.0], spread, now_ns, frame)
        return bench.call(SetMap, name, SetMap.Request(initial_pose=message))

    play(bench, node, drive, part(drive, end=0.6))
    for frame, spread, why in (('odom', 1.0, "frame is 'odom'"), ('map', -1.0, 'negative var')):
        set_pose(frame, spread * np.eye(3))
        assert why in ' '.join(node.monitors[name].refused)
    assert abs(node.filter.state.pose[0]) < 1.0
    set_pose('map', 0.01 * np.eye(3))
    assert node.filter.state.pose[0] > 6.5 and node.monitors[name].used == 1
    bench.call(*everywhere)
    assert node.filter.state is None and node.status().level.name == 'UNINITIALISED'
    play(bench, node, drive, part(drive, 0.6))
    assert near(node.filter.state.pose, drive.poses[-1], 0.4)
    bench.do(node.trigger_deactivate)
    bench.call(*everywhere)
    assert node.filter.state is not None
    assert node.monitors[everywhere[1]].refused == {'this node is not active': 1}


def test_reset_and_pause(bench):
    drive = FilterDrive(seconds=5, **NOISY)
    node = bench.run(EkfNode)
    play(bench, node, drive, part(drive, end=0.6))
    assert bench.call(SetBool, 'ekf_node/pause', SetBool.Request(data=True)).success
    accepted = node.filter.counts['measurement: accepted']
    assert accepted > 0
    odometries = bench.listen(Odometry, 'ekf/odometry')
    poses = bench.listen(PoseWithCovarianceStamped, 'ekf/pose')
    events = play(bench, node, drive, part(drive, 0.6, 1.0))
    images = sum(kind for _, kind, _ in events)
    assert until(lambda: len(poses) == images and len(odometries) == len(events) - images)
    assert until(lambda: node.monitors[SEEN].refused['paused'] == images)
    assert node.filter.counts['measurement: accepted'] == accepted
    assert 'paused' in ' '.join(node.status().reasons)
    bench.call(SetBool, 'ekf_node/pause', SetBool.Request(data=False))
    answer = bench.call(Trigger, 'ekf_node/reset', Trigger.Request())
    assert answer.success and answer.message == 'UNINITIALISED'
    play(bench, node, drive, part(drive, 1.0))
    assert until(lambda: node.status().level.name == 'LOCALISED')


def test_two_publishers_of_odometry_and_one_without_poses_are_named(bench):
    drive = FilterDrive(seconds=1.2, **NOISY)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    odometries, logged = bench.listen(Odometry, 'ekf/odometry'), mock.Mock()
    with mock.patch.object(node, 'get_logger', return_value=logged):
        second = bench.node.create_publisher(Odometry, 'odom', 1000)
        assert until(lambda: node.count_publishers('/odom') == 1)
        for number, event in enumerate(part(drive, end=1.0, kinds=[0])):
            topic, message = message_of(drive, *event[1:])
            message.pose.pose.position.x += 3.0 * (number % 2)
            bench.publish_until(topic, message, lambda n=number: len(odometries) > n)
        assert until(lambda: node.count_publishers('/odom') == 2)
        text = 'two publishers on /odom: stop one, or take another topic by odom:='
        assert text in node.health()[1] and node.status().level.name == 'DEGRADED'
        assert text in str(logged.warning.mock_calls)
        bench.do(bench.node.destroy_publisher, second)
        assert until(lambda: text not in node.health()[1])
        transforms = bench.listen(TransformStamped, 'ekf/map_to_odom')
        for event in part(drive, 1.0, kinds=[0]):
            number += 1
            topic, message = message_of(drive, *event[1:])
            message.pose.pose.orientation = Quaternion(w=0.0)
            bench.publish_until(topic, message, lambda n=number: len(odometries) > n)
        assert 'its pose is not filled' in str(logged.warning.mock_calls)
    assert near(pose_of(odometries[-1]), drive.poses[-1], 0.2) and transforms == []


TWIST, TURNED, PLACED = 'twist.twist', 'pose.pose.orientation', 'pose.pose.position'
MALFORMED = [
    ('odom', f'{TWIST}.linear.x', math.nan), ('odom', f'{TWIST}.angular.z', 1e200),
    ('odom', TURNED, Quaternion(w=0.0)), ('odom', 'header.stamp', Stamp()),
    ('odom', 'header.stamp.nanosec', 2_000_000_000),
    (SEEN, f'{PLACED}.x', math.inf), (SEEN, 'pose.covariance', -np.ones(36)),
    (SEEN, 'header.frame_id', 'elsewhere'), (SEEN, 'header.stamp.sec', 2_000_000_000),
]  # fmt: skip


def test_malformed_messages_are_counted_and_change_nothing(bench):
    drive = FilterDrive(seconds=1, **NOISY)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    odometries = bench.listen(Odometry, 'ekf/odometry')
    play(bench, node, drive, part(drive, end=0.8))
    before, good = node.filter.state, dict(message_of(drive, *e) for e in [(0, 39), (1, 6)])
    for topic, path, value in MALFORMED:
        count, broken = refused(node, topic), copy.deepcopy(good[topic])
        parent, _, name = path.rpartition('.')
        setattr(attrgetter(parent)(broken), name, value)
        bench.publish(topic, broken)
        assert until(lambda t=topic, n=count: refused(node, t) > n), (topic, path, value)
        after = node.filter.state
        assert np.array_equal(before.mean, after.mean), (path, value)
        assert np.array_equal(before.covariance, after.covariance), (path, value)
    assert not [why for m in node.monitors.values() for why in m.refused if 'internal' in why]
    play(bench, node, drive, part(drive, 0.8))
    assert until(lambda: len(odometries) == len(drive.stamps_ns))


def test_silence_is_reported_without_any_clock_moving(bench):
    """Messages have stopped for good: only the wall clock shows how unsure the pose is by now."""
    drive = FilterDrive(seconds=3, **NOISY)
    node = bench.run(EkfNode, silence_timeout=0.2, lost_std=0.5, degraded_std=0.4)
    states = bench.listen(String, 'ekf/state', latched_qos())
    play(bench, node, drive, part(drive, end=2.0))
    for told in ('nothing on /odom', f'nothing on /{SEEN}', 'LOST: position known to'):
        assert until(lambda t=told: any(t in state.data for state in states)), told
    assert node.filter.status.level.name != 'LOST', 'by the stamps of the messages it is not'
    level, _, values = node.health()
    assert level == DiagnosticStatus.ERROR and float(values['position std [m]']) > 0.5
    play(bench, node, drive, part(drive, 2.0))
    assert node.status().level.name != 'LOST'
    gone = f'nobody publishes on /{SEEN}'
    bench.forget(SEEN)  # as when sfa_node has died
    assert until(lambda: gone in states[-1].data and gone in node.health()[1])
    assert 'nobody publishes on /odom' not in states[-1].data


def test_simulated_time_that_does_not_come_is_named_and_that_steps_back_starts_anew(
    bench, monkeypatch
):
    monkeypatch.setattr(lifecycle, 'PATIENCE_S', 0.0)
    node = bench.run(EkfNode, use_sim_time=True, initial_pose=AT_ORIGIN)
    told = bench.listen(DiagnosticArray, '/diagnostics')
    assert until(lambda: told and 'there is no time on /clock' in told[-1].status[0].message)
    assert told[-1].status[0].level == DiagnosticStatus.WARN
    for stamp_ns in (START_NS, START_NS - 10**10):
        bench.publish('/clock', Clock(clock=convert.to_stamp(stamp_ns)))
        assert until(lambda s=stamp_ns: node.get_clock().now().nanoseconds == s)
        if stamp_ns == START_NS:
            play(bench, node, FilterDrive(seconds=0.3))
            assert until(lambda: '/clock' not in told[-1].status[0].message)
    assert until(lambda: node.filter.counts['reset'] == 1)


def test_the_path_is_thinned_and_bounded(bench, monkeypatch, capfd):
    """And without tf2_msgs the node runs, and says so."""
    monkeypatch.setattr(ekf_node, 'TFMessage', None)
    monkeypatch.setattr(ekf_node, 'PATH_LENGTH', 3)
    node, drive = bench.run(EkfNode, initial_pose=AT_ORIGIN), FilterDrive(seconds=3, rate_hz=10)
    heard = bench.listen(Path, 'ekf/path')
    play(bench, node, drive, part(drive, kinds=[0]))
    assert until(lambda: len(heard) == 6 and len(heard[-1].poses) == 3)
    assert np.all(np.diff(stamps_of(heard[-1].poses)) == 500_000_000)
    assert 'tf2_msgs is not installed' in capfd.readouterr().err


def test_what_the_model_knows_and_what_is_set_live_reaches_the_filter(bench, monkeypatch):
    """Errors are published once, perhaps before the node is active; malformed ones are rejected.
    Turns of images show how late they are stamped.
    """
    node, taken = bench.run(EkfNode, start=False), []
    monkeypatch.setattr(PoseFilter, 'add_turned', lambda _, *turned: taken.append(turned))
    node.trigger_configure()
    topic, correlation = 'sfa/rig', ErrorCorrelation(0.1, 3.0)
    bench.publish(topic, convert.to_rig(Rig(), correlation), latched_qos())
    assert until(lambda: node.monitors[topic].used == 1)
    correct = json.loads(convert.to_rig(Rig(), correlation).data)
    wrong = [{'error_correlation': numbers} for numbers in ([0.5], [1.5, 1.0], [0.5, -1.0])]
    wrong += [{'wheel_scale': [math.nan, 1.0]}, {'unknown': [0.0, 0.0]}, {'camera_left': None}]
    for count, text in enumerate(['[]', *(json.dumps({**correct, **each}) for each in wrong)], 1):
        bench.publish(topic, String(data=text), latched_qos())
        assert until(lambda n=count: refused(node, topic) == n), text
    assert node.filter.correlation == correlation
    node.trigger_activate()
    play(bench, node, FilterDrive(seconds=0.3, **NOISY))
    before = node.filter.state.pose
    assert node.set_parameters([Parameter('measurement_factor', value=4.0)])[0].successful
    assert node.filter.config.measurement_factor == 4.0
    assert np.array_equal(before, node.filter.state.pose)
    bench.publish('sfa/turned', convert.to_turned(0.5, START_NS, 'first_image'))
    assert until(lambda: taken == [(START_NS, pytest.approx(0.5))])


def test_after_an_error_inside_it_starts_anew_and_goes_on(bench, monkeypatch):
    """An error that every message would raise again does not leave the last state standing."""
    drive = FilterDrive(seconds=7, **NOISY)
    node = bench.run(EkfNode)
    states = bench.listen(String, 'ekf/state', latched_qos())
    play(bench, node, drive, part(drive, end=4.0))
    assert until(lambda: states and states[-1].data.startswith('LOCALISED'))
    count = len(states)
    with monkeypatch.context() as patch:
        patch.setattr(node.filter, 'add_odometry', mock.Mock(side_effect=OverflowError))
        play(bench, node, drive, part(drive, 4.0, 4.05))
    play(bench, node, drive, part(drive, 4.05))
    assert set(node.monitors['odom'].refused) == {'internal error: OverflowError'}
    assert node.filter.counts['reset'] > 0
    assert until(lambda: states[-1].data.startswith('LOCALISED'))
    assert any(not state.data.startswith('LOCALISED') for state in states[count:])


def test_frames_and_quality_of_service_are_parameters(bench):
    """The map's frame always; the others where the odometry's messages leave them empty."""
    frames = {'map_frame': 'garden', 'odom_frame': 'wheels', 'base_frame': 'robot'}
    reliable = {'qos_overrides./odom.subscription.reliability': 'reliable'}
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN, publish_tf=False, **frames, **reliable)
    assert bench.node.count_publishers('/tf') == 0, 'others may broadcast the transform'
    fused = bench.listen(Odometry, 'ekf/odometry')
    transforms = bench.listen(TransformStamped, 'ekf/map_to_odom')
    assert until(lambda: bench.node.get_subscriptions_info_by_topic('/odom'))
    profile = bench.node.get_subscriptions_info_by_topic('/odom')[0].qos_profile
    assert profile.reliability.name == 'RELIABLE'
    drive = FilterDrive(seconds=1)
    topic, message = message_of(drive, 0, 0)
    message.header.frame_id = message.child_frame_id = ''
    bench.publish(topic, message)
    assert until(lambda: fused and transforms)
    assert (fused[0].header.frame_id, fused[0].child_frame_id) == ('garden', 'robot')
    header = transforms[0].header
    assert (header.frame_id, transforms[0].child_frame_id) == ('garden', 'wheels')
    _, without_heading = message_of(drive, 1, 0)
    without_heading.header.frame_id, without_heading.pose.covariance[35] = 'garden', 0.0
    bench.publish(SEEN, without_heading)
    assert until(lambda: node.filter.counts['measurement: accepted'] == 1), 'as a position'


def test_after_a_restart_it_looks_where_it_was_first(bench, tmp_path):
    pose_file = tmp_path / 'pose.json'
    drive = FilterDrive(seconds=3, **NOISY)
    patient = {'pose_file': str(pose_file), 'silence_timeout': 60.0}
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN, **patient)
    play(bench, node, drive)
    assert until(lambda: node.status().level.name == 'LOCALISED')
    last = node.filter.state
    assert not until(pose_file.exists, 0.5), 'the period has not passed'
    bench.end(node)
    again = bench.run(EkfNode, **patient)
    heard = bench.listen(PoseWithCovarianceStamped, 'ekf/pose')
    assert np.allclose(again.filter.state.pose, last.pose)
    assert 0.5 < again.filter.state.position_std < 1.0
    assert again.status().level.name == 'DEGRADED', 'no image has confirmed it yet'
    elsewhere = FilterDrive(seconds=2, start=(30.0, 0.0, 1.0), **NOISY)
    play(bench, again, elsewhere)
    assert until(lambda: len(heard) == len(elsewhere.pictures))
    assert distances(pose_of(heard[-1]), elsewhere.poses[elsewhere.pictures[-1]]) < 0.5
    (tmp_path / 'file').touch()
    node = bench.run(EkfNode, pose_file=str(tmp_path / 'file' / 'pose.json'))
    assert 'cannot be written' in ' '.join(node.monitors['pose_file'].refused), 'at start'
    bench.end(node)
    pose_file.write_text('{}')
    for given in ({'initial_pose': AT_ORIGIN}, {}):
        node = bench.run(EkfNode, pose_file=str(pose_file), **given)
        assert node.filter.state is None and node.status().level.name == 'UNINITIALISED'
        bench.end(node)
