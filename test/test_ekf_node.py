# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ekf_node on real messages: what it publishes, what it survives, how it tells its state."""

import copy
import json
import math
from pathlib import Path as FilePath

import numpy as np
import pytest
from filter_drives import START_NS, FilterDrive, from_rest, winding

pytest.importorskip('rclpy')

from builtin_interfaces.msg import Time as Stamp
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry, Path
from rclpy.parameter import Parameter
from ros_bench import until
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from transform_buffer import AsText, TransformBuffer

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import compose
from sfa_localization.data.messages import read_planar, read_stamp, read_yaw
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.nodes import conversions as convert
from sfa_localization.nodes import ekf_node, lifecycle
from sfa_localization.nodes.ekf_node import EkfNode
from sfa_localization.nodes.lifecycle import latched_qos

pytestmark = pytest.mark.ros
IMAGE_POSE = 'sfa/pose_with_covariance'
AT_ORIGIN = [0.0, 0.0, 0.0]
SPREAD = np.diag([0.04, 0.04, 0.0025])
NOISY = {'position_std': 0.1, 'yaw_std': 0.03, 'v_std': 0.02, 'omega_std': 0.01}


def odometry(drive, i):
    spread, stamp_ns = np.diag(drive.variances()), int(drive.stamps_ns[i])
    frames = ('odom', 'base_link')
    return convert.to_odometry(
        drive.reckoned[i], np.eye(3), drive.read[i], spread, stamp_ns, frames
    )


def picture(drive, k, spread=SPREAD, frame='map'):
    stamp_ns = int(drive.stamps_ns[drive.pictures[k]])
    return convert.to_pose_with_covariance(drive.seen[k], spread, stamp_ns, frame)


def play(bench, node, drive, begin=0.0, end=math.inf, kinds=(0, 1)):
    """Send these seconds of a drive, and wait until the node has dealt with them; the events."""
    counts = node.monitors['odom'], node.monitors[IMAGE_POSE]
    events = [e for e in drive.events() if e[1] in kinds and begin <= (e[0] - START_NS) / 1e9 < end]
    for _, kind, index in events:
        before = counts[kind].received
        topic, make = (IMAGE_POSE, picture) if kind else ('odom', odometry)
        bench.publish(topic, make(drive, index))
        # One at a time: the order between topics is then the drive's.
        assert until(lambda b=before, k=kind: counts[k].received > b)
    return events


def pose_of(message):
    return np.array(read_planar(message.pose.pose.position, message.pose.pose.orientation))


def near(one, other, atol):
    miss = np.subtract(one, other)
    return np.hypot(*miss[:2]) < atol and abs(math.remainder(miss[2], 2 * math.pi)) < atol


def refused(node, topic):
    return sum(node.monitors[topic].refused.values())


def test_live_is_offline_and_stamps_are_the_inputs(bench):
    drive = FilterDrive(seconds=3, **NOISY)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    heard = bench.listen(Odometry, 'ekf/odometry')
    poses = bench.listen(PoseWithCovarianceStamped, 'ekf/pose')
    transforms = bench.listen(TransformStamped, 'ekf/map_to_odom')
    offline = PoseFilter(FilterConfig(initial_pose=(0.0, 0.0, 0.0)))
    rig = Rig(wheel_scale=Quantity(1.02, 0.01))
    bench.publish('sfa/rig', convert.to_rig(rig, ErrorCorrelation()), latched_qos())
    assert until(lambda: node.monitors['sfa/rig'].used == 1)
    offline.expect(rig)
    play(bench, node, drive)
    assert until(lambda: len(transforms) == len(heard) == len(drive.stamps_ns))
    assert until(lambda: len(poses) == len(drive.pictures))
    for event in drive.events():
        stamp_ns, kind, index = event
        if kind == 0:
            offline.add_odometry(stamp_ns, *drive.read[index], drive.variances())
            told, t = heard[index], transforms[index].transform
            assert read_stamp(told.header.stamp) == stamp_ns
            assert near(pose_of(told), offline.at(stamp_ns).pose, 1e-9)
            map_to_odom = [t.translation.x, t.translation.y, read_yaw(t.rotation)]
            assert near(compose(map_to_odom, drive.reckoned[index]), pose_of(told), 1e-9)
            assert read_stamp(transforms[index].header.stamp) == stamp_ns
        else:
            offline.add_measurement(stamp_ns, drive.seen[index], SPREAD)
            assert near(pose_of(poses[index]), offline.at(stamp_ns).pose, 1e-9)
            told = np.array(poses[index].pose.covariance).reshape(6, 6)
            spread = offline.at(stamp_ns).pose_covariance
            assert np.allclose(told[np.ix_([0, 1, 5], [0, 1, 5])], spread, atol=1e-12)
    assert (heard[-1].header.frame_id, heard[-1].child_frame_id) == ('map', 'base_link')
    assert (transforms[-1].header.frame_id, transforms[-1].child_frame_id) == ('map', 'odom')


@pytest.mark.parametrize('tolerance_s', [0.1, 0.0])
def test_a_lookup_in_tf_is_the_pose_of_ekf_odometry_and_there_is_one_ahead(
    bench, monkeypatch, tolerance_s
):
    """Images correct the pose; at odometry's 50 Hz, 0.1 s is a whole number of its periods."""
    monkeypatch.setattr(ekf_node, 'TFMessage', AsText)
    drive, buffer = FilterDrive(seconds=3, **NOISY), TransformBuffer()
    node = bench.run(EkfNode, initial_pose=[0.3, -0.3, 0.1], transform_tolerance=tolerance_s)
    told, sent = bench.listen(Odometry, 'ekf/odometry'), bench.listen(String, '/tf')
    play(bench, node, drive)
    assert until(lambda: len(told) == len(sent) == len(drive.stamps_ns))
    for message in sent:
        buffer.add(message)
    found = [buffer.lookup(stamp_ns) for stamp_ns in drive.stamps_ns.tolist()]
    for i, message in enumerate(told):
        assert near(compose(found[i], drive.reckoned[i]), pose_of(message), 1e-6)
    assert np.ptp(found, axis=0)[:2].max() > 0.1, 'nothing was corrected'
    ahead_ns = int(drive.stamps_ns[-1]) + round(tolerance_s * 1e9)
    assert np.allclose(buffer.lookup(ahead_ns), found[-1], atol=0.1)
    assert buffer.newest_ns - ahead_ns in (0, 500)


def test_every_measurement_gets_its_verdict(bench):
    drive = FilterDrive(seconds=2, **NOISY)
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
    monitor = node.monitors[IMAGE_POSE]
    assert until(lambda: monitor.used + refused(node, IMAGE_POSE) == len(drive.pictures))
    assert monitor.refused == {'outside the gate': 1}


def test_the_state_is_on_diagnostics_for_programs(bench):
    """With the level, and the keys that config/problems.md names."""
    drive = FilterDrive(twists=from_rest(winding(4)), **NOISY)
    node = bench.run(EkfNode, silence_timeout=60.0)
    early = bench.listen(String, 'ekf/state', latched_qos())
    heard = bench.listen(DiagnosticArray, '/diagnostics')
    assert until(lambda: early and early[-1].data.startswith('UNINITIALISED: no odometry'))
    assert until(lambda: any(m.status[0].level == DiagnosticStatus.WARN for m in heard))
    play(bench, node, drive)
    assert until(lambda: early[-1].data.startswith('LOCALISED'))
    late = []
    bench.node.create_subscription(String, 'ekf/state', late.append, latched_qos())
    assert until(lambda: late and late[0].data.startswith('LOCALISED'))
    level, text, values = node.health()
    assert (level, text, values['state']) == (DiagnosticStatus.OK, 'LOCALISED', 'LOCALISED')
    page = (FilePath(__file__).parents[1] / 'config/problems.md').read_text('utf-8')
    for key in values:
        kind, _, reason = key.partition(': ')
        assert f'`{kind}: REASON`' in page if reason else f'`{key}`' in page, key

    def told():
        return {v.key: v.value for v in heard[-1].status[0].values}

    assert until(lambda: told().get('odometry: used') == str(len(drive.stamps_ns)))
    values = told()
    assert values['/odom: received'] == values['odometry: used']
    assert float(values['/odom: rate [Hz]']) > 0 and 'position std [m]' in values
    assert float(values['/odom: latency p99 [ms]']) >= float(values['/odom: latency p50 [ms]']) > 0
    for expected, settings in (
        ((DiagnosticStatus.WARN, 'DEGRADED'), FilterConfig(degraded_std=1e-3)),
        ((DiagnosticStatus.ERROR, 'LOST'), FilterConfig(degraded_std=1e-3, lost_std=1e-3)),
    ):
        node.filter.reconfigure(settings)
        level, text, values = node.health()
        assert (level, values['state']) == expected and 'position known to' in text


def test_initialpose_and_set_pose_set_the_pose(bench):
    drive = FilterDrive(seconds=1)
    node = bench.run(EkfNode, silence_timeout=0.1, lost_std=0.5, degraded_std=0.4)
    for topic, x in (('initialpose', 7.0), ('ekf_node/set_pose', -3.0)):
        message = convert.to_pose_with_covariance([x, 1.0, math.pi], SPREAD, 1, 'map')
        message.header.stamp = Stamp()
        bench.publish(topic, message)
        assert until(lambda x=x: node.filter.state and node.filter.state.pose[0] == x)
    # It waits for the first message, however long.
    assert not until(lambda: node.status().level.name != 'DEGRADED', 1.0)
    bench.publish('initialpose', convert.to_pose_with_covariance([1, 1, 0], SPREAD, 5, 'odom'))
    assert until(lambda: "frame is 'odom', not 'map'" in node.monitors['initialpose'].refused)
    play(bench, node, drive, kinds=[0])
    assert abs(node.filter.state.pose[0] - (-3.0 - drive.poses[-1, 0])) < 0.1


def test_reset_and_pause(bench):
    drive = FilterDrive(seconds=6, **NOISY)
    node = bench.run(EkfNode)
    play(bench, node, drive, end=1.0)
    assert bench.call(SetBool, 'ekf_node/pause', SetBool.Request(data=True)).success
    accepted = node.filter.counts['measurement: accepted']
    assert accepted > 0
    odometries = bench.listen(Odometry, 'ekf/odometry')
    poses = bench.listen(PoseWithCovarianceStamped, 'ekf/pose')
    events = play(bench, node, drive, 1.0, 2.0)
    images = sum(kind for _, kind, _ in events)
    # The estimate goes on by odometry, on every topic.
    assert until(lambda: len(poses) == images and len(odometries) == len(events) - images)
    assert until(lambda: node.monitors[IMAGE_POSE].refused['paused'] == images)
    assert node.filter.counts['measurement: accepted'] == accepted
    assert 'paused' in ' '.join(node.status().reasons)
    bench.call(SetBool, 'ekf_node/pause', SetBool.Request(data=False))
    answer = bench.call(Trigger, 'ekf_node/reset', Trigger.Request())
    assert answer.success and answer.message == 'UNINITIALISED'
    play(bench, node, drive, 2.0)
    assert until(lambda: node.status().level.name == 'LOCALISED')


TWIST, TURNED, PLACED = 'twist.twist', 'pose.pose.orientation', 'pose.pose.position'
MALFORMED = [
    ('odom', f'{TWIST}.linear.x', math.nan), ('odom', f'{TWIST}.angular.z', math.inf),
    ('odom', f'{TWIST}.linear.x', 1e200), ('odom', f'{TURNED}.w', math.nan),
    ('odom', TURNED, 0.0), ('odom', f'{TURNED}.z', 1e200), ('odom', 'header.stamp', 0),
    ('odom', 'header.stamp.nanosec', 2_000_000_000),
    (IMAGE_POSE, f'{PLACED}.x', math.nan), (IMAGE_POSE, f'{PLACED}.y', 1e300),
    (IMAGE_POSE, f'{TURNED}.w', math.inf), (IMAGE_POSE, TURNED, 0.0),
    (IMAGE_POSE, 'pose.covariance', math.nan), (IMAGE_POSE, 'pose.covariance', -1.0),
    (IMAGE_POSE, 'pose.covariance', 1e308), (IMAGE_POSE, 'header.frame_id', 'elsewhere'),
    (IMAGE_POSE, 'header.stamp', 0), (IMAGE_POSE, 'header.stamp.sec', 2_000_000_000),
]  # fmt: skip


def broken(message, path, value):
    """The message with a field, or each field of a field, of another value."""
    made = target = copy.deepcopy(message)
    *parents, name = path.split('.')
    for parent in parents:
        target = getattr(target, parent)
    held = getattr(target, name)
    if name == 'covariance':
        held[:] = value
    elif hasattr(held, 'get_fields_and_field_types'):
        for field in held.get_fields_and_field_types():
            setattr(held, field, value)
    else:
        setattr(target, name, value)
    return made


def test_malformed_messages_are_counted_and_change_nothing(bench):
    drive = FilterDrive(seconds=1, **NOISY)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    odometries = bench.listen(Odometry, 'ekf/odometry')
    play(bench, node, drive, end=0.8)
    before, good = node.filter.state, {'odom': odometry(drive, 39), IMAGE_POSE: picture(drive, 6)}
    for topic, path, value in MALFORMED:
        count = refused(node, topic)
        bench.publish(topic, broken(good[topic], path, value))
        assert until(lambda t=topic, n=count: refused(node, t) > n), (topic, path, value)
        after = node.filter.state
        assert np.array_equal(before.mean, after.mean), (path, value)
        assert np.array_equal(before.covariance, after.covariance), (path, value)
    assert not [why for m in node.monitors.values() for why in m.refused if 'internal' in why]
    play(bench, node, drive, 0.8)
    assert until(lambda: len(odometries) == len(drive.stamps_ns))
    assert all(np.all(np.isfinite(pose_of(message))) for message in odometries)


def test_silence_is_reported_without_any_clock_moving(bench):
    """Messages have stopped for good: only the wall clock shows how unsure the pose is by now."""
    drive = FilterDrive(seconds=4, **NOISY)
    node = bench.run(EkfNode, silence_timeout=0.2, lost_std=0.5, degraded_std=0.4)
    states = bench.listen(String, 'ekf/state', latched_qos())
    play(bench, node, drive, end=2.0)
    for told in ('nothing on /odom', f'nothing on /{IMAGE_POSE}', 'LOST: position known to'):
        assert until(lambda t=told: any(t in state.data for state in states)), told
    assert node.filter.status.level.name != 'LOST', 'by the stamps of the messages it is not'
    assert float(node.health()[2]['position std [m]']) > 0.5
    play(bench, node, drive, 2.0)
    assert node.status().level.name != 'LOST'
    gone = f'nobody publishes on /{IMAGE_POSE}'
    bench.forget(IMAGE_POSE)  # as when sfa_node has died
    assert until(lambda: gone in states[-1].data and gone in node.health()[1])
    assert 'nobody publishes on /odom' not in states[-1].data


def test_simulated_time_that_steps_back_starts_anew(bench):
    node = bench.run(EkfNode, use_sim_time=True, initial_pose=AT_ORIGIN)
    for stamp_ns in (START_NS, START_NS - 10**10):
        bench.publish('/clock', Clock(clock=convert.to_stamp(stamp_ns)))
        assert until(lambda s=stamp_ns: node.get_clock().now().nanoseconds == s)
        if stamp_ns == START_NS:
            play(bench, node, FilterDrive(seconds=0.5))
    assert until(lambda: node.filter.counts['reset'] == 1)


def test_simulated_time_that_does_not_come_is_named(bench, monkeypatch):
    monkeypatch.setattr(lifecycle, 'PATIENCE_S', 0.0)
    node = bench.run(EkfNode, use_sim_time=True)
    told = bench.listen(DiagnosticArray, '/diagnostics')
    assert until(lambda: told and 'there is no time on /clock' in told[-1].status[0].message)
    assert told[-1].status[0].level == DiagnosticStatus.WARN
    bench.publish('/clock', Clock(clock=Stamp(sec=100)))
    assert until(lambda: node.get_clock().now().nanoseconds == 100 * 10**9)
    assert until(lambda: '/clock' not in told[-1].status[0].message)


def test_the_path_is_thinned_and_bounded(bench, monkeypatch):
    monkeypatch.setattr(ekf_node, 'PATH_LENGTH', 3)
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN)
    heard = bench.listen(Path, 'ekf/path')
    play(bench, node, FilterDrive(seconds=4, rate_hz=20), kinds=[0])
    assert until(lambda: heard and len(heard[-1].poses) == 3)
    stamps = [read_stamp(pose.header.stamp) for pose in heard[-1].poses]
    assert np.all(np.diff(stamps) >= 500_000_000)


def test_overrides_of_quality_of_service_are_taken(bench, monkeypatch, capfd):
    """And without tf2_msgs the node runs, and says so."""
    monkeypatch.setattr(ekf_node, 'TFMessage', None)
    bench.run(EkfNode, **{
        'qos_overrides./odom.subscription.reliability': 'reliable',
        'qos_overrides./ekf/odometry.publisher.depth': 3,
    })  # fmt: skip
    assert until(lambda: bench.node.get_subscriptions_info_by_topic('/odom'))
    profile = bench.node.get_subscriptions_info_by_topic('/odom')[0].qos_profile
    assert profile.reliability.name == 'RELIABLE'
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
    wrong = [{'error_correlation': numbers} for numbers in ([], [0.5], [1.5, 1.0], [0.5, -1.0])]
    wrong += [{'wheel_scale': [math.nan, 1.0]}, {'unknown': [0.0, 0.0]}, {'camera_left': None}]
    for text in ('', '[]', *(json.dumps({**correct, **values}) for values in wrong)):
        count = node.monitors[topic].received
        bench.publish(topic, String(data=text), latched_qos())
        assert until(lambda n=count: node.monitors[topic].received > n)
    assert until(lambda: refused(node, topic) == 9)
    assert node.filter.correlation == correlation
    node.trigger_activate()
    play(bench, node, FilterDrive(seconds=0.5, **NOISY))
    before = node.filter.state.pose
    assert node.set_parameters([Parameter('measurement_factor', value=4.0)])[0].successful
    assert node.filter.config.measurement_factor == 4.0
    assert np.array_equal(before, node.filter.state.pose)
    bench.publish('sfa/turned', convert.to_turned(0.5, START_NS, 'first_image'))
    assert until(lambda: taken == [(START_NS, pytest.approx(0.5))])


def test_after_an_error_inside_it_starts_anew_and_goes_on(bench, monkeypatch):
    """An error that every message would raise again does not leave the last state standing."""
    drive = FilterDrive(seconds=8, **NOISY)
    node = bench.run(EkfNode)
    states = bench.listen(String, 'ekf/state', latched_qos())
    play(bench, node, drive, end=4.0)
    assert until(lambda: states and states[-1].data.startswith('LOCALISED'))
    works, anew, resets, begun = node.filter.add_odometry, node.filter.reset, [], len(states)

    def add_odometry(*given):
        if not resets:
            raise OverflowError
        return works(*given)

    monkeypatch.setattr(node.filter, 'add_odometry', add_odometry)
    monkeypatch.setattr(node.filter, 'reset', lambda: (resets.append(1), anew()))
    play(bench, node, drive, 4.0)
    assert node.monitors['odom'].refused == {'internal error: OverflowError': 1} and resets == [1]
    assert until(lambda: states[-1].data.startswith('LOCALISED'))
    assert any(not state.data.startswith('LOCALISED') for state in states[begun:])


def test_frames_are_parameters(bench):
    """The map's always; those of odometry and robot where the messages leave them empty."""
    frames = {'map_frame': 'garden', 'odom_frame': 'wheels', 'base_frame': 'robot'}
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN, publish_tf=False, **frames)
    assert bench.node.count_publishers('/tf') == 0, 'others may broadcast the transform'
    fused = bench.listen(Odometry, 'ekf/odometry')
    transforms = bench.listen(TransformStamped, 'ekf/map_to_odom')
    drive = FilterDrive(seconds=1)
    message = odometry(drive, 0)
    message.header.frame_id = message.child_frame_id = ''
    bench.publish('odom', message)
    assert until(lambda: fused and transforms)
    assert (fused[0].header.frame_id, fused[0].child_frame_id) == ('garden', 'robot')
    told = transforms[0].header.frame_id, transforms[0].child_frame_id
    assert told == ('garden', 'wheels')
    without_heading = picture(drive, 0, frame='garden')
    without_heading.pose.covariance[35] = 0.0
    without_heading.pose.pose.orientation.z, without_heading.pose.pose.orientation.w = 1.0, 0.0
    bench.publish(IMAGE_POSE, without_heading)
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
    assert pose_file.exists()
    again = bench.run(EkfNode, **patient)
    heard = bench.listen(PoseWithCovarianceStamped, 'ekf/pose')
    assert np.allclose(again.filter.state.pose, last.pose)
    assert 0.5 < again.filter.state.position_std < 1.0
    assert again.status().level.name == 'DEGRADED', 'no image has confirmed it yet'
    # Switched on elsewhere: the second image that says so is believed.
    elsewhere = FilterDrive(seconds=4, start=(30.0, 0.0, 1.0), **NOISY)
    play(bench, again, elsewhere)
    assert until(lambda: len(heard) == len(elsewhere.pictures))
    assert np.hypot(*(pose_of(heard[-1]) - elsewhere.poses[elsewhere.pictures[-1]])[:2]) < 0.5
    pose_file.write_text('{}')
    for given in ({'initial_pose': AT_ORIGIN}, {}):
        node = bench.run(EkfNode, pose_file=str(pose_file), **given)
        assert node.filter.state is None and node.status().level.name == 'UNINITIALISED'
        bench.end(node)
