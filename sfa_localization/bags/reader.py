# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Read any ROS 1 or ROS 2 bag: its topics by their use, and their messages as stamped values.

Nothing is lost silently: the message counts of the bag are compared with what was read, and every
message that is not used is counted with its reason. Bags are never written to.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sfa_localization.bags import decoding
from sfa_localization.bags import motion_arrays as motion
from sfa_localization.bags.files import ZSTD_MAGIC, Record, Topic, add_problem, inflate_message
from sfa_localization.bags.motion_arrays import StampedValues
from sfa_localization.bags.recording import Recording
from sfa_localization.bags.settings import BagConfig
from sfa_localization.bags.topic_stream import Item, Stream
from sfa_localization.data.errors import BagError, LocalizationError, MessageError
from sfa_localization.data.messages import NO_STAMP, read_yaw_rate
from sfa_localization.data.run import Count, Image, Odometry, Trajectory, YawRate

OWN_TOPICS = re.compile(r'/(ekf|sfa)/|/panorama(/compressed)?$')
"""What omnicam_node, sfa_node and ekf_node publish is no input where others are recorded too."""
REMEDY = 'try `mcap recover` on its files, or `ros2 bag reindex`'
MOST_TOPICS = 8
"""Topics that an error message lists."""


class Kind(NamedTuple):
    """The use of a topic: its title in errors, its command line flag, the types by which it is
    found, and those accepted when it is named.
    """

    title: str
    flag: str
    found: tuple[str, ...]
    named: tuple[str, ...]


_IMAGES, _TRUTH = (decoding.IMAGE, decoding.COMPRESSED), decoding.STAMPED_POSES
KINDS = {
    'image': Kind('images', '--image-topic', _IMAGES, _IMAGES),
    'odometry': Kind('odometry', '--odom-topic', (decoding.ODOMETRY,), decoding.POSES),
    'imu': Kind('yaw rates', '--imu-topic', (decoding.IMU,), (decoding.IMU,)),
    'points_topic': Kind('measured places', '--points-topic', decoding.PLACES, decoding.PLACES),
    'ground_truth': Kind('true poses', '--ground-truth-topic', _TRUTH, decoding.POSES),
}


class Bag:
    """Context manager over one bag: a folder, or a single .db3, .mcap or .bag file.

    `strict` raises for damaged bags and messages instead of counting the losses. An open bag has
    all `topics` by name, and the `problems` found so far. Raises BagError.
    """

    def __init__(
        self, path: Path | str, *, strict: bool = False, config: BagConfig | None = None
    ) -> None:
        self.path, self.strict = Path(path), strict
        self._by_header = (config or BagConfig()).stamp_source == 'header'
        self._streams: dict[str, Stream] = {}

    def __enter__(self) -> Bag:
        self.recording = Recording(self.path)
        self.topics, self.problems = self.recording.topics, self.recording.problems
        self._raise_problems()
        return self

    def __exit__(self, *_: object) -> None:
        self.recording.close()

    @property
    def counts(self) -> dict[str, Count]:
        """Used and rejected messages of each topic read so far."""
        return {topic: stream.count for topic, stream in self._streams.items()}

    def find(self, kind: str, topic: str = '') -> str:
        """Name of the topic that serves as `kind` (a key of KINDS): the named, or the only one.

        Raises BagError when it is missing, of another type, or one of several.
        """
        wanted = KINDS[kind]
        if topic:
            return self._named(wanted, topic)
        found = [t for t in self.topics.values() if t.kind in wanted.found and t.count]
        found = [t for t in found if not OWN_TOPICS.search(t.name)] or found
        if not found:
            kinds = _short(wanted.found, ' or ')
            has = self._contents(wanted)
            raise BagError(f'{self.path}: has no {wanted.title} ({kinds}); {has}')
        if len(found) > 1:
            names = ', '.join(sorted(topic.name for topic in found))
            raise BagError(f'{self.path}: several topics have {wanted.title}: {names}; '
                           f'choose one with {wanted.flag}')  # fmt: skip
        return self._readable(found[0])

    def _named(self, wanted: Kind, name: str) -> str:
        plain, colon, child_frame = name.lstrip('/').partition(':')
        topic = self.topics.get(f'/{plain}') or self.topics.get(plain)
        if topic is None:
            raise BagError(f'{self.path}: has no topic {name}; {self._contents(wanted)}')
        if topic.kind not in wanted.named:
            kinds = _short(wanted.named, ', ')
            raise BagError(f'{self.path}: {topic.name} is {topic.kind or "of unknown type"}, not '
                           f'one of {kinds}; name another with {wanted.flag}')  # fmt: skip
        if topic.count == 0:
            raise BagError(f'{self.path}: {topic.name} has no messages; {self._contents(wanted)}')
        return self._readable(topic) + (colon + child_frame if child_frame else '')

    def _readable(self, topic: Topic) -> str:
        if topic.serialization in decoding.SERIALIZATIONS:
            return topic.name
        raise BagError(f'{self.path}: {topic.name} is serialized as {topic.serialization!r}; '
                       'only cdr can be read: record it so')  # fmt: skip

    def _contents(self, wanted: Kind) -> str:
        """The topics that the bag has, and the remedy."""
        kinds = sorted(f'{t.name} ({_short([t.kind])}, {t.count})' for t in self.topics.values())
        shown = ', '.join(kinds[:MOST_TOPICS] + ['...'] * (len(kinds) > MOST_TOPICS)) or 'no topics'
        return f'it has {shown}: record one, or name one with {wanted.flag}'

    def images(self, topic: str = '') -> Iterator[tuple[int, Image]]:
        """Stamps and images (H, W, 3) BGR, one at a time."""
        return self._values(self.stream(self.find('image', topic), decoding.image_of))

    def odometry(self, topic: str = '') -> Odometry:
        """All odometry; of a topic with poses only, twists are their differences."""
        stream = self.stream(self.find('odometry', topic), decoding.odometry_of)
        return self.to_odometry(stream, list(self._values(stream)))

    def yaw_rate(self, topic: str = '') -> YawRate:
        """All yaw rates of an Imu."""
        stream = self.stream(self.find('imu', topic), read_yaw_rate)
        return motion.to_yaw_rate(list(self._values(stream)))

    def trajectory(self, topic: str = '') -> Trajectory:
        """All poses of a topic, by default of the true poses."""
        stream = self.stream(self.find('ground_truth', topic), decoding.pose_of)
        return motion.to_trajectory(list(self._values(stream)))

    def _values(self, stream: Stream) -> Iterator[tuple[int, Any]]:
        return ((stamp_ns, value) for _, stamp_ns, value in self.read([stream]))

    def to_odometry(self, stream: Stream, values: StampedValues) -> Odometry:
        """Odometry of a stream's values; what is odd about it is noted as a problem."""
        odometry, oddity = motion.to_odometry(values)
        self.problems += [f'{stream.topic}: {oddity}'] if oddity else []
        return odometry

    def stream(self, name: str, convert: Callable[[Any], Any]) -> Stream:
        """A topic to be read; of a TFMessage, '/tf:FRAME' names the transform that is wanted."""
        topic, _, frame = name.partition(':')
        self._streams[topic] = Stream(self.path, topic, convert, self.strict)
        if self.topics[topic].kind == decoding.TF:
            self._streams[topic].frame = frame
        return self._streams[topic]

    def any_stream(self, topic: str, convert: Callable[[Any], Any]) -> Stream:
        """A topic of any type, which may be empty; unknown types have the value None."""
        stream = self._streams[topic] = Stream(self.path, topic, convert, self.strict)
        stream.opaque = not decoding.can_decode(self.topics[topic])
        stream.required = False
        return stream

    def read(self, streams: Iterable[Stream]) -> Iterator[tuple[Stream, int, Any]]:
        """Read the streams' topics in one pass: stream, stamp in ns, value.

        Raises BagError when a topic has no usable message, or in strict reading on any loss.
        """
        by_topic: dict[str, list[Stream]] = {}
        for stream in streams:
            by_topic.setdefault(stream.topic, []).append(stream)
        for record in self.messages(by_topic):
            for stream in by_topic[record[0].name]:
                stream.received += 1
                item = self._item(stream, *record)
                yield from _used(stream, stream.push(item) if item is not None else ())
        for stream in itertools.chain(*by_topic.values()):
            yield from _used(stream, stream.flush())
            self._check_complete(stream)

    def _item(self, stream: Stream, topic: Topic, receive_ns: int, data: bytes) -> Item | None:
        """The stamp and value of a message; None of one that is counted as rejected."""
        if stream.opaque:
            return Item(receive_ns, receive_ns, None)
        try:
            part = decoding.decode(data, topic)
            if stream.frame is not None:
                part = decoding.transform_to(stream.frame, part, topic.name)
            if part is None:
                stream.skipped.add('transforms of other frames')
                return None
            stamp_ns = decoding.header_stamp(part) if self._by_header else None
            return Item(stamp_ns or receive_ns, receive_ns, stream.convert(part))
        except BagError:
            raise
        except LocalizationError as error:
            stream.skip(str(error))
            return None

    def messages(self, topics: Iterable[str], start_ns: int = 0) -> Iterator[Record]:
        """Topic, reception in ns and serialized bytes, as recorded, and in its order."""
        for record in self.recording.messages(set(topics), start_ns):
            if record[2][:4] != ZSTD_MAGIC:
                yield record
                continue
            try:
                yield record[0], record[1], inflate_message(record[2])
            except MessageError as error:
                add_problem(self.problems, f'{record[0].name}: {error}')

    def _check_complete(self, stream: Stream) -> None:
        """Compare the messages read with the bag's own count; no usable message is an error."""
        expected = self.topics[stream.topic].count
        if stream.received < expected:
            lost = f'{stream.received} of {expected} messages read; {REMEDY}'
            add_problem(self.problems, f'{stream.topic}: {lost}')
            stream.skipped.add('lost in a damaged bag', expected - stream.received)
        self._raise_problems()
        if stream.required and stream.used == 0:
            reasons = (
                ', '.join(f'{n} {why}' for why, n in stream.skipped.items()) or 'none recorded'
            )
            remedy = f'; {REMEDY}' if stream.received < expected else ''
            if NO_STAMP in reasons:
                remedy = '; try the time of reception (stamp_source: receive)'
            raise BagError(f'{self.path}: {stream.topic}: no usable message ({reasons}){remedy}')

    def _raise_problems(self) -> None:
        if self.strict and self.problems:
            raise BagError(f'{self.path}: {self.problems[0]}; read without --strict to salvage it')


def _used(stream: Stream, items: Iterable[Item]) -> Iterator[tuple[Stream, int, Any]]:
    for item in items:
        stream.used += 1
        yield stream, item.stamp_ns, item.value


def _short(kinds: Iterable[str], between: str = '') -> str:
    """Names of types without their package."""
    return between.join(kind.rsplit('/', 1)[-1] for kind in kinds)
