# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings classes as ROS parameters: described, ranged, and validated together."""

from __future__ import annotations

import array
import dataclasses
import itertools
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from sfa_localization.camera.settings import CameraConfig, SurroundConfig
from sfa_localization.config import (
    given_names,
    ignored_sections,
    resolved_beside,
    unknown_names,
)
from sfa_localization.data.errors import ConfigError, LocalizationError
from sfa_localization.data.settings import Settings, nearest

S = TypeVar('S', bound=Settings)
Current = dict[type[Settings], Settings]
"""The settings in force, by their class."""
_FILES: dict[type[Settings], str] = {
    CameraConfig: 'calibration_file',
    SurroundConfig: 'camera_files',
}
"""Parameters that name files, which lie beside the parameter file."""
_CLOCK = 'use_sim_time'  # a parameter of each node that is not read-only


def declare(node: Node, kinds: Sequence[type[Settings]]) -> Current:
    """Declare every field of `kinds` as a parameter of `node`; return the values given to it.

    Settings that are not `live` become read-only. Raises ConfigError for a wrong value.
    """
    current: Current = {}
    for kind in kinds:
        fields = dataclasses.fields(kind)
        values = {item.name: _declare_field(node, item) for item in fields}
        current[kind] = kind.from_mapping(values, f'parameters of node {node.get_name()!r}')
        for item in fields:
            node.set_descriptor(item.name, _descriptor(item))
    return current


def on_change(
    node: Node,
    current: Current,
    check: Callable[[Current], None],
    apply: Callable[[Settings], None],
) -> None:
    """Check changes of live parameters together, keep them in `current`, and hand them to `apply`.

    Nothing is applied, and the answer gives the reason, if a value is out of range or contradicts
    other parameters, or if `check` raises a LocalizationError.
    """
    fields = {item.name: item for kind in current for item in dataclasses.fields(kind)}

    def convert(changes: list[Parameter]) -> list[Parameter]:
        """Without those that change nothing, as read-only ones by `ros2 param load` of a dump."""
        typed = [_typed(fields[c.name], c) if c.name in fields else c for c in changes]
        now = {p.name: p.value for p in node.get_parameters([c.name for c in typed])}
        changed = [c for c in typed if c.value != now[c.name]]
        return changed or [node.get_parameter(_CLOCK)]  # ROS refuses an empty list

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

    node.add_pre_set_parameters_callback(convert)
    node.add_on_set_parameters_callback(judge)
    node.add_post_set_parameters_callback(accept)


def _changed(settings: S, changes: Sequence[Parameter]) -> S:
    """The settings with those of `changes` that belong to them. Raises ConfigError."""
    names = {item.name for item in dataclasses.fields(settings)}
    return dataclasses.replace(
        settings, **{change.name: change.value for change in changes if change.name in names}
    )


def _typed(item: dataclasses.Field[Any], given: Parameter) -> Parameter:
    """A parameter with real numbers instead of integers if its setting has them.

    ROS reads 3 as an integer, and gives an empty list any type.
    """
    value = given.value
    if isinstance(item.default, float) and type(value) is int:
        return Parameter(item.name, value=float(value))
    if item.metadata['texts']:
        texts = list(value) if isinstance(value, (list, tuple)) else value
        is_text = isinstance(texts, list) and all(isinstance(entry, str) for entry in texts)
        return Parameter(item.name, Parameter.Type.STRING_ARRAY, texts) if is_text else given
    is_list = isinstance(item.default, tuple) and isinstance(value, (list, tuple, array.array))
    if is_list and all(type(entry) in (int, float) for entry in value):
        return Parameter(item.name, Parameter.Type.DOUBLE_ARRAY, [float(x) for x in value])
    return given


def warn_of_arguments(node: Node, words: Sequence[str]) -> None:
    """Warn of arguments without effect: unknown parameters, and sections for other nodes.

    ROS takes `ekf_node:` for a node without namespace, and gives /robot1/ekf_node nothing of it.
    """
    name = node.get_fully_qualified_name()
    logger = node.get_logger()
    declared = node.list_parameters([], 0).names
    given = set()
    for flag, value in itertools.pairwise(words):
        if flag in ('-p', '--param'):
            given.add(value.partition(':=')[0].rpartition(':')[2])
        if flag != '--params-file':
            continue
        try:
            given |= given_names(value, name)
            keys = ignored_sections(value, name)
        except ConfigError:  # ROS, which is less strict, has read it
            continue
        if keys:
            logger.warning(
                f'{value}: nothing of {", ".join(keys)} is used: this node is {name}; '
                f'write /**/{node.get_name()}: for any namespace'
            )
    for unknown in unknown_names(given):
        logger.warning(f'unknown parameter {unknown!r}{nearest(unknown, declared)}')


def resolve_beside_file(node: Node, current: Current, words: Sequence[str]) -> list[type[Settings]]:
    """Resolve calibration files against the folder of the parameter file that names them; return
    the settings that one names.
    """
    return [kind for kind in current.keys() & _FILES.keys() if _resolve(node, current, words, kind)]


def _resolve(node: Node, current: Current, words: Sequence[str], kind: type[Settings]) -> bool:
    pairs = [*itertools.pairwise(words)]
    given = _FILES[kind]
    if any(flag in ('-p', '--param') and value.startswith(given) for flag, value in pairs):
        return False
    for file in reversed([value for flag, value in pairs if flag == '--params-file']):
        with suppress(ConfigError):  # ROS, which is less strict, has read it
            if given in given_names(file, node.get_fully_qualified_name()):
                current[kind] = resolved_beside(current[kind], file)
                return True
    return False


def _declare_field(node: Node, item: dataclasses.Field[Any]) -> Any:
    """Declare one setting of any type, which the descriptor narrows later; return its value."""
    node.declare_parameter(item.name, item.default, ParameterDescriptor(dynamic_typing=True))
    given = node.get_parameter(item.name)
    if isinstance(item.default, tuple) and given.value is None:  # `[]` in a parameter file
        given = Parameter(item.name, value=[])
    node.set_parameters([_typed(item, given)])
    return _typed(item, given).value


def _descriptor(item: dataclasses.Field[Any]) -> ParameterDescriptor:
    """Descriptor of one setting: type, description with unit, range, and whether it may change.

    ROS has no range for lists, nor with one bound only; their Settings check them.
    """
    meta = item.metadata
    unit = f' [{meta["unit"]}]' if meta['unit'] else ''
    descriptor = ParameterDescriptor(description=f'{meta["doc"]}{unit}', read_only=not meta['live'])
    descriptor.type = _typed(item, Parameter(item.name, value=item.default)).type_.value
    if meta['choices']:
        descriptor.additional_constraints = 'one of: ' + ', '.join(filter(None, meta['choices']))
    low = meta['low']
    high = meta['high']
    if low is None or high is None:
        return descriptor
    if isinstance(item.default, float):
        bounds = FloatingPointRange(from_value=float(low), to_value=float(high))
        descriptor.floating_point_range = [bounds]
    elif type(item.default) is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return descriptor
