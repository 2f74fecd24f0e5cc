# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bag files of the sqlite3 storage, every schema from ROS 2 Crystal on, damaged ones too.

Our own queries, because rosbags (0.11.9) opens no file that is cut off, stops at a damaged page and
leaves out the messages of a leftover write-ahead log without an error. Of 13200 messages it reads 0
where the file is cut off at 60 % (here 7692), and 6589 where 4096 bytes in the middle are
overwritten (here 13199): `salvage` in test/benchmarks/bench_bag.py.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

from sfa_localization.bags.storage import (
    MOST_TOPICS,
    Channel,
    Record,
    add_problem,
    make_channel,
    one_line,
)
from sfa_localization.data.errors import BagError

MAGIC = b'SQLite format 3\x00'
_STEPS, _STEPS_PER_BYTE = 50_000_000, 16
"""Instructions of SQLite that one query may take, and more for each byte of the file: reading a row
takes about 20. Damaged pages can lead in circles."""
_STEPS_AT_ONCE = 1 << 16
"""Instructions between two looks at their number."""
_SMALLEST_ROW = 8
"""Bytes of a row without its data."""


class SqliteStorage:
    """One .db3 file. Raises BagError when not even its list of topics can be read."""

    def __init__(self, path: Path) -> None:
        self._path, self.problems, self.notes = path, list[str](), list[str]()
        self._size = path.stat().st_size
        self._copy: tempfile.TemporaryDirectory[str] | None = None
        self._database = self._connect()
        self._steps, self._repeats = 0, False
        self._database.set_progress_handler(self._step, _STEPS_AT_ONCE)
        try:
            self._by_id = self._read_topics_if_cut_off()
        except (sqlite3.Error, ValueError, TypeError) as error:
            self.close()
            raise BagError(f'{path}: no readable bag database ({one_line(error)})') from None
        self.channels = list(self._by_id.values())
        counts = self._or_damaged(self._read_counts, None)
        self.counts: dict[str, int] = counts if counts is not None else self._count_reachable()
        self.start_ns = self._or_damaged(self._read_start, 0)

    def _connect(self) -> sqlite3.Connection:
        """Open read-only. Unfinished transactions are completed in a copy, never in the bag."""
        path = self._path
        logs = [path.with_name(path.name + end) for end in ('-wal', '-journal')]
        logs = [log for log in logs if log.is_file() and log.stat().st_size > 0]
        if logs:
            self._copy = tempfile.TemporaryDirectory(prefix='bag-')
            path = Path(self._copy.name) / self._path.name
            for file in (self._path, *logs):
                target = path.with_name(file.name)
                shutil.copyfile(file, target)
            self._size = sum(file.stat().st_size for file in (self._path, *logs))
            self.notes.append(f'{self._path.name}: was not closed; its {logs[0].name} is read too')
        access = 'mode=rw' if logs else 'mode=ro&immutable=1'
        uri = f'{path.absolute().as_uri()}?{access}'
        return sqlite3.connect(uri, uri=True, check_same_thread=False)

    def _step(self) -> bool:
        """True, which ends the query, when it has taken more steps than the file can be worth."""
        self._steps += _STEPS_AT_ONCE
        return self._is_slow()

    def _is_slow(self) -> bool:
        return self._steps > _STEPS + _STEPS_PER_BYTE * self._size

    def _query(self, text: str, values: tuple[Any, ...] = ()) -> sqlite3.Cursor:
        self._steps = 0
        return self._database.execute(text, values)

    def _or_damaged(self, read: Callable[[], Any], otherwise: Any) -> Any:
        try:
            return read()
        except (sqlite3.Error, ValueError, TypeError) as error:
            self._damaged(error)
            return otherwise

    def _damaged(self, error: Exception) -> None:
        text = f'{self._path.name}: damaged database ({one_line(error)}); intact pages are read'
        add_problem(self.problems, text)

    def _columns(self, table: str) -> set[str]:
        """Columns of a table. Raises ValueError where its rows are not what the file holds.

        A view, a generated column or a default makes any number of bytes of a few.
        """
        query = 'SELECT type, rootpage FROM sqlite_master WHERE name = ? COLLATE NOCASE'
        for kind, page in self._query(query, (table,)):
            if kind != 'table' or not page:
                raise ValueError(f'{table} is a {one_line(kind)} without rows of its own')
        columns = list(self._query(f'PRAGMA table_xinfo({table})'))
        if any(hidden or default is not None for *_, default, _key, hidden in columns):
            raise ValueError(f'{table} has columns that are not stored')
        return {column[1] for column in columns}

    def _read_topics_if_cut_off(self) -> dict[int, Channel]:
        """The topics, even of a file that is shorter than its header states."""
        try:
            return self._read_topics()
        except sqlite3.DatabaseError as error:
            self._damaged(error)
            # Makes SQLite use the real length of the file; the file is open for reading only.
            self._database.execute('PRAGMA writable_schema=ON')
            return self._read_topics()

    def _read_topics(self) -> dict[int, Channel]:
        columns = self._columns('topics')
        if not columns or not self._columns('messages'):
            raise ValueError('it has no tables of topics and messages')
        qos = 'offered_qos_profiles' if 'offered_qos_profiles' in columns else "''"
        rows = self._query(
            f'SELECT id, name, type, serialization_format, {qos} FROM topics ORDER BY id '
            f'LIMIT {MOST_TOPICS + 1}'
        )
        channels = {
            int(key): make_channel(topic, kind, serial, qos)
            for key, topic, kind, serial, qos in rows
        }
        if len(channels) > MOST_TOPICS:
            raise ValueError(f'it has more than {MOST_TOPICS} topics')
        return channels

    def _read_counts(self) -> dict[str, int]:
        counts = {channel.topic: 0 for channel in self.channels}
        query = (
            "SELECT topic_id, count(*), sum(iif(typeof(data) = 'blob', length(data), 0)) "
            'FROM messages GROUP BY topic_id'
        )
        held = 0
        for key, count, size in self._query(query):
            held += size + count * _SMALLEST_ROW
            if key in self._by_id:
                counts[self._by_id[key].topic] += count
        if held > self._size:
            self._repeats = True  # pages that several others lead to: sorting would copy them
            raise sqlite3.DatabaseError('its rows are more than the file holds')
        return counts

    def _count_reachable(self) -> dict[str, int]:
        """Messages per topic, counted row by row."""
        counts = {channel.topic: 0 for channel in self.channels}
        last = self._last_row()
        for row in self._rows(range(1, last + 1), 'topic_id'):
            if row[0] in self._by_id:
                counts[self._by_id[row[0]].topic] += 1
        lost = last - sum(counts.values())
        self.problems.append(f'{self._path.name}: {lost} of {last} rows are on damaged pages')
        return counts

    def _rows(self, ids: Iterable[int], columns: str) -> Iterator[tuple[Any, ...]]:
        """The rows of the messages that are on intact pages."""
        query = f'SELECT {columns} FROM messages NOT INDEXED WHERE id = ?'
        self._steps = 0
        for row in ids:
            try:
                found = self._database.execute(query, (row,)).fetchone()
            except (sqlite3.Error, OverflowError):
                if self._is_slow():
                    return
                continue
            if found is not None:
                yield found

    def _read_start(self) -> int:
        (start,) = self._query('SELECT min(timestamp) FROM messages').fetchone()
        return int(start or 0)

    def messages(self, topics: Collection[str], start_ns: int) -> Iterator[Record]:
        """Messages by reception; those on damaged pages are skipped."""
        wanted = {key: channel for key, channel in self._by_id.items() if channel.topic in topics}
        query = (
            'SELECT topic_id, timestamp, data, id FROM messages '
            f'WHERE topic_id IN ({",".join(map(str, wanted))}) AND timestamp >= {start_ns} '
            "AND typeof(data) = 'blob' ORDER BY timestamp"
        )
        last: tuple[int, int] | None = None
        read = 0
        try:
            for key, stamp, data, row in () if self._repeats else self._query(query):
                if type(stamp) is int and type(data) is bytes:
                    read += len(data) + _SMALLEST_ROW
                    if read > self._size:
                        raise sqlite3.DatabaseError('its rows are more than the file holds')
                    self._steps = 0
                    last = stamp, row
                    yield wanted[key], stamp, data
        except (sqlite3.Error, OverflowError) as error:
            self._damaged(error)
            yield from self._salvaged(wanted, start_ns, last)
        if self._repeats:
            yield from self._salvaged(wanted, start_ns, None)

    def _salvaged(
        self, wanted: dict[int, Channel], start_ns: int, last: tuple[int, int] | None
    ) -> Iterator[Record]:
        """The messages on intact pages, row by row, without those up to `last` (stamp, row)."""
        rows = self._rows(range(1, self._last_row() + 1), 'topic_id, timestamp, data, id')
        read = 0
        for key, stamp, data, row in rows:
            if key not in wanted or type(stamp) is not int or type(data) is not bytes:
                continue
            read += len(data) + _SMALLEST_ROW
            if read > self._size:
                return
            if stamp >= start_ns and (last is None or (stamp, row) > last):
                yield wanted[key], stamp, data

    def _last_row(self) -> int:
        """The number of the last row, limited by the size of the file."""
        room = self._size // _SMALLEST_ROW
        last = self._or_damaged(
            lambda: self._query('SELECT max(id) FROM messages').fetchone()[0], room
        )
        return min(int(last or 0), room)

    def close(self) -> None:
        """Release the file and its copy."""
        self._database.close()
        if self._copy is not None:
            self._copy.cleanup()
