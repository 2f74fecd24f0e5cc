# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Replay a bag through rclpy, where `ros2 bag play` is not installed.

Messages are published as the recorded bytes, with their topics, types and QoS; header stamps are
unchanged; the time of reception sets the pace.
"""

from __future__ import annotations

import importlib
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException, NotInitializedException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.signals import SignalHandlerOptions
from rosbags.convert.converter import migrate_bytes
from rosbags.interfaces import Qos, QosDurability, QosLiveliness, QosReliability, QosTime
from rosbags.typesys import Stores
from rosgraph_msgs.msg import Clock

from sfa_localization.bags.decoding import COMPRESSED, IMAGE, ODOMETRY, typestore
from sfa_localization.bags.files import Topic
from sfa_localization.bags.reader import Bag
from sfa_localization.commands.pace import (
    FASTER,
    PAUSE,
    SLOWER,
    STEP,
    Keyboard,
    Pace,
    PlayConfig,
)
from sfa_localization.data.errors import BagError
from sfa_localization.data.rejections import encodable

DEPTH = 10  # of a publisher's queue, in messages
LATCHED_DEPTH = 100  # of the queue that late subscribers receive, in messages
KEY_WAIT_S = 0.05  # longest wait for a key before /clock and ROS are checked again
SETTLED_S = 0.5  # without a new subscriber: all nodes of the chain have started
RATE_STEP = 1.1  # one press of a key: 10 % faster or slower
CLOCK_RATE_HZ = 40.0  # of /clock: a period of 25 ms, as `ros2 bag play --clock` has
FOREVER_S = 9223372036  # rmw's infinite duration


@dataclass
class Played:
    """Result of a replay: messages per topic, and topics left out with the reason."""

    messages: Counter[str] = field(default_factory=Counter)
    skipped: dict[str, str] = field(default_factory=dict)


def play(
    path: Path | str,
    *,
    config: PlayConfig | None = None,
    loop: bool = False,
    clock: bool = False,
    topics: Collection[str] = (),
    wait_for: Collection[str] = (),
    context: Context | None = None,
    strict: bool = False,
) -> Played:
    """Replay a bag until its end, or until its context is shut down; Ctrl-C raises.

    `topics` limits it to those named. It starts when the topics of `wait_for` have subscribers
    (none named: when images and odometry have some and the number is stable), or after the
    configured wait. `context` must be initialized; by default one is created. Raises BagError.
    """
    played = Played()
    with _initialized(context) as ros, Bag(path, strict=strict) as bag, Keyboard() as keyboard:
        try:
            with _node(ros) as node:
                player = Player(node, bag, config or PlayConfig(), keyboard, clock, topics)
                played = player.played
                player.wait_for_subscribers(wait_for)
                player.play(loop)
        except (RuntimeError, NotInitializedException):  # of rclpy, while it is shut down
            if ros.ok():
                raise
    return played


@contextmanager
def _initialized(context: Context | None) -> Iterator[Context]:
    """The context, or a new one that is shut down afterwards."""
    if context is not None:
        yield context
        return
    context = Context()
    # No arguments: among those of the command may be a name that is not UTF-8.
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.ALL)
    try:
        yield context
    finally:
        rclpy.try_shutdown(context=context)


@contextmanager
def _node(context: Context) -> Iterator[Node]:
    """A node, destroyed afterwards."""
    node = Node('bag_player', context=context, start_parameter_services=False)
    try:
        yield node
    finally:
        node.destroy_node()


class Player:
    """Publishes the messages of an open bag from a node, at the pace they were received."""

    def __init__(
        self,
        node: Node,
        bag: Bag,
        config: PlayConfig,
        keyboard: Keyboard,
        clock: bool = False,
        topics: Collection[str] = (),
    ) -> None:
        self._node, self._bag, self._config, self._keyboard = node, bag, config, keyboard
        self.played = Played()
        self._publishers: dict[str, Publisher] = {}
        for topic in self._chosen(topics):
            self._advertise(topic)
        if not self._publishers:
            reasons = '; '.join(f'{t}: {why}' for t, why in self.played.skipped.items())
            raise BagError(f'{bag.path}: no topic can be played ({reasons or "it has none"})')
        self._ticker = Ticker(node, CLOCK_RATE_HZ) if clock else None
        self._start_ns = bag.recording.start_ns + int(config.start_offset * 1e9)
        if next(bag.messages(self._publishers, self._start_ns), None) is None:
            raise BagError(f'{bag.path}: nothing to play after {config.start_offset:g} s')
        self.pace = Pace(self._start_ns, config.rate)
        self._convert = Ros1Converter()

    def _chosen(self, names: Collection[str]) -> list[Topic]:
        topics = self._bag.topics
        for name in names:
            if name not in topics:
                known = ', '.join(sorted(topics))
                raise BagError(f'{self._bag.path}: has no topic {name}; --topics can be: {known}')
        return [topics[name] for name in names or topics]

    def _advertise(self, topic: Topic) -> None:
        """Create the topic's publisher, or record why it is left out."""
        kind = message_class(topic.kind)
        if topic.serialization not in ('cdr', 'ros1'):
            self._leave_out(topic, f'is serialized as {topic.serialization!r}')
        elif kind is None:
            self._leave_out(topic, f'type {topic.kind or "unknown"} is not installed')
        else:
            try:
                publisher = self._node.create_publisher(kind, topic.name, qos_profile(topic.qos))
                self._publishers[topic.name] = publisher
            except InvalidTopicNameException:
                self._leave_out(topic, 'is not a valid topic name')

    def _leave_out(self, topic: Topic, reason: str) -> None:
        self.played.skipped[topic.name] = reason
        self._node.get_logger().warning(f'not played: {topic.name}: {reason}')

    def wait_for_subscribers(self, topics: Collection[str] = ()) -> bool:
        """Wait until the topics have subscribers; False if they do not appear in time.

        None named: until images and odometry have some, and the number is stable.
        """
        needed = self._needed(topics)
        deadline, settled = Pace(0, 1.0), Pace(0, 1.0)
        last = 0
        while deadline.time_ns < self._config.wait * 1e9 and self._alive():
            count = sum(p.get_subscription_count() for p in self._publishers.values())
            met = all(any(p.get_subscription_count() for p in group) for group in needed.values())
            if topics and met:
                return True
            if count != last:
                last = count
                settled.jump(0)
            if not topics and met and count and settled.time_ns > SETTLED_S * 1e9:
                return True
            self._keyboard.read(KEY_WAIT_S)
        missing = [name for name, group in needed.items()
                   if not any(p.get_subscription_count() for p in group)]  # fmt: skip
        if missing and self._alive() and self._config.wait:
            self._node.get_logger().warning(
                f'no subscriber of {" and ".join(missing)} after {self._config.wait:g} s: '
                'playing anyway (--wait sets the time)'
            )
        return False

    def _needed(self, topics: Collection[str]) -> dict[str, list[Publisher]]:
        """Groups of publishers, by name; at least one of each group needs a subscriber."""
        if topics:
            return {name: [self._publishers[name]] for name in topics if name in self._publishers}
        kinds = {'images': (IMAGE, COMPRESSED), 'odometry': (ODOMETRY,)}
        known = self._bag.topics
        found = {
            what: [made for name, made in self._publishers.items() if known[name].kind in kind]
            for what, kind in kinds.items()
        }
        return {what: group for what, group in found.items() if group}

    def play(self, loop: bool = False) -> Played:
        """Publish the bag, repeatedly with `loop`, until ROS shuts down."""
        if self._keyboard.attached:
            self._node.get_logger().info('space: pause, right arrow or s: one message, '
                                         'up and down: faster and slower')  # fmt: skip
        while True:
            self.pace.jump(self._start_ns)
            if not self._play_once():
                return self.played
            if not loop:
                self._await_acknowledgement()
                self._report()
                return self.played

    def _play_once(self) -> bool:
        """Publish the bag from its start; False when ROS was shut down."""
        for topic, receive_ns, data in self._bag.messages(self._publishers, self._start_ns):
            if not self._wait_until(receive_ns):
                return False
            if topic.serialization == 'ros1':
                data = self._convert(data, topic.kind)
            self._publishers[topic.name].publish(bytes(data))
            self.played.messages[topic.name] += 1
        return True

    def _wait_until(self, stamp_ns: int) -> bool:
        """Wait until a message is due, handling keys and /clock; False when ROS was shut down."""
        checked = False
        while self._alive():
            if self._ticker is not None:
                self._ticker.tick(self.pace.time_ns)
            delay = self.pace.delay(stamp_ns)
            if delay <= 0 and checked:
                return True
            checked = True
            longest = min(KEY_WAIT_S, self._ticker.period) if self._ticker else KEY_WAIT_S
            if self._apply_key(self._keyboard.read(min(max(delay, 0.0), longest)), stamp_ns):
                return True
        return False

    def _apply_key(self, key: str, stamp_ns: int) -> bool:
        """Apply the action of a key; True when it requests the next message now."""
        if key == PAUSE:
            self.pace.toggle_pause()
        elif key == FASTER:
            self.pace.scale(RATE_STEP)
        elif key == SLOWER:
            self.pace.scale(1 / RATE_STEP)
        elif key == STEP and self.pace.paused:
            self.pace.jump(stamp_ns)
            return True
        return False

    def _alive(self) -> bool:
        return bool(self._node.context.ok())

    def _report(self) -> None:
        """Warn of damage in the bag, and of messages that could not be read."""
        problems = list(self._bag.problems)
        for name in self._publishers if self._config.start_offset == 0 else ():
            played, expected = self.played.messages[name], self._bag.topics[name].count
            if played < expected:
                problems.append(f'{name}: {played} of {expected} messages could be read')
        for problem in problems:
            self._node.get_logger().warning(encodable(f'{self._bag.path}: {problem}'))

    def _await_acknowledgement(self) -> None:
        """Let reliable subscribers receive what is still queued."""
        for publisher in self._publishers.values():
            if self._alive():
                publisher.wait_for_all_acked(Duration(seconds=1))


class Ticker:
    """Publishes the bag's time on /clock, at most `rate` times per second of steady time."""

    def __init__(self, node: Node, rate: float) -> None:
        self.period = 1 / rate
        self._publisher = node.create_publisher(Clock, '/clock', DEPTH)
        self._next = Pace(0, 1.0)

    def tick(self, time_ns: int) -> None:
        """Publish when it is due."""
        if self._next.delay(0) > 0:
            return
        seconds, nanoseconds = divmod(time_ns, 10**9)
        self._publisher.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
        self._next.jump(-int(self.period * 1e9))


class Ros1Converter:
    """Converts serialized ROS 1 messages to ROS 2."""

    def __init__(self) -> None:
        self._ros1, self._ros2 = typestore(Stores.ROS1_NOETIC), typestore(Stores.ROS2_JAZZY)
        self._cache: dict[str, object] = {}

    def __call__(self, data: bytes, kind: str) -> bytes:
        """Convert one message of a standard type. Raises BagError for a damaged one."""
        try:
            arguments = self._ros1, self._ros2, kind, kind, self._cache, data
            return bytes(migrate_bytes(*arguments, src_is2=False, dst_is2=True))
        except Exception as error:  # parsing damaged bytes fails in many ways
            raise BagError(f'a {kind} of ROS 1 cannot be converted ({error})') from None


def message_class(kind: str) -> Callable[..., Any] | None:
    """The Python class of a message type, or None where it is not installed.

    Bags name types as they like: nothing is imported but a package `msg` within another, and
    nothing from the current folder.
    """
    package, _, name = kind.partition('/msg/')
    if not (package.isidentifier() and name.isidentifier() and _is_installed(package)):
        return None
    try:
        found = getattr(importlib.import_module(f'{package}.msg'), name, None)
    except ImportError:
        return None
    return found if isinstance(found, type) else None


def _is_installed(package: str) -> bool:
    """Whether a package with messages is found, and that outside the current folder."""
    here = Path.cwd()
    folders = [folder for folder in sys.path if folder and Path(folder).resolve() != here]
    outer = PathFinder.find_spec(package, folders)
    if outer is None or outer != PathFinder.find_spec(package):
        return False
    inner = PathFinder.find_spec(f'{package}.msg', outer.submodule_search_locations or [])
    return inner is not None


def qos_profile(offered: Collection[Qos]) -> QoSProfile:
    """QoS to publish with: compatible with every subscriber of the recorded publishers.

    Reliable also satisfies best-effort subscribers, and transient local also volatile ones: where
    the recorded publishers differ, or their QoS is unknown, the stronger policy is offered.
    """
    first = next(iter(offered), None)
    latched = bool(offered) and all(q.durability == QosDurability.TRANSIENT_LOCAL for q in offered)
    weak = bool(offered) and all(q.reliability == QosReliability.BEST_EFFORT for q in offered)
    depth = max([q.depth for q in offered if q.depth < FOREVER_S], default=0)
    profile = QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=max(depth, LATCHED_DEPTH if latched else DEPTH),
        reliability=ReliabilityPolicy.BEST_EFFORT if weak else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
    if first is not None and len(set(offered)) == 1:
        _copy_times(first, profile)
    return profile


def _copy_times(offered: Qos, profile: QoSProfile) -> None:
    """Copy deadline, lifespan and liveliness where they are finite."""
    for name in ('deadline', 'lifespan', 'liveliness_lease_duration'):
        duration: QosTime = getattr(offered, name)
        if 0 < duration.sec * 10**9 + duration.nsec < FOREVER_S * 10**9:
            setattr(profile, name, Duration(seconds=duration.sec, nanoseconds=duration.nsec))
    if offered.liveliness == QosLiveliness.MANUAL_BY_TOPIC:
        profile.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
