# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Base of all settings: typed, with a description, a range and the only default.

Each room has its own module `settings`; nodes declare their ROS parameters from its classes,
and `sfa_localization.config` reads and writes the parameter file from them.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from sfa_localization.data.errors import ConfigError
from sfa_localization.data.rejections import quoted

S = TypeVar('S', bound='Settings')
_LONGEST_NAME = 100
"""Characters of a wrong name that are compared with those of the parameters."""
_MOST_ENTRIES, _LONGEST_TEXT = 100, 4096
"""Of a value: no list of sectors and no path is longer, and longer ones would block a node."""


def setting(
    default: Any,
    doc: str,
    *,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """Declare one parameter: `doc` describes it, [low, high] or `choices` bound it.

    `live` parameters may change while a node runs; the others are read-only after start.
    """
    bounds = {'low': low, 'high': high, 'choices': choices}
    return dataclasses.field(
        default=default, metadata={'doc': doc, 'unit': unit, 'live': live, **bounds}
    )


@dataclass(frozen=True, slots=True)
class Settings:
    """Base of the parameter groups: immutable, and checked when constructed."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            value = _checked(item, getattr(self, item.name))
            object.__setattr__(self, item.name, value)

    @classmethod
    def from_mapping(cls: type[S], mapping: Mapping[str, Any], where: str) -> S:
        """Build from names and values; `where` is their origin in errors.

        Raises ConfigError for an unknown name, a wrong type or a value out of range.
        """
        known = {item.name for item in dataclasses.fields(cls)}
        for name in mapping:
            if name not in known:
                raise ConfigError(
                    f'{where}: unknown parameter {quoted(name)}'
                    f'{nearest(name, known) or "; known are " + ", ".join(sorted(known))}'
                )
        try:
            return cls(**mapping)
        except ConfigError as error:
            raise ConfigError(f'{where}: {error}') from None


def nearest(name: str, known: Collection[str]) -> str:
    """The end of a message about an unknown name: the most similar known one, or ''."""
    close = difflib.get_close_matches(name[:_LONGEST_NAME], sorted(known), n=1)
    return f'; did you mean {close[0]!r}?' if close else ''


def _checked(item: dataclasses.Field[Any], value: Any) -> Any:
    """Return the value in the type of the default, or raise ConfigError."""
    where = item.name
    value = _converted(where, item.default, value)
    numbers = value if isinstance(value, tuple) else (value,)
    for number in numbers:
        _check_bounds(where, item.metadata, number)
    return value


def _converted(where: str, default: Any, value: Any) -> Any:
    """Accept an int for a float and a list for a tuple; otherwise require the same type."""
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        if len(value) > _MOST_ENTRIES:
            raise ConfigError(f'{where}: {len(value)} entries are more than {_MOST_ENTRIES}')
        kind = default[0] if default else 0.0
        return tuple(_converted(where, kind, entry) for entry in value)
    if isinstance(default, bool) or isinstance(value, bool):
        matches = isinstance(default, bool) and isinstance(value, bool)
    elif isinstance(default, float) and isinstance(value, (int, float)):
        return _float(where, value)
    else:
        matches = isinstance(value, type(default))
    if isinstance(value, str) and len(value) > _LONGEST_TEXT:
        raise ConfigError(f'{where}: a text of {len(value)} characters, more than {_LONGEST_TEXT}')
    if not matches:
        raise ConfigError(f'{where}: {quoted(value)} is not of type {type(default).__name__}')
    return value


def _float(where: str, value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        raise ConfigError(f'{where}: {quoted(value)} is too large') from None


def _check_bounds(where: str, metadata: Mapping[str, Any], value: Any) -> None:
    if metadata['choices'] and value not in metadata['choices']:
        raise ConfigError(
            f'{where}: {quoted(value)} is not one of {", ".join(filter(None, metadata["choices"]))}'
        )
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f'{where}: {value!r} is not a finite number')
    low, high = metadata['low'], metadata['high']
    if (low is not None and value < low) or (high is not None and value > high):
        raise ConfigError(f'{where}: {quoted(value)} is outside [{low}, {high}] {metadata["unit"]}')
