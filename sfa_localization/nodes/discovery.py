# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Topics of an input's type, for an input that nobody publishes on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from sfa_localization.data.image_topics import without_transport
from sfa_localization.nodes.monitor import steady_s
from sfa_localization.nodes.process import NODES

PATIENCE_S = 3.0
"""Time before another topic is taken: drivers of cameras and wheels may start after this node."""
DEPTH = '/compressedDepth'
_OUTPUTS = '/ekf/odometry', '/panorama', '/panorama/compressed'
"""Odometry and images of this package's nodes, which a bag may hold: never an input."""


def is_ours(node: Any, name: str) -> bool:
    """Whether a node of this package publishes a topic, as the other `node` sees it."""
    return bool({other for other, _ in _publishers(node, name)} & {*NODES, node.get_name()})


def _publishers(node: Any, name: str) -> set[tuple[str, str]]:
    """Names and namespaces of the nodes that publish a topic."""
    infos = node.get_publishers_info_by_topic(name)
    return {(info.node_name, info.node_namespace) for info in infos}


class Discovery:
    """Looks for topics of `types`, of which the first is that of the input `topic`.

    `arguments` of the launch file choose another topic: the first is the input's. `take` is called
    with the only topic of the first type that qualifies, or else of any, and with this type, unless
    the input was remapped to a topic that is published; and with the input's own topic when
    somebody publishes on that again. A `fixed` input takes other transports of its topic only.
    """

    def __init__(
        self,
        node: Any,
        topic: str,
        types: Sequence[str],
        arguments: Sequence[str],
        take: Callable[[str, str], None] | None = None,
        *,
        fixed: bool = False,
    ) -> None:
        self._node = node
        self._topic = topic
        self._arguments = arguments
        self._types = types
        self._start_s = steady_s()
        self._expected = node.resolve_topic_name(topic)
        self._take = take
        self._fixed = fixed or node.is_remapped(topic)
        self._has_substitute = False
        self.hint = ''
        """Which topics there are, while nobody publishes on that of the input."""
        node.every(1.0, self.look)

    def look(self) -> None:
        """Take a topic, or update `hint` and log it."""
        early = steady_s() < self._start_s + PATIENCE_S
        infos = self._node.get_publishers_info_by_topic(self._expected)
        published = any(info.topic_type == self._types[0] for info in infos)
        if self._has_substitute and published and self._take is not None:
            self._has_substitute = False
            self._take(self._expected, self._types[0])
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
        usable = [(name, kind) for name, kind in topics if self._qualifies(name)]
        of_input = [(name, kind) for name, kind in usable if kind == self._types[0]]
        candidates = of_input or usable
        if self._take is not None and len(candidates) == 1:
            self._substitute(*candidates[0])
            return
        listed = ', '.join(f'{name} ({kind})' for name, kind in topics)
        choices = ' or '.join(f'{argument}:=NAME' for argument in self._arguments)
        hint = f'nobody publishes on {self._expected}; there are {listed}: {choices}'
        before = self.hint
        self.hint = hint if listed else ''
        if self.hint not in ('', before):
            self._node.get_logger().warning(self.hint)

    def _substitute(self, name: str, kind: str) -> None:
        """Take a topic in place of the input's own."""
        assert self._take is not None
        self._has_substitute = True
        self.hint = ''
        base = without_transport(name)
        given = f'{self._arguments[0]}:={base}'
        if kind != self._types[0]:
            given += f' image_transport:={name.removeprefix(base).strip("/") or "raw"}'
        self._node.get_logger().warning(
            f'nobody publishes on {self._expected}: taking {name}, the only {kind}; {given} makes '
            'this permanent'
        )
        self._take(name, kind)

    def _qualifies(self, name: str) -> bool:
        """Whether a topic is no output of this package, and in no other robot's namespace. An input
        that is remapped takes the same images by another transport only.
        """
        if self._fixed:
            return without_transport(name) == without_transport(self._expected)
        below = self._node.get_namespace().rstrip('/') + '/'
        spaces = {f'{space}/' for _, space in self._node.get_node_names_and_namespaces()}
        others = tuple(space for space in spaces if len(space) > len(below))
        usual = name.startswith(below) and not name.startswith(others)
        is_image = not name.endswith(DEPTH)
        return usual and is_image and not self._is_output(name)

    def _is_output(self, name: str) -> bool:
        return is_ours(self._node, name) or name.endswith(_OUTPUTS)

    def _publishers(self, name: str) -> set[tuple[str, str]]:
        return _publishers(self._node, name)
