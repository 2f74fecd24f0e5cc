# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of every format and every damage: exact counts, stamps and pixels, or one clear error."""

import os
import shutil
import tracemalloc

import bag_formats as formats
import numpy as np
import pytest
from bag_formats import COUNTS, DELAY, FORMATS, IMAGES, PERIOD, image, pose, read_odometry, stamp
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from sfa_localization.bags.drives import ReadingRecipe, read_drive
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.settings import TopicNames
from sfa_localization.camera.settings import CameraConfig
from sfa_localization.data.errors import BagError
from sfa_localization.inspection import inspect

ZSTD = b'\x28\xb5\x2f\xfd'


def snapshot(path):
    """Return every file with its content and time of change."""
    return {str(f): (f.read_bytes(), f.stat().st_mtime_ns) for f in path.rglob('*') if f.is_file()}


def received(path, start_ns=0):
    """Return reception, topic and bytes of all messages."""
    with Bag(path) as bag:
        return [(at, c.name, data) for c, at, data in bag.messages(bag.topics, start_ns)]


@pytest.mark.parametrize('name', FORMATS)
def test_every_format_is_read_exactly(name, tmp_path, messages):
    path = FORMATS[name](tmp_path / 'bag', messages)
    before = snapshot(tmp_path)
    with Bag(path, strict=True) as bag:
        assert {topic.name: topic.count for topic in bag.topics.values()} == COUNTS
        assert list(bag.images())[-1][0] == stamp(IMAGES - 1) and bag.problems == []
    run = read_drive(path, tmp_path / 'cache', strict=True, want_truth=True)
    assert sorted(c.used for c in run.counts.values()) == sorted(COUNTS.values())
    assert not any(count.skipped for count in run.counts.values())
    assert run.panoramas.stamps_ns.tolist() == [stamp(i) for i in range(IMAGES)]
    (batch,) = run.panoramas.batches(IMAGES)
    assert np.array_equal(batch, [image(i) for i in range(IMAGES)])
    steps = np.arange(IMAGES * formats.PER_IMAGE + 1) / formats.PER_IMAGE
    assert run.odometry.stamps_ns.tolist() == [stamp(i) for i in steps]
    assert_allclose(run.odometry.poses, [pose(i) for i in steps], atol=1e-12)
    assert_array_equal(run.odometry.twists, [[5.0, 0.2]] * len(steps))
    assert_array_equal(run.odometry.variances, [[0.04, 0.01]] * len(steps))
    assert_allclose(run.ground_truth.poses, [pose(i) for i in range(IMAGES)], atol=1e-12)
    assert_allclose(run.yaw_rate.omega, 0.01 * steps[:-1], atol=1e-15)
    assert set(run.yaw_rate.variance) == {0.09}
    shutil.rmtree(tmp_path / 'cache')
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize('name', ['mcap', 'sqlite3', 'ROS 1 bz2'])
def test_messages_come_in_order_of_reception_from_any_moment_on(name, tmp_path, messages):
    """Also of a ROS 1 bag whose topics were written one after the other, in separate chunks."""
    stored = messages if name == 'mcap' else sorted(messages, key=lambda m: m.topic)
    parts = received(FORMATS[name](tmp_path / 'bag', stored))
    assert sorted(part[:2] for part in parts) == sorted((m.receive_ns, m.topic) for m in messages)
    assert [at for at, _, _ in parts] == sorted(m.receive_ns for m in messages)
    middle = stamp(IMAGES / 2)
    later = [at for at, _, _ in received(tmp_path / 'bag', middle)]
    assert later == sorted(m.receive_ns for m in messages if m.receive_ns >= middle)


WRITERS = {
    **{f'mcap {c}': lambda p, m, c=c: formats.write_mcap(p / 'a.mcap', m, compression=c)
       for c in ('', 'zstd', 'lz4', None)},
    'sqlite3': lambda p, m: formats.write_database(p / 'a.db3', m),
}  # fmt: skip


@pytest.mark.parametrize('name', ['mcap None', 'sqlite3'])
def test_memory_does_not_grow_with_a_bag(name, tmp_path, messages):
    picture = next(m for m in messages if m.topic == '/image_raw')

    def peak(count):
        entries = [picture._replace(receive_ns=stamp(index)) for index in range(count)]
        path = WRITERS[name](tmp_path / str(count), entries)
        tracemalloc.start()
        with Bag(path) as bag:
            assert sum(1 for _ in bag.messages(bag.topics)) == count
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    assert peak(4_000) < 1.1 * peak(1_000) + 33_000


@pytest.mark.parametrize('name', ['version 9', 'lone db3', 'lone mcap'])
def test_quality_of_service_is_kept(name, tmp_path, messages):
    with Bag(FORMATS[name](tmp_path / 'bag', messages)) as bag:
        (qos,) = bag.topics['/odom'].qos
    parts = qos.depth, qos.reliability.name, qos.durability.name
    assert parts == (7, 'BEST_EFFORT', 'TRANSIENT_LOCAL')


def test_silence_of_a_library_is_an_error(tmp_path, messages, monkeypatch):
    """As rosbags 0.11 reads nothing where metadata and file spell a type differently."""
    path = FORMATS['other text in the metadata'](tmp_path / 'bag', messages)
    monkeypatch.setattr(Sqlite3Reader, 'messages', lambda *_: iter(()))
    with pytest.raises(BagError, match=r'12 lost .*`mcap recover`.*`ros2 bag reindex`'):
        read_drive(path, tmp_path / 'cache')


def salvaged(path):
    """Return the share of odometry that a damaged bag yields; each message is as recorded."""
    with Bag(path) as bag:
        odometry = read_odometry(bag)
        for at, pose_read in zip(odometry.stamps_ns, odometry.poses, strict=True):
            assert_allclose(pose_read, pose((at - stamp(0)) / PERIOD), atol=1e-6)
        assert bag.problems
        declared, lost = bag.topics['/odom'].count, sum(bag.counts['/odom'].skipped.values())
        assert len(odometry.stamps_ns) + lost == declared
    with pytest.raises(BagError, match=r'`[a-z0-9 ]+( FILE .recover)?` repairs'):
        Bag(path, strict=True).__enter__()
    return len(odometry.stamps_ns) / COUNTS['/odom']


@pytest.mark.parametrize('name', WRITERS)
def test_a_cut_off_file_is_read_up_to_the_cut(name, tmp_path, messages):
    path = WRITERS[name](tmp_path, messages)
    every, size = received(path), path.stat().st_size
    for share in (0.95, 0.7, 0.4):
        os.truncate(path, int(size * share))
        assert 0.5 * share < salvaged(path) <= 1
        parts = received(path)
        assert set(parts) <= set(every) and parts == sorted(parts, key=lambda part: part[0])


@pytest.mark.parametrize('name', ['version 5', 'mcap zstd file'])
def test_a_cut_off_bag_counts_what_is_lost(name, tmp_path, messages):
    noise = [m._replace(topic='/noise') for m in messages if m.topic == '/image_raw']
    path = FORMATS[name](tmp_path / 'bag', [part for m in messages for part in (m, *noise)])
    (file,) = [file for file in path.iterdir() if file.suffix != '.yaml']
    os.truncate(file, int(file.stat().st_size * 0.7))
    assert 0 < salvaged(path) < 1


def test_a_damaged_chunk_costs_itself_alone(tmp_path, messages):
    path = WRITERS['mcap zstd'](tmp_path, messages)
    data = bytearray(path.read_bytes())
    start = data.index(ZSTD, len(data) // 2)
    data[start : start + 40] = b'\xff' * 40
    path.write_bytes(data)
    with Bag(path) as bag:
        assert 0.8 < len(read_odometry(bag).stamps_ns) / COUNTS['/odom'] < 1
        assert 'a damaged chunk is skipped' in ' '.join(bag.problems)


@pytest.mark.parametrize('data', [ZSTD + bytes(20), b''])
def test_a_damaged_message_costs_itself_alone(data, tmp_path, messages):
    first = next(i for i, m in enumerate(messages) if m.topic == '/odom')
    messages = [*messages[:first], messages[first]._replace(data=data), *messages[first + 1 :]]
    with Bag(formats.write_mcap(tmp_path / 'a.mcap', messages)) as bag:
        assert len(read_odometry(bag).stamps_ns) == COUNTS['/odom'] - 1
        assert sum(bag.counts['/odom'].skipped.values()) == 1


def test_a_missing_file_of_several_is_counted(tmp_path, messages):
    path = formats.write_split(tmp_path / 'bag', messages)
    (path / 'bag_3.mcap').unlink()
    with Bag(path) as bag:
        (problem,) = bag.problems
        assert problem.endswith('bag_3.mcap: is missing; copy all files of the bag')
        read_odometry(bag)
        assert sum(bag.counts['/odom'].skipped.values()) > 0
    with pytest.raises(BagError, match=r'bag_3.mcap: is missing'), Bag(path, strict=True):
        pass


@pytest.mark.parametrize(('content', 'complaint'), [
    (b'', 'holds nothing'), (b'not a bag at all', 'is no bag file'),
    (b'SQLite format 3\x00', 'no readable bag database'),
    (b'\x89MCAP0\r\n', 'holds no readable message'), (ZSTD, 'cut-off zstd data'),
    (b'#ROSBAG V2.0\n', 'no readable bag .*`rosbag reindex`'),
    (None, 'neither metadata.yaml nor'),
])  # fmt: skip
def test_what_holds_no_bag_is_one_error(content, complaint, tmp_path):
    path = tmp_path / 'bag.mcap'
    path.mkdir() if content is None else path.write_bytes(content)
    with pytest.raises(BagError, match=rf'bag.*: .*{complaint}') as error, Bag(path):
        pass
    assert '\n' not in str(error.value)


def test_damaged_metadata_is_rebuilt(tmp_path, messages):
    path = formats.write_version(tmp_path / 'bag', messages, 5)
    for text in ('', 'a: [', '[1, 2]', 'a: 3', 'rosbag2_bagfile_information: {}', '[' * 30_000):
        (path / 'metadata.yaml').write_text(text)
        with Bag(path) as bag:
            assert {t.name: t.count for t in bag.topics.values()} == COUNTS
        damaged = pytest.raises(BagError, match=r'metadata\.yaml is damaged .*ros2 bag reindex')
        with damaged, Bag(path, strict=True):
            pass


def test_messages_in_a_write_ahead_log_are_a_problem(tmp_path, messages):
    path = formats.write_database(tmp_path / 'bag.db3', messages)
    (tmp_path / 'bag.db3-wal').write_bytes(b'some')
    with Bag(path) as bag:
        assert 'bag.db3-wal: holds more messages' in bag.problems[0]


def test_odd_names_are_opened_and_a_pipe_is_no_bag(tmp_path, messages):
    for name in ('a?b', 'a#b', 'a%20b', 'ä b', '\udcff'):
        FORMATS['sqlite3'](tmp_path / 'plain', messages[:50]).rename(tmp_path / name)
        with Bag(tmp_path / name, strict=True) as bag:
            assert len(list(bag.messages(bag.topics))) == 50
    os.mkfifo(tmp_path / 'pipe.mcap')
    with pytest.raises(BagError, match='neither a file'), Bag(tmp_path / 'pipe.mcap'):
        pass


def test_images_without_odometry_are_skipped_and_counted(tmp_path, messages):
    late, early = stamp(2), stamp(9)
    kept = [m for m in messages if m.topic != '/odom' or late <= m.receive_ns - DELAY <= early]
    run = read_drive(formats.write_version(tmp_path / 'bag', kept, 5), tmp_path)
    assert run.panoramas.stamps_ns.tolist() == [stamp(i) for i in range(2, 10)]
    (batch,) = run.panoramas.batches(99)
    assert np.array_equal(batch, [image(i) for i in range(2, 10)])
    skipped = {'no odometry within 0.5 s': 4}
    assert run.counts['images'].as_dict() == {'used': 8, 'skipped': skipped}


@pytest.mark.parametrize(('distinct', 'used'), [(False, [0, 1, 2, 3, 4, 5]), (True, [0, 3, 5])])
def test_learning_leaves_out_images_that_repeat_the_one_before(distinct, used, tmp_path):
    """A driver that was late sends an old image with a new stamp: it shows another place. What is
    no panorama is unwrapped.
    """
    pictures = [np.full((20, 40, 3), k, np.uint8) for k in (0, 0, 0, 3, 3, 0)]
    formats.write_pictures(tmp_path / 'bag', pictures)
    camera = CameraConfig(camera_model='equirectangular')
    recipe = ReadingRecipe(camera=camera, distinct=distinct)
    run = read_drive(tmp_path / 'bag', tmp_path / 'cache', recipe)
    assert run.panoramas.stamps_ns.tolist() == [stamp(i) for i in used]
    assert run.panoramas.shape == (60, 600, 3)
    skipped = {'image repeats the one before': 3} if distinct else {}
    assert run.counts['images'].as_dict() == {'used': len(used), 'skipped': skipped}


def test_a_drive_of_a_frozen_camera_is_refused_by_its_cause(tmp_path):
    """Also by inspect, which then does not blame the turns of the images."""
    formats.write_pictures(tmp_path / 'bag', [image(0)] * 40)
    text = '39 of 40 images repeat the one before: the camera was frozen'
    with pytest.raises(BagError, match=f'bag: /image: {text}'):
        read_drive(tmp_path / 'bag', tmp_path / 'cache', ReadingRecipe(distinct=True))
    report = inspect(tmp_path / 'bag')
    assert any(lack.startswith(text) for lack in report.lacks)
    assert 'images turn' not in ' '.join(report.lacks)


def test_truth_is_read_only_when_wanted(tmp_path, messages):
    broken = [m._replace(data=b'\xff') if m.topic == '/ground_truth' else m for m in messages]
    path = formats.write_version(tmp_path / 'bag', broken, 5)
    assert read_drive(path, tmp_path, strict=True).ground_truth is None
    with pytest.raises(BagError, match='/ground_truth: no usable message'):
        read_drive(path, tmp_path, want_truth=True)
    recipe = ReadingRecipe(topics=TopicNames(ground_truth='/odom'))
    run = read_drive(path, tmp_path, recipe, want_truth=True)
    assert_array_equal(run.ground_truth.poses, run.odometry.poses)


def test_an_error_leaves_no_files(tmp_path):
    formats.write_pictures(tmp_path / 'bag', [image(k) for k in range(3)], later=36_000)
    with pytest.raises(BagError, match=r'none of 3 images of /image has odometry within 0\.5 s'):
        read_drive(tmp_path / 'bag', tmp_path / 'cache')
    assert list((tmp_path / 'cache').iterdir()) == []
