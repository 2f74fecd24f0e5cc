# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Topics of a bag that are stamped by different clocks, by their reception."""

from pathlib import Path

import numpy as np
import pytest
from robustness.troubles import (
    IMAGES,
    IMU,
    ODOMETRY,
    SECOND_NS,
    TEST,
    TRUTH,
    alter,
    restamp,
    stamp_of,
)

from sfa_localization.bags.drives import read_drive
from sfa_localization.bags.topic_stream import Item, Stream, clock_offset


@pytest.mark.parametrize(
    ('topic', 'ahead_s', 'text'),
    [
        (IMAGES, 37, 'images: stamped 37.0 s ahead of the odometry (/p'),
        (IMAGES, -3600.4, 'images: stamped 3600.4 s behind the odometry, by their reception:'),
        (IMU, 18, 'gyroscope: stamped 18.0 s ahead of the odometry (/imu in'),
        (TRUTH, 7, 'ground truth: stamped 7.0 s ahead of the odometry'),
        (ODOMETRY, 19, 'images: stamped 19.0 s behind the odometry (/odom'),
        (IMAGES, 1, ''),  # turns show it
        (IMAGES, -7, 'delayed, or by another clock? not corrected'),
    ],
)
def test_clocks_that_differ_by_their_reception_become_one(topic, ahead_s, text, tmp_path, caplog):
    bag, ahead_ns = tmp_path / 'bag', round(ahead_s * SECOND_NS)
    alter(TEST, bag, {topic: lambda m, _: restamp(m, stamp_of(m) + ahead_ns)})
    right, read = (read_drive(path, tmp_path, want_truth=True) for path in (TEST, bag))
    assert text in caplog.text and ('by their reception' in caplog.text) == bool(text)
    for name in ('panoramas', 'yaw_rate', 'ground_truth'):
        late_ns = getattr(read, name).stamps_ns[20] - getattr(right, name).stamps_ns[20]
        late_ns -= read.odometry.stamps_ns[20] - right.odometry.stamps_ns[20]
        if 'not' not in text and text:
            assert abs(late_ns) < SECOND_NS // 20


@pytest.mark.parametrize('received', ['stamp', 'zero', 'one moment'])
def test_a_bag_without_times_of_reception_is_read_by_its_stamps(received):
    streams = [Stream(Path('bag'), name, lambda _: None, False) for name in ('images', 'odometry')]
    for stream, begin_s in zip(streams, (60, 0), strict=True):
        for stamp_ns in (np.arange(begin_s, 100, 0.1) * SECOND_NS).astype(int) + 10**18:
            at_ns = {'stamp': stamp_ns, 'zero': 0, 'one moment': 10**18}[received]
            stream.push(Item(int(stamp_ns), int(at_ns), None))
    assert clock_offset('images', *streams) == (0, '')
