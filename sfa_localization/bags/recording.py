# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A bag on disk: its files, its metadata, and the message counts of both.

Not the directory reader of rosbags (0.11.9), because it rejects a bag when one of its files is
missing or its metadata is damaged or newer, opens no compressed file without metadata, and reads
0 of 145 messages, without an error, when metadata and file spell a type differently
(test_bag.py::test_other_words_in_the_metadata_do_not_empty_a_bag).
"""

from __future__ import annotations

import itertools
import os
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

from sfa_localization.bags import mcap as bag_mcap
from sfa_localization.bags import ros1 as bag_ros1
from sfa_localization.bags import sqlite as bag_sqlite
from sfa_localization.bags.storage import (
    MOST_PROBLEMS,
    ZSTD_MAGIC,
    Channel,
    Record,
    Storage,
    add_problem,
    inflate_file,
    make_channel,
    one_line,
)
from sfa_localization.data.errors import BagError
from sfa_localization.data.files import is_regular, read_regular, start_of
from sfa_localization.data.plain_yaml import LONGEST, load_yaml
from sfa_localization.data.rejections import short_line

METADATA = 'metadata.yaml'
NEWEST_METADATA = 9
MOST_FILES = 10_000
"""Files of a bag: a week of a new one every minute."""
SUFFIXES = ('.db3', '.mcap', '.bag', '.db3.zstd', '.mcap.zstd')
READERS: dict[bytes, Callable[[Path], Storage]] = {
    bag_sqlite.MAGIC: bag_sqlite.SqliteStorage,
    bag_mcap.MAGIC: bag_mcap.McapStorage,
    bag_ros1.MAGIC: bag_ros1.open_ros1,
}


def recorded_files(path: Path) -> list[Path]:
    """The files of the bag at a path that is a folder or a metadata.yaml; any other path alone."""
    folder = path.parent if path.name == METADATA else path
    try:
        return [folder / name for name in _bag_files(folder)] + [folder / METADATA]
    except OSError:
        return [path]


def _bag_files(folder: Path) -> list[str]:
    """Names of the files of a folder that can be of a bag. Raises OSError."""
    return [name for name in os.listdir(folder) if name.endswith(SUFFIXES)]


@dataclass
class Metadata:
    """The content of metadata.yaml of any version: files, channels, messages per topic."""

    files: list[str] = field(default_factory=list)
    version: int = NEWEST_METADATA
    channels: list[Channel] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    file_counts: dict[str, int] = field(default_factory=dict)


class Recording:
    """The files of a bag opened as one; `path` is a folder, a single file or a metadata.yaml.

    `channels` are by topic, `declared` and `stored` the messages per topic by the metadata and by
    the files, `problems` the damage, `notes` unusual findings.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.parent if path.name == METADATA else path
        self.problems: list[str] = []
        self.notes: list[str] = []
        self.storages: list[Storage] = []
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.metadata = self._read_metadata()
        try:
            self._open_files()
        except BaseException:
            self.close()
            raise
        self.declared = self.metadata.counts
        self.channels = self._merge_channels()

    def close(self) -> None:
        """Release all files."""
        for storage in self.storages:
            storage.close()
        if self._folder is not None:
            self._folder.cleanup()

    def all_problems(self) -> list[str]:
        """Problems of the bag and of its files, so far."""
        return [*self.problems, *(text for storage in self.storages for text in storage.problems)]

    def stored(self, topic: str) -> int:
        """Messages of a topic by the count of the files."""
        return sum(storage.counts.get(topic, 0) for storage in self.storages)

    def messages(self, topics: Collection[str], start_ns: int = 0) -> Iterator[Record]:
        """Messages of the topics received at or after `start_ns`, file after file."""
        for storage in self.storages:
            yield from storage.messages(topics, start_ns)

    @property
    def start_ns(self) -> int:
        """Reception of the first message."""
        return min(storage.start_ns for storage in self.storages)

    def _read_metadata(self) -> Metadata:
        if not os.path.exists(self.path):
            raise BagError(f'{short_line(str(self.path))}: no such bag; check the path')
        if is_regular(self.path):
            return Metadata([self.path.name])
        if not self.path.is_dir():
            raise BagError(f'{self.path}: is neither a file nor a folder; copy it to a file')
        file = self.path / METADATA
        if not file.exists():
            self.notes.append(f'no {METADATA}; rebuilt from the files')
            return self._rebuilt()
        try:
            metadata = parse_metadata(read_regular(file, LONGEST).decode(errors='replace'))
        except OSError as error:
            raise BagError(f'{file}: cannot be read: {error.strerror or error}') from None
        except ValueError as error:
            self.problems.append(f'{METADATA} is damaged ({error}); rebuilt from the files')
            return self._rebuilt()
        unlisted = sorted(set(self._found()) - set(metadata.files), key=_natural)
        for name in unlisted[:MOST_PROBLEMS]:
            text = f'{name} is in the folder, but not in {METADATA}: it is not read'
            add_problem(self.problems, text)
        if metadata.version > NEWEST_METADATA:
            self.notes.append(f'{METADATA} has version {metadata.version}, newer than known')
        return metadata

    def _rebuilt(self) -> Metadata:
        names = sorted(self._found(), key=_natural)
        if not names:
            raise BagError(f'{self.path}: no bag: neither {METADATA} nor .db3, .mcap, .bag')
        for name in _missing_splits(names):
            add_problem(self.problems, f'{name} is missing between other files; copy all files')
        return Metadata(names)

    def _found(self) -> list[str]:
        """Names of the bag files in the folder. Raises BagError."""
        try:
            return _bag_files(self.path)
        except OSError as error:
            raise BagError(f'{self.path}: cannot be read: {error.strerror}') from None

    def _open_files(self) -> None:
        folder = self.path if self.path.is_dir() else self.path.parent
        failures: list[BagError] = []
        files = list(dict.fromkeys(self.metadata.files))
        if len(files) < len(self.metadata.files):
            self.problems.append(f'{METADATA} lists files twice; each is read once')
        if len(files) > MOST_FILES:
            raise BagError(f'{self.path}: has {len(files)} files, more than {MOST_FILES}')
        for name in files:
            try:
                self._open_file(folder / name)
            except BagError as failure:
                failures.append(failure)
        if not self.storages:
            raise failures[0] if failures else BagError(f'{self.path}: {METADATA} names no files')
        for reason in map(str, failures):
            add_problem(self.problems, reason)
        if not self.metadata.counts:
            self.storages.sort(key=lambda storage: storage.start_ns)

    def _open_file(self, path: Path) -> None:
        """Open one file, of the format in its first bytes. Raises BagError."""
        try:
            storage = open_storage(self._decompressed(path), path)
            self.storages.append(storage)
            self.notes += storage.notes
        except FileNotFoundError:
            count = self.metadata.file_counts.get(path.name)
            lost = f' with {count} messages' if count else ''
            raise BagError(f'{path}: is missing{lost}; copy all files of the bag') from None
        except OSError as error:
            raise BagError(f'{path}: cannot be read: {error.strerror}') from None

    def _decompressed(self, path: Path) -> Path:
        """The file itself, or a decompressed copy of it. Raises OSError, or BagError."""
        if path.exists() and not is_regular(path):
            raise BagError(f'{path}: is no regular file; copy it to one')
        if start_of(path, len(ZSTD_MAGIC)) != ZSTD_MAGIC:
            return path
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix='bag-')
        target = Path(self._folder.name) / path.stem
        damage = inflate_file(path, target)
        if damage and not target.stat().st_size:
            raise BagError(f'{path}: {damage}: nothing of it can be read')
        if damage:
            self.problems.append(f'{path.name}: {damage}')
        return target

    def _merge_channels(self) -> dict[str, Channel]:
        """One channel per topic: by the files, completed by the metadata."""
        merged = {channel.topic: channel for channel in self.metadata.channels}
        for storage in self.storages:
            for channel in storage.channels:
                known = merged.get(channel.topic)
                if known is not None and known.kind and known.kind != channel.kind:
                    text = f'{channel.topic} is {known.kind} and elsewhere {channel.kind}'
                    add_problem(self.notes, text)
                qos = known.qos if known is not None and not channel.qos else channel.qos
                merged[channel.topic] = channel._replace(qos=qos)
        return merged


def _natural(name: str) -> list[Any]:
    """Sorting key that puts bag_10 after bag_2."""
    parts = re.split(r'(\d+)', name)
    return [(int(part), '') if part.isdigit() else (-1, part) for part in parts]


def _missing_splits(names: list[str]) -> list[str]:
    """Files that a recorder must have numbered between the first and the last of the names."""
    numbered: dict[tuple[str, str], set[int]] = {}
    for name in names:
        match = re.fullmatch(r'(.*_)(\d{1,6})(\.[a-z3.]+)', name)
        if match:
            numbered.setdefault((match[1], match[3]), set()).add(int(match[2]))
    gaps = (
        f'{start}{number}{end}'
        for (start, end), known in numbered.items()
        if max(known) - min(known) < 2 * len(known)
        for number in range(min(known), max(known))
        if number not in known
    )
    return list(itertools.islice(gaps, MOST_PROBLEMS))


def open_storage(plain: Path, path: Path) -> Storage:
    """Open a bag file by its first bytes; errors name `path`, from which it was decompressed.

    Raises BagError, or OSError.
    """
    start = start_of(plain, max(map(len, READERS)))
    if not start:
        raise BagError(f'{path}: is empty (0 bytes); record it again')
    for magic, reader in READERS.items():
        if start.startswith(magic):
            try:
                return reader(plain)
            except BagError as error:
                raise BagError(str(error).replace(str(plain), str(path))) from None
    raise BagError(f'{path}: is no bag file: its first bytes are not of sqlite3, mcap or ROS 1')


def parse_metadata(text: str) -> Metadata:
    """Read metadata.yaml of any version. Raises ValueError when it is malformed."""
    try:
        tree = load_yaml(text)['rosbag2_bagfile_information']
        metadata = Metadata(
            version=int(tree['version']),
            files=[PurePath(one_line(file)).name for file in tree['relative_file_paths']],
            file_counts={
                PurePath(str(file['path'])).name: int(file['message_count'])
                for file in tree.get('files') or []
            },
        )
        for entry in tree['topics_with_message_count']:
            topic = entry['topic_metadata']
            qos = topic.get('offered_qos_profiles') or ''
            names = topic['name'], topic['type'], topic['serialization_format']
            channel = make_channel(*names, qos)
            metadata.channels.append(channel)
            metadata.counts[channel.topic] += int(entry['message_count'])
    except KeyError as error:
        raise ValueError(f'it has no {one_line(error.args[0])}') from None
    except (TypeError, AttributeError, OverflowError):
        raise ValueError('its entries are not those of a bag') from None
    return metadata
