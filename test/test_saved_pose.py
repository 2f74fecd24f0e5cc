# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The last sure pose: what is written is read back, and any other file is rejected by name."""

import json

import numpy as np
import pytest

pytest.importorskip('rclpy')
from sfa_localization.data.errors import DataError
from sfa_localization.nodes.saved_pose import SavedPose, load_pose, save_pose

SAVED = SavedPose(7, 'map', np.array([1.0, -2.0, 3.0]), np.diag([0.04, 0.01, 0.0025]))


def test_what_is_written_is_read_back(tmp_path):
    path = tmp_path / 'new folder' / 'pose.json'
    assert load_pose(path, 'map') is None
    save_pose(path, SAVED)
    read = load_pose(path, 'map')
    assert (read.stamp_ns, read.frame) == (7, 'map')
    np.testing.assert_array_equal(read.pose, SAVED.pose)
    np.testing.assert_array_equal(read.covariance, SAVED.covariance)
    assert [file.name for file in path.parent.iterdir()] == ['pose.json']


def test_a_robot_that_was_off_may_have_been_moved_a_little():
    assert np.sqrt(SAVED.moved()[0, 0]) == pytest.approx(np.hypot(0.2, 0.5))
    assert np.sqrt(SAVED.moved()[2, 2]) == pytest.approx(np.hypot(0.05, 0.3))


GOOD = {'version': 1, 'stamp_ns': 7, 'frame': 'map', 'pose': [0, 0, 0],
        'covariance': np.eye(3).tolist()}  # fmt: skip
BAD = {
    'empty': '',
    'binary': '\x00\x80',
    'a list': '[1, 2]',
    'nested': '[' * 20000,
    'huge': '1' * 100_000,
    'other version': json.dumps({**GOOD, 'version': 2}),
    'other frame': json.dumps({**GOOD, 'frame': 'hall'}),
    'no pose': json.dumps({k: v for k, v in GOOD.items() if k != 'pose'}),
    'two numbers': json.dumps({**GOOD, 'pose': [0, 0]}),
    'text': json.dumps({**GOOD, 'pose': ['a', 'b', 'c']}),
    'ragged': json.dumps({**GOOD, 'covariance': [[1], [1, 2], 3]}),
    'not finite': json.dumps({**GOOD, 'pose': [float('nan'), 0, 0]}),
    'negative': json.dumps({**GOOD, 'covariance': (-np.eye(3)).tolist()}),
    'stamp': json.dumps({**GOOD, 'stamp_ns': float('inf')}),
}


def test_a_file_that_is_none_is_rejected_by_name(tmp_path):
    path = tmp_path / 'pose.json'
    for text in BAD.values():
        path.write_text(text)
        with pytest.raises(DataError, match=r'pose\.json: '):
            load_pose(path, 'map')
    with pytest.raises(DataError, match='no regular file'):
        load_pose(tmp_path, 'map')


def test_only_what_holds_a_pose_or_nothing_is_written_over(tmp_path):
    """Not the model, which the parameter may name by mistake."""
    path = tmp_path / 'model.npz'
    for name in ('other version', 'other frame', 'two numbers', 'empty'):
        path.write_text(BAD[name])
        save_pose(path, SAVED)
        assert load_pose(path, 'map').stamp_ns == 7
    for name in ('binary', 'a list', 'nested', 'huge', 'no pose'):
        path.write_text(BAD[name])
        with pytest.raises(DataError, match=r'model\.npz: holds no saved pose, and stays'):
            save_pose(path, SAVED)
        assert path.read_text() == BAD[name]
