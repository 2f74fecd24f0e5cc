# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""YAML from a stranger as plain data, in bounded depth, size, number and length of numbers.

The events of the text are checked before anything is made of them: libyaml's composer overflows the
stack on nested brackets, and aliases of aliases become millions of values.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Hashable, Iterator
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
MOST_VALUES = 500_000
"""Values, with those that aliases repeat."""
LONGEST_NUMBER = 64
"""Characters of a number: longer ones are no float, and cost more than their length."""
_NUMBER = re.compile(r'[-+]?\d[\da-fA-FxXoO_:.]*')


def load_yaml(text: str, loader: Any = YamlLoader, *, first: bool = False) -> Any:
    """Plain data of the only document of a text, or of the `first`; None when there is none.

    Raises ValueError, whose text is one line, for text that is no YAML, has a key twice, or
    exceeds a limit.
    """
    if len(text) > LONGEST:
        raise ValueError(f'has {len(text)} characters, more than {LONGEST}')
    try:
        documents = _checked_documents(text)
        for _ in itertools.islice(documents, 1 if first else None):
            pass
        return _loaded(text, loader, first)
    except yaml.MarkedYAMLError as error:
        raise ValueError(f'is not YAML: {_described(error)}') from None
    except yaml.YAMLError as error:
        raise ValueError(f'is not YAML: {" ".join(str(error).split())[:200]}') from None


def _loaded(text: str, loader: Any, first: bool) -> Any:
    """The document of a text within the limits. Raises ValueError, and yaml.YAMLError."""
    try:
        return next(iter(yaml.load_all(text, loader)), None) if first else yaml.load(text, loader)
    except yaml.YAMLError:
        raise
    except Exception as error:  # dates and numbers that cannot be fail in many ways
        why = ' '.join(str(error).split())[:200]
        raise ValueError(f'has a date or a number that cannot be: {why}') from None


def _described(error: yaml.MarkedYAMLError) -> str:
    """Problem and place, without the text around it."""
    place = error.problem_mark or error.context_mark
    where = f'line {place.line + 1}, column {place.column + 1}: ' if place else ''
    problem = ' '.join(str(error.problem or error.context).split())
    return f'{where}{problem[:200]}'


class _Level:
    """A sequence or mapping that is open: the values in it so far, and the keys of a mapping."""

    def __init__(self, anchor: str | None, is_mapping: bool) -> None:
        self.anchor, self.is_mapping = anchor, is_mapping
        self.count, self.parts = 1, 0
        self.keys: set[Hashable] = set()

    @property
    def expects_key(self) -> bool:
        return self.is_mapping and self.parts % 2 == 0


def _checked_documents(text: str) -> Iterator[None]:
    """Yield after each document that respects the limits. Raises ValueError."""
    levels: list[_Level] = []
    counts: dict[str, int] = {}
    for event in yaml.parse(text, YamlLoader):
        if isinstance(event, yaml.DocumentStartEvent):
            counts.clear()
        elif isinstance(event, yaml.DocumentEndEvent):
            yield
        elif isinstance(event, yaml.CollectionStartEvent):
            levels.append(_Level(event.anchor, isinstance(event, yaml.MappingStartEvent)))
            if len(levels) > DEEPEST:
                raise ValueError(f'is nested deeper than {DEEPEST} levels')
        elif isinstance(event, yaml.CollectionEndEvent):
            closed = levels.pop()
            _add(levels, closed.count, closed.anchor, counts)
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in counts:
                raise ValueError(
                    f'the alias {str(event.anchor)[:50]!r} stands for itself or nothing'
                )
            _add(levels, counts[event.anchor], None, counts)
        elif isinstance(event, yaml.ScalarEvent):
            _check_scalar(event, levels)
            _add(levels, 1, event.anchor, counts)


def _add(levels: list[_Level], count: int, anchor: str | None, counts: dict[str, int]) -> None:
    """Add a complete value, made of `count`, to the level that is open."""
    if anchor is not None:
        counts[anchor] = count
    if levels:
        levels[-1].count += count
        levels[-1].parts += 1
        count = levels[-1].count
    if count > MOST_VALUES:
        raise ValueError(f'holds more than {MOST_VALUES} values')


def _check_scalar(event: Any, levels: list[_Level]) -> None:
    text, plain = event.value, event.implicit[0] or event.tag is not None
    if plain and len(text) > LONGEST_NUMBER and _NUMBER.fullmatch(text):
        raise ValueError(f'has a number of {len(text)} characters, more than {LONGEST_NUMBER}')
    if levels and levels[-1].expects_key:
        keys = levels[-1].keys
        if text in keys and text != '<<':  # which merges other mappings, of any number
            line = event.start_mark.line + 1
            raise ValueError(f'has the key {text[:100]!r} twice, again in line {line}')
        keys.add(text)
