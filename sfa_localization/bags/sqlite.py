# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bag files of the sqlite3 storage, read by rosbags; damaged ones from a copy of what is intact.

rosbags opens no damaged file, leaves out what is in a leftover log without an error, and has no
limits: SQLite itself checks a file before.
"""

from __future__ import annotations

import itertools
import os
import re
import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import Reader

from sfa_localization.bags.storage import (
    MOST_QOS,
    MOST_TOPICS,
    Channel,
    Record,
    add_problem,
    make_channel,
    one_line,
)
from sfa_localization.data.errors import BagError

MAGIC = b'SQLite format 3\x00'
_STEPS, _STEPS_PER_BYTE, _STEPS_AT_ONCE = 50_000_000, 16, 1 << 16
"""Instructions of SQLite for a file, more for each of its bytes, and those between two looks at
their number: a row takes about 20. Damaged pages can lead in circles."""
_LARGEST_GAP = 1 << 40
"""Numbers that are tried after the last row that can be read."""
_ODD_LETTERS = re.compile('[?#%\udc80-\udcff]')
"""What has a meaning in an address of SQLite, or none in UTF-8."""
_PLAIN_TABLE = re.compile(
    r'CREATE TABLE\s+"?\w+"?\s*\(\s*"?id"? INTEGER PRIMARY KEY'
    r'(\s*,\s*"?\w+"? (INTEGER|TEXT|BLOB)( NOT NULL)?)+\s*\)'
)
"""What recorders write. A view, a generated column or a default make any number of bytes of a few,
and so do numbers of topics that are not unique."""


class SqliteStorage:
    """One .db3 file, never written to. Raises BagError when its topics cannot be read."""

    def __init__(self, path: Path) -> None:
        self._path, self.problems, self._open = path, list[str](), ExitStack()
        self._channels: dict[int, Channel] = {}
        counts: Counter[str] = Counter()
        try:
            source = self._completed()
            self._room = source.stat().st_size
            self._reader = self._open.enter_context(Reader(self._sound(source)))
            for key, topic, kind, _, _, count, ext, _ in self._reader.connections:
                assert isinstance(ext, ConnectionExtRosbag2)
                channel = make_channel(
                    topic, kind, ext.serialization_format, ext.offered_qos_profiles
                )
                self._channels[key] = channel
                counts[channel.topic] += count
        except Exception as error:  # a parser of foreign bytes fails in many ways
            self.close()
            raise BagError(f'{path}: no readable bag database ({one_line(error)}); '
                           'try `sqlite3 FILE .recover`') from None  # fmt: skip
        self.channels, self.counts = list(self._channels.values()), dict(counts)
        self.start_ns = self._reader.start_time

    def close(self) -> None:
        """Release the file and its copies."""
        self._open.close()

    def messages(self, topics: Collection[str], start_ns: int) -> Iterator[Record]:
        """Messages received at or after `start_ns`, by reception."""
        channels, room = self._channels, self._room
        wanted = [c for c in self._reader.connections if channels[c.id].topic in topics]
        try:
            messages = self._reader.messages(wanted, start_ns) if wanted else ()
            for connection, stamp, data in messages:
                room -= len(data)
                if room < 0:
                    raise ValueError('its rows are more than the file holds')
                if type(data) is bytes:
                    yield channels[connection.id], stamp, data
        except Exception as error:  # as above
            text = f'damaged database ({one_line(error)}); read up to the damage'
            add_problem(self.problems, f'{self._path.name}: {text}')

    def _copy_name(self) -> Path:
        """A name in a folder that is removed when the file is closed."""
        folder = self._open.enter_context(tempfile.TemporaryDirectory(prefix='bag-'))
        return Path(folder) / 'copy.db3'

    def _completed(self) -> Path:
        """The file, or a copy: with what is in the logs of a recorder that crashed, in whole pages.

        Of a page that was cut off, SQLite would take the rest for zeros.
        """
        with self._path.open('rb') as file:
            page = int.from_bytes(file.read(18)[16:], 'big')
        size = _size(self._path)
        whole = size - size % (page if page > 1 else 1 << 16)
        ends = [end for end in ('-wal', '-journal') if _size(Path(f'{self._path}{end}'))]
        if not ends and whole == size:
            return self._path
        copy = self._copy_name()
        for end in ('', *ends):
            shutil.copyfile(f'{self._path}{end}', f'{copy}{end}')
        os.truncate(copy, whole)
        if ends:
            with closing(sqlite3.connect(copy)) as database:
                database.execute('PRAGMA journal_mode=DELETE').fetchall()
        return copy

    def _sound(self, source: Path) -> Path:
        """A path that rosbags can read, perhaps of a copy. Raises sqlite3.Error or ValueError."""
        address = f'{source.absolute().as_uri()}?mode=ro&immutable=1'
        with closing(sqlite3.connect(address, uri=True)) as database:
            spent, most = itertools.count(), _STEPS + _STEPS_PER_BYTE * self._room
            database.set_progress_handler(
                lambda: next(spent) * _STEPS_AT_ONCE > most, _STEPS_AT_ONCE
            )
            reason = _damage(database)
            if not reason and source.suffix == '.db3' and not _ODD_LETTERS.search(str(source)):
                return source
            copy = self._copy_name()
            if not reason:  # but a name that is no part of an address
                copy.symlink_to(source.absolute())
                return copy
            # Makes SQLite use the real length of the file; the file is open for reading only.
            database.execute('PRAGMA writable_schema=ON')
            _require_plain_tables(database)
            _copy_rows(database, copy, self._room)
        text = f'{self._path.name}: damaged database ({reason}); intact pages are read'
        self.problems.append(f'{text}; `sqlite3 FILE .recover` repairs it')
        return copy


def _size(path: Path) -> int:
    """Bytes of a file, 0 where there is none."""
    return path.stat().st_size if path.is_file() else 0


def _damage(database: sqlite3.Connection) -> str:
    """What is wrong with the pages of a database; '' for nothing."""
    try:
        _require_plain_tables(database)
        sound = database.execute('PRAGMA quick_check(1)').fetchall() == [('ok',)]
        return '' if sound else 'damaged pages'
    except sqlite3.DatabaseError as error:
        return one_line(error)


def _require_plain_tables(database: sqlite3.Connection) -> None:
    """Raise ValueError where rows are other than a recorder writes them."""
    query = 'SELECT sql FROM sqlite_master WHERE name = ? COLLATE NOCASE'
    for table in ('topics', 'messages'):
        found = database.execute(query, (table,)).fetchone()
        if found is None or not _PLAIN_TABLE.fullmatch(str(found[0])):
            raise ValueError(f'it has no table of {table} as recorders write it')
    topics = database.execute('SELECT * FROM topics').fetchmany(MOST_TOPICS + 1)
    if len(topics) > MOST_TOPICS:
        raise ValueError(f'it has more than {MOST_TOPICS} topics')
    if sum(len(str(value)) for row in topics for value in row) > MOST_QOS:
        raise ValueError(f'its topics have more than {MOST_QOS} characters')


def _copy_rows(database: sqlite3.Connection, target: Path, room: int) -> None:
    """Copy the rows on intact pages, topics without QoS. Raises sqlite3.Error without topics."""
    topics = database.execute('SELECT id, name, type, serialization_format FROM topics').fetchall()
    with closing(sqlite3.connect(target)) as copy, copy:
        copy.execute('CREATE TABLE topics(id, name, type, serialization_format)')
        copy.execute('CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)')
        copy.execute('CREATE INDEX timestamp_idx ON messages (timestamp ASC)')
        copy.executemany('INSERT INTO topics VALUES(?, ?, ?, ?)', topics)
        copy.executemany('INSERT INTO messages VALUES(?, ?, ?, ?)', _rows(database, room))


def _rows(database: sqlite3.Connection, room: int) -> Iterator[tuple[Any, ...]]:
    """The messages on intact pages, by number; after damage with gaps that double."""
    query = (
        'SELECT id, topic_id, timestamp, data FROM messages NOT INDEXED '
        "WHERE id >= ? AND typeof(data) = 'blob' AND typeof(timestamp) = 'integer' ORDER BY id"
    )
    at, gap = 0, 1
    while gap < _LARGEST_GAP:
        try:
            for row in database.execute(query, (at,)):
                room -= len(row[3])
                if row[0] < at or room < 0:  # pages that several others lead to
                    return
                yield row
                at, gap = row[0] + 1, 1
            return
        except sqlite3.DatabaseError:
            at, gap = at + gap, 2 * gap
