# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Images that end in a drive, or come in another order than their stamps, are named."""

from dataclasses import replace

import pytest
from filter_drives import FilterDrive
from picture_readers import PictureReader, panorama
from rosbags.typesys import Stores, get_typestore

from sfa_localization import evaluation
from sfa_localization.bags.writer import BagWriter, blank
from sfa_localization.data.geometry import RigidTransform
from sfa_localization.reports import evaluation as report

STORE = get_typestore(Stores.ROS2_JAZZY)
DRIVE = FilterDrive(
    seconds=24, rate_hz=20, every=4, start=(5.0, 60.0, 0.3),
    v_std=0.02, omega_std=0.01, position_std=0.1, yaw_std=0.03,
)  # fmt: skip


def evaluated(path, order):
    """What is said of a drive whose images (of 5 Hz) come in this order of stamps."""
    stamps_ns = (DRIVE.stamps_ns[DRIVE.pictures] + 7_000_000).tolist()
    with BagWriter(path) as bag:
        for i, stamp_ns in enumerate(DRIVE.stamps_ns.tolist()):
            told = DRIVE.reckoned[i], DRIVE.read[i], DRIVE.variances()
            bag.odometry('/odom', stamp_ns, *told)
            bag.pose('/truth', stamp_ns, DRIVE.poses[i])
        for k, received_ns in zip(order, sorted(stamps_ns[k] for k in order), strict=True):
            picture = panorama(DRIVE.seen[k], k)
            message = blank(STORE, 'sensor_msgs/msg/Image')
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamps_ns[k], 10**9)
            message.height, message.width, message.step = 16, 64, 3 * 64
            message.encoding, message.data = 'bgr8', picture.reshape(-1)
            bag.message('/panorama', received_ns, message)
    result = evaluation.evaluate(PictureReader(), path, transform=RigidTransform(0, 0, 0))
    return result, report.count_lines(result.counts)


def test_a_stream_of_images_that_ends_in_a_drive_is_named(tmp_path):
    """The last of 60 images of 24 s comes at 59 x 0.2 s; live the filter says so within 3 s."""
    result, lines = evaluated(tmp_path / 'ends', range(60))
    silence = result.counts['without_images']
    assert silence['to_the_end'] and silence['seconds'] == pytest.approx(
        23.95 - 59 * 0.2 - 0.2 - 0.007
    )
    assert any(line.startswith('images: none could be used from 12 s of the drive to the end')
               for line in lines)  # fmt: skip
    assert str(result.steps[-1].status).startswith('DEGRADED: ')
    assert 'no usable image for 12 s' in str(result.steps[-1].status)


def test_a_drive_without_one_of_several_cameras_is_degraded_as_live(tmp_path, monkeypatch):
    read_drive = evaluation.read_drive
    rear = 'camera rear: it sends no images'
    lacking = ('',) * 30 + (rear,) * 20 + ('',) * 10
    monkeypatch.setattr(
        evaluation, 'read_drive', lambda *a, **k: replace(read_drive(*a, **k), lacking=lacking)
    )
    result, _ = evaluated(tmp_path / 'rear', range(60))
    statuses = [str(step.status) for step in result.steps if step.image is not None]
    assert [rear in status for status in statuses] == [bool(text) for text in lacking]
    assert all(status.startswith('DEGRADED: ') for status in statuses[30:50])
    assert set(statuses[20:30] + statuses[50:]) == {'LOCALISED'}


def test_a_gap_of_images_is_named_with_its_seconds_and_a_short_one_is_not(tmp_path):
    order = [k for k in range(119) if not 50 < k <= 70]
    result, lines = evaluated(tmp_path / 'gap', order)
    assert result.counts['without_images']['seconds'] == pytest.approx(21 * 0.2)
    assert any('from 10 s of the drive to 14 s:' in line for line in lines)
    order = [k for k in range(119) if not 50 < k <= 60]
    result, lines = evaluated(tmp_path / 'short', order)
    assert 'without_images' not in result.counts
    assert not any('none could be used' in line or 'are left out' in line for line in lines)


def test_images_whose_stamps_alternate_are_named_as_out_of_order(tmp_path):
    order = [k + swapped for k in range(0, 118, 2) for swapped in (1, 0)]
    result, lines = evaluated(tmp_path / 'swapped', order)
    assert result.counts['images'] == {'used': 59, 'skipped': {'stamp jumps': 59}}
    assert any(line.startswith('images: 59 of 118 are left out because their stamps jump')
               for line in lines)  # fmt: skip
