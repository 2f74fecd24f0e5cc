# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of every format and every damage: exact counts, stamps and pixels, or one clear error."""

import os
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from bag_formats import (
    COUNTS,
    DELAY,
    FORMATS,
    IMAGES,
    PER_IMAGE,
    SHAPE,
    Message,
    drive,
    image,
    metadata,
    pose,
    stamp,
    write_database,
    write_mcap,
    write_ros1,
    write_rosbags,
    write_split,
    write_version,
)
from rosbags.rosbag2 import Reader

from sfa_localization.bags.reader import Bag
from sfa_localization.bags.run_loader import load_run
from sfa_localization.bags.settings import BagConfig, TopicNames
from sfa_localization.bags.writer import BagWriter
from sfa_localization.data.errors import BagError


@pytest.fixture(scope='session')
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    """Return the drive that all bags hold."""
    return drive(tmp_path_factory.mktemp('drive'))


def snapshot(path: Path) -> dict[str, tuple[bytes, int]]:
    """Return every file with its content and time of change."""
    files = [path] if path.is_file() else sorted(path.rglob('*'))
    return {str(f): (f.read_bytes(), f.stat().st_mtime_ns) for f in files if f.is_file()}


# The matrix.


@pytest.mark.parametrize('name', FORMATS)
def test_every_format_is_read_exactly(name: str, tmp_path: Path, messages: list[Message]) -> None:
    path = FORMATS[name](tmp_path / 'bag', messages)
    before = snapshot(tmp_path)
    with Bag(path, strict=True) as bag:
        assert {topic.name: topic.count for topic in bag.topics.values()} == COUNTS
        pictures = list(bag.images())
        odometry, truth, gyro = bag.odometry(), bag.trajectory(), bag.yaw_rate()
        assert {t: c.used for t, c in bag.counts.items()} == COUNTS
        assert all(not count.skipped for count in bag.counts.values())
        assert bag.problems == []
    assert [at for at, _ in pictures] == [stamp(i) for i in range(IMAGES)]
    assert all(np.array_equal(picture, image(i)) for i, (_, picture) in enumerate(pictures))
    steps = np.arange(IMAGES * PER_IMAGE + 1) / PER_IMAGE
    assert odometry.stamps_ns.tolist() == [stamp(i) for i in steps]
    np.testing.assert_allclose(odometry.poses, [pose(i) for i in steps], atol=1e-12)
    np.testing.assert_array_equal(odometry.twists, [[5.0, 0.2]] * len(steps))
    np.testing.assert_array_equal(odometry.variances, [[0.04, 0.01]] * len(steps))
    np.testing.assert_allclose(truth.poses, [pose(i) for i in range(IMAGES)], atol=1e-12)
    np.testing.assert_allclose(gyro.omega, 0.01 * steps[:-1], atol=1e-15)
    assert set(gyro.variance) == {0.09}
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize('name', FORMATS)
def test_every_format_gives_the_same_run(
    name: str, tmp_path: Path, messages: list[Message]
) -> None:
    path = FORMATS[name](tmp_path / 'bag', messages)
    run = load_run(path, cache=tmp_path / 'cache', strict=True)
    assert run.panoramas.stamps_ns.tolist() == [stamp(i) for i in range(IMAGES)]
    assert run.panoramas.shape == SHAPE
    (batch,) = run.panoramas.batches(IMAGES)
    assert np.array_equal(batch, [image(i) for i in range(IMAGES)])
    assert run.ground_truth is None and 'ground_truth' not in run.counts
    assert run.yaw_rate is not None
    used = {use: count.used for use, count in run.counts.items()}
    assert used == {'images': IMAGES, 'odometry': COUNTS['/odom'], 'imu': COUNTS['/imu']}


def test_messages_come_in_order_of_reception(tmp_path: Path, messages: list[Message]) -> None:
    by_topic = sorted(messages, key=lambda message: message.topic)
    write_mcap(tmp_path / 'bag.mcap', by_topic, per_chunk=7)
    with Bag(tmp_path / 'bag.mcap') as bag:
        receptions = [receive_ns for _, receive_ns, _ in bag.messages(bag.topics)]
    assert receptions == sorted(message.receive_ns for message in messages)


@pytest.mark.parametrize('name', ['mcap', 'sqlite3', 'ROS 1', 'split mcap'])
def test_reading_can_start_later(name: str, tmp_path: Path, messages: list[Message]) -> None:
    path, middle = FORMATS[name](tmp_path / 'bag', messages), stamp(IMAGES / 2)
    with Bag(path) as bag:
        receptions = [receive_ns for _, receive_ns, _ in bag.messages(bag.topics, middle)]
    assert receptions == [m.receive_ns for m in messages if m.receive_ns >= middle]


def test_stamps_of_reception_can_be_chosen(tmp_path: Path, messages: list[Message]) -> None:
    path = write_version(tmp_path / 'bag', messages, 5)
    with Bag(path, config=BagConfig(stamp_source='receive')) as bag:
        assert [at for at, _ in bag.images()] == [stamp(i) + DELAY for i in range(IMAGES)]


def test_quality_of_service_is_kept(tmp_path: Path, messages: list[Message]) -> None:
    with Bag(write_version(tmp_path / 'bag', messages, 4)) as bag:
        (qos,) = bag.topics['/odom'].qos
    assert (qos.depth, qos.reliability.name, qos.durability.name) == (
        7,
        'BEST_EFFORT',
        'TRANSIENT_LOCAL',
    )


# What rosbags 0.11 reads as empty, without a word.


def test_other_words_in_the_metadata_do_not_empty_a_bag(
    tmp_path: Path, messages: list[Message]
) -> None:
    path = FORMATS['other text in the metadata'](tmp_path / 'bag', messages)
    with Reader(path) as reader:
        assert reader.message_count == len(messages)
        assert list(reader.messages()) == []  # the trap
    with Bag(path, strict=True) as bag:
        assert len(bag.odometry().stamps_ns) == COUNTS['/odom']


def test_fewer_messages_than_declared_are_counted_as_lost(
    tmp_path: Path, messages: list[Message]
) -> None:
    path = tmp_path / 'bag'
    write_database(path / 'bag_0.db3', messages[: len(messages) // 2])
    (path / 'metadata.yaml').write_text(metadata(5, ['bag_0.db3'], messages))
    with Bag(path) as bag:
        read = len(bag.odometry().stamps_ns)
        assert 0 < read < COUNTS['/odom']
        assert bag.counts['/odom'].skipped == {'lost in a damaged bag': COUNTS['/odom'] - read}
        assert bag.problems == [f'/odom: {read} of {COUNTS["/odom"]} messages read']
    with (
        pytest.raises(BagError, match='of 61 messages read; read without --strict'),
        Bag(path, strict=True) as bag,
    ):
        bag.odometry()


# Damage.


def cut(path: Path, share: float) -> Path:
    """Cut a file off as a crash does."""
    os.truncate(path, int(path.stat().st_size * share))
    return path


def loaded(path: Path) -> tuple[int, int]:
    """Return how many odometry messages were read, and how many were lost, of a damaged bag."""
    with Bag(path) as bag:
        odometry = bag.odometry()
        for at, pose_read in zip(odometry.stamps_ns, odometry.poses, strict=True):
            np.testing.assert_allclose(pose_read, pose((at - stamp(0)) / 1e8), atol=1e-6)
        assert bag.problems
        return len(odometry.stamps_ns), sum(bag.counts['/odom'].skipped.values())


@pytest.mark.parametrize('compression', ['', 'zstd', 'lz4', None])
@pytest.mark.parametrize('share', [0.3, 0.6, 0.95])
def test_a_cut_off_mcap_is_read_up_to_the_cut(
    compression: str | None, share: float, tmp_path: Path, messages: list[Message]
) -> None:
    path = write_mcap(tmp_path / 'bag.mcap', messages, compression=compression)
    read, _ = loaded(cut(path, share))
    assert share * 0.5 * COUNTS['/odom'] <= read <= COUNTS['/odom']
    with pytest.raises(BagError, match='has no index, recording cut off'), Bag(path, strict=True):
        pass


def test_a_cut_off_bag_counts_what_is_lost(tmp_path: Path, messages: list[Message]) -> None:
    path = tmp_path / 'bag'
    cut(write_mcap(path / 'bag_0.mcap', messages, compression='zstd'), 0.6)
    (path / 'metadata.yaml').write_text(metadata(5, ['bag_0.mcap'], messages, storage='mcap'))
    read, lost = loaded(path)
    assert read > 0 and lost > 0 and read + lost == COUNTS['/odom']


def test_a_damaged_chunk_costs_itself_alone(tmp_path: Path, messages: list[Message]) -> None:
    path = write_mcap(tmp_path / 'bag.mcap', messages, compression='zstd')
    data = bytearray(path.read_bytes())
    middle = data.index(b'\x28\xb5\x2f\xfd', len(data) // 2)
    data[middle : middle + 40] = bytes(40)
    path.write_bytes(bytes(data))
    read, lost = loaded(path)
    in_chunk = 20  # messages per chunk, of all topics
    assert 0 < lost < in_chunk and read + lost == COUNTS['/odom']


@pytest.mark.parametrize('share', [0.4, 0.7, 0.95])
def test_a_cut_off_database_is_read_where_it_can_be(
    share: float, tmp_path: Path, messages: list[Message]
) -> None:
    path = tmp_path / 'bag'
    cut(write_database(path / 'bag_0.db3', messages), share)
    (path / 'metadata.yaml').write_text(metadata(5, ['bag_0.db3'], messages))
    read, lost = loaded(path)
    assert read > 0 and lost > 0 and read + lost == COUNTS['/odom']


def test_a_damaged_page_costs_its_rows_alone(tmp_path: Path, messages: list[Message]) -> None:
    path = write_database(tmp_path / 'bag.db3', messages)
    data = bytearray(path.read_bytes())
    page = len(data) // 2 // 4096 * 4096
    data[page : page + 4096] = b'\xff' * 4096
    path.write_bytes(bytes(data))
    with Bag(path) as bag:
        read = len(bag.odometry().stamps_ns)
        assert 0.8 * COUNTS['/odom'] < read < COUNTS['/odom']
        assert any('damaged database' in problem for problem in bag.problems)


def test_a_cut_off_compressed_file_is_read_up_to_the_cut(
    tmp_path: Path, messages: list[Message]
) -> None:
    noise = [m._replace(topic='/noise') for m in messages if m.topic == '/image_raw']
    bulk = [entry for m in messages for entry in (m, *noise)]
    path = FORMATS['mcap zstd file'](tmp_path / 'bag', bulk)
    cut(path / 'bag_0.mcap.zstd', 0.7)
    with Bag(path) as bag:
        assert any('cut-off zstd data' in problem for problem in bag.problems)
        assert 0 < len(bag.odometry().stamps_ns) < COUNTS['/odom']


def test_a_missing_file_of_several_is_counted(tmp_path: Path, messages: list[Message]) -> None:
    path = write_split(tmp_path / 'bag', messages, 'mcap')
    (path / 'bag_3.mcap').unlink()
    lost = -(-len(messages) // 12)
    with Bag(path) as bag:
        (problem,) = bag.problems
        assert problem.endswith(
            f'bag_3.mcap: is missing with {lost} messages; copy all files of the bag'
        )
        bag.odometry()
        assert sum(bag.counts['/odom'].skipped.values()) > 0
    with pytest.raises(BagError, match=r'bag_3.mcap: is missing'), Bag(path, strict=True):
        pass


@pytest.mark.parametrize(
    ('content', 'complaint'),
    [
        (b'', 'is empty'),
        (b'not a bag at all', 'is no bag file'),
        (b'SQLite format 3\x00', 'no readable bag database'),
        (b'\x89MCAP0\r\n', 'holds no readable message'),
        (b'#ROSBAG V2.0\n', 'unreadable ROS 1 bag'),
        (b'#ROSBAG V1.2\n', 'unreadable ROS 1 bag'),
        (b'\x28\xb5\x2f\xfd', 'cut-off zstd data'),
    ],
)
def test_a_file_without_content_is_one_error(
    content: bytes, complaint: str, tmp_path: Path
) -> None:
    path = tmp_path / 'bag.mcap'
    path.write_bytes(content)
    with pytest.raises(BagError, match=rf'bag.*: {complaint}') as error, Bag(path):
        pass
    assert '\n' not in str(error.value)


def test_a_database_of_something_else_is_rejected(tmp_path: Path) -> None:
    database = sqlite3.connect(tmp_path / 'other.db3')
    database.execute('CREATE TABLE birds(name TEXT)')
    database.commit()
    database.close()
    with pytest.raises(BagError, match='no tables of topics'), Bag(tmp_path / 'other.db3'):
        pass


@pytest.mark.parametrize('compression', ['', 'lz4', 'bz2'])
def test_a_cut_off_ros1_bag_is_read_up_to_the_cut(
    compression: str, tmp_path: Path, messages: list[Message]
) -> None:
    path = write_ros1(tmp_path / 'bag.bag', messages, compression, chunk_size=2000)
    with Bag(path) as bag:
        every = list(bag.messages(bag.topics))
    with Bag(cut(path, 0.5)) as bag:
        found = list(bag.messages(bag.topics))
        assert 'has no index, recording cut off?' in bag.problems[0]
    assert 0.3 * len(every) < len(found) < 0.7 * len(every)
    assert found == every[: len(found)]


def test_a_ros1_bag_that_lost_its_index_only_is_read_whole(
    tmp_path: Path, messages: list[Message]
) -> None:
    path = write_ros1(tmp_path / 'bag.bag', messages)
    with Bag(path) as bag:
        every, topics = list(bag.messages(bag.topics)), bag.topics
    path.write_bytes(path.read_bytes()[:-20])
    with Bag(path) as bag:
        assert (list(bag.messages(bag.topics)), bag.topics) == (every, topics)


def test_a_ros1_bag_with_nothing_to_read_names_the_remedy(
    tmp_path: Path, messages: list[Message]
) -> None:
    path = cut(write_ros1(tmp_path / 'bag.bag', messages), 0.005)
    with pytest.raises(BagError, match='rosbag reindex'), Bag(path):
        pass


@pytest.mark.parametrize(
    ('path', 'complaint'), [('nowhere', 'no such bag'), ('empty', 'neither metadata.yaml nor')]
)
def test_a_path_that_is_no_bag_is_rejected(path: str, complaint: str, tmp_path: Path) -> None:
    (tmp_path / 'empty').mkdir()
    with pytest.raises(BagError, match=complaint), Bag(tmp_path / path):
        pass


@pytest.mark.parametrize(('text', 'why'), [
    ('', 'its entries are not'), ('a: [', 'is not YAML'), ('[1, 2]', 'its entries are not'),
    ('a: 3', 'it has no rosbag2_bagfile_information'),
    ('rosbag2_bagfile_information: 3', 'its entries are not'),
    ('rosbag2_bagfile_information: {}', 'it has no version'),
])  # fmt: skip
def test_damaged_metadata_is_rebuilt(
    text: str, why: str, tmp_path: Path, messages: list[Message]
) -> None:
    path = write_version(tmp_path / 'bag', messages, 5)
    (path / 'metadata.yaml').write_text(text)
    with Bag(path) as bag:
        assert {t.name: t.count for t in bag.topics.values()} == COUNTS
        assert any(f'metadata.yaml is damaged ({why}' in problem for problem in bag.problems)
    with pytest.raises(BagError, match=r'metadata\.yaml is damaged'), Bag(path, strict=True):
        pass


def test_newer_metadata_is_noted(tmp_path: Path, messages: list[Message]) -> None:
    path = write_version(tmp_path / 'bag', messages, 9)
    file = path / 'metadata.yaml'
    file.write_text(file.read_text().replace('version: 9', 'version: 99'))
    with Bag(path, strict=True) as bag:
        assert len(bag.odometry().stamps_ns) == COUNTS['/odom']
        assert any('version 99' in note for note in bag.recording.notes)


# Nothing is modified.


def unfinished(path: Path, messages: list[Message]) -> Path:
    """Write a database whose last messages are still in its log, as after a crash."""
    write_database(path, messages[:-40])
    database = sqlite3.connect(path)
    database.execute('PRAGMA journal_mode=WAL')
    database.execute('PRAGMA wal_autocheckpoint=0')
    ids = dict(database.execute('SELECT name, id FROM topics').fetchall())
    for m in messages[-40:]:
        row = (ids[m.topic], m.receive_ns, m.data)
        database.execute('INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)', row)
    database.commit()
    crashed = path.with_name('crashed.db3')
    for end in ('', '-wal', '-shm'):
        shutil.copyfile(f'{path}{end}', f'{crashed}{end}')
    database.close()
    for end in ('', '-wal', '-shm'):
        Path(f'{path}{end}').unlink(missing_ok=True)
    return crashed


@pytest.mark.parametrize('writable', [True, False])
def test_messages_in_a_leftover_log_are_read(
    writable: bool, tmp_path: Path, messages: list[Message]
) -> None:
    (tmp_path / 'bag').mkdir()
    path = unfinished(tmp_path / 'bag' / 'bag.db3', messages)
    before = snapshot(tmp_path / 'bag')
    if not writable:
        path.parent.chmod(0o500)
    try:
        with Bag(path) as bag:
            assert len(bag.odometry().stamps_ns) == COUNTS['/odom']
            assert any('-wal' in note for note in bag.recording.notes)
    finally:
        path.parent.chmod(0o700)
    assert snapshot(tmp_path / 'bag') == before


def test_an_empty_leftover_log_is_ignored(tmp_path: Path, messages: list[Message]) -> None:
    path = write_database(tmp_path / 'bag.db3', messages)
    for end in ('-wal', '-shm'):
        Path(f'{path}{end}').write_bytes(b'')
    before = snapshot(tmp_path)
    with Bag(path, strict=True) as bag:
        assert len(bag.odometry().stamps_ns) == COUNTS['/odom']
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize('name', ['a?b', 'a#b', 'a%20b', 'ä b'])
def test_odd_names_are_opened(name: str, tmp_path: Path, messages: list[Message]) -> None:
    path = write_rosbags(tmp_path / 'plain', messages)
    path.rename(tmp_path / name)
    with Bag(tmp_path / name, strict=True) as bag:
        assert len(bag.odometry().stamps_ns) == COUNTS['/odom']


# Runs.


def test_images_without_odometry_are_skipped_and_counted(
    tmp_path: Path, messages: list[Message]
) -> None:
    late, early = stamp(2), stamp(9)
    kept = [m for m in messages if m.topic != '/odom' or late <= m.receive_ns - DELAY <= early]
    run = load_run(write_version(tmp_path / 'bag', kept, 5), cache=tmp_path)
    assert run.panoramas.stamps_ns.tolist() == [stamp(i) for i in range(2, 10)]
    (batch,) = run.panoramas.batches(99)
    assert np.array_equal(batch, [image(i) for i in range(2, 10)])
    assert run.counts['images'].as_dict() == {
        'used': 8,
        'skipped': {'no odometry within 0.5 s': 4},
    }


@pytest.mark.parametrize(('distinct', 'used'), [(False, [0, 1, 2, 3, 4, 5]), (True, [0, 3, 5])])
def test_learning_leaves_out_images_that_repeat_the_one_before(
    distinct: bool, used: list[int], tmp_path: Path
) -> None:
    """A driver that was late sends an old image with a new stamp: it shows another place."""
    path = tmp_path / 'bag'
    with BagWriter(path) as bag:
        for index, shown in enumerate((0, 0, 0, 3, 3, 0)):
            bag.image('/image', stamp(index), image(shown), 'camera')
            bag.odometry('/odom', stamp(index), pose(index), (1, 0), (0, 0))
    run = load_run(path, cache=tmp_path / 'cache', distinct=distinct)
    assert run.panoramas.stamps_ns.tolist() == [stamp(i) for i in used]
    skipped = {'image repeats the one before': 3} if distinct else {}
    assert run.counts['images'].as_dict() == {'used': len(used), 'skipped': skipped}


@pytest.mark.parametrize(('tolerance', 'used'), [(0.05, IMAGES // 2), (0.1, IMAGES - 1)])
def test_odometry_tolerance_is_an_argument(
    tolerance: float, used: int, tmp_path: Path, messages: list[Message]
) -> None:
    even = {stamp(i) + DELAY for i in range(0, IMAGES, 2)}
    sparse = [m for m in messages if m.topic != '/odom' or m.receive_ns in even]
    path = write_version(tmp_path / 'bag', sparse, 5)
    run = load_run(path, cache=tmp_path, odometry_tolerance_s=tolerance)
    assert len(run.panoramas) == used


def test_truth_is_read_only_when_wanted(tmp_path: Path, messages: list[Message]) -> None:
    broken = [m._replace(data=b'\xff') if m.topic == '/ground_truth' else m for m in messages]
    path = write_version(tmp_path / 'bag', broken, 5)
    load_run(path, cache=tmp_path, strict=True)
    with pytest.raises(BagError, match='/ground_truth: no usable message'):
        load_run(path, cache=tmp_path, want_truth=True)


def test_one_topic_can_serve_twice(tmp_path: Path, messages: list[Message]) -> None:
    path = write_version(tmp_path / 'bag', messages, 5)
    topics = TopicNames(ground_truth='/odom')
    run = load_run(path, cache=tmp_path, want_truth=True, topics=topics)
    assert run.ground_truth is not None
    np.testing.assert_array_equal(run.ground_truth.poses, run.odometry.poses)


def test_images_are_unwrapped_when_they_are_no_panoramas(
    tmp_path: Path, messages: list[Message]
) -> None:
    path = write_version(tmp_path / 'bag', messages, 5)
    assert load_run(path, cache=tmp_path, unwrap=lambda i: i[:2]).panoramas.shape == SHAPE
    square = tmp_path / 'square'
    with BagWriter(square) as bag:
        for index in range(3):
            bag.image('/image', stamp(index), np.full((20, 20, 3), index, np.uint8), 'camera')
            bag.odometry('/odom', stamp(index), pose(index), (1, 0), (0, 0))
    run = load_run(square, cache=tmp_path, unwrap=lambda i: i[:2])
    assert run.panoramas.shape == (2, 20, 3)


def test_progress_reports_every_image(tmp_path: Path, messages: list[Message]) -> None:
    told: list[tuple[int, int]] = []
    path = write_version(tmp_path / 'bag', messages, 5)
    load_run(path, cache=tmp_path, progress=lambda done, total: told.append((done, total)))
    assert [total for _, total in told] == [IMAGES] * IMAGES
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert told[-1][0] == IMAGES


def test_nothing_is_left_behind_after_an_error(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        for index in range(3):
            bag.image('/image', stamp(index), image(index), 'camera')
            bag.odometry('/odom', stamp(index + 36_000), pose(index), (1, 0), (0, 0))
    with pytest.raises(BagError, match=r'none of 3 images of /image has odometry within 0\.5 s'):
        load_run(tmp_path / 'bag', cache=tmp_path / 'cache')
    assert list((tmp_path / 'cache').iterdir()) == []
