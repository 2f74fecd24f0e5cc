# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Record messages as they come, so that a power cut loses at most what was not flushed."""

from __future__ import annotations

import copy
import os
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from typing import IO, Any

import yaml
from mcap.writer import Writer
from rosbags.typesys import Stores

from sfa_localization.bags.decoding import typestore
from sfa_localization.bags.files import McapFile
from sfa_localization.bags.recording import METADATA
from sfa_localization.data.errors import BagError
from sfa_localization.data.files import write_bytes


def files_with_messages(folder: Path) -> list[Path]:
    """The files of a recorded drive that hold something."""
    return sorted(path for path in folder.glob('*.mcap') if path.stat().st_size)


def _end_ns(path: Path) -> int:
    """When the last message in a file was received; 0 if none can be read."""
    with suppress(BagError), closing(McapFile(path, [])) as file:
        return file.end_ns
    return 0


class BagRecorder:
    """Writes serialized messages into a new mcap file in a folder, which becomes a bag of rosbag2.

    The messages that a folder holds already stay: the bag goes on in its next file, and has no
    metadata.yaml then, which `ros2 bag reindex` writes. Files are empty until their first message,
    and empty ones are removed. `end_ns` is the last reception in the folder, or 0. Nothing is
    compressed or gathered in chunks, as by rosbag2's preset `fastwrite`: 10 raw images of
    1280 x 960 a second take 0.26 of a core, 0.33 with chunks, 0.5 with zstd. Raises BagError where
    it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.counts: Counter[str] = Counter()
        self._kinds: dict[str, str] = {}
        self._channels: dict[str, int] = {}
        self._stamps_ns: list[int] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._earlier = files_with_messages(folder)
            self.end_ns = max(map(_end_ns, self._earlier), default=0)
            for path in {*folder.glob('*.mcap')} - {*self._earlier}:
                path.unlink()
            self._path = folder / f'{folder.name}_{len(self._earlier)}.mcap'
            self._file: IO[bytes] = self._path.open('xb')
            self._writer = Writer(self._file, use_chunking=False)
            self._disk = ThreadPoolExecutor(1)
            self._synced: Future[None] | None = None
        except OSError as error:
            raise self._failed(error) from None

    def write(self, topic: str, kind: str, data: bytes, received_ns: int) -> None:
        """Write a message of a type, `data`, as it was serialized."""
        try:
            if not self._channels:
                self._writer.start('ros2', library='sfa_localization')
                (self.folder / METADATA).unlink(missing_ok=True)
            if topic not in self._channels:
                self._channels[topic] = self._channel(topic, kind)
                self._kinds[topic] = kind
            self._writer.add_message(self._channels[topic], received_ns, data, received_ns)
        except OSError as error:
            raise self._failed(error) from None
        self.counts[topic] += 1
        self._stamps_ns = [*self._stamps_ns[:1], received_ns]
        self.end_ns = received_ns

    def flush(self) -> None:
        """Hand to the system what was written so far, and let the disk keep it, which takes its
        time: an error is raised by the next call.
        """
        if not self.counts:
            return
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]
            if self._synced is None or self._synced.done():
                if self._synced is not None:
                    self._synced.result()
                self._synced = self._disk.submit(os.fsync, self._file.fileno())
        except OSError as error:
            raise self._failed(error) from None

    def close(self) -> None:
        """Complete the file, and write the metadata if it is the only one."""
        try:
            with self._file, self._disk:
                if self.counts:
                    self._writer.finish()  # type: ignore[no-untyped-call]
            if not self.counts:
                self._path.unlink()
            elif not self._earlier:
                text = yaml.safe_dump(self._metadata(), sort_keys=False)
                write_bytes(self.folder / METADATA, text.encode(), BagError)
        except OSError as error:
            raise self._failed(error) from None

    def _channel(self, topic: str, kind: str) -> int:
        """The number of a new topic in the file."""
        definition, _ = typestore(Stores.ROS2_JAZZY).generate_msgdef(kind, ros_version=2)
        schema = self._writer.register_schema(kind, 'ros2msg', definition.encode())
        return self._writer.register_channel(topic, 'cdr', schema, {'offered_qos_profiles': ''})

    def _metadata(self) -> dict[str, Any]:
        """What rosbag2 keeps beside the file."""
        stamps_ns = self._stamps_ns or [0]
        start = {'nanoseconds_since_epoch': stamps_ns[0]}
        duration = {'nanoseconds': stamps_ns[-1] - stamps_ns[0]}
        count = self.counts.total()
        file = {'starting_time': start, 'duration': duration, 'message_count': count}
        topics = [
            {
                'topic_metadata': {
                    'name': topic,
                    'type': kind,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': [],
                    'type_description_hash': typestore(Stores.ROS2_JAZZY).hash_rihs01(kind),
                },
                'message_count': self.counts[topic],
            }
            for topic, kind in self._kinds.items()
        ]
        information = {
            'version': 9,
            'storage_identifier': 'mcap',
            'relative_file_paths': [self._path.name],
            **file,
            'topics_with_message_count': topics,
            'compression_format': '',
            'compression_mode': '',
            'files': [{'path': self._path.name, **copy.deepcopy(file)}],
            'custom_data': None,
            'ros_distro': 'jazzy',
        }  # fmt: skip
        return {'rosbag2_bagfile_information': information}

    def _failed(self, error: OSError) -> BagError:
        return BagError(f'{self.folder}: cannot be written: {error.strerror or error}')
