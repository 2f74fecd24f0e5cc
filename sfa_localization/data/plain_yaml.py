# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""YAML as plain data, of bounded length and depth, in which each key is there once."""

from __future__ import annotations

from typing import Any

import yaml

try:
    from yaml import CSafeLoader as YamlLoader
except ImportError:  # PyYAML was built without libyaml
    from yaml import SafeLoader as YamlLoader  # type: ignore[assignment]

LONGEST = 1 << 23
"""Characters of a text: metadata of a bag with ten thousand files."""
DEEPEST = 32
"""Levels of nesting; no file of this package or of ROS has ten."""


def load_yaml(text: str, loader: Any = YamlLoader, *, first: bool = False) -> Any:
    """Plain data of the only document of a text, or of the `first`; None when there is none.

    Raises ValueError, whose text is one line, for text that is no YAML, has a key twice, or
    exceeds a limit.
    """
    if len(text) > LONGEST:
        raise ValueError(f'has {len(text)} characters, more than {LONGEST}')
    try:
        _check_events(text, first)
        return next(yaml.load_all(text, loader), None) if first else yaml.load(text, loader)
    except yaml.YAMLError as error:
        place = getattr(error, 'problem_mark', None)
        where = f'line {place.line + 1}, column {place.column + 1}: ' if place else ''
        why = ' '.join(str(getattr(error, 'problem', error)).split())[:200]
        raise ValueError(f'is not YAML: {where}{why}') from None
    except _LimitError as error:
        raise ValueError(str(error)) from None
    except Exception as error:  # dates and numbers that cannot be fail in many ways
        why = ' '.join(str(error).split())[:200]
        raise ValueError(f'has a date or a number that cannot be: {why}') from None


class _LimitError(Exception):
    """The text breaks a rule of this module, in words."""


def _check_events(text: str, first: bool) -> None:
    """Check depth and keys before anything is made: libyaml's composer overflows the stack."""
    levels: list[list[Any]] = []  # of each that is open: the keys of a mapping, values so far
    for event in yaml.parse(text, YamlLoader):
        if isinstance(event, yaml.DocumentEndEvent) and first:
            return
        if isinstance(event, yaml.CollectionEndEvent):
            levels.pop()
        elif isinstance(event, yaml.NodeEvent):
            if levels:
                _add(event, levels[-1])
            if isinstance(event, yaml.CollectionStartEvent):
                levels.append([set() if isinstance(event, yaml.MappingStartEvent) else None, 0])
                if len(levels) > DEEPEST:
                    raise _LimitError(f'is nested deeper than {DEEPEST} levels')


def _add(event: Any, level: list[Any]) -> None:
    """Count a value of an open level, and note it where it is a key."""
    keys, level[1] = level[0], level[1] + 1
    if keys is not None and level[1] % 2 and isinstance(event, yaml.ScalarEvent):
        key = event.value
        if key in keys and key != '<<':  # which merges other mappings, of any number
            raise _LimitError(f'has the key {key[:100]!r} twice')
        keys.add(key)
