# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Replay a bag through rclpy, where `ros2 bag play` is not installed.

Messages are published as the recorded bytes, with their topics, types and QoS; header stamps are
unchanged; the time of reception sets the pace.
"""

from __future__ import annotations

import importlib
import time
from collections import Counter
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rclpy
from builtin_interfaces.msg import Time
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosbags.interfaces import Qos, QosDurability, QosReliability
from rosgraph_msgs.msg import Clock

from sfa_localization.bags.decoding import COMPRESSED, IMAGE, ODOMETRY
from sfa_localization.bags.reader import Bag
from sfa_localization.data.errors import BagError
from sfa_localization.data.rejections import encodable

if TYPE_CHECKING:
    from sfa_localization.commands.play import PlayConfig

DEPTH = 10  # of a publisher's queue, in messages
LATCHED_DEPTH = 100  # of the queue that late subscribers receive, in messages
SETTLED_S = 0.5  # without a new subscriber: all nodes of the chain have started
CLOCK_PERIOD_S = 0.025  # of /clock, as `ros2 bag play --clock` has


def play(
    path: Path | str,
    config: PlayConfig,
    *,
    loop: bool = False,
    clock: bool = False,
    topics: Collection[str] = (),
) -> Counter[str]:
    """Replay a bag until its end, or with `loop` until Ctrl-C; return the messages of each topic.

    `topics` limits it to those named. It starts when images and odometry have subscribers and
    their number is stable, or after the configured wait. Raises BagError.
    """
    context, played = Context(), Counter[str]()
    # No arguments: among those of the command may be a name that is not UTF-8.
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        with Bag(path) as bag:
            node = Node('bag_player', context=context, start_parameter_services=False)
            publishers = _publishers(node, bag, topics)
            _await_subscribers(node, bag, publishers, config.wait)
            ticker = node.create_publisher(Clock, '/clock', DEPTH) if clock else None
            while True:
                pace = ReplayClock(bag.recording.start_ns, config.rate, ticker)
                for topic, receive_ns, data in bag.messages(publishers):
                    pace.wait_until(receive_ns)
                    publishers[topic.name].publish(bytes(data))
                    played[topic.name] += 1
                if not (loop and played):
                    break
            for publisher in publishers.values():
                publisher.wait_for_all_acked(Duration(seconds=1))
            for problem in bag.problems:
                node.get_logger().warning(encodable(f'{bag.path}: {problem}'))
    finally:
        rclpy.try_shutdown(context=context)
    return played


def _publishers(node: Node, bag: Bag, names: Collection[str]) -> dict[str, Publisher]:
    """A publisher for each topic, of all or of those named; others are logged with the reason."""
    topics, made, reasons = bag.topics, dict[str, Publisher](), list[str]()
    for name in names or topics:
        if name not in topics:
            known = ', '.join(sorted(topics))
            raise BagError(f'{bag.path}: has no topic {name}; --topics can be: {known}')
        topic = topics[name]
        kind = message_class(topic.kind)
        if topic.serialization != 'cdr':
            reasons.append(f'{name}: is serialized as {topic.serialization!r}; convert it to ROS 2')
        elif kind is None:
            reasons.append(f'{name}: type {topic.kind or "unknown"} is not installed')
        else:
            try:
                made[name] = node.create_publisher(kind, name, qos_profile(topic.qos))
            except InvalidTopicNameException:
                reasons.append(f'{name}: is not a valid topic name')
    if not made:
        raise BagError(
            f'{bag.path}: no topic can be played ({"; ".join(reasons) or "it has none"})'
        )
    for reason in reasons:
        node.get_logger().warning(f'not played: {reason}')
    return made


def _await_subscribers(
    node: Node, bag: Bag, publishers: dict[str, Publisher], wait_s: float
) -> None:
    """Return when images and odometry have subscribers and their number is stable, or in time."""
    kinds = {'images': (IMAGE, COMPRESSED), 'odometry': (ODOMETRY,)}
    needed = {
        what: [made for name, made in publishers.items() if bag.topics[name].kind in kind]
        for what, kind in kinds.items()
    }
    missing, last, settled = list[str](), 0, time.monotonic()
    end = settled + wait_s
    while (now := time.monotonic()) < end:
        counts = {made: made.get_subscription_count() for made in publishers.values()}
        missing = [
            what for what, group in needed.items() if group and not any(map(counts.get, group))
        ]
        if sum(counts.values()) != last:
            last, settled = sum(counts.values()), now
        if last and not missing and now - settled > SETTLED_S:
            return
        time.sleep(0.05)
    if missing:
        node.get_logger().warning(
            f'no subscriber of {" and ".join(missing)} after {wait_s:g} s: playing anyway '
            '(--wait sets the time)'
        )


class ReplayClock:
    """The time of a bag (ns): from `start_ns` on, `rate` times as fast as a steady clock.

    It is published on the topic of `ticker`, where there is one.
    """

    def __init__(self, start_ns: int, rate: float, ticker: Publisher | None = None) -> None:
        self._start_ns, self._rate, self._ticker = start_ns, rate, ticker
        self._start = self._ticked = time.monotonic()

    def wait_until(self, stamp_ns: int) -> None:
        """Return when the bag's time is `stamp_ns`."""
        due = self._start + (stamp_ns - self._start_ns) * 1e-9 / self._rate
        while (now := time.monotonic()) < due:
            if self._ticker is not None and now >= self._ticked:
                passed_ns = int((now - self._start) * self._rate * 1e9)
                seconds, nanoseconds = divmod(self._start_ns + passed_ns, 10**9)
                self._ticker.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
                self._ticked = now + CLOCK_PERIOD_S
            time.sleep(min(due - now, CLOCK_PERIOD_S))


def message_class(kind: str) -> Callable[..., Any] | None:
    """The Python class of a message type, or None where it is not installed."""
    package, _, name = kind.partition('/msg/')
    try:
        found = getattr(importlib.import_module(f'{package or "unknown"}.msg'), name, None)
    except ImportError:
        return None
    return found if isinstance(found, type) else None


def qos_profile(offered: Collection[Qos]) -> QoSProfile:
    """QoS to publish with: compatible with every subscriber of the recorded publishers.

    Reliable also satisfies best-effort subscribers, and transient local also volatile ones: where
    the recorded publishers differ, or their QoS is unknown, the stronger policy is offered.
    """
    latched = bool(offered) and all(q.durability == QosDurability.TRANSIENT_LOCAL for q in offered)
    weak = bool(offered) and all(q.reliability == QosReliability.BEST_EFFORT for q in offered)
    depth = LATCHED_DEPTH if latched else DEPTH
    return QoSProfile(
        depth=max([depth, *(q.depth for q in offered if q.depth < 2**31)]),
        reliability=ReliabilityPolicy.BEST_EFFORT if weak else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
