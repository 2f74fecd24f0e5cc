# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings classes as ROS parameters: described, ranged, and validated together."""

from __future__ import annotations

import array
import dataclasses
import itertools
import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from sfa_localization.config import SECTIONS, ignored_sections
from sfa_localization.data.errors import ConfigError
from sfa_localization.data.settings import Settings, nearest

S = TypeVar('S', bound=Settings)
_LARGEST_INTEGER = 2**63 - 1


def declare(node: Node, kind: type[S]) -> S:
    """Declare every field of `kind` as a parameter of `node`; return the values given to it.

    Settings that are not `live` become read-only. Raises ConfigError for a value that is rejected.
    """
    values = {
        item.name: _plain(item, _declare_field(node, item)) for item in dataclasses.fields(kind)
    }
    return kind.from_mapping(values, f'parameters of node {node.get_name()!r}')


def on_change(node: Node, current: Callable[[], S], apply: Callable[[S], None]) -> None:
    """Check changes of live parameters together, and hand the new settings to `apply`.

    `current` returns the settings in force. A change that they cannot take is rejected, with the
    reason in the answer to the request, and nothing is applied.
    """

    def check(changes: list[Parameter]) -> SetParametersResult:
        for change in changes:
            if change.type_ is Parameter.Type.NOT_SET and node.has_parameter(change.name):
                reason = f'parameter {change.name!r} cannot be removed: give it a value'
                return SetParametersResult(successful=False, reason=reason)
        try:
            changed(current(), changes)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def accept(changes: list[Parameter]) -> None:
        settings = changed(current(), changes)
        if settings != current():
            apply(settings)

    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(accept)


def changed(settings: S, changes: Sequence[Parameter]) -> S:
    """The settings with those of `changes` that belong to them. Raises ConfigError."""
    values = {item.name: getattr(settings, item.name) for item in dataclasses.fields(settings)}
    given = {change.name: change.value for change in changes if change.name in values}
    for item in dataclasses.fields(settings):
        if item.name in given:
            values[item.name] = _plain(item, given[item.name])
    return type(settings).from_mapping(values, 'parameters')


def _plain(item: dataclasses.Field[Any], value: Any) -> Any:
    """A parameter's value in the types that settings take."""
    if isinstance(value, array.array):  # so arrays arrive in messages
        return value.tolist()
    # An empty list arrives from a parameter file as nothing at all, and `ros2 param dump` writes
    # that as null, which is a text to the parser of ROS.
    return () if item.default == () and value in (None, 'null') else value


def warn_of_unknown(node: Node) -> None:
    """Warn of each value given to the node for a parameter that it does not have.

    Parameters of the other nodes are ignored: a section `/**` gives them to all.
    """
    others = {
        item.name
        for kinds in SECTIONS.values()
        for kind in kinds
        for item in dataclasses.fields(kind)
    }
    # rclpy has no public way to ask what was given but not declared.
    given = node._parameter_overrides
    known = node.list_parameters([], 0).names
    for name in sorted(set(given) - set(known) - others):
        if not name.startswith('qos_overrides.'):  # declared with their topics
            node.get_logger().warning(f'unknown parameter {name!r}{nearest(name, known)}')


def warn_of_ignored_files(node: Node, arguments: Sequence[str]) -> None:
    """Warn of each parameter file among the arguments whose sections for the node are not its.

    ROS takes `ekf_node:` for a node without namespace, and gives /robot1/ekf_node nothing of it.
    """
    name = node.get_fully_qualified_name()
    for flag, path in itertools.pairwise(arguments):
        if flag != '--params-file':
            continue
        try:
            keys = ignored_sections(path, name)
        except ConfigError:  # read by ROS, which is less strict
            continue
        if keys:
            node.get_logger().warning(
                f'{path}: nothing of {", ".join(keys)} is used: this node is {name}; '
                f'write /**/{node.get_name()}: for any namespace'
            )


def _declare_field(node: Node, item: dataclasses.Field[Any]) -> Any:
    default = list(item.default) if isinstance(item.default, tuple) else item.default
    try:
        return node.declare_parameter(item.name, default, descriptor(item)).value
    except InvalidParameterTypeException as error:
        return _declare_converted(node, item, error)
    except ParameterException as error:
        raise ConfigError(f'parameter {item.name!r}: {error}') from None


def _declare_converted(node: Node, item: dataclasses.Field[Any], error: Exception) -> Any:
    """Take `-p size:=3` for a parameter that is a real number: ROS reads 3 as an integer."""
    probe = node.declare_parameter(item.name, descriptor=ParameterDescriptor(dynamic_typing=True))
    node.undeclare_parameter(item.name)
    kind = item.default[0] if isinstance(item.default, tuple) else item.default
    given = list(probe.value) if isinstance(item.default, tuple) and probe.value else probe.value
    numbers = given if isinstance(given, list) else [given]
    if not isinstance(kind, float) or not all(type(entry) is int for entry in numbers):
        raise ConfigError(f'parameter {item.name!r}: {error}') from None
    value = [float(entry) for entry in given] if isinstance(given, list) else float(given)
    try:
        return node.declare_parameter(
            item.name, value, descriptor(item), ignore_override=True
        ).value
    except ParameterException as rejected:
        raise ConfigError(f'parameter {item.name!r}: {rejected}') from None


def descriptor(item: dataclasses.Field[Any]) -> ParameterDescriptor:
    """Descriptor of one setting: description with unit, range, and whether it may change."""
    meta = item.metadata
    unit = f' [{meta["unit"]}]' if meta['unit'] else ''
    made = ParameterDescriptor(description=f'{meta["doc"]}{unit}', read_only=not meta['live'])
    # An empty list has no type in ROS; its Settings check what is given instead.
    made.dynamic_typing = item.default == ()
    if meta['choices']:
        made.additional_constraints = 'one of: ' + ', '.join(meta['choices'])
    if meta['low'] is not None or meta['high'] is not None:
        _bound(made, item.default, meta['low'], meta['high'])
    return made


def _bound(made: ParameterDescriptor, default: Any, low: float | None, high: float | None) -> None:
    """Give a scalar its range; arrays have none in ROS and are checked by their Settings."""
    if isinstance(default, float):
        lowest = -sys.float_info.max if low is None else float(low)
        highest = sys.float_info.max if high is None else float(high)
        made.floating_point_range = [FloatingPointRange(from_value=lowest, to_value=highest)]
    elif isinstance(default, int) and not isinstance(default, bool):
        least = -_LARGEST_INTEGER if low is None else int(low)
        most = _LARGEST_INTEGER if high is None else int(high)
        made.integer_range = [IntegerRange(from_value=least, to_value=most)]
