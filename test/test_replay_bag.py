# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""evaluate --bag writes what the nodes would publish on a drive, with the values it has judged."""

import json
import re
from collections import defaultdict
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose
from page_tables import ROOT
from picture_readers import DROVE, PictureReader, Recording, load_pictures
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from sfa_localization import evaluation
from sfa_localization.camera.encodings import decode_compressed
from sfa_localization.cli import main
from sfa_localization.commands.replay_bag import write_replay
from sfa_localization.data.errors import BagError
from sfa_localization.data.geometry import RigidTransform, compose
from sfa_localization.mapping.settings import GroundConfig

STORE = get_typestore(Stores.ROS2_JAZZY)
IMAGES = 119 - 1  # one is of another size
LATCHED = {'/tf_static', '/sfa/map', '/sfa/map_paths', '/ekf/path', '/ekf/state'}


def read(path):
    """Stamps and messages of each topic, and the latched topics."""
    messages = defaultdict(list)
    with Reader(path) as bag:
        for connection, stamp_ns, data in bag.messages():
            message = STORE.deserialize_cdr(data, connection.msgtype)
            messages[connection.topic].append((stamp_ns, message))
        latched = {
            connection.topic for connection in bag.connections
            for qos in connection.ext.offered_qos_profiles
            if qos.durability is QosDurability.TRANSIENT_LOCAL
        }  # fmt: skip
    return messages, latched


def planar(pose):
    q = pose.orientation
    return [pose.position.x, pose.position.y, 2 * np.arctan2(q.z, q.w)]


def assert_poses(expected, pose):
    moved = np.array(planar(pose)) - expected
    moved[2] = np.angle(np.exp(1j * moved[2]))
    assert_allclose(moved, 0.0, atol=1e-9)


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    return Recording().write(tmp_path_factory.mktemp('bags') / 'drive')


@pytest.fixture(scope='module')
def replayed(drive, tmp_path_factory):
    """The evaluation of a drive, whose truth is beside the map, and its bag."""
    beside = RigidTransform(0.5, -0.2, 0.03)
    result = evaluation.evaluate(PictureReader(), drive, transform=beside)
    path = tmp_path_factory.mktemp('replays') / 'replay.mcap'
    write_replay(path, result, DROVE)
    return result, *read(path)


def test_each_topic_holds_as_many_messages_as_the_nodes_would_publish(replayed):
    result, messages, latched = replayed
    started = [step for step in result.steps if step.state]
    images = sum(step.image is not None for step in started)
    assert latched == LATCHED
    texts = [message.data for _, message in messages.pop('/ekf/state')]
    assert texts[0] == 'UNINITIALISED: no usable image yet' and 'LOCALISED' in texts
    assert all(a != b for a, b in pairwise(texts))
    assert {topic: len(rows) for topic, rows in messages.items()} == {
        '/tf_static': 1, '/sfa/map': 1, '/sfa/map_paths': 1, '/ekf/path': 1,
        '/panorama/compressed': IMAGES, '/sfa/pose_with_covariance': IMAGES,
        '/sfa/slow_features': IMAGES, '/ground_truth': len(result.truth),
        '/ekf/odometry': len(started) - images, '/ekf/pose': images,
    }  # fmt: skip


def test_estimates_are_those_that_were_judged(replayed):
    result, messages, _ = replayed
    ekf = result.estimates['ekf']
    rows = messages['/ekf/odometry']
    assert [stamp_ns for stamp_ns, _ in rows] == ekf.stamps_ns.tolist()
    place = messages['/tf_static'][0][1].transforms[0]
    assert (place.header.frame_id, place.child_frame_id) == ('map', 'world')
    x, y, yaw = result.transform.x_m, result.transform.y_m, result.transform.yaw_rad
    q = place.transform.rotation
    origin = [place.transform.translation.x, place.transform.translation.y]
    world_in_map = np.array([*origin, 2 * np.arctan2(q.z, q.w)])
    assert_allclose(compose(np.array([x, y, yaw]), world_in_map), 0.0, atol=1e-12)
    states = [step.state for step in result.steps if step.state and step.image is None]
    for (_, message), judged, state in zip(rows, ekf.poses, states, strict=True):
        assert (message.header.frame_id, message.child_frame_id) == ('map', 'base_link')
        in_map = np.array(planar(message.pose.pose))
        laid = compose(np.array([x, y, yaw]), in_map)
        assert_allclose(np.exp(1j * (laid[2] - judged[2])), 1.0, atol=1e-9)
        assert_allclose(laid[:2], judged[:2], atol=1e-9)
        covariance = message.pose.covariance.reshape(6, 6)[np.ix_([0, 1, 5], [0, 1, 5])]
        assert_allclose(covariance, state.pose_covariance)
        assert_allclose(message.twist.twist.linear.x, state.twist[0])
    path = messages['/ekf/path'][0][1].poses
    assert len(path) == len(ekf) + 1 and path[-1].pose == rows[-1][1].pose.pose


def test_images_truth_and_map_are_those_of_drive_and_model(replayed):
    result, messages, _ = replayed
    seen = [step.image for step in result.steps if step.image is not None]
    for (_, message), image in zip(messages['/sfa/pose_with_covariance'], seen, strict=True):
        assert_poses(image.pose, message.pose.pose)
        assert message.pose.covariance[[0, 7, 35]].tolist() == image.covariance.diagonal().tolist()
    for (_, message), image in zip(messages['/sfa/slow_features'], seen, strict=True):
        assert message.data.tolist() == image.slow_features.tolist()
    pictures = [message for _, message in messages['/panorama/compressed']]
    stored = result.run.panoramas.read(0, IMAGES)
    for number in (0, 20, 100):  # lossy: gray levels of random dots
        picture = decode_compressed(pictures[number].data.tobytes())
        assert picture.shape == (16, 64, 3)
        assert np.abs(picture.astype(float).mean() - stored[number].mean()) < 3.0
    truth = messages['/ground_truth']
    assert [stamp_ns for stamp_ns, _ in truth] == result.truth.stamps_ns.tolist()
    for (_, message), pose in zip(truth, result.truth.poses, strict=True):
        assert message.header.frame_id == 'world'
        assert_poses(pose, message.pose)
    ((_, grid),) = messages['/sfa/map']
    cells = DROVE.cells(GroundConfig())
    assert (grid.info.height, grid.info.width) == cells.driven.shape
    assert [grid.info.origin.position.x, grid.info.origin.position.y] == cells.corner.tolist()
    assert (grid.data == 0).sum() == cells.driven.sum() and (grid.data == -1).any()
    ((_, paths),) = messages['/sfa/map_paths']
    (marker,) = paths.markers
    assert marker.type == marker.LINE_LIST and marker.header.frame_id == 'map'
    assert [(p.x, p.y) for p in marker.points] == [(0.0, 1.0), (0.5, 1.0), (0.5, 1.0), (0.5, 1.5)]
    assert [(c.r, c.g) for c in marker.colors] == [(0.0, 1.0), (0.5, 0.5), (0.5, 0.5), (1.0, 0.0)]


def test_the_layouts_show_the_truth_and_all_that_a_replay_holds(replayed):
    """But for what has no place in the view of the map."""
    layout = json.loads((ROOT / 'config/foxglove_layout.json').read_text('utf-8'))
    rviz = (ROOT / 'config/localization.rviz').read_text('utf-8')
    in_rviz = {f'/{topic.strip("/")}' for topic in re.findall(r'Value: (\S+/?\w+)$', rviz, re.M)}
    shown = set(replayed[1]) - {
        '/tf_static', '/panorama/compressed', '/sfa/slow_features', '/ekf/state', '/ekf/odometry',
    }  # fmt: skip
    assert shown <= set(layout['configById']['3D!map']['topics'])
    assert shown <= in_rviz


def test_a_bag_is_written_whole_or_not_at_all_and_replaces_nothing(
    drive, replayed, tmp_path, monkeypatch, capsys
):
    load_pictures(monkeypatch)
    words = ['evaluate', 'reader.npz', str(drive), '--bag', str(tmp_path / 'replay')]
    assert main(words) == 0
    assert f'{tmp_path / "replay"}: written' in capsys.readouterr().out
    counts = {topic: len(rows) for topic, rows in read(tmp_path / 'replay')[0].items()}
    assert counts['/panorama/compressed'] == IMAGES
    monkeypatch.setattr(evaluation, 'evaluate', lambda *_, **__: pytest.fail('too late'))
    assert main(words) == 1
    assert 'already exists; name another bag or remove it' in capsys.readouterr().err
    result = replayed[0]
    monkeypatch.setattr('sfa_localization.bags.writer.encode_jpeg', lambda _: 1 / 0)
    with pytest.raises((ZeroDivisionError, BagError)):
        write_replay(tmp_path / 'broken', result, DROVE)
    assert [path.name for path in tmp_path.iterdir()] == ['replay']
