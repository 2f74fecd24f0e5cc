# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The parameter file: one YAML for nodes and trainer, written from the settings of the rooms."""

from __future__ import annotations

import dataclasses
import difflib
import re
import textwrap
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from sfa_localization.bags.settings import BagConfig, TopicNames
from sfa_localization.camera.settings import (
    CameraConfig,
    CaptureConfig,
    PanoramaConfig,
    SurroundConfig,
    WatchConfig,
)
from sfa_localization.data.errors import ConfigError
from sfa_localization.data.files import read_text, write_bytes
from sfa_localization.data.plain_yaml import LONGEST, load_yaml
from sfa_localization.data.rejections import quoted
from sfa_localization.data.settings import Settings, nearest
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.nodes.settings import (
    EkfNodeConfig,
    NodeConfig,
    OmnicamNodeConfig,
    SfaNodeConfig,
    TeachNodeConfig,
)
from sfa_localization.sfa.settings import NetworkConfig

S = TypeVar('S', bound=Settings)
SECTIONS: dict[str, tuple[type[Settings], ...]] = {
    'omnicam_node': (
        NodeConfig,
        OmnicamNodeConfig,
        CaptureConfig,
        CameraConfig,
        SurroundConfig,
        PanoramaConfig,
    ),
    'sfa_node': (NodeConfig, SfaNodeConfig, WatchConfig),
    'ekf_node': (NodeConfig, EkfNodeConfig, FilterConfig),
    'teach_node': (NodeConfig, TeachNodeConfig, TopicNames),
    'training': (TopicNames, BagConfig, NetworkConfig, SegmentConfig, MetricConfig),
}
"""The settings of each section; the trainer reads camera and panorama from omnicam_node."""
_KEY = 'ros__parameters'
_WILDCARDS = {'**': r'(/\w+)*', '*': r'/\w+'}
_ROS_PARAMETERS = ('use_sim_time', 'qos_overrides', 'start_type_description_service')
"""Parameters that rclpy declares for every node."""
_MISSPELT = 0.85  # similarity of names; ekf_filter_node of robot_localization has 0.7
_HEAD = """\
# Every parameter of sfa_localization, with its default; all are optional.
# Nodes read this file with --ros-args --params-file FILE, commands with --config FILE.
# /**/ stands for any namespace, or none; ROS ignores sections of other namespaces.
# Written from the code by: python -m sfa_localization config --output FILE
"""


def load_settings(path: Path | str, section: str, kind: type[S]) -> S:
    """Return the settings `kind` of a section; missing parameters have their defaults.

    Raises ConfigError with file, section and parameter for an invalid file.
    """
    parameters = load_section(Path(path), section)
    names = {item.name for item in dataclasses.fields(kind)}
    chosen = {name: value for name, value in parameters.items() if name in names}
    return resolved_beside(kind.from_mapping(chosen, f'{path}: {section}'), path)


def resolved_beside(settings: S, path: Path | str) -> S:
    """Settings of a parameter file, whose relative calibration files lie beside it."""
    folder = Path(path).parent
    if isinstance(settings, CameraConfig) and settings.calibration_file:
        return dataclasses.replace(
            settings, calibration_file=str(folder / settings.calibration_file)
        )
    if isinstance(settings, SurroundConfig):
        files = tuple(str(folder / file) for file in settings.camera_files)
        return dataclasses.replace(settings, camera_files=files)
    return settings


def load_section(path: Path, section: str) -> dict[str, Any]:
    """Return the parameters of a section in any namespace, and its parameters in `/**`.

    Parameters of ROS, such as `use_sim_time`, are kept. Raises ConfigError, also if sections of
    several namespaces differ: a command cannot choose between robots.
    """
    items = _items(section)
    shared: dict[str, Any] = {}
    robots: dict[str, dict[str, Any]] = {}
    for key, values in _sections(path).items():
        namespace, _, node = key.strip('/').rpartition('/')
        if node not in (*SECTIONS, *_WILDCARDS):
            raise ConfigError(
                f'{path}: unknown section {quoted(key)}; known are {", ".join(SECTIONS)}, also in '
                f'a namespace, and /**'
            )
        if node in _WILDCARDS:
            _check_names(values, all_names(), f'{path}: {key}')
            shared.update(values)
        else:
            _check_names(values, _items(node), f'{path}: {node}')
        if node == section:
            robots.setdefault(namespace, {}).update(values)
    given = {**shared, **_merged(robots, f'{path}: {section}')}
    return {
        name: _value(items[name], value) if name in items else value
        for name, value in given.items()
        if name in items or _is_of_ros(name)
    }


def _items(section: str) -> dict[str, dataclasses.Field[Any]]:
    """The settings of a section by name."""
    return {item.name: item for kind in SECTIONS[section] for item in dataclasses.fields(kind)}


def all_names() -> set[str]:
    """Return the names of the parameters of all sections."""
    return {name for section in SECTIONS for name in _items(section)}


def _is_of_ros(name: str) -> bool:
    """Whether rclpy declares the parameter, written as a tree or with dots."""
    return name.partition('.')[0] in _ROS_PARAMETERS


def load_changes(path: Path | str) -> dict[str, dict[str, Any]]:
    """Return all parameters in a file, by section, as `render` takes them. Raises ConfigError."""
    return {section: load_section(Path(path), section) for section in SECTIONS}


def ignored_sections(path: Path | str, node: str) -> list[str]:
    """Return the keys of sections that are meant for a node but that ROS does not give to it.

    `node` is the full name, such as /robot1/ekf_node. The name in the key is misspelt, or if no
    section matches, its namespace is wrong. Raises ConfigError for an unreadable file.
    """
    keys = [*_sections(Path(path))]
    name = _node_of(node)
    same_name = [key for key in keys if _node_of(key) == name]
    misspelt = [
        key
        for key in keys
        if difflib.get_close_matches(_node_of(key), {*SECTIONS, name}, 1, _MISSPELT) == [name]
        and key not in same_name
    ]
    return misspelt + ([] if any(_matches(key, node) for key in keys) else same_name)


def given_names(path: Path | str, node: str) -> set[str]:
    """Return the parameters that ROS gives from a file to a node of this full name."""
    sections = _sections(Path(path)).items()
    return {name for key, values in sections if _matches(key, node) for name in values}


def unknown_names(names: Collection[str]) -> list[str]:
    """Return those parameters that neither this package nor ROS has."""
    return sorted(name for name in set(names) - all_names() if not _is_of_ros(name))


def _node_of(key: str) -> str:
    return key.rpartition('/')[2]


def _matches(key: str, node: str) -> bool:
    """Whether ROS gives a section to a node with this full name."""
    parts = (_WILDCARDS.get(part, '/' + re.escape(part)) for part in key.split('/') if part)
    return re.fullmatch(''.join(parts), node) is not None


def _sections(path: Path) -> dict[str, dict[str, Any]]:
    """Return the parameters of each section by its key, with namespaces joined by slashes.

    As in ROS, `robot1: {ekf_node: ...}` and `/robot1/ekf_node: ...` are equivalent.
    """
    try:
        # Not from a pipe, which would be empty for the next section.
        document = load_yaml(read_text(path, LONGEST, ConfigError))
    except ValueError as error:
        raise ConfigError(f'{path}: {error}') from None
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise ConfigError(f'{path}: must hold sections such as {", ".join(SECTIONS)}')
    sections: dict[str, dict[str, Any]] = {}
    for name, part in document.items():
        _collect(str(name), part, path, sections)
    return sections


def _collect(key: str, part: Any, path: Path, sections: dict[str, dict[str, Any]]) -> None:
    """Add the section of a key, or the sections of the namespace that the key names."""
    inner = part if isinstance(part, dict) else {}
    nested = bool(inner) and _node_of(key) not in SECTIONS and _KEY not in inner
    if nested and all(isinstance(below, dict) for below in inner.values()):
        for name, below in inner.items():
            _collect(f'{key}/{str(name).lstrip("/")}', below, path, sections)
        return
    if part is not None and (not isinstance(part, dict) or (part and set(part) != {_KEY})):
        raise ConfigError(
            f'{path}: section {quoted(key)} must hold {_KEY!r}, and parameters below it'
        )
    values = inner.get(_KEY) or {}
    if not isinstance(values, dict):
        raise ConfigError(f'{path}: {key}.{_KEY} must hold names and values')
    sections.setdefault(key, {}).update({str(name): value for name, value in values.items()})


def _merged(robots: Mapping[str, Mapping[str, Any]], where: str) -> dict[str, Any]:
    """Return the parameters of {namespace: parameters}; namespaces override wildcards.

    Raises ConfigError if two robots have different values of a parameter.
    """
    merged: dict[str, Any] = {}
    for namespace, values in robots.items():
        for name, value in values.items() if '*' not in namespace else ():
            if name in merged and merged[name] != value:
                raise ConfigError(
                    f'{where}: {name} is {quoted(merged[name])} for one robot and {quoted(value)} '
                    f'for another: give commands a file of one robot'
                )
            merged[name] = value
    wild = [values for namespace, values in robots.items() if '*' in namespace]
    return {name: value for values in [*wild, merged] for name, value in values.items()}


def _check_names(values: Mapping[str, Any], names: Collection[str], where: str) -> None:
    for name in values:
        if name not in names and not _is_of_ros(name):
            raise ConfigError(f'{where}: unknown parameter {quoted(name)}{nearest(name, names)}')


def _value(item: dataclasses.Field[Any], value: Any) -> Any:
    """Convert to float as ROS does: from an integer, or from 1e-3, a string in YAML 1.1."""
    if isinstance(item.default, float) and type(value) in (str, int):
        try:
            return float(value)
        except (ValueError, OverflowError):
            return value
    return value


def render(changes: Mapping[str, Mapping[str, Any]] | None = None) -> str:
    """Return the parameter file: defaults, replaced by `changes` {section: {name: value}}."""
    parts = [_HEAD]
    for section, kinds in SECTIONS.items():
        prefix = '/**/' if section.endswith('_node') else ''
        parts.append(f'{prefix}{section}:\n  {_KEY}:\n')
        changed = (changes or {}).get(section, {})
        parts += [_group(kind, changed) for kind in kinds]
        if of_ros := {name: value for name, value in changed.items() if _is_of_ros(name)}:
            text = yaml.safe_dump(of_ros, sort_keys=False, allow_unicode=True)
            parts.append(textwrap.indent(f'# --- Parameters of ROS.\n{text}', '    '))
    return ''.join(parts)


def write_config(path: Path | str, changes: Mapping[str, Mapping[str, Any]] | None = None) -> None:
    """Write `render(changes)` to a file, atomically. Raises ConfigError."""
    write_bytes(Path(path), render(changes).encode(), ConfigError)


def _group(kind: type[Settings], changes: Mapping[str, Any]) -> str:
    title = (kind.__doc__ or '').strip().splitlines()[0]
    lines = [f'    # --- {title}']
    for item in dataclasses.fields(kind):
        lines += [f'    # {line}' for line in textwrap.wrap(_described(item), 94)]
        lines.append(f'    {item.name}: {_text(changes.get(item.name, item.default))}')
    return '\n'.join(lines) + '\n'


def _described(item: dataclasses.Field[Any]) -> str:
    """Return description, unit and range of a parameter, and whether it may change at run time."""
    meta = item.metadata
    unit = f' [{meta["unit"]}]' if meta['unit'] else ''
    parts = [f'{meta["doc"]}{unit}']
    if meta['choices']:
        parts.append('one of ' + ', '.join(filter(None, meta['choices'])))
    if meta['low'] is not None or meta['high'] is not None:
        low = '' if meta['low'] is None else f'{meta["low"]:g}'
        high = '' if meta['high'] is None else f'{meta["high"]:g}'
        parts.append(f'{low}..{high}')
    if meta['live']:
        parts.append('may change while running')
    return '; '.join(parts)


def _text(value: Any) -> str:
    """Return a value in YAML 1.1, strings in quotes."""
    if isinstance(value, str):
        return "'" + value.replace("'", "''") + "'"
    plain = list(value) if isinstance(value, tuple) else value
    return yaml.safe_dump(plain, default_flow_style=True, width=1000).splitlines()[0]
