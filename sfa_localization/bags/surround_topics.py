# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Several topics with images of one robot: which cameras they are, and their panoramas as a stream.

Topics belong together if they have one rate, a camera_info each, and optical frames that /tf_static
puts onto the robot, so that each looks in a direction of its own.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from sfa_localization.bags import decoding
from sfa_localization.bags.reader import KINDS, PUBLISHED, Bag
from sfa_localization.bags.static_transforms import Frames
from sfa_localization.bags.topic_stream import Item, Stream, Used
from sfa_localization.camera.calibration_files import calibration_of_info
from sfa_localization.camera.joining import Joined
from sfa_localization.camera.sectors import MountedCamera
from sfa_localization.camera.surround import MOST_CAMERAS, Surround
from sfa_localization.data.errors import BagError, CameraError, MessageError
from sfa_localization.data.image_topics import info_topic, without_transport
from sfa_localization.data.transforms import BASE, TOPIC

BETWEEN = ','
"""Between the names of several topics in an option or parameter."""
PATIENCE = 10
"""Later images for which one is waited: a stream holds an image back until its next one."""
_COUNTED = 10  # messages of each topic that show its rate
_SAME_RATE = 1.5
_SAME_DIRECTION_DEG = 20.0  # between the optical axes of a stereo pair, or of color and depth


def camera_name(topic: str) -> str:
    """The name of a camera by its topic: 'front' for /front/image_raw/compressed."""
    plain = without_transport(topic).strip('/')
    space, _, _ = plain.rpartition('/')
    return space or plain


def topics_of(bag: Bag, named: str) -> dict[str, str]:
    """The topics of several cameras by the names of these, those `named` or all; {} where the bag
    has images of one. Raises BagError.
    """
    names = [name.strip() for name in named.split(BETWEEN) if name.strip()]
    topics = [bag.find('image', name) for name in names]
    topics = topics or [topic.name for topic in bag.candidates('image')]
    return {camera_name(topic): topic for topic in sorted(topics)} if len(topics) > 1 else {}


def topics_like(bag: Bag, named: str, cameras: Sequence[MountedCamera]) -> dict[str, str]:
    """The topics in a bag of the cameras of a model; {} where one topic is `named`, or the bag has
    only panoramas that omnicam_node made of them. Raises BagError.
    """
    if named and BETWEEN not in named:
        return {}
    topics = topics_of(bag, named) or {
        camera_name(topic.name): topic.name for topic in bag.candidates('image')
    }
    if all(map(PUBLISHED.search, topics.values())):
        return {}
    chosen = {c.name: topics[c.name] for c in cameras if c.name in topics}
    if not chosen:
        raise BagError(
            f'{bag.path}: the model was trained with the cameras '
            f'{", ".join(c.name for c in cameras)}, and the bag has images of '
            f'{", ".join(topics) or "none"}: record the same topics'
        )
    return chosen


def cameras_of(bag: Bag, named: str, odometry: str) -> tuple[MountedCamera, ...]:
    """The cameras of a bag that make one panorama, () for a single one. Raises BagError where it
    has several topics of images that do not belong together, or nothing tells how.
    """
    topics = topics_of(bag, named)
    if not topics:
        return ()
    survey = _Survey(bag, [*topics.values()], odometry)
    problems = survey.problems()
    cameras = list[MountedCamera]()
    try:
        cameras += [survey.camera(name, topic) for name, topic in topics.items() if not problems]
    except CameraError as error:
        problems.append(str(error))
    problems = problems or _alike(cameras)
    if problems:
        raise BagError(
            f'{bag.path}: several topics have images: {", ".join(topics.values())}; they make no '
            f'panorama: {"; ".join(problems)}; or choose one with {KINDS["image"].flag}'
        )
    return tuple(cameras)


def _alike(cameras: Sequence[MountedCamera]) -> list[str]:
    """A sentence about cameras that look the same way."""
    least = np.cos(np.radians(_SAME_DIRECTION_DEG))
    return [
        f'{one.name} and {other.name} look the same way'
        for one, other in combinations(cameras, 2)
        if one.ahead @ other.ahead > least
    ]


class _Survey:
    """The first messages of topics with images, of their calibrations, and of the odometry."""

    def __init__(self, bag: Bag, topics: Sequence[str], odometry: str) -> None:
        self._topics = topics
        self._frames = Frames()
        self._base = odometry
        self._infos = dict[str, Any]()
        self._stamps: dict[str, list[int]] = {topic: [] for topic in topics}
        infos = {info_topic(topic) for topic in topics} & set(bag.topics)
        wanted = {TOPIC, odometry, *topics, *infos} & set(bag.topics)
        wanted = {name for name in wanted if decoding.can_decode(bag.topics[name])}
        transforms = bag.topics[TOPIC].count if TOPIC in wanted else 0
        for record, receive_ns, data in bag.messages(wanted):
            name = record.name
            if name in self._stamps:
                self._stamps[name].append(receive_ns)
            if name == TOPIC or name not in {*self._frames.of_topic, *self._infos}:
                with contextlib.suppress(MessageError, AttributeError):
                    self._add(name, decoding.decode(data, record), name in infos)
            counted = min(map(len, self._stamps.values())) >= _COUNTED
            complete = len(self._frames.of_topic) + len(self._infos) >= len(wanted - {TOPIC})
            if counted and complete and self._frames.transforms >= transforms:
                break

    def _add(self, name: str, message: Any, is_info: bool) -> None:
        if is_info:
            self._infos[name] = message
        else:
            self._frames.add(name, message)

    def problems(self) -> list[str]:
        """Why the topics do not belong together, in sentences."""
        texts = []
        if len(self._topics) > MOST_CAMERAS:
            texts.append(f'more than {MOST_CAMERAS} cameras')
        missing = [info for t in self._topics if (info := info_topic(t)) not in self._infos]
        if missing:
            texts.append(f'no {" or ".join(missing)} tells the lens: record camera_info')
        loose = [topic for topic in self._topics if self._pose(topic) is None]
        if loose and not missing:
            frames = ', '.join(self._frames.of_topic.get(t) or 'without a name' for t in loose)
            texts.append(
                f'no {TOPIC} from {self._robot} to {frames} tells where the cameras look: record it'
            )
        steps = {t: np.median(np.diff(at)) for t, at in self._stamps.items() if len(at) > 1}
        if steps and max(steps.values()) > _SAME_RATE * max(min(steps.values()), 1):
            rates = ', '.join(f'{topic} {1e9 / max(s, 1):.0f} Hz' for topic, s in steps.items())
            texts.append(f'their rates differ: {rates}')
        return texts

    @property
    def _robot(self) -> str:
        return self._frames.of_topic.get(self._base) or BASE

    def _pose(self, topic: str) -> Any:
        return self._frames.tree.pose(self._frames.of_topic.get(topic, ''), self._robot)

    def camera(self, name: str, topic: str) -> MountedCamera:
        """The camera of a topic. Raises CameraError for a calibration that cannot be used."""
        try:
            lens = calibration_of_info(self._infos[info_topic(topic)])
        except CameraError as error:
            raise CameraError(f'{info_topic(topic)}: {error}') from None
        return MountedCamera.at(name, lens, self._pose(topic))


class SurroundStream:
    """The images of several topics of a bag as one stream, `panoramas`.

    The topics are read as the streams of `cameras`. Their images are joined by stamp, and `convert`
    makes a value of those of one time.
    """

    def __init__(
        self,
        bag: Bag,
        topics: Mapping[str, str],
        surround: Surround,
        convert: Callable[[Joined], Any],
    ) -> None:
        self.panoramas = Stream(bag.path, BETWEEN.join(topics.values()), convert, bag.strict)
        self.cameras = {name: self._camera(bag, name, topic) for name, topic in topics.items()}
        self._surround = surround
        self._open = len(topics)
        self._receive_ns = 0

    def _camera(self, bag: Bag, name: str, topic: str) -> Stream:
        stream = bag.stream(topic, lambda image: image, required=False)
        stream.passes = functools.partial(self._add, name)
        stream.ends = self._close
        return stream

    def _add(self, name: str, item: Item) -> Iterator[Used]:
        """Take an image of a camera; pass its stamp, and the panoramas that are complete."""
        self._receive_ns = item.receive_ns
        yield self.cameras[name], item.stamp_ns, None
        yield from self._passed(self._surround.join(name, item.stamp_ns, item.value))

    def _close(self) -> Iterator[Used]:
        """Take the end of a camera; at that of the last, pass the rest. Raises BagError where there
        is no panorama.
        """
        self._open -= 1
        if self._open:
            return
        yield from self._passed(self._surround.flush())
        yield from self.panoramas.flush()
        if not self.panoramas.used:
            skipped = [s.skipped for s in (self.panoramas, *self.cameras.values())]
            reasons = ', '.join(f'{n} {why}' for part in skipped for why, n in part.items())
            where = f'{self.panoramas.bag}: {self.panoramas.topic}'
            raise BagError(f'{where}: no panorama ({reasons or "no images"})')

    def _passed(self, joined: Sequence[Joined]) -> Iterator[Used]:
        for images in joined:
            self.panoramas.received += 1
            yield from self.panoramas.take([(images.stamp_ns, images)], self._receive_ns)
