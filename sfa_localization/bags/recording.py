# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A bag on disk: its files, its metadata, and the message counts of both.

The directory reader of rosbags (0.11.9) rejects a bag with a missing file or newer metadata, and
reads no message, without an error, where metadata and file spell a type differently
(test_bag.py::test_silence_of_a_library_is_an_error).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory

from sfa_localization.bags.files import (
    READERS,
    ZSTD_MAGIC,
    Record,
    StoredFile,
    Topic,
    describe,
    inflate_file,
    make_topic,
)
from sfa_localization.data.errors import BagError
from sfa_localization.data.files import first_bytes, read_regular
from sfa_localization.data.plain_yaml import LONGEST, load_yaml
from sfa_localization.data.rejections import listed, short_line

METADATA = 'metadata.yaml'
SUFFIXES = ('.db3', '.mcap', '.bag', '.db3.zstd', '.mcap.zstd')


def recorded_files(path: Path) -> list[Path]:
    """The files of a bag, if the path is its folder or its metadata.yaml; else the path."""
    folder = path.parent if path.name == METADATA else path
    try:
        return [folder / name for name in _bag_files(folder)] + [folder / METADATA]
    except OSError:
        return [path]


def is_bag(path: Path) -> bool:
    """Whether a path has the name of a bag's file, or is a folder with a file of a bag."""
    files = path.glob('*') if path.is_dir() else [path]
    return any(file.name.endswith((*SUFFIXES, METADATA)) for file in files)


def _bag_files(folder: Path) -> list[str]:
    """Names of the files of a folder with suffixes of bags. Raises OSError."""
    return sorted(name for name in os.listdir(folder) if name.endswith(SUFFIXES))


class Recording:
    """The files of a bag opened as one; `path` is a folder, a single file or a metadata.yaml.

    `topics` are by name, each with the larger of its counts in metadata and files; `notes` are
    oddities without damage. Raises BagError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.parent if path.name == METADATA else path
        self.problems = list[str]()
        self.notes = list[str]()
        self._files: list[StoredFile] = []
        self._open = ExitStack()
        names, topics = self._read_metadata()
        try:
            self._open_files(names)
        except BaseException:
            self.close()
            raise
        if not topics:
            self._files.sort(key=lambda file: file.start_ns)
        self.start_ns = min(file.start_ns for file in self._files)
        stored: Counter[str] = Counter()
        self.topics = {topic.name: topic for topic in topics}
        for topic in (topic for file in self._files for topic in file.topics.values()):
            stored[topic.name] += topic.count
            declared = self.topics.get(topic.name, topic)
            count = max(declared.count, stored[topic.name])
            self.topics[topic.name] = replace(topic, qos=topic.qos or declared.qos, count=count)

    def close(self) -> None:
        """Release all files."""
        self._open.close()

    def messages(self, names: Collection[str], start_ns: int = 0) -> Iterator[Record]:
        """Messages of the topics received at or after `start_ns`, file after file."""
        for file in self._files:
            yield from file.messages(names, start_ns)

    def _read_metadata(self) -> tuple[list[str], list[Topic]]:
        """Names of the files, and the topics in the metadata."""
        if not os.path.exists(self.path):
            raise BagError(f'{short_line(str(self.path))}: no such bag; check the path')
        if os.path.isfile(self.path):
            return [self.path.name], []
        if not self.path.is_dir():
            raise BagError(f'{self.path}: is neither a file nor a folder; copy it to a file')
        file = self.path / METADATA
        try:
            files = _bag_files(self.path)
            names, topics = parse_metadata(read_regular(file, LONGEST).decode(errors='replace'))
            self.problems += [
                f'{name} is in the folder, but not in {METADATA}: it is not read'
                for name in sorted(set(files) - set(names))
            ]
            return names, topics
        except FileNotFoundError:
            self.notes.append(f'no {METADATA}; rebuilt from the files')
        except OSError as error:
            raise BagError(f'{file}: cannot be read: {error.strerror or error}') from None
        except ValueError as error:
            self.problems.append(f'{METADATA} is damaged ({error}); rebuilt from the files, as '
                                 '`ros2 bag reindex` does for good')  # fmt: skip
        if not files:
            inside = [path.name for path in self.path.glob('*') if path.is_dir() and is_bag(path)]
            if inside:
                bags = listed(sorted(inside))
                raise BagError(f'{self.path}: is no bag; it holds the bags {bags}: name them')
            raise BagError(f'{self.path}: no bag: neither {METADATA} nor .db3, .mcap, .bag')
        return files, []

    def _open_files(self, names: list[str]) -> None:
        """Open each file once. Raises BagError when none can be read."""
        failures = []
        for name in dict.fromkeys(names):
            path = self.path / name if self.path.is_dir() else self.path
            try:
                file = self._open_file(path)
                self._open.callback(file.close)
                self._files.append(file)
            except (OSError, ValueError) as error:
                failures.append(f'{path}: cannot be read: {describe(error)}')
            except BagError as error:
                failures.append(str(error))
        if not self._files:
            raise BagError(next(iter(failures), f'{self.path}: its {METADATA} names no file'))
        self.problems += failures

    def _open_file(self, path: Path) -> StoredFile:
        """Open one file, or a decompressed copy, by its first bytes. Raises OSError or BagError."""
        plain = path
        damage = ''
        if not path.exists():
            raise BagError(f'{path}: is missing; copy all files of the bag')
        if not path.is_file():
            raise BagError(f'{path}: is no regular file; copy it to one')
        if first_bytes(path, len(ZSTD_MAGIC)) == ZSTD_MAGIC:
            folder = self._open.enter_context(TemporaryDirectory(prefix='bag-'))
            plain = Path(folder) / path.stem
            if damage := inflate_file(path, plain):
                self.problems.append(f'{path.name}: {damage}')
        start = first_bytes(plain, 16)
        if not start:
            raise BagError(f'{path}: holds nothing ({damage or "0 bytes"}); record it again')
        for magic, reader in READERS.items():
            if start.startswith(magic):
                try:
                    return reader(plain, self.problems)
                except BagError as error:
                    raise BagError(str(error).replace(str(plain), str(path))) from None
        raise BagError(f'{path}: is no bag file: its first bytes are not of sqlite3, mcap or ROS 1')


def parse_metadata(text: str) -> tuple[list[str], list[Topic]]:
    """Names of the files, and topics, in a metadata.yaml of any version. Raises ValueError."""
    try:
        tree = load_yaml(text)['rosbag2_bagfile_information']
        names = [PurePath(str(file)).name for file in tree['relative_file_paths']]
        topics = []
        for entry in tree['topics_with_message_count']:
            topic = entry['topic_metadata']
            qos = topic.get('offered_qos_profiles') or ''
            fields = topic['name'], topic['type'], topic['serialization_format'], qos
            topics.append(make_topic(*fields, entry['message_count']))
    except KeyError as error:
        raise ValueError(f'it has no {short_line(str(error.args[0]))}') from None
    except (TypeError, AttributeError, OverflowError):
        raise ValueError('it does not describe a bag') from None
    return names, topics
