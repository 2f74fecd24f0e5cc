# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""An input that nobody publishes on, and that was not remapped: found by its type."""

from __future__ import annotations

from typing import Any

from sfa_localization.nodes.monitor import Monitor, steady_s

PATIENCE_S = 3.0
"""Time before another topic is taken: drivers of cameras and wheels may start after this node."""


class Discovery:
    """Looks for the only topic of a type, for the input `topic` of a node."""

    def __init__(self, node: Any, topic: str, kind: Any) -> None:
        self._node, self._topic = node, topic
        self._type = f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'
        self._start_s = steady_s()
        self._given = node.resolve_topic_name(topic)
        self._remapped = self._given != node.resolve_topic_name(topic, only_expand=True)
        self._named: list[str] = []
        self._taken = False

    def found(self, monitor: Monitor) -> str:
        """The topic to take from now on; '' for no change.

        It is the input's own again when somebody publishes on that.
        """
        if self._remapped or steady_s() < self._start_s + PATIENCE_S:
            return ''
        if self._node.count_publishers(self._given):
            back, self._taken = self._taken, False
            return self._given if back else ''
        if self._taken or monitor.received:
            return ''
        names = self._candidates()
        if len(names) == 1:
            self._taken = True
            self._node.get_logger().warning(
                f'nobody publishes on {self._given}: taking {names[0]}, the only {self._type}; '
                f'-r {self._topic}:={names[0]} makes this permanent'
            )
            return names[0]
        if names and names != self._named:
            self._node.get_logger().warning(
                f'nobody publishes on {self._given}, and {", ".join(names)} are {self._type}: '
                f'choose one with -r {self._topic}:=NAME'
            )
        self._named = names
        return ''

    def _candidates(self) -> list[str]:
        """Topics of the type, below the node's namespace, that another node publishes."""
        below = self._node.get_namespace().rstrip('/') + '/'
        own = self._node.get_fully_qualified_name()
        return sorted(
            name
            for name, types in self._node.get_topic_names_and_types()
            if self._type in types and name.startswith(below) and own not in self._publishers(name)
            if self._publishers(name)
        )

    def _publishers(self, name: str) -> set[str]:
        return {
            f'{info.node_namespace.rstrip("/")}/{info.node_name}'
            for info in self._node.get_publishers_info_by_topic(name)
        }
