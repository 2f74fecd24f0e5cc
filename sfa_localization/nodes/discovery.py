# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Topics of an input's type, for an input that nobody publishes on."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

from sfa_localization.nodes.monitor import steady_s
from sfa_localization.nodes.process import NODES

PATIENCE_S = 3.0
"""Time before another topic is taken: drivers of cameras and wheels may start after this node."""
_TRANSPORT = re.compile('/(compressed|ffmpeg|foxglove)$')
_OUTPUTS = '/ekf/odometry', '/panorama', '/panorama/compressed'
"""Odometry and images of this package's nodes, which a bag may hold: never an input."""


class Discovery:
    """Looks for topics of `types`, of which the first is that of the input `topic`.

    `arguments` of the launch file choose another topic: the first is the input's. `take` is called
    with the only topic that qualifies, unless the input was remapped, and with the input's own
    topic when somebody publishes on that again.
    """

    def __init__(
        self,
        node: Any,
        topic: str,
        types: Sequence[str],
        arguments: Sequence[str],
        take: Callable[[str], None] | None = None,
    ) -> None:
        self._node = node
        self._topic = topic
        self._arguments = arguments
        self._types = types
        self._start_s = steady_s()
        self._expected = node.resolve_topic_name(topic)
        self._take = None if node.is_remapped(topic) else take
        self._has_substitute = False
        self.hint = ''
        """Which topics there are, while nobody publishes on that of the input."""
        node.every(1.0, self.look)

    def look(self) -> None:
        """Take a topic, or update `hint` and log it."""
        early = steady_s() < self._start_s + PATIENCE_S
        published = self._node.count_publishers(self._expected)
        if self._has_substitute and published and self._take is not None:
            self._has_substitute = False
            self._take(self._expected)
        elif early or published or self._node.monitors[self._topic].received:
            self.hint = ''
        elif not self._has_substitute:
            self._choose()

    def _choose(self) -> None:
        this_node = {(self._node.get_name(), self._node.get_namespace())}
        topics = [
            (name, kind)
            for kind in self._types
            for name, kinds in sorted(self._node.get_topic_names_and_types())
            if kind in kinds and self._publishers(name) - this_node
            # Panoramas are an input where an argument of the launch file takes them.
            if 'panorama' in self._arguments or not self._is_output(name)
        ]
        usable = [n for n, kind in topics if kind == self._types[0] and self._qualifies(n)]
        if self._take is not None and len(usable) == 1:
            self._has_substitute = True
            self.hint = ''
            self._node.get_logger().warning(
                f'nobody publishes on {self._expected}: taking {usable[0]}, the only '
                f'{self._types[0]}; {self._arguments[0]}:={_TRANSPORT.sub("", usable[0])} '
                'makes this permanent'
            )
            self._take(usable[0])
            return
        listed = ', '.join(f'{name} ({kind})' for name, kind in topics)
        choices = ' or '.join(f'{argument}:=NAME' for argument in self._arguments)
        hint = f'nobody publishes on {self._expected}; there are {listed}: {choices}'
        before = self.hint
        self.hint = hint if listed else ''
        if self.hint not in ('', before):
            self._node.get_logger().warning(self.hint)

    def _qualifies(self, name: str) -> bool:
        """Whether a topic is no output of this package, and in no other robot's namespace."""
        below = self._node.get_namespace().rstrip('/') + '/'
        spaces = {f'{space}/' for _, space in self._node.get_node_names_and_namespaces()}
        others = tuple(space for space in spaces if len(space) > len(below))
        usual = name.startswith(below) and not name.startswith(others)
        return usual and not self._is_output(name)

    def _is_output(self, name: str) -> bool:
        ours = {node for node, _ in self._publishers(name)} & {*NODES, self._node.get_name()}
        return bool(ours) or name.endswith(_OUTPUTS)

    def _publishers(self, name: str) -> set[tuple[str, str]]:
        infos = self._node.get_publishers_info_by_topic(name)
        return {(info.node_name, info.node_namespace) for info in infos}
