# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""One small drive written as every kind of bag, for the tests."""

import sqlite3
from collections import Counter
from typing import NamedTuple

import numpy as np
import yaml
import zstandard
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.convert.converter import migrate_bytes
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from sfa_localization.bags.decoding import odometry_of
from sfa_localization.bags.writer import BagWriter

START = 1_700_000_000_123_456_789
PERIOD = 100_000_000
DELAY = 5_000_000
IMAGES = 12
PER_IMAGE = 5
SHAPE = (6, 40, 3)
_FOREVER = {'sec': 2147483647, 'nsec': 4294967295}
_QOS = {'history': 1, 'depth': 7, 'reliability': 2, 'durability': 1, 'deadline': _FOREVER,
        'lifespan': _FOREVER, 'liveliness': 1, 'liveliness_lease_duration': _FOREVER,
        'avoid_ros_namespace_conventions': False}  # fmt: skip
QOS_TEXT = yaml.safe_dump([_QOS])


class Message(NamedTuple):
    """A recorded message: reception in ns, CDR bytes."""

    topic: str
    kind: str
    receive_ns: int
    data: bytes


def image(index):
    """The index-th picture of the drive, all different."""
    return np.random.default_rng(index).integers(0, 256, SHAPE, np.uint8)


def stamp(index):
    """Stamp of the index-th picture; fractions for what comes between."""
    return START + round(index * PERIOD)


def pose(index):
    """Where the robot is at the index-th picture: 0.5 m on, turning slowly."""
    return (0.5 * index, -0.25 * index, 0.02 * index)


def drive(path):
    """Record the drive with the writer under test; return it as messages received late."""
    with BagWriter(path / 'drive', 'sqlite3') as bag:
        for index in range(IMAGES):
            bag.image('/image_raw', stamp(index), image(index), 'camera')
            bag.pose('/ground_truth', stamp(index), np.array(pose(index)), 'world')
            for part in range(PER_IMAGE):
                at = index + part / PER_IMAGE
                twist, variance = (5.0, 0.2), (0.04, 0.01)
                bag.odometry('/odom', stamp(at), pose(at), twist, variance)
                bag.imu('/imu', stamp(at), 0.01 * at, 0.09)
        bag.odometry('/odom', stamp(IMAGES), pose(IMAGES), twist, variance)
    with Reader(path / 'drive') as reader:
        return [
            Message(connection.topic, connection.msgtype, receive_ns + DELAY, bytes(data))
            for connection, receive_ns, data in reader.messages()
        ]


COUNTS = {'/image_raw': IMAGES, '/ground_truth': IMAGES, '/imu': IMAGES * PER_IMAGE,
          '/odom': IMAGES * PER_IMAGE + 1}  # fmt: skip


def write_pictures(path, pictures, later=0):
    """Record pictures with odometry, which lags behind by so many of them."""
    with BagWriter(path) as bag:
        for index, picture in enumerate(pictures):
            bag.image('/image', stamp(index), picture, 'camera')
            bag.odometry('/odom', stamp(index + later), pose(index), (1, 0), (0, 0))
    return path


def read_odometry(bag, topic=''):
    """All odometry of an open bag."""
    stream = bag.stream(bag.find('odometry', topic), odometry_of)
    return bag.to_odometry(stream, [(at, value) for _, at, value in bag.read([stream])])


def kinds(messages):
    """Type of each topic."""
    return {message.topic: message.kind for message in messages}


# Files.


def write_rosbags(path, messages, storage='sqlite3'):
    """Write with the newest metadata, as rosbags does."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with BagWriter(path, storage) as writer:
        for m in messages:
            writer.message(m.topic, m.receive_ns, store.deserialize_cdr(m.data, m.kind))
    return path


def write_database(path, messages, *, schema=2, kind=str, serialization='cdr', qos=QOS_TEXT):
    """Write a .db3 as the recorders of the time did: schema 1 has no QoS, 2 has; 3 its version."""
    path.parent.mkdir(parents=True, exist_ok=True)
    database = sqlite3.connect(path)
    database.execute('PRAGMA synchronous=OFF')
    database.executescript(
        'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, '
        'serialization_format TEXT NOT NULL'
        f'{", offered_qos_profiles TEXT NOT NULL" if schema >= 2 else ""});'
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, '
        'timestamp INTEGER NOT NULL, data BLOB NOT NULL);'
        'CREATE INDEX timestamp_idx ON messages (timestamp ASC)'
    )
    if schema >= 3:
        database.execute('CREATE TABLE schema(schema_version INTEGER, ros_distro TEXT)')
        database.execute('INSERT INTO schema VALUES (3, "humble")')
    ids = {topic: number for number, topic in enumerate(kinds(messages), 1)}
    for topic, name in kinds(messages).items():
        row = [ids[topic], topic, kind(name), serialization] + ([qos] if schema >= 2 else [])
        database.execute(f'INSERT INTO topics VALUES ({",".join("?" * len(row))})', row)
    rows = [(ids[m.topic], m.receive_ns, m.data) for m in messages]
    insert = 'INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)'
    database.executemany(insert, rows)
    database.commit()
    database.close()
    return path


def metadata(version, files, messages, *, storage='sqlite3', kind=str, compression=''):
    """Text of metadata.yaml as its version has it, of all that is read."""
    qos = yaml.safe_load(QOS_TEXT) if version >= 9 else QOS_TEXT
    offered = {'offered_qos_profiles': qos} if version >= 4 else {}
    told = [
        {'topic_metadata': {'name': topic, 'type': kind(kinds(messages)[topic]),
                            'serialization_format': 'cdr', **offered}, 'message_count': count}
        for topic, count in Counter(message.topic for message in messages).items()
    ]  # fmt: skip
    first, *_, last = sorted(message.receive_ns for message in messages)
    information = {
        'version': version, 'storage_identifier': storage,
        'relative_file_paths': [f'bag/{file}' if version < 4 else file for file in files],
        'duration': {'nanoseconds': last - first},
        'starting_time': {'nanoseconds_since_epoch': first},
        'message_count': len(messages), 'topics_with_message_count': told,
        'compression_format': 'zstd' if compression else '', 'compression_mode': compression,
    }  # fmt: skip
    return yaml.safe_dump({'rosbag2_bagfile_information': information}, sort_keys=False)


def write_version(path, messages, version):
    """Write a bag as the recorder of metadata `version` did, with sqlite3."""
    schema = 1 if version < 4 else 2 if version < 7 else 3
    write_database(path / 'bag_0.db3', messages, schema=schema)
    (path / 'metadata.yaml').write_text(metadata(version, ['bag_0.db3'], messages))
    return path


def write_mcap(path, messages, *, compression='', index=True, chunk_size=4000):
    """Write an .mcap in chunks, or without (`compression` None), with an index or without."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = ('repeat_channels', 'repeat_schemas', 'use_statistics', 'use_summary_offsets')
    writer = McapWriter(
        str(path),
        chunk_size,
        CompressionType[(compression or 'none').upper()],
        index_types=IndexType.ALL if index else IndexType.NONE,
        use_chunking=compression is not None,
        **dict.fromkeys(names, index),
    )
    writer.start('ros2', 'test')
    channels = {}
    for topic, kind in kinds(messages).items():
        schema = writer.register_schema(kind, 'ros2msg', b'')
        qos = {'offered_qos_profiles': QOS_TEXT}
        channels[topic] = writer.register_channel(topic, 'cdr', schema, qos)
    for m in messages:
        writer.add_message(channels[m.topic], m.receive_ns, m.data, m.receive_ns)
    writer.finish()
    return path


def write_ros1(path, messages, compression='', chunk_size=1 << 20):
    """Write a ROS 1 .bag."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ros2, ros1 = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
    writer, cache = Ros1Writer(path), {}
    writer.chunk_threshold = chunk_size
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression.upper()])
    with writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=ros1)
            for topic, kind in kinds(messages).items()
        }
        for m in messages:
            data = migrate_bytes(
                ros2, ros1, m.kind, m.kind, cache, m.data, src_is2=True, dst_is2=False
            )
            writer.write(connections[m.topic], m.receive_ns, data)
    return path


# Whole bags.


def write_split(path, messages):
    """Write a bag in twelve files, so that names in order are not files in order."""
    size = -(-len(messages) // 12)
    parts = [messages[start : start + size] for start in range(0, len(messages), size)]
    names = [f'bag_{index}.mcap' for index in range(len(parts))]
    for name, part in zip(names, parts, strict=True):
        write_mcap(path / name, part, compression='zstd')
    (path / 'metadata.yaml').write_text(metadata(5, names, messages, storage='mcap'))
    return path


def without_metadata(path):
    (path / 'metadata.yaml').unlink()
    return path


def _packed(path, messages, storage, mode):
    """Compress every message, or every file, as `ros2 bag record --compression-mode` does."""
    if mode == 'MESSAGE':
        messages = [m._replace(data=zstandard.compress(m.data)) for m in messages]
    write, name = (write_mcap, 'bag_0.mcap') if storage == 'mcap' else (write_database, 'bag_0.db3')
    file = write(path / name, messages)
    if mode == 'FILE':
        name += '.zstd'
        (path / name).write_bytes(zstandard.compress(file.read_bytes()))
        file.unlink()
    text = metadata(6, [name], messages, storage=storage, compression=mode)
    (path / 'metadata.yaml').write_text(text)
    return path


def _other_text(path, messages):
    """A bag whose metadata and database tell types and QoS in other words."""
    write_database(path / 'bag_0.db3', messages, qos='')
    text = metadata(4, ['bag_0.db3'], messages, kind=lambda name: name.replace('/msg/', '/'))
    (path / 'metadata.yaml').write_text(text)
    return path


FORMATS = {
    **{f'version {v}': lambda p, m, v=v: write_version(p, m, v) for v in (1, 5, 9)},
    'sqlite3': write_rosbags,
    'sqlite3 zstd file': lambda p, m: _packed(p, m, 'sqlite3', 'FILE'),
    'sqlite3 zstd message': lambda p, m: _packed(p, m, 'sqlite3', 'MESSAGE'),
    'mcap': lambda p, m: write_rosbags(p, m, storage='mcap'),
    'mcap zstd file': lambda p, m: _packed(p, m, 'mcap', 'FILE'),
    'mcap zstd message': lambda p, m: _packed(p, m, 'mcap', 'MESSAGE'),
    'split mcap': write_split,
    'split without metadata': lambda p, m: without_metadata(write_split(p, m)),
    'without metadata': lambda p, m: without_metadata(write_version(p, m, 5)),
    'other text in the metadata': _other_text,
    'lone db3': lambda p, m: write_database(p / 'lone.db3', m),
    'lone mcap': lambda p, m: write_mcap(p / 'lone.mcap', m),
    'lone mcap, zstd': lambda p, m: write_mcap(p / 'lone.mcap', m, compression='zstd'),
    'lone mcap, lz4': lambda p, m: write_mcap(p / 'lone.mcap', m, compression='lz4'),
    'lone mcap, no index': lambda p, m: write_mcap(p / 'lone.mcap', m, index=False),
    'lone mcap, neither': lambda p, m: write_mcap(p / 'a.mcap', m, compression=None, index=False),
    'ROS 1': lambda p, m: write_ros1(p / 'lone.bag', m),
    'ROS 1 bz2': lambda p, m: write_ros1(p / 'lone.bag', m, 'bz2', chunk_size=2000),
    'ROS 1 lz4': lambda p, m: write_ros1(p / 'lone.bag', m, 'lz4'),
}
