# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which topics of a bag are used, how their messages are read, and which stamps count."""

import math
from functools import partial
from operator import attrgetter

import bag_formats as formats
import numpy as np
import pytest
from bag_formats import PERIOD, pose, read_odometry, stamp
from numpy.testing import assert_allclose
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from sfa_localization.bags.drives import ReadingRecipe, read_drive, read_drives
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.satellite_fixes import east_north
from sfa_localization.bags.settings import BagConfig, TopicNames
from sfa_localization.bags.writer import BagWriter, blank
from sfa_localization.cli import main
from sfa_localization.data.errors import BagError
from sfa_localization.inspection import inspect

STORE = get_typestore(Stores.ROS2_JAZZY)
COUNT = 6


def stamped(kind, stamp_ns, **fields):
    """A message with a header; `kind` is package/Name."""
    message = blank(STORE, kind.replace('/', '/msg/'))
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def placed(kind, part, stamp_ns, x, y, yaw, **fields):
    """A message whose `part` tells where the robot is."""
    message = stamped(kind, stamp_ns, **fields)
    names = ('translation', 'rotation') if part == 'transform' else ('position', 'orientation')
    place, turn = (attrgetter(f'{part}.{name}')(message) for name in names)
    place.x, place.y, place.z = float(x), float(y), 0.3
    turn.z, turn.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return message


pose_stamped = partial(placed, 'geometry_msgs/PoseStamped', 'pose')
with_covariance = partial(placed, 'geometry_msgs/PoseWithCovarianceStamped', 'pose.pose')
transform = partial(placed, 'geometry_msgs/TransformStamped', 'transform')


def tf(stamp_ns, *pose):
    message = blank(STORE, 'tf2_msgs/msg/TFMessage')
    message.transforms = [transform(stamp_ns, *pose, child_frame_id='base_link')]
    return message


def odometry(stamp_ns, *pose, v=1.0):
    message = placed('nav_msgs/Odometry', 'pose.pose', stamp_ns, *pose)
    message.twist.twist.linear.x, message.child_frame_id = v, 'base_link'
    return message


def picture(stamp_ns, **changes):
    fields = {'height': 4, 'width': 20, 'encoding': 'bgr8', 'step': 60}
    fields |= {'data': np.full(240, 7, np.uint8), **changes}
    return stamped('sensor_msgs/Image', stamp_ns, **fields)


def record(path, entries):
    """Write (topic, reception, message) to a bag."""
    with BagWriter(path) as bag:
        for entry in entries:
            bag.message(*entry)
    return path


def poses_of(make_message, topic):
    return [(topic, stamp(i) + 1000, make_message(stamp(i), *pose(i))) for i in range(COUNT)]


EXPECTED = np.array([pose(i) for i in range(COUNT)])


@pytest.mark.parametrize('make_message', [pose_stamped, with_covariance, transform, tf, odometry])
def test_poses_come_in_any_type_and_serve_as_odometry_when_named(make_message, tmp_path):
    path = record(tmp_path / 'bag', poses_of(make_message, '/p'))
    name = '/p:base_link' if make_message is tf else '/p'
    with Bag(path, strict=True) as bag:
        truth, read = bag.trajectory(name), read_odometry(bag, name)
    assert truth.stamps_ns.tolist() == [stamp(i) for i in range(COUNT)]
    assert_allclose(truth.poses, EXPECTED, atol=1e-12)
    assert_allclose(read.poses, EXPECTED, atol=1e-12)
    if make_message is not odometry:
        speed = math.hypot(0.5, 0.25) * 1e9 / PERIOD
        assert_allclose(read.twists[:, 0], speed, rtol=1e-4)
        assert_allclose(read.twists[:, 1], 0.02 * 1e9 / PERIOD, atol=1e-6)
        assert not read.variances.any()
    entries = [('/p', stamp(i), pose_stamped(stamp(i), -0.1 * i, 0.0, 0.0)) for i in range(4)]
    with Bag(record(tmp_path / 'backwards', entries)) as bag:
        assert_allclose(read_odometry(bag, '/p').twists, [[-1.0, 0.0]] * 4, atol=1e-9)


def test_a_transform_is_selected_by_its_frame(tmp_path):
    wheel = transform(stamp(99), 9.0, 9.0, 0.0, child_frame_id='wheel')
    entries = [*poses_of(tf, '/tf'), ('/tf', stamp(COUNT), tf(stamp(COUNT), 0, 0, 0))]
    for _, _, message in entries:
        message.transforms.insert(0, wheel)
    entries[-1][2].transforms.pop()
    with Bag(record(tmp_path / 'bag', entries), strict=True) as bag:
        with pytest.raises(BagError, match=r'base_link, wheel, .* choose one as /tf:FRAME'):
            bag.trajectory('/tf')
        truth = bag.trajectory('/tf:base_link')
        assert bag.counts['/tf'].skipped == {'transforms of other frames': 1}
    assert_allclose(truth.poses, EXPECTED, atol=1e-12)


def fix(stamp_ns, latitude, longitude, std=0.0, status=2):
    """A fix of an antenna; without a standard deviation, its covariance is unknown."""
    message = stamped('sensor_msgs/NavSatFix', stamp_ns, latitude=latitude, longitude=longitude)
    message.header.frame_id, message.status.status = 'gps', status
    message.position_covariance[[0, 4]], message.position_covariance_type = std**2, 3 * bool(std)
    return message


@pytest.mark.parametrize(('origin', 'per_degree'), [
    ((50.0, 8.0), (71_695.8, 111_229.0)), ((-50.0, -70.0), (71_695.8, 111_229.0)),
    ((0.0, 180.0), (111_319.5, 110_574.3)), ((69.0, -179.999), (40_008.6, 111_560.9)),
])  # fmt: skip
def test_fixes_are_places_in_the_plane_at_the_origin(origin, per_degree):
    """Meters per degree by tables of the ellipsoid, also across 180 degrees."""
    for east, north in ((100.0, 0.0), (0.0, -100.0), (-300.0, 200.0)):
        latitude = origin[0] + north / per_degree[1]
        longitude = (origin[1] + east / per_degree[0] + 180) % 360 - 180
        place = east_north(latitude, longitude, origin)
        assert place == pytest.approx((east, north), abs=0.02)


def test_fixes_of_several_bags_have_one_origin_and_the_errors_that_they_state(tmp_path):
    """And are those of the antenna, where a static transform tells its place."""
    place = transform(stamp(0), 0.3, -0.1, 0.0, child_frame_id='gps')
    place.header.frame_id = 'base_link'
    link = blank(STORE, 'tf2_msgs/msg/TFMessage')
    link.transforms = [place]
    rows = [(0.02, 2), (1.5, 0), (0.0, 0), (0.0, 2), (0.0, -1)]
    bags = []
    for number in range(2):
        fixes = [fix(stamp(i), 50 + 1e-5 * (i + number), 8.0, *row) for i, row in enumerate(rows)]
        fixes.append(fix(stamp(5), math.nan, 8.0))
        entries = [('/fix', stamp(i), message) for i, message in enumerate(fixes)]
        entries += [('/tf_static', stamp(0), link)] * (number == 0)
        entries += [('/camera', stamp(number), picture(stamp(number)))]
        bags.append(record(tmp_path / str(number), [*poses_of(odometry, '/odom'), *entries]))
    topics = TopicNames(points_topic='/fix', ground_truth='/fix')
    first, second = read_drives(bags, tmp_path, ReadingRecipe(topics=topics))
    assert first.origin == second.origin == (50.0, 8.0)
    assert first.points.std == pytest.approx([0.02, 1.5, 2.5, 0.3])
    assert second.points.places.imag == pytest.approx(1.11229 * np.arange(1, 5), abs=1e-3)
    assert first.points.lever == pytest.approx([0.3 - 0.1j] * 4) and not second.points.lever.any()
    skipped = first.counts['points'].skipped
    assert skipped == {'the receiver has no fix': 1, 'place is not finite': 1}
    recipe = ReadingRecipe(topics=topics, origin=(50.0, 8.001))
    truth = read_drive(bags[0], tmp_path, recipe, want_truth=True).ground_truth
    assert truth.poses[0] == pytest.approx([-71.696, 0.0, 0.0], abs=1e-3)
    with Bag(bags[1]) as bag:
        assert bag.trajectory('/fix').poses[1] == pytest.approx([0.0, 1.11229, 0.0], abs=1e-3)


def full(path, *more):
    entries = [('/camera', stamp(i), picture(stamp(i))) for i in range(COUNT)]
    return record(path, [*entries, *poses_of(odometry, '/odom'), *more])


def test_a_folder_that_holds_bags_is_none(tmp_path):
    for name in 'ba':
        full(tmp_path / name)
    with pytest.raises(BagError, match='is no bag; it holds the bags a, b: name them'):
        Bag(tmp_path).__enter__()


def test_a_missing_or_wrong_topic_names_the_remedy(tmp_path, messages):
    """And of several that could be meant, which there are."""
    with Bag(full(tmp_path / 'bag', ('/second', stamp(1), picture(stamp(1))))) as bag:
        for kind, name, complaint in (
            ('image', '', r'several topics have images: /camera, /second; .* --image-topic'),
            ('image', '/nothing', r'has no topic /nothing; it has /camera \(Image, 6\)'),
            ('odometry', '/camera', r'/camera is sensor_msgs/msg/Image, not one of Odometry'),
            ('imu', '', r'has no yaw rates \(Imu\); .* --imu-topic'),
        ):
            with pytest.raises(BagError, match=complaint):
                bag.find(kind, name)
        assert bag.find('image', '/second') == bag.find('image', 'second') == '/second'
    path = formats.write_database(tmp_path / 'other.db3', messages, serialization='protobuf')
    with Bag(path) as bag, pytest.raises(BagError, match="/odom is serialized as 'protobuf'"):
        bag.find('odometry')


def test_a_bag_recorded_while_the_nodes_ran_is_read_by_its_inputs(tmp_path):
    at = stamp(0)
    inputs = {'/camera/image_raw': picture(at), '/wheels/odometry': odometry(at, 0, 0, 0),
              '/truth': pose_stamped(at, 0, 0, 0)}  # fmt: skip
    published = dict(zip(
        ('/robot/panorama', '/robot/ekf/odometry', '/robot/sfa/pose'), inputs.values(), strict=True
    ))  # fmt: skip
    entries = [(topic, at, message) for topic, message in (inputs | published).items()]
    with Bag(record(tmp_path / 'bag', entries)) as bag:
        assert [bag.find(k) for k in ('image', 'odometry', 'ground_truth')] == [*inputs]


def test_faulty_messages_are_skipped_and_counted(tmp_path):
    """Other faults of images: test_pictures.py."""
    bad = [
        ('/odom', stamp(2) + 1, odometry(stamp(2) + 1, 0.0, 0.0, 0.0, v=math.inf)),
        ('/camera', stamp(2) + 7, picture(stamp(2) + 7, encoding='rgb9')),
        ('/camera', stamp(2) + 8, picture(stamp(2) + 8, height=2, data=np.zeros(120, np.uint8))),
    ]
    path = full(tmp_path / 'bag', *bad)
    run = read_drive(path, tmp_path)
    for use, reasons in {
        'images': ("unsupported encoding 'rgb9'", 'size is not 20x4 like the first image'),
        'odometry': ('twist is not finite',),
    }.items():  # fmt: skip
        told = {'used': COUNT, 'skipped': dict.fromkeys(reasons, 1)}
        assert run.counts[use].as_dict() == told
    with pytest.raises(BagError, match='read without --strict'):
        read_drive(path, tmp_path, strict=True)


TIMES = [stamp(i) for i in range(10)]
HOUR = 3600 * 10**9
LATER, EARLIER = ([t + hours * HOUR for t in TIMES] for hours in (1, -1))
STAMPS = [
    (TIMES[:1], TIMES[:1], {}),
    ([0, *TIMES[1:]], TIMES[1:], {'zero or negative stamp': 1}),
    ([*TIMES[:4], TIMES[3], *TIMES[4:9]], TIMES[:9], {'duplicate stamp': 1}),
    ([*TIMES[:3], TIMES[4], TIMES[3], *TIMES[5:]], TIMES[:3] + TIMES[4:],
     {'stamp out of order': 1}),
    # One that is 0.4 s ahead blocks none of those in between.
    ([*TIMES[:4], TIMES[8], *TIMES[5:]], TIMES[:4] + TIMES[5:], {'stamp jumps': 1}),
    ([*TIMES[:4], EARLIER[4], *TIMES[5:]], TIMES[:4] + TIMES[5:], {'clock was set back': 1}),
    ([LATER[0], *TIMES[1:]], TIMES[1:], {'stamp jumps': 1}),
    ([*TIMES[:9], LATER[9]], TIMES[:9], {'stamp jumps': 1}),
    # A clock that was set forward stays so: what follows is as good as what came before.
    (TIMES[:5] + LATER[5:], TIMES[:5] + LATER[5:], {}),
    # Set back, later pictures would have to be put among the earlier ones.
    (TIMES[:5] + EARLIER[5:], TIMES[:5], {'clock was set back': 5}),
]  # fmt: skip
"""Stamps, received every 0.1 s; those that are used, and the reasons of others."""


def test_stamps_that_cannot_be(tmp_path):
    for number, (stamps, used, skipped) in enumerate(STAMPS):
        entries = [('/p', stamp(i), pose_stamped(s, 0.0, 0.0, 0.0)) for i, s in enumerate(stamps)]
        with Bag(record(tmp_path / str(number), entries)) as bag:
            assert bag.trajectory().stamps_ns.tolist() == used
            assert bag.counts['/p'].skipped == skipped
    whole = [stamp(0) // 10**9 * 10**9 + i // 10 * 10**9 for i in range(40)]
    entries = [('/p', s + i, pose_stamped(s, 0.0, 0.0, 0.0)) for i, s in enumerate(whole)]
    refusal = pytest.raises(BagError, match=r'36 messages have the stamp .*stamp_source: receive')
    with Bag(record(tmp_path / 'whole', entries)) as bag, refusal:
        bag.trajectory()
    entries = [('/p', stamp(i), pose_stamped(0, *pose(i))) for i in range(COUNT)]
    path = record(tmp_path / 'bag', entries)
    refusal = pytest.raises(BagError, match=r'6 zero or negative stamp.*stamp_source: receive')
    with Bag(path) as bag, refusal:
        bag.trajectory()
    with Bag(path, config=BagConfig(stamp_source='receive')) as bag:
        assert_allclose(bag.trajectory().poses, EXPECTED, atol=1e-12)


def test_inspect_reads_stamps_as_the_parameter_file_says(tmp_path, capsys):
    made = ('/camera', lambda: picture(0)), ('/odom', lambda: odometry(0, 0, 0, 0))
    entries = [(topic, stamp(k), message()) for k in range(4) for topic, message in made]
    words = ['inspect', str(record(tmp_path / 'bag', entries))]
    (tmp_path / 'a.yaml').write_text('training: {ros__parameters: {stamp_source: receive}}')
    main(words)
    assert '/odom (Odometry): 0 messages' in capsys.readouterr().out
    main([*words, '--config', str(tmp_path / 'a.yaml')])
    assert '/odom (Odometry): 4 messages' in capsys.readouterr().out


def test_a_gyroscope_that_is_silent_is_warned_of_and_done_without(tmp_path, caplog):
    with Writer(tmp_path / 'bag', version=9) as writer:
        writer.add_connection('/imu', 'sensor_msgs/msg/Imu', typestore=STORE)
        for topic, made in (('/camera', picture), ('/odom', lambda at: odometry(at, 0, 0, 0))):
            kind = made(1).__msgtype__
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for k in range(4):
                writer.write(connection, stamp(k), STORE.serialize_cdr(made(stamp(k)), kind))
    run = read_drive(tmp_path / 'bag', tmp_path / 'cache')
    assert run.yaw_rate is None and len(run.panoramas) == 4
    assert 'no message on /imu: continuing without gyroscope' in caplog.text
    assert 'imu' not in ' '.join(inspect(tmp_path / 'bag').lacks)
    with pytest.raises(BagError, match='/imu'):
        read_drive(tmp_path / 'bag', tmp_path, ReadingRecipe(topics=TopicNames(imu='/imu')))


def test_odometry_whose_pose_is_constant_is_integrated(tmp_path):
    """For other units see test_motion_check.py."""
    entries = [('/odom', stamp(k), odometry(stamp(k), 0, 0, 0)) for k in range(100)]
    with Bag(record(tmp_path / 'constant', entries)) as bag:
        assert read_odometry(bag).poses[:, 0] == pytest.approx(np.arange(100) * PERIOD * 1e-9)
        assert bag.problems == ['/odom: the pose is constant; the twist is integrated instead']


def test_what_cannot_be_written_is_named(tmp_path):
    with pytest.raises(BagError, match='already exists'), BagWriter(tmp_path):
        pass
    with pytest.raises(BagError, match="storage 'tape' is not one of mcap, sqlite3"):
        BagWriter(tmp_path / 'bag', 'tape')
    with pytest.raises(BagError, match=r'/x is sensor_msgs/msg/Image, not'):
        record(tmp_path / 'new', [('/x', 1, picture(1)), ('/x', 1, odometry(1, 0, 0, 0))])
