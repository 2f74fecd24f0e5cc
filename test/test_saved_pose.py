# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The last sure pose: what is written is read back, and any other file is rejected by name."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from sfa_localization.data.errors import DataError
from sfa_localization.nodes.saved_pose import SavedPose, load_pose, save_pose

SAVED = SavedPose(7, 'map', np.array([1.0, -2.0, 3.0]), np.diag([0.04, 0.01, 0.0025]))
OTHER = [
    {'version': 2}, {'frame': 'hall'}, {'pose': [0, 0]}, {'pose': ['a', 'b', 'c']},
    {'covariance': [[1], [1, 2], 3]}, {'pose': [float('nan'), 0, 0]},
    {'covariance': (-np.eye(3)).tolist()}, {'stamp_ns': float('inf')},
]  # fmt: skip


def test_what_is_written_is_read_back_and_another_pose_rejected_and_written_over(tmp_path):
    path = tmp_path / 'new folder' / 'pose.json'
    assert load_pose(path, 'map') is None
    for change in OTHER:
        save_pose(path, SAVED)
        read = load_pose(path, 'map')
        assert (read.stamp_ns, read.frame) == (7, 'map')
        assert_array_equal(read.pose, SAVED.pose)
        assert_array_equal(read.covariance, SAVED.covariance)
        path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
        with pytest.raises(DataError, match=r'pose\.json: cannot be used'):
            load_pose(path, 'map')
    # A robot that was off may have been moved a little.
    stds = np.sqrt(np.diag(read.moved()))
    assert_allclose(stds, np.hypot([0.2, 0.1, 0.05], [0.5, 0.5, 0.3]))


def test_a_file_of_something_else_is_rejected_by_name_and_stays(tmp_path):
    """Not the model, which the parameter may name by mistake."""
    path = tmp_path / 'model.npz'
    for text in ['\x00\x80', '[1, 2]', '{"stamp_ns": 7}']:
        path.write_text(text)
        for attempt in (lambda: load_pose(path, 'map'), lambda: save_pose(path, SAVED)):
            with pytest.raises(DataError, match=r'model\.npz: holds no saved pose, and stays'):
                attempt()
        assert path.read_text() == text
