# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Replay a bag through rclpy, also where `ros2 bag play` is not installed.

Messages are published as the recorded bytes, with their topics, types, QoS and header stamps, and
at the pace of the recording.
"""

from __future__ import annotations

import importlib
import time
from collections import Counter
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

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

from sfa_localization.bags.decoding import IMAGES, ODOMETRY
from sfa_localization.bags.reader import Bag
from sfa_localization.commands.settings import PlayConfig
from sfa_localization.data.errors import BagError
from sfa_localization.data.rejections import encodable

DEPTH = 10
LATCHED_DEPTH = 100
"""Messages in the queue of a publisher, and in the queue that late subscribers receive."""
SETTLED_S = 0.5  # without a new subscriber, all nodes have started
CLOCK_PERIOD_S = 0.025  # of /clock, as for `ros2 bag play --clock`


def play(
    path: Path | str,
    config: PlayConfig,
    *,
    loop: bool = False,
    clock: bool = False,
    topics: Collection[str] = (),
) -> Counter[str]:
    """Replay a bag to its end, or with `loop` until Ctrl-C; return the message count of each topic.

    Only the named `topics` are played, all without names. The replay starts when images and
    odometry have subscribers and no more come, or after `config.wait`. Raises BagError.
    """
    context = Context()
    played = Counter[str]()
    # args=[]: rclpy cannot read names on the command line that are not UTF-8.
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        with Bag(path) as bag:
            node = Node('bag_player', context=context, start_parameter_services=False)
            publishers = _publishers(node, bag, topics)
            _await_subscribers(node, bag, publishers, config.wait)
            ticker = node.create_publisher(Clock, '/clock', DEPTH) if clock else None
            while True:
                start = time.monotonic()
                for topic, receive_ns, data in bag.messages(publishers):
                    bag_s = (receive_ns - bag.recording.start_ns) * 1e-9
                    _sleep_until(start + bag_s / config.rate, ticker, receive_ns, config.rate)
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
    """A publisher for each topic, or for the named ones; logs which cannot be played, and why."""
    topics = bag.topics
    made = dict[str, Publisher]()
    reasons = list[str]()
    for name in names or topics:
        if name not in topics:
            choices = ', '.join(sorted(topics))
            raise BagError(f'{bag.path}: has no topic {name}; --topics can be: {choices}')
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
    """Wait until images and odometry have subscribers and no more come, `wait_s` at most."""
    kinds = {'images': IMAGES, 'odometry': (ODOMETRY,)}
    needed = {
        what: [made for name, made in publishers.items() if bag.topics[name].kind in kind]
        for what, kind in kinds.items()
    }
    missing = list[str]()
    last = 0
    changed = time.monotonic()
    end = changed + wait_s
    while (now := time.monotonic()) < end:
        counts = {made: made.get_subscription_count() for made in publishers.values()}
        missing = [
            what for what, group in needed.items() if group and not any(map(counts.get, group))
        ]
        if sum(counts.values()) != last:
            last = sum(counts.values())
            changed = now
        if last and not missing and now - changed > SETTLED_S:
            return
        time.sleep(0.05)
    if missing:
        node.get_logger().warning(
            f'no subscriber of {" and ".join(missing)} after {wait_s:g} s: playing anyway '
            '(--wait sets the time)'
        )


def _sleep_until(due: float, ticker: Publisher | None, stamp_ns: int, rate: float) -> None:
    """Sleep until `due`, by time.monotonic(); `stamp_ns` is the bag's time then, for /clock."""
    while (remaining_s := due - time.monotonic()) > 0:
        if ticker is not None:
            seconds, nanoseconds = divmod(stamp_ns - int(remaining_s * rate * 1e9), 10**9)
            ticker.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
        time.sleep(min(remaining_s, CLOCK_PERIOD_S))


def message_class(kind: str) -> Callable[..., Any] | None:
    """The Python class of a message type, None if it is not installed."""
    package, _, name = kind.partition('/msg/')
    try:
        message = getattr(importlib.import_module(f'{package or "unknown"}.msg'), name, None)
    except ImportError:
        return None
    return message if isinstance(message, type) else None


def qos_profile(offered: Collection[Qos]) -> QoSProfile:
    """The QoS of a publisher that all subscribers of the recorded publishers accept.

    If the recorded publishers differ, or their QoS is unknown, it is reliable and volatile.
    """
    latched = bool(offered) and all(q.durability == QosDurability.TRANSIENT_LOCAL for q in offered)
    weak = bool(offered) and all(q.reliability == QosReliability.BEST_EFFORT for q in offered)
    depth = LATCHED_DEPTH if latched else DEPTH
    return QoSProfile(
        depth=max([depth, *(q.depth for q in offered if q.depth < 2**31)]),
        reliability=ReliabilityPolicy.BEST_EFFORT if weak else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
