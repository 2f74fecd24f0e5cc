# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings classes as ROS parameters: described, ranged, and validated together."""

from __future__ import annotations

import array
import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from sfa_localization.config import all_names, ignored_sections
from sfa_localization.data.errors import ConfigError, LocalizationError
from sfa_localization.data.settings import Settings, nearest

S = TypeVar('S', bound=Settings)
Current = dict[type[Settings], Settings]
"""The settings in force, by their class."""


def declare(node: Node, kind: type[S]) -> S:
    """Declare every field of `kind` as a parameter of `node`; return the values given to it.

    Settings that are not `live` become read-only. Raises ConfigError for a value that is rejected.
    """
    values = {item.name: _declare_field(node, item) for item in dataclasses.fields(kind)}
    return kind.from_mapping(values, f'parameters of node {node.get_name()!r}')


def on_change(
    node: Node,
    current: Current,
    check: Callable[[Current], None],
    apply: Callable[[Settings], None],
) -> None:
    """Check changes of live parameters together, keep them in `current`, and hand them to `apply`.

    A change that is out of range, or wrong beside the other parameters, or for which `check`
    raises a LocalizationError, is rejected, with the reason in the answer to the request, and
    nothing is applied.
    """
    fields = {item.name: item for kind in current for item in dataclasses.fields(kind)}

    def convert(changes: list[Parameter]) -> list[Parameter]:
        return [typed(fields[c.name], c) if c.name in fields else c for c in changes]

    def judge(changes: list[Parameter]) -> SetParametersResult:
        try:
            check({kind: _changed(settings, changes) for kind, settings in current.items()})
        except LocalizationError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def accept(changes: list[Parameter]) -> None:
        for kind, settings in [*current.items()]:
            current[kind] = _changed(settings, changes)
            if current[kind] != settings:
                apply(current[kind])

    # One for all settings: rclpy would join the lists of several.
    node.add_pre_set_parameters_callback(convert)
    node.add_on_set_parameters_callback(judge)
    node.add_post_set_parameters_callback(accept)


def _changed(settings: S, changes: Sequence[Parameter]) -> S:
    """The settings with those of `changes` that belong to them. Raises ConfigError."""
    names = {item.name for item in dataclasses.fields(settings)}
    return dataclasses.replace(
        settings, **{change.name: change.value for change in changes if change.name in names}
    )


def typed(item: dataclasses.Field[Any], given: Parameter) -> Parameter:
    """The parameter as one of its setting's type, where its value can be that.

    ROS reads 3 as an integer, also for a real number, and an empty list has no type.
    """
    value = given.value
    if isinstance(item.default, float) and type(value) is int:
        return Parameter(item.name, value=float(value))
    entries = value if isinstance(value, (list, tuple, array.array)) else [value]
    if isinstance(item.default, tuple) and all(type(entry) in (int, float) for entry in entries):
        return Parameter(item.name, Parameter.Type.DOUBLE_ARRAY, [float(x) for x in entries])
    return given


def warn_of_unknown(node: Node) -> None:
    """Warn of each value given to the node for a parameter that it does not have.

    Parameters of the other nodes are ignored: a section `/**` gives them to all.
    """
    # rclpy has no public way to ask what was given but not declared.
    given = node._parameter_overrides
    known = node.list_parameters([], 0).names
    for name in sorted(set(given) - set(known) - all_names()):
        if not name.startswith('qos_overrides.'):  # declared with their topics
            node.get_logger().warning(f'unknown parameter {name!r}{nearest(name, known)}')


def warn_of_ignored_files(node: Node, arguments: Sequence[str]) -> None:
    """Warn of each parameter file among the arguments with sections for the node that are not its.

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
    default = typed(item, Parameter(item.name, value=item.default))
    given = node._parameter_overrides.get(item.name, default)
    if isinstance(item.default, tuple) and given.value is None:  # `[]` in a parameter file
        given = Parameter(item.name, value=[])
    writable, final = _descriptor(item), _descriptor(item)
    writable.read_only, final.type = False, default.type_.value
    # By its type alone: an empty list as the value would make it one of bytes.
    node.declare_parameter(item.name, default.type_, writable, ignore_override=True)
    result = node.set_parameters([typed(item, given)])[0]
    if not result.successful:
        raise ConfigError(f'parameter {item.name!r}: {result.reason}')
    node.set_descriptor(item.name, final)
    return node.get_parameter(item.name).value


def _descriptor(item: dataclasses.Field[Any]) -> ParameterDescriptor:
    """Descriptor of one setting: description with unit, range, and whether it may change.

    Lists, and what is bounded on one side, have no range in ROS; their Settings check them.
    """
    meta = item.metadata
    unit = f' [{meta["unit"]}]' if meta['unit'] else ''
    made = ParameterDescriptor(description=f'{meta["doc"]}{unit}', read_only=not meta['live'])
    if meta['choices']:
        made.additional_constraints = 'one of: ' + ', '.join(filter(None, meta['choices']))
    low, high = meta['low'], meta['high']
    if low is None or high is None:
        return made
    if isinstance(item.default, float):
        made.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high))
        ]
    elif type(item.default) is int:
        made.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return made
