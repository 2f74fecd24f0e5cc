# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""An input that nobody publishes on: what there is instead, found by its type."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from sfa_localization.nodes.monitor import steady_s

PATIENCE_S = 3.0
"""Time before another topic is taken: drivers of cameras and wheels may start after this node."""
_OUTPUTS = '/ekf/odometry', '/panorama', '/panorama/compressed'
"""Odometry and images of this package's own nodes, live or from a bag: never an input."""


class Discovery:
    """Looks for topics of the types `kinds`, of which the first is that of the input `topic`.

    `arguments` of the launch file choose another topic: the first is the input's. `take` is called
    with the only topic that qualifies, where the input was not remapped, and with the input's own
    when somebody publishes on that again.
    """

    def __init__(
        self,
        node: Any,
        topic: str,
        kinds: Sequence[Any],
        arguments: Sequence[str],
        take: Callable[[str], None] | None = None,
    ) -> None:
        self._node, self._topic, self._arguments = node, topic, arguments
        self._own = node.get_name(), node.get_namespace()
        self._types = [f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}' for kind in kinds]
        self._start_s = steady_s()
        self._given = node.resolve_topic_name(topic)
        remapped = self._given != node.resolve_topic_name(topic, only_expand=True)
        self._take = None if remapped else take
        self._taken = False
        self.hint = ''
        """Which topics there are, while nobody publishes on that of the input."""
        node.every(1.0, self.look)

    def look(self) -> None:
        """Take a topic, or log, and keep in `hint`, which ones there are."""
        if self._taken and self._take is not None:
            if self._node.count_publishers(self._given):
                self._taken = False
                self._take(self._given)
            return
        there = self._there()
        names = [*filter(self._qualifies, there.get(self._types[0], []))]
        if self._take is None or len(names) != 1:
            self._tell(there)
            return
        self._taken, self.hint = True, ''
        self._node.get_logger().warning(
            f'nobody publishes on {self._given}: taking {names[0]}, the only {self._types[0]}; '
            f'{self._arguments[0]}:={names[0].removesuffix("/compressed")} makes this permanent'
        )
        self._take(names[0])

    def _there(self) -> dict[str, list[str]]:
        """Topics of other nodes, by type; none where there is an input, or soon may be."""
        early = steady_s() < self._start_s + PATIENCE_S
        received = self._node.monitor(self._topic).received
        if early or received or self._node.count_publishers(self._given):
            return {}
        named = sorted(self._node.get_topic_names_and_types())
        return {
            wanted: [
                n for n, kinds in named if wanted in kinds and self._publishers(n) - {self._own}
            ]
            for wanted in self._types
        }

    def _tell(self, there: dict[str, list[str]]) -> None:
        listed = [f'{name} ({kind})' for kind, names in there.items() for name in names]
        choices = ' or '.join(f'{argument}:=NAME' for argument in self._arguments)
        hint = f'nobody publishes on {self._given}; there are {", ".join(listed)}: {choices}'
        before, self.hint = self.hint, hint if listed else ''
        if self.hint not in ('', before):
            self._node.get_logger().warning(self.hint)

    def _qualifies(self, name: str) -> bool:
        """No output of this node or package, and in no namespace where only other nodes are."""
        below = self._node.get_namespace().rstrip('/') + '/'
        spaces = {f'{space}/' for _, space in self._node.get_node_names_and_namespaces()}
        others = tuple(space for space in spaces if len(space) > len(below))
        usual = name.startswith(below) and not name.startswith(others)
        return usual and not name.endswith(_OUTPUTS) and self._own not in self._publishers(name)

    def _publishers(self, name: str) -> set[tuple[str, str]]:
        infos = self._node.get_publishers_info_by_topic(name)
        return {(info.node_name, info.node_namespace) for info in infos}
