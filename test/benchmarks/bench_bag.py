# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Speed of reading bags against bare rosbags, the same bag in turns: `python bench_bag.py`."""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from sfa_localization.bags.reader import Bag
from sfa_localization.bags.writer import BagWriter

START = 1_700_000_000_000_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)
STORAGES = ('mcap', 'sqlite3')
Counter = Callable[[Path], tuple[int, int]]


def write_drive(path, storage, pictures=1200):
    """A drive with 10 JPEG panoramas, 50 odometry and 50 gyro messages per second."""
    rng = np.random.default_rng(1)
    panorama = rng.integers(0, 256, (60, 600, 3), np.uint8)
    with BagWriter(path, storage) as bag:
        for index in range(pictures * 5):
            at = START + index * 20_000_000
            if index % 5 == 0:
                bag.image('/panorama/compressed', at, panorama, 'camera', 'jpeg')
            bag.odometry('/odom', at, (0.01 * index, 0.0, 0.0), (0.5, 0.0), (0.01, 0.01))
            bag.imu('/imu', at, 0.0, 0.01)
    return path


def bare_raw(path):
    """Messages and bytes, by rosbags alone."""
    count = size = 0
    with Reader(path) as reader:
        for _, _, data in reader.messages():
            count, size = count + 1, size + len(data)
    return count, size


def our_raw(path):
    """Messages and bytes, by ours."""
    count = size = 0
    with Bag(path) as bag:
        for _, _, data in bag.messages(bag.topics):
            count, size = count + 1, size + len(data)
    return count, size


def bare_decoded(path):
    """Messages and bytes, each deserialized by rosbags."""
    count = size = 0
    with Reader(path) as reader:
        for connection, _, data in reader.messages():
            STORE.deserialize_cdr(data, connection.msgtype)
            count, size = count + 1, size + len(data)
    return count, size


def our_decoded(path):
    """Messages, each deserialized, its stamp judged and counted, by ours."""
    count = 0
    with Bag(path) as bag:
        for _ in bag.read([bag.any_stream(topic, lambda message: None) for topic in bag.topics]):
            count += 1
    return count, 0


CASES = {'raw': (our_raw, bare_raw), 'decoded': (our_decoded, bare_decoded)}


def seconds(read, path):
    start = time.perf_counter()
    read(path)
    return time.perf_counter() - start


def in_turns(ours, bare, path, rounds):
    """Median of the ratios of speed, and our median seconds."""
    ratios, times = [], []
    for turn in range(rounds):
        order = (ours, bare) if turn % 2 else (bare, ours)
        taken = {read: seconds(read, path) for read in order}
        ratios.append(taken[bare] / taken[ours])
        times.append(taken[ours])
    return statistics.median(ratios), statistics.median(times)


def bench_bag(folder, rounds=9):
    """Speed of our iteration over that of bare rosbags, the lesser storage's, and each case."""
    result: dict[str, float] = {}
    for storage in STORAGES:
        path = write_drive(folder / storage, storage)
        count, size = bare_raw(path)
        assert our_raw(path) == (count, size) and our_decoded(path)[0] == count
        for name, (ours, bare) in CASES.items():
            ratio, taken = in_turns(ours, bare, path, rounds)
            result[f'bag_over_rosbags_{storage}_{name}'] = ratio
            result[f'bag_{storage}_{name}_messages_per_s'] = count / taken
            result[f'bag_{storage}_{name}_mb_per_s'] = size / taken / 1e6
    iteration = min(result[f'bag_over_rosbags_{storage}_raw'] for storage in STORAGES)
    return {'bag_over_rosbags': iteration, **result}


if __name__ == '__main__':
    with tempfile.TemporaryDirectory() as temporary:
        found = bench_bag(Path(temporary))
        sys.stdout.write(json.dumps(found, indent=2) + '\n')
