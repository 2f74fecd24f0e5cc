# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""One small drive written as every kind of bag, by hand or by rosbags, for the tests."""

import io
import sqlite3
import struct
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import lz4.frame
import numpy as np
import yaml
from rosbags.convert.converter import migrate_bytes
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from sfa_localization.bags.writer import RELIABLE, BagWriter

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

START = 1_700_000_000_123_456_789
PERIOD = 100_000_000
DELAY = 5_000_000
IMAGES = 12
PER_IMAGE = 5
SHAPE = (6, 40, 3)
QOS_TEXT = yaml.safe_dump(
    [
        {
            'history': 1,
            'depth': 7,
            'reliability': 2,
            'durability': 1,
            'deadline': {'sec': 2147483647, 'nsec': 4294967295},
            'lifespan': {'sec': 2147483647, 'nsec': 4294967295},
            'liveliness': 1,
            'liveliness_lease_duration': {'sec': 2147483647, 'nsec': 4294967295},
            'avoid_ros_namespace_conventions': False,
        }
    ]
)


class Message(NamedTuple):
    """A recorded message: reception in ns, CDR bytes."""

    topic: str
    kind: str
    receive_ns: int
    data: bytes


def image(index: int) -> np.ndarray:
    """The index-th picture of the drive, all different."""
    return np.random.default_rng(index).integers(0, 256, SHAPE, np.uint8)


def stamp(index: float) -> int:
    """Stamp of the index-th picture; fractions for what comes between."""
    return START + round(index * PERIOD)


def pose(index: float) -> tuple[float, float, float]:
    """Where the robot is at the index-th picture: 0.5 m on, turning slowly."""
    return (0.5 * index, -0.25 * index, 0.02 * index)


def drive(path: Path) -> list[Message]:
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


COUNTS = {
    '/image_raw': IMAGES,
    '/ground_truth': IMAGES,
    '/imu': IMAGES * PER_IMAGE,
    '/odom': IMAGES * PER_IMAGE + 1,
}


def counts(messages: Sequence[Message]) -> dict[str, int]:
    """Messages per topic."""
    topics = [message.topic for message in messages]
    return {topic: topics.count(topic) for topic in dict.fromkeys(topics)}


def kinds(messages: Sequence[Message]) -> dict[str, str]:
    """Type of each topic."""
    return {message.topic: message.kind for message in messages}


# Files.


def write_rosbags(path: Path, messages: Sequence[Message], **options: object) -> Path:
    """Write with rosbags; `storage`, `version`, `compression` (a CompressionMode)."""
    storage = StoragePlugin.MCAP if options.get('storage') == 'mcap' else StoragePlugin.SQLITE3
    writer = Writer(path, version=options.get('version', 9), storage_plugin=storage)
    mode = options.get('compression')
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    store = get_typestore(Stores.ROS2_JAZZY)
    with writer:
        connections = {
            topic: writer.add_connection(
                topic, kind, typestore=store, offered_qos_profiles=[RELIABLE]
            )
            for topic, kind in kinds(messages).items()
        }
        for message in messages:
            writer.write(connections[message.topic], message.receive_ns, message.data)
    return path


def write_database(
    path: Path,
    messages: Sequence[Message],
    *,
    schema: int = 2,
    kind: Callable[[str], str] = str,
    serialization: str = 'cdr',
    qos: str = QOS_TEXT,
) -> Path:
    """Write a .db3 as the recorders of the time did: schema 1 has no QoS, 2 has; 3 its version."""
    path.parent.mkdir(parents=True, exist_ok=True)
    database = sqlite3.connect(path)
    database.execute('PRAGMA synchronous=OFF')
    extra = ', offered_qos_profiles TEXT NOT NULL' if schema >= 2 else ''
    database.execute(
        'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, '
        f'serialization_format TEXT NOT NULL{extra})'
    )
    database.execute(
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, '
        'timestamp INTEGER NOT NULL, data BLOB NOT NULL)'
    )
    database.execute('CREATE INDEX timestamp_idx ON messages (timestamp ASC)')
    if schema >= 3:
        database.execute('CREATE TABLE schema(schema_version INTEGER, ros_distro TEXT)')
        database.execute('INSERT INTO schema VALUES (3, "humble")')
    ids = {topic: number for number, topic in enumerate(kinds(messages), 1)}
    for topic, name in kinds(messages).items():
        row = [ids[topic], topic, kind(name), serialization] + ([qos] if schema >= 2 else [])
        database.execute(f'INSERT INTO topics VALUES ({",".join("?" * len(row))})', row)
    for message in messages:
        row = (ids[message.topic], message.receive_ns, message.data)
        database.execute('INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)', row)
    database.commit()
    database.close()
    return path


def metadata(
    version: int,
    files: Sequence[str],
    messages: Sequence[Message],
    *,
    storage: str = 'sqlite3',
    kind: Callable[[str], str] = str,
    serialization: str = 'cdr',
    qos: str = QOS_TEXT,
    compression: str = '',
    file_counts: Sequence[int] = (),
) -> str:
    """Text of metadata.yaml as its version has it."""
    told = []
    for topic, count in counts(messages).items():
        entry = {'name': topic, 'type': kind(kinds(messages)[topic])}
        entry['serialization_format'] = serialization
        if version >= 4:
            entry['offered_qos_profiles'] = qos if version < 9 else yaml.safe_load(qos or '[]')
        if version >= 7:
            entry['type_description_hash'] = ''
        told.append({'topic_metadata': entry, 'message_count': count})
    receptions = [message.receive_ns for message in messages]
    start = {'nanoseconds_since_epoch': min(receptions)}
    duration = {'nanoseconds': max(receptions) - min(receptions)}
    information = {
        'version': version,
        'storage_identifier': storage,
        'relative_file_paths': [f'bag/{file}' if version < 4 else file for file in files],
        'duration': duration,
        'starting_time': start,
        'message_count': len(messages),
        'topics_with_message_count': told,
    }
    if version >= 3:
        information['compression_format'] = 'zstd' if compression else ''
        information['compression_mode'] = compression
    if version >= 5:
        information['files'] = [
            {'path': file, 'starting_time': start, 'duration': duration, 'message_count': number}
            for file, number in zip(files, file_counts or [len(messages)], strict=True)
        ]
    if version >= 6:
        information['custom_data'] = None
    if version >= 8:
        information['ros_distro'] = 'jazzy'
    return yaml.safe_dump({'rosbag2_bagfile_information': information}, sort_keys=False)


def write_version(path: Path, messages: Sequence[Message], version: int) -> Path:
    """Write a bag as the recorder of metadata `version` did, with sqlite3."""
    schema = 1 if version < 4 else 2 if version < 7 else 3
    write_database(path / 'bag_0.db3', messages, schema=schema)
    (path / 'metadata.yaml').write_text(metadata(version, ['bag_0.db3'], messages))
    return path


# mcap by hand: https://mcap.dev/spec


def _text(text: str | bytes) -> bytes:
    data = text.encode() if isinstance(text, str) else text
    return struct.pack('<I', len(data)) + data


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack('<BQ', opcode, len(body)) + body


def _definitions(messages: Sequence[Message], serialization: str) -> bytes:
    parts = []
    for number, (topic, kind) in enumerate(kinds(messages).items(), 1):
        parts.append(
            _record(3, struct.pack('<H', number) + _text(kind) + _text('ros2msg') + _text(''))
        )
        qos = _text('offered_qos_profiles') + _text(QOS_TEXT)
        body = struct.pack('<HH', number, number) + _text(topic) + _text(serialization) + _text(qos)
        parts.append(_record(4, body))
    return b''.join(parts)


def _bodies(messages: Sequence[Message], all_messages: Sequence[Message]) -> bytes:
    ids = {topic: number for number, topic in enumerate(kinds(all_messages), 1)}
    return b''.join(
        _record(5, struct.pack('<HIQQ', ids[m.topic], 0, m.receive_ns, m.receive_ns) + m.data)
        for m in messages
    )


PACKERS: dict[str, Callable[[bytes], bytes]] = {
    '': bytes,
    'zstd': zstd.compress,
    'lz4': lz4.frame.compress,
}


def write_mcap(
    path: Path,
    messages: Sequence[Message],
    *,
    compression: str | None = '',
    per_chunk: int = 20,
    index: bool = True,
    serialization: str = 'cdr',
) -> Path:
    """Write an .mcap in chunks, or without (`compression` None), with an index or without."""
    path.parent.mkdir(parents=True, exist_ok=True)
    out, chunks = io.BytesIO(), []
    out.write(b'\x89MCAP0\r\n' + _record(1, _text('ros2') + _text('test')))
    definitions = _definitions(messages, serialization)
    if compression is None:
        out.write(definitions + _bodies(messages, messages))
    for start in range(0, len(messages) if compression is not None else 0, per_chunk):
        part = messages[start : start + per_chunk]
        plain = (definitions if start == 0 else b'') + _bodies(part, messages)
        first, last = min(m.receive_ns for m in part), max(m.receive_ns for m in part)
        packed = PACKERS[compression](plain)
        head = struct.pack('<QQQI', first, last, len(plain), 0) + _text(compression)
        record = _record(6, head + struct.pack('<Q', len(packed)) + packed)
        entry = struct.pack('<QQQQ', first, last, out.tell(), len(record)) + struct.pack(
            '<IQ', 0, 0
        )
        chunks.append(_record(8, entry + _text(compression) + struct.pack('<QQ', 0, 0)))
        out.write(record)
    out.write(_record(15, struct.pack('<I', 0)))
    start = out.tell() if index else 0
    if index:
        out.write(definitions + b''.join(chunks) + _statistics(messages, len(chunks)))
    out.write(_record(2, struct.pack('<QQI', start, 0, 0)) + b'\x89MCAP0\r\n')
    path.write_bytes(out.getvalue())
    return path


def _statistics(messages: Sequence[Message], chunks: int) -> bytes:
    told = b''.join(
        struct.pack('<HQ', number, count)
        for number, count in enumerate(counts(messages).values(), 1)
    )
    topics, times = len(kinds(messages)), [message.receive_ns for message in messages]
    head = struct.pack(
        '<QHIIIIQQ', len(messages), topics, topics, 0, 0, chunks, min(times), max(times)
    )
    return _record(11, head + _text(told))


def write_ros1(
    path: Path, messages: Sequence[Message], compression: str = '', chunk_size: int = 1 << 20
) -> Path:
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


def compress_files(folder: Path) -> None:
    """Compress every storage file of a folder as `ros2 bag record --compression-mode file`."""
    for file in [*folder.glob('*.db3'), *folder.glob('*.mcap')]:
        file.with_name(f'{file.name}.zstd').write_bytes(zstd.compress(file.read_bytes()))
        file.unlink()


def compressed_messages(messages: Sequence[Message]) -> list[Message]:
    """Messages as `--compression-mode message` stores them."""
    return [message._replace(data=zstd.compress(message.data)) for message in messages]


def write_split(path: Path, messages: Sequence[Message], storage: str, files: int = 12) -> Path:
    """Write a bag in several files, more than nine, so that names must be sorted by number."""
    size = -(-len(messages) // files)
    names, numbers = [], []
    for index in range(files):
        part = messages[index * size : (index + 1) * size]
        numbers.append(len(part))
        if storage == 'mcap':
            names.append(write_mcap(path / f'bag_{index}.mcap', part, compression='zstd').name)
        else:
            names.append(write_database(path / f'bag_{index}.db3', part).name)
    text = metadata(5, names, messages, storage=storage, file_counts=numbers)
    (path / 'metadata.yaml').write_text(text)
    return path


def _without_metadata(path: Path) -> Path:
    (path / 'metadata.yaml').unlink()
    return path


def _message_mode(path: Path, messages: Sequence[Message], storage: str) -> Path:
    packed = compressed_messages(messages)
    if storage == 'mcap':
        name = write_mcap(path / 'bag_0.mcap', packed).name
    else:
        name = write_database(path / 'bag_0.db3', packed, schema=3).name
    text = metadata(6, [name], messages, storage=storage, compression='MESSAGE')
    (path / 'metadata.yaml').write_text(text)
    return path


def _file_mode(path: Path, messages: Sequence[Message], storage: str) -> Path:
    name = f'bag_0.{"mcap" if storage == "mcap" else "db3"}'
    write = write_mcap if storage == 'mcap' else write_database
    write(path / name, messages)
    text = metadata(5, [f'{name}.zstd'], messages, storage=storage, compression='FILE')
    (path / 'metadata.yaml').write_text(text)
    compress_files(path)
    return path


def _other_text(path: Path, messages: Sequence[Message]) -> Path:
    """A bag whose metadata and database tell types and QoS in other words."""
    write_database(path / 'bag_0.db3', messages, qos='')
    text = metadata(4, ['bag_0.db3'], messages, kind=lambda name: name.replace('/msg/', '/'))
    (path / 'metadata.yaml').write_text(text)
    return path


Format = Callable[[Path, Sequence[Message]], Path]
STORAGE = CompressionMode.STORAGE
FORMATS: dict[str, Format] = {
    **{f'version {v}': lambda p, m, v=v: write_version(p, m, v) for v in range(1, 10)},
    'sqlite3': lambda p, m: write_rosbags(p, m),
    'sqlite3 v8': lambda p, m: write_rosbags(p, m, version=8),
    'sqlite3 zstd file': lambda p, m: write_rosbags(p, m, compression=CompressionMode.FILE),
    'sqlite3 zstd message': lambda p, m: write_rosbags(p, m, compression=CompressionMode.MESSAGE),
    'mcap': lambda p, m: write_rosbags(p, m, storage='mcap'),
    'mcap zstd chunks': lambda p, m: write_rosbags(p, m, storage='mcap', compression=STORAGE),
    'old sqlite3 zstd file': lambda p, m: _file_mode(p, m, 'sqlite3'),
    'mcap zstd file': lambda p, m: _file_mode(p, m, 'mcap'),
    'old sqlite3 zstd message': lambda p, m: _message_mode(p, m, 'sqlite3'),
    'mcap zstd message': lambda p, m: _message_mode(p, m, 'mcap'),
    'split sqlite3': lambda p, m: write_split(p, m, 'sqlite3'),
    'split mcap': lambda p, m: write_split(p, m, 'mcap'),
    'split sqlite3 without metadata': lambda p, m: _without_metadata(write_split(p, m, 'sqlite3')),
    'split mcap without metadata': lambda p, m: _without_metadata(write_split(p, m, 'mcap')),
    'sqlite3 without metadata': lambda p, m: _without_metadata(write_version(p, m, 5)),
    'zstd file without metadata': lambda p, m: _without_metadata(_file_mode(p, m, 'sqlite3')),
    'zstd message without metadata': lambda p, m: _without_metadata(_message_mode(p, m, 'mcap')),
    'other text in the metadata': _other_text,
    'lone db3': lambda p, m: write_database(p / 'lone.db3', m),
    'lone mcap': lambda p, m: write_mcap(p / 'lone.mcap', m),
    'lone mcap, lz4': lambda p, m: write_mcap(p / 'lone.mcap', m, compression='lz4'),
    'lone mcap, no chunks': lambda p, m: write_mcap(p / 'lone.mcap', m, compression=None),
    'lone mcap, no index': lambda p, m: write_mcap(p / 'lone.mcap', m, index=False),
    'lone mcap, neither': lambda p, m: write_mcap(
        p / 'lone.mcap', m, compression=None, index=False
    ),
    'ROS 1': lambda p, m: write_ros1(p / 'lone.bag', m),
    'ROS 1 bz2': lambda p, m: write_ros1(p / 'lone.bag', m, 'bz2'),
    'ROS 1 lz4': lambda p, m: write_ros1(p / 'lone.bag', m, 'lz4'),
}
