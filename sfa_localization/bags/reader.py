# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Read any ROS 1 or ROS 2 bag: its topics by their use, and their messages as stamped values.

Nothing is lost silently: the messages read are compared with the counts of the bag, and each unused
message is counted with its reason. Bags are never written to.
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
from sfa_localization.bags.satellite_fixes import in_plane
from sfa_localization.bags.settings import BagConfig
from sfa_localization.bags.topic_stream import Stream, Used
from sfa_localization.camera.video import ImageReader
from sfa_localization.data.errors import BagError, DataError, LocalizationError, MessageError
from sfa_localization.data.messages import IMPOSSIBLE_STAMP, NO_STAMP, read_stamp
from sfa_localization.data.rejections import listed
from sfa_localization.data.run import Count, Image, Odometry, Trajectory

PUBLISHED = re.compile(r'/(ekf|sfa)/|/panorama(/compressed)?$')
"""Topics of omnicam_node, sfa_node and ekf_node; an input is preferred to them."""
REMEDY = 'try `mcap recover` on its files, or `ros2 bag reindex`'


class Kind(NamedTuple):
    """The use of a topic: its title in errors, its command line flag, the `usual` types by which it
    is chosen, and the types `accepted` when it is named.
    """

    title: str
    flag: str
    usual: tuple[str, ...]
    accepted: tuple[str, ...]


_IMAGES = decoding.IMAGES
_TRUTH = decoding.STAMPED_POSES
KINDS = {
    'image': Kind('images', '--image-topic', _IMAGES, _IMAGES),
    'odometry': Kind('odometry', '--odom-topic', (decoding.ODOMETRY,), decoding.POSES),
    'imu': Kind('yaw rates', '--imu-topic', (decoding.IMU,), (decoding.IMU,)),
    'points_topic': Kind('measured places', '--points-topic', decoding.PLACES, decoding.PLACES),
    'ground_truth': Kind('true poses', '--ground-truth-topic', _TRUTH, decoding.TRUTHS),
}

STAMP_FAULTS = {
    'duplicate stamp': 'the stamp of the one before, as of drivers that stamp whole seconds',
    IMPOSSIBLE_STAMP: 'stamps of 1e9 nanoseconds or more',
}
"""Why stamps of a topic are unusable, by the reason for which its messages are skipped."""
FAULTY_STAMPS = 2.0
"""Where so many times as many messages are skipped as used, the others have wrong stamps too."""


class Bag:
    """Context manager over one bag: a folder, or a single .db3, .mcap or .bag file.

    `strict` raises for damaged bags and messages instead of counting them. An open bag has all
    `topics` by name, and its `problems` so far. Raises BagError.
    """

    def __init__(
        self, path: Path | str, *, strict: bool = False, config: BagConfig | None = None
    ) -> None:
        self.path = Path(path)
        self.strict = strict
        self._by_header = (config or BagConfig()).stamp_source == 'header'
        self._streams: dict[str, Stream] = {}

    def __enter__(self) -> Bag:
        self.recording = Recording(self.path)
        self.topics = self.recording.topics
        self.problems = self.recording.problems
        self._raise_problems()
        return self

    def __exit__(self, *_: object) -> None:
        self.recording.close()

    @property
    def counts(self) -> dict[str, Count]:
        """Used and rejected messages of each topic read so far."""
        return {topic: stream.count for topic, stream in self._streams.items()}

    def find(self, kind: str, topic: str = '') -> str:
        """Name of the topic of a `kind` (a key of KINDS): the given one, or the only one.

        Raises BagError when it is missing, of another type, or ambiguous.
        """
        wanted = KINDS[kind]
        if topic:
            return self._named(wanted, topic)
        topics = self.candidates(kind)
        if not topics:
            kinds = _short(wanted.usual, ' or ')
            has = self._contents(wanted)
            raise BagError(f'{self.path}: has no {wanted.title} ({kinds}); {has}')
        if len(topics) > 1:
            names = ', '.join(sorted(t.name for t in topics))
            raise BagError(f'{self.path}: several topics have {wanted.title}: {names}; '
                           f'choose one with {wanted.flag}')  # fmt: skip
        return self._readable(topics[0])

    def candidates(self, kind: str) -> list[Topic]:
        """The topics among which that of a `kind` (a key of KINDS) is found."""
        usual = KINDS[kind].usual
        topics = [t for t in self.topics.values() if t.kind in usual and t.count]
        topics = [t for t in topics if not PUBLISHED.search(t.name)] or topics
        return [t for t in topics if t.kind not in decoding.VIDEOS] or topics

    def has(self, kind: str, topic: str = '') -> bool:
        """Whether the topic of a `kind` is named, or one of its usual types has messages."""
        usual = KINDS[kind].usual
        return bool(topic) or any(t.count and t.kind in usual for t in self.topics.values())

    def _named(self, wanted: Kind, name: str) -> str:
        plain, colon, child_frame = name.lstrip('/').partition(':')
        topic = self.topics.get(f'/{plain}') or self.topics.get(plain)
        if topic is None:
            raise BagError(f'{self.path}: has no topic {name}; {self._contents(wanted)}')
        if topic.kind not in wanted.accepted:
            kinds = _short(wanted.accepted, ', ')
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
        names = sorted(f'{t.name} ({_short([t.kind])}, {t.count})' for t in self.topics.values())
        has = listed(names) or 'no topics'
        return f'it has {has}: record one, or name one with {wanted.flag}'

    def images(
        self, topic: str = '', wanted: Callable[[int], bool] = lambda stamp_ns: True
    ) -> Iterator[tuple[int, Image]]:
        """Stamps and images (H, W, 3) BGR, one at a time, of the `wanted` stamps: of others, only
        those of videos are decoded.
        """
        stream = self.stream(self.find('image', topic), lambda image: image)
        stream.wanted = wanted
        return ((at, image) for at, image in self._values(stream) if wanted(at))

    def stamps(self, topic: str) -> Stream:
        """The images of a topic, to be read without decoding them."""
        stream = self.stream(topic, lambda message: None)
        stream.images = None
        return stream

    def trajectory(self, topic: str = '') -> Trajectory:
        """All poses of a topic, by default of the true poses."""
        stream = self.stream(self.find('ground_truth', topic), decoding.true_pose_of)
        values = list(self._values(stream))
        if self.topics[stream.topic].kind == decoding.FIX:
            values = in_plane(values, values[0][1][:2])
        return motion.to_trajectory(values)

    def _values(self, stream: Stream) -> Iterator[tuple[int, Any]]:
        return ((stamp_ns, value) for _, stamp_ns, value in self.read([stream]))

    def to_odometry(self, stream: Stream, values: StampedValues) -> Odometry:
        """Odometry of values; counts faults. Raises BagError for two publishers."""
        try:
            odometry, oddities, faults = motion.to_odometry(values, stream.topic)
        except DataError as error:
            raise BagError(f'{self.path}: {error}') from None
        self.problems += [f'{stream.topic}: {oddity}' for oddity in oddities]
        for reason, number in faults.items():
            stream.skipped.add(reason, number)
            stream.used -= number
        return odometry

    def stream(self, name: str, convert: Callable[[Any], Any], *, required: bool = True) -> Stream:
        """A topic to be read: `convert` is called with images (H, W, 3) BGR, or with messages.

        Of a required TFMessage, '/tf:FRAME' selects a transform; messages of unknown types have the
        value None.
        """
        topic, _, frame = name.partition(':')
        stream = self._streams[topic] = Stream(self.path, topic, convert, self.strict)
        stream.required = required
        stream.opaque = not decoding.can_decode(self.topics[topic])
        if required and self.topics[topic].kind == decoding.TF:
            stream.frame = frame
        if self.topics[topic].kind in decoding.IMAGES:
            stream.images = ImageReader(_short([self.topics[topic].kind]))
        return stream

    def read(self, streams: Iterable[Stream]) -> Iterator[Used]:
        """Read the streams' topics in one pass: stream, stamp in ns, value.

        Raises BagError when a topic has no usable message, or in strict reading on any loss.
        """
        by_topic = dict[str, list[Stream]]()
        receive_ns = 0
        for stream in streams:
            by_topic.setdefault(stream.topic, []).append(stream)
        for record in self.messages(by_topic):
            receive_ns = record[1]
            for stream in by_topic[record[0].name]:
                stream.received += 1
                yield from stream.take(self._parts(stream, *record), receive_ns)
        for stream in itertools.chain(*by_topic.values()):
            if stream.images:
                yield from stream.take(stream.images.finish(), receive_ns)
            yield from stream.flush()
            yield from stream.ends()
            self._check_complete(stream)

    def collect(self, streams: Iterable[Stream]) -> None:
        """Read the `values` of streams in one pass. Raises BagError as `read` does."""
        for stream, stamp_ns, value in self.read(streams):
            stream.values.append((stamp_ns, stream.keep(value)))

    def _parts(
        self, stream: Stream, topic: Topic, receive_ns: int, data: bytes
    ) -> list[tuple[int, Any]]:
        """Stamps, and a message, the images that are complete with it, or the error in it."""
        if stream.opaque:
            return [(receive_ns, None)]
        try:
            part = decoding.decode(data, topic)
            if stream.frame is not None:
                part = decoding.transform_to(stream.frame, part, topic.name)
            if part is None:
                stream.skipped.add('transforms of other frames')
                return []
            header = getattr(part, 'header', None) if self._by_header else None
            stamp_ns = receive_ns if header is None else read_stamp(header.stamp)
            if stream.images is None:
                return [(stamp_ns, part)]
            is_video = topic.kind in decoding.VIDEOS
            return stream.images.add(stamp_ns, part) if is_video or stream.wanted(stamp_ns) else []
        except BagError:
            raise
        except LocalizationError as error:
            return [(receive_ns, error)]

    def messages(self, topics: Iterable[str], start_ns: int = 0) -> Iterator[Record]:
        """Topic, reception in ns and serialized bytes, in the order of recording."""
        for record in self.recording.messages(set(topics), start_ns):
            if record[2][:4] != ZSTD_MAGIC:
                yield record
                continue
            try:
                yield record[0], record[1], inflate_message(record[2])
            except MessageError as error:
                add_problem(self.problems, f'{record[0].name}: {error}')

    def _check_complete(self, stream: Stream) -> None:
        """Compare the messages read with the bag's count; no usable message is an error."""
        expected = self.topics[stream.topic].count
        if stream.received < expected:
            lost = f'{stream.received} of {expected} messages read; {REMEDY}'
            add_problem(self.problems, f'{stream.topic}: {lost}')
            stream.skipped.add('lost in a damaged bag', expected - stream.received)
        self._raise_problems()
        for fault, cause in STAMP_FAULTS.items():
            count = stream.skipped[fault]
            if stream.required and count > FAULTY_STAMPS * stream.used > 0:
                raise BagError(
                    f'{self.path}: {stream.topic}: {count} messages have {cause}: use the time of '
                    'reception (stamp_source: receive)'
                )
        if stream.required and stream.used == 0:
            reasons = ', '.join(f'{n} {why}' for why, n in stream.skipped.items())
            reasons = reasons or 'none recorded'
            remedy = f'; {REMEDY}' if stream.received < expected else ''
            if NO_STAMP in reasons:
                remedy = '; try the time of reception (stamp_source: receive)'
            raise BagError(f'{self.path}: {stream.topic}: no usable message ({reasons}){remedy}')

    def _raise_problems(self) -> None:
        if self.strict and self.problems:
            raise BagError(f'{self.path}: {self.problems[0]}; read without --strict to salvage it')


def _short(kinds: Iterable[str], between: str = '') -> str:
    """Names of types without their package."""
    return between.join(kind.rsplit('/', 1)[-1] for kind in kinds)
