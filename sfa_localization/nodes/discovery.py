# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""An input that nobody publishes on: what there is instead, found by its type."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sfa_localization.nodes.monitor import Monitor, steady_s

PATIENCE_S = 3.0
"""Time before another topic is taken: drivers of cameras and wheels may start after this node."""
_OUTPUTS = '/ekf/odometry', '/panorama', '/panorama/compressed'
"""Odometry and images of this package's own nodes, live or from a bag: never an input."""


class Discovery:
    """Looks for topics of the types `kinds`, of which the first is that of the input `topic`.

    `arguments` of the launch file choose another topic: the first is the input's.
    """

    def __init__(self, node: Any, topic: str, kinds: Sequence[Any], *arguments: str) -> None:
        self._node, self._arguments = node, arguments
        self._types = [f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}' for kind in kinds]
        self._start_s = steady_s()
        self._given = node.resolve_topic_name(topic)
        self._remapped = self._given != node.resolve_topic_name(topic, only_expand=True)
        self._taken = False
        self.hint = ''
        """Which topics there are, while nobody publishes on that of the input."""

    def found(self, monitor: Monitor) -> str:
        """The topic to take from now on; '' for no change.

        It is the only one that qualifies, where the input was not remapped; or the input's own
        again when somebody publishes on that.
        """
        if self._taken:
            self._taken = not self._node.count_publishers(self._given)
            return '' if self._taken else self._given
        there = self._there(monitor)
        names = [] if self._remapped else [*filter(self._qualifies, there.get(self._types[0], []))]
        if len(names) != 1:
            self._tell(there)
            return ''
        self._taken, self.hint = True, ''
        self._node.get_logger().warning(
            f'nobody publishes on {self._given}: taking {names[0]}, the only {self._types[0]}; '
            f'{self._arguments[0]}:={names[0].removesuffix("/compressed")} makes this permanent'
        )
        return names[0]

    def look(self, monitor: Monitor) -> None:
        """Log, and keep in `hint`, what there is; take nothing."""
        self._tell(self._there(monitor))

    def _there(self, monitor: Monitor) -> dict[str, list[str]]:
        """Topics of other nodes, by type; none where there is an input, or soon may be."""
        early = steady_s() < self._start_s + PATIENCE_S
        if early or monitor.received or self._node.count_publishers(self._given):
            return {}
        named = sorted(self._node.get_topic_names_and_types())
        return {
            wanted: [name for name, kinds in named if wanted in kinds and self._of_others(name)]
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
        """Not an output of this package, and not in a namespace where other nodes are."""
        below = self._node.get_namespace().rstrip('/') + '/'
        spaces = {f'{space}/' for _, space in self._node.get_node_names_and_namespaces()}
        others = tuple(space for space in spaces if len(space) > len(below))
        return (
            name.startswith(below) and not name.startswith(others) and not name.endswith(_OUTPUTS)
        )

    def _of_others(self, name: str) -> bool:
        own = self._node.get_name(), self._node.get_namespace()
        infos = self._node.get_publishers_info_by_topic(name)
        publishers = {(info.node_name, info.node_namespace) for info in infos}
        return bool(publishers) and own not in publishers
