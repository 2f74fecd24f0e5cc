# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A bag on disk: its files, its metadata, and the message counts of both.

Not the directory reader of rosbags (0.11.9), because it rejects a bag when one of its files is
missing or its metadata is damaged or newer, opens no compressed file without metadata, and reads
0 of 145 messages, without an error, when metadata and file spell a type differently
(test_bag.py::test_silence_of_a_library_is_an_error).
"""

from __future__ import annotations

import itertools
import os
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path, PurePath

from sfa_localization.bags import mcap, ros1, sqlite
from sfa_localization.bags.storage import (
    ZSTD_MAGIC,
    Channel,
    Record,
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
_SPLIT = r'(.*_)(\d{1,6})(\.[a-z3.]+)'
SUFFIXES = ('.db3', '.mcap', '.bag', '.db3.zstd', '.mcap.zstd')
Storage = mcap.McapStorage | ros1.Ros1Storage | sqlite.SqliteStorage
READERS: dict[bytes, Callable[[Path], Storage]] = {
    sqlite.MAGIC: sqlite.SqliteStorage,
    mcap.MAGIC: mcap.McapStorage,
    ros1.MAGIC: ros1.Ros1Storage,
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
    return sorted(name for name in os.listdir(folder) if name.endswith(SUFFIXES))


@dataclass
class Metadata:
    """The content of metadata.yaml of any version: files, channels, messages per topic."""

    files: list[str]
    version: int = NEWEST_METADATA
    channels: list[Channel] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)


class Recording:
    """The files of a bag opened as one; `path` is a folder, a single file or a metadata.yaml.

    `channels` are by topic, `counts` the messages of each, the larger number of those in the
    metadata and in the files; `notes` are unusual findings that are no damage. Raises BagError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.parent if path.name == METADATA else path
        self.problems, self.notes = list[str](), list[str]()
        self._storages: list[Storage] = []
        self._open = ExitStack()
        metadata = self._read_metadata()
        try:
            self._open_files(metadata.files)
        except BaseException:
            self.close()
            raise
        if not metadata.counts:
            self._storages.sort(key=lambda storage: storage.start_ns)
        self.start_ns = min(storage.start_ns for storage in self._storages)
        stored = sum((Counter(storage.counts) for storage in self._storages), Counter[str]())
        self.counts = metadata.counts | stored
        self.channels = {channel.topic: channel for channel in metadata.channels}
        for channel in (channel for storage in self._storages for channel in storage.channels):
            known = self.channels.get(channel.topic, channel)
            self.channels[channel.topic] = channel._replace(qos=channel.qos or known.qos)

    def close(self) -> None:
        """Release all files."""
        self._open.close()

    def all_problems(self) -> list[str]:
        """Problems of the bag and of its files, so far."""
        return self.problems + [text for storage in self._storages for text in storage.problems]

    def messages(self, topics: Collection[str], start_ns: int = 0) -> Iterator[Record]:
        """Messages of the topics received at or after `start_ns`, file after file."""
        for storage in self._storages:
            yield from storage.messages(topics, start_ns)

    def _read_metadata(self) -> Metadata:
        if not os.path.exists(self.path):
            raise BagError(f'{short_line(str(self.path))}: no such bag; check the path')
        if is_regular(self.path):
            return Metadata([self.path.name])
        if not self.path.is_dir():
            raise BagError(f'{self.path}: is neither a file nor a folder; copy it to a file')
        file = self.path / METADATA
        try:
            found = _bag_files(self.path)
            metadata = parse_metadata(read_regular(file, LONGEST).decode(errors='replace'))
        except FileNotFoundError:
            self.notes.append(f'no {METADATA}; rebuilt from the files')
        except OSError as error:
            raise BagError(f'{file}: cannot be read: {error.strerror or error}') from None
        except ValueError as error:
            self.problems.append(f'{METADATA} is damaged ({error}); rebuilt from the files, as '
                                 '`ros2 bag reindex` does for good')  # fmt: skip
        else:
            for name in sorted(set(found) - set(metadata.files)):
                text = f'{name} is in the folder, but not in {METADATA}: it is not read'
                add_problem(self.problems, text)
            if metadata.version > NEWEST_METADATA:
                self.notes.append(f'{METADATA} has version {metadata.version}, newer than known')
            return metadata
        if not found:
            raise BagError(f'{self.path}: no bag: neither {METADATA} nor .db3, .mcap, .bag')
        numbered = [match for name in found if (match := re.fullmatch(_SPLIT, name))]
        splits = sorted((match[1], int(match[2]), match[3]) for match in numbered)
        for (start, one, end), (other_start, other, _) in itertools.pairwise(splits):
            if start == other_start and other > one + 1:
                text = f'{start}{one + 1}{end} is missing between other files; copy all files'
                add_problem(self.problems, text)
        return Metadata(found)

    def _open_files(self, names: list[str]) -> None:
        """Open each file once. Raises BagError when none can be read."""
        if len(names) > MOST_FILES:
            raise BagError(f'{self.path}: has {len(names)} files, more than {MOST_FILES}')
        failures = ['it has no files']
        for name in dict.fromkeys(names):
            path = self.path / name if self.path.is_dir() else self.path
            try:
                storage = self._open_file(path)
                self._open.callback(storage.close)
                self._storages.append(storage)
            except FileNotFoundError:
                failures.append(f'{path}: is missing; copy all files of the bag')
            except OSError as error:
                failures.append(f'{path}: cannot be read: {error.strerror or error}')
            except BagError as error:
                failures.append(str(error))
        if not self._storages:
            raise BagError(failures[:2][-1])
        for failure in failures[1:]:
            add_problem(self.problems, failure)

    def _open_file(self, path: Path) -> Storage:
        """Open one file, or a decompressed copy, by its first bytes. Raises OSError or BagError."""
        plain = path
        if path.exists() and not is_regular(path):
            raise BagError(f'{path}: is no regular file; copy it to one')
        start = start_of(path, max(map(len, READERS)))
        if not start:
            raise BagError(f'{path}: is empty (0 bytes); record it again')
        if start.startswith(ZSTD_MAGIC):
            folder = self._open.enter_context(tempfile.TemporaryDirectory(prefix='bag-'))
            plain = Path(folder) / path.stem
            damage = inflate_file(path, plain)
            if damage:
                self.problems.append(f'{path.name}: {damage}')
            start = start_of(plain, max(map(len, READERS)))
            if not start:
                raise BagError(f'{path}: {damage}: nothing of it can be read')
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
        version, files = int(tree['version']), map(one_line, tree['relative_file_paths'])
        metadata = Metadata([PurePath(file).name for file in files], version)
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
