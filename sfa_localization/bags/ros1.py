# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bag files of ROS 1 (format 2.0), read by rosbags."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

from rosbags.rosbag1 import Reader

from sfa_localization.bags.storage import Record, make_channel, one_line
from sfa_localization.data.errors import BagError

MAGIC = b'#ROSBAG V'


class Ros1Storage:
    """One .bag file. Raises BagError when it has no index or is damaged."""

    def __init__(self, path: Path) -> None:
        self._path, self.problems, self.notes = path, list[str](), list[str]()
        self._reader = Reader(path)
        try:
            self._reader.open()
        except Exception as error:  # a parser of foreign bytes fails in many ways
            raise BagError(
                f'{path}: unreadable ROS 1 bag ({_text(error)}); repair it with `rosbag reindex`'
            ) from None
        self._connections = list(self._reader.connections)
        self._channels = {
            c.id: make_channel(c.topic, c.msgtype, 'ros1', '') for c in self._connections
        }
        self.channels = list(self._channels.values())
        counts: Counter[str] = Counter()
        for connection in self._connections:
            counts[self._channels[connection.id].topic] += connection.msgcount
        self.counts: dict[str, int] = dict(counts)
        self.start_ns = self._reader.start_time

    def messages(self, topics: Collection[str], start_ns: int) -> Iterator[Record]:
        """Messages by reception, up to the first damage."""
        wanted = [c for c in self._connections if self._channels[c.id].topic in topics]
        if not wanted:
            return
        try:
            for connection, stamp, data in self._reader.messages(wanted, start=start_ns):
                yield self._channels[connection.id], stamp, data
        except Exception as error:  # as above
            self.problems.append(f'{self._path.name}: damaged ({_text(error)}); read up to there')

    def close(self) -> None:
        """Release the file."""
        self._reader.close()


def _text(error: Exception) -> str:
    return one_line(error).rstrip('.') or type(error).__name__
