# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bag files of the sqlite3 storage, every schema from ROS 2 Crystal on, damaged ones too."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

from sfa_localization.bags.storage import Channel, Record, make_channel, one_line
from sfa_localization.data.errors import BagError

MAGIC = b'SQLite format 3\x00'


class SqliteStorage:
    """One .db3 file. Raises BagError when not even its list of topics can be read."""

    def __init__(self, path: Path) -> None:
        self._path, self.problems, self.notes = path, list[str](), list[str]()
        self._copy: tempfile.TemporaryDirectory[str] | None = None
        self._database = self._connect()
        try:
            self._by_id = self._read_topics_of_damaged()
        except (sqlite3.Error, ValueError, TypeError) as error:
            self.close()
            raise BagError(f'{path}: no readable bag database ({one_line(error)})') from None
        self.channels = list(self._by_id.values())
        counts = self._guarded(self._read_counts, None)
        self.counts: dict[str, int] = counts if counts is not None else self._count_reachable()
        self.start_ns = self._guarded(self._read_start, 0)

    def _connect(self) -> sqlite3.Connection:
        """Open read-only. Unfinished transactions are completed in a copy, never in place."""
        path, logs = self._path, self._pending_logs()
        if logs:
            self._copy = tempfile.TemporaryDirectory(prefix='bag-')
            path = Path(self._copy.name) / self._path.name
            for file in (self._path, *logs):
                target = path.with_name(file.name)
                shutil.copyfile(file, target)
            self.notes.append(f'{self._path.name}: was not closed; its {logs[0].name} is read, too')
        access = 'mode=rw' if logs else 'mode=ro&immutable=1'
        uri = f'{path.absolute().as_uri()}?{access}'
        return sqlite3.connect(uri, uri=True, check_same_thread=False)

    def _pending_logs(self) -> list[Path]:
        logs = [self._path.with_name(self._path.name + end) for end in ('-wal', '-journal')]
        return [log for log in logs if log.is_file() and log.stat().st_size > 0]

    def _guarded(self, read: Callable[[], Any], otherwise: Any) -> Any:
        try:
            return read()
        except (sqlite3.Error, ValueError, TypeError) as error:
            self._damaged(error)
            return otherwise

    def _damaged(self, error: Exception) -> None:
        text = f'{self._path.name}: damaged database ({one_line(error)}); what is reachable is read'
        if text not in self.problems:
            self.problems.append(text)

    def _columns(self, table: str) -> set[str]:
        return {row[1] for row in self._database.execute(f'PRAGMA table_info({table})')}

    def _read_topics_of_damaged(self) -> dict[int, Channel]:
        """The topics, of a file too that is shorter than its header says."""
        try:
            return self._read_topics()
        except sqlite3.DatabaseError as error:
            self._damaged(error)
            # It makes SQLite go by the file's real length; nothing can be written here.
            self._database.execute('PRAGMA writable_schema=ON')
            return self._read_topics()

    def _read_topics(self) -> dict[int, Channel]:
        columns = self._columns('topics')
        if not columns or not self._columns('messages'):
            raise ValueError('it has no tables of topics and messages')
        qos = 'offered_qos_profiles' if 'offered_qos_profiles' in columns else "''"
        rows = self._database.execute(
            f'SELECT id, name, type, serialization_format, {qos} FROM topics ORDER BY id'
        )
        return {
            int(key): make_channel(topic, kind, serial, qos)
            for key, topic, kind, serial, qos in rows
        }

    def _read_counts(self) -> dict[str, int]:
        counts = {channel.topic: 0 for channel in self.channels}
        query = 'SELECT topic_id, count(*) FROM messages GROUP BY topic_id'
        for key, count in self._database.execute(query):
            if key in self._by_id:
                counts[self._by_id[key].topic] += count
        return counts

    def _count_reachable(self) -> dict[str, int]:
        """Messages per topic by a walk over all rows."""
        counts = {channel.topic: 0 for channel in self.channels}
        last = self._last_row()
        for row in self._rows(range(1, last + 1), 'topic_id'):
            if row[0] in self._by_id:
                counts[self._by_id[row[0]].topic] += 1
        lost = last - sum(counts.values())
        self.problems.append(f'{self._path.name}: {lost} of {last} rows are on damaged pages')
        return counts

    def _rows(self, ids: Iterable[int], columns: str) -> Iterator[tuple[Any, ...]]:
        """Those rows of the messages that can be reached."""
        query = f'SELECT {columns} FROM messages NOT INDEXED WHERE id = ?'
        for row in ids:
            try:
                found = self._database.execute(query, (row,)).fetchone()
            except (sqlite3.Error, OverflowError):
                continue
            if found is not None:
                yield found

    def _read_start(self) -> int:
        (start,) = self._database.execute('SELECT min(timestamp) FROM messages').fetchone()
        return int(start or 0)

    def messages(self, topics: Collection[str], start_ns: int) -> Iterator[Record]:
        """Messages by reception; those on damaged pages are passed over."""
        wanted = {key: channel for key, channel in self._by_id.items() if channel.topic in topics}
        query = (
            'SELECT topic_id, timestamp, data, id FROM messages '
            f'WHERE topic_id IN ({",".join(map(str, wanted))}) AND timestamp >= {start_ns} '
            'ORDER BY timestamp'
        )
        last: tuple[int, int] | None = None
        try:
            for key, stamp, data, row in self._database.execute(query):
                if type(stamp) is int and type(data) is bytes:
                    last = stamp, row
                    yield wanted[key], stamp, data
        except (sqlite3.Error, OverflowError) as error:
            self._damaged(error)
            yield from self._salvaged(wanted, start_ns, last)

    def _salvaged(
        self, wanted: dict[int, Channel], start_ns: int, last: tuple[int, int] | None
    ) -> Iterator[Record]:
        """Row by row what can still be reached, without those up to `last` (stamp, row)."""
        rows = self._rows(range(1, self._last_row() + 1), 'topic_id, timestamp, data, id')
        for key, stamp, data, row in rows:
            if key not in wanted or type(stamp) is not int or type(data) is not bytes:
                continue
            if stamp >= start_ns and (last is None or (stamp, row) > last):
                yield wanted[key], stamp, data

    def _last_row(self) -> int:
        """The last row's number, no more than the file has room for."""
        room = self._path.stat().st_size // 8
        last = self._guarded(
            lambda: self._database.execute('SELECT max(id) FROM messages').fetchone()[0], room
        )
        return min(int(last or 0), room)

    def close(self) -> None:
        """Release the file and a copy made of it."""
        self._database.close()
        if self._copy is not None:
            self._copy.cleanup()
