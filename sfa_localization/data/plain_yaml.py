# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""YAML as plain data, of bounded length and depth, whose mappings have each key once."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import yaml

try:
    from yaml import CSafeLoader as YamlLoader
except ImportError:  # PyYAML was built without libyaml
    from yaml import SafeLoader as YamlLoader  # type: ignore[assignment]

LONGEST = 1 << 23
"""Characters of a text: metadata of a bag with ten thousand files."""
_DEEPEST = 32  # levels of nesting; no file of this package or of ROS has ten
_POWER = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$')


def load_yaml(text: str, loader: Any = YamlLoader, *, first: bool = False) -> Any:
    """Plain data of the only document of a text, or of the `first`; None when there is none.

    Raises ValueError with one line of text for broken YAML, a repeated key, or an exceeded limit.
    """
    if len(text) > LONGEST:
        raise ValueError(f'has {len(text)} characters, more than {LONGEST}')
    loader = _with_powers(loader)
    try:
        _check_events(text, first)
        return next(yaml.load_all(text, loader), None) if first else yaml.load(text, loader)
    except yaml.YAMLError as error:
        place = getattr(error, 'problem_mark', None)
        where = f'line {place.line + 1}, column {place.column + 1}: ' if place else ''
        why = ' '.join(str(getattr(error, 'problem', error)).split())[:200]
        raise ValueError(f'is not YAML: {where}{why}') from None
    except Exception as error:  # impossible dates and numbers fail in many ways
        why = ' '.join(str(error).split())[:200]
        raise ValueError(f'has an impossible date or number: {why}') from None


@cache
def _with_powers(loader: Any) -> Any:
    """The loader, for which numbers such as 4e-09, which most programs write, are no texts, as they
    are in YAML 1.1.
    """
    extended: Any = type(loader.__name__, (loader,), {})
    extended.add_implicit_resolver('tag:yaml.org,2002:float', _POWER, [*'-+.0123456789'])
    return extended


def _check_events(text: str, first: bool) -> None:
    """Check depth and keys before anything is made: libyaml's composer overflows the stack."""
    levels: list[list[Any]] = []  # of each open collection: its keys and number of nodes
    for event in yaml.parse(text, YamlLoader):
        if isinstance(event, yaml.DocumentEndEvent) and first:
            return
        if isinstance(event, yaml.CollectionEndEvent):
            levels.pop()
        if not isinstance(event, yaml.NodeEvent):
            continue
        problem = ''
        if levels:
            keys = levels[-1][0]
            levels[-1][1] = levels[-1][1] + 1
            if keys is not None and levels[-1][1] % 2 and isinstance(event, yaml.ScalarEvent):
                if event.value in keys and event.value != '<<':  # merges any number of mappings
                    problem = f'it has the key {event.value[:100]!r} twice'
                keys.add(event.value)
        if isinstance(event, yaml.CollectionStartEvent):
            levels.append([set() if isinstance(event, yaml.MappingStartEvent) else None, 0])
            if len(levels) > _DEEPEST:
                problem = f'it is nested deeper than {_DEEPEST} levels'
        if problem:
            mark = event.start_mark
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)  # type: ignore[arg-type]
