# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Base of all settings: each has a type, a description, a range and the only default.

Each room has a module `settings`; nodes declare their ROS parameters from its classes, and
`sfa_localization.config` reads and writes the parameter file from them.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from sfa_localization.data.errors import ConfigError
from sfa_localization.data.rejections import quoted

S = TypeVar('S', bound='Settings')
_FORMS = {
    bool: 'true or false',
    float: 'a number',
    int: 'a whole number',
    str: 'a text; put it in quotes',
    tuple: 'a list of numbers, such as [1.0, 2.5], or of texts',
}


def setting(
    default: Any,
    doc: str,
    *,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
    texts: bool = False,
) -> Any:
    """Declare one parameter: `doc` describes it, [low, high] or `choices` bound it.

    `live` parameters may change while a node runs; the others are read-only after start. A list
    holds numbers, or `texts`.
    """
    metadata = {'doc': doc, 'unit': unit, 'live': live, 'low': low, 'high': high}
    return dataclasses.field(
        default=default, metadata={'choices': choices, 'texts': texts, **metadata}
    )


@dataclass(frozen=True, slots=True)
class Settings:
    """Base of the parameter groups: immutable, and checked when constructed."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            entry = '' if item.metadata['texts'] else 0.0
            value = _converted(item.name, item.default, getattr(self, item.name), entry)
            for number in value if isinstance(value, tuple) else (value,):
                _check_bounds(item.name, item.metadata, number)
            object.__setattr__(self, item.name, value)

    @classmethod
    def from_mapping(cls: type[S], mapping: Mapping[str, Any], where: str) -> S:
        """Build from names and values; `where` is their origin in errors.

        Raises ConfigError for an unknown name, a wrong type or a value out of range.
        """
        names = {item.name for item in dataclasses.fields(cls)}
        for name in mapping:
            if name not in names:
                hint = nearest(name, names) or f'; the names are {", ".join(sorted(names))}'
                raise ConfigError(f'{where}: unknown parameter {quoted(name)}{hint}')
        try:
            return cls(**mapping)
        except ConfigError as error:
            raise ConfigError(f'{where}: {error}') from None


def require_pose(name: str, pose: tuple[float, ...]) -> None:
    """Raise ConfigError for a pose that is neither empty nor x (m), y (m) and yaw (rad)."""
    if len(pose) not in (0, 3):
        raise ConfigError(
            f'{name}: {len(pose)} numbers given; give x (m), y (m) and yaw (rad), or none'
        )
    if pose and abs(pose[2]) > 2 * math.pi:
        raise ConfigError(f'{name}: a yaw of {pose[2]:g} rad is more than a turn: give radians')


def nearest(name: str, names: Collection[str]) -> str:
    """The end of a message about an unknown name: the most similar of the names, or ''."""
    close = difflib.get_close_matches(name[:100], sorted(names), n=1)
    return f'; did you mean {close[0]!r}?' if close else ''


def _converted(where: str, default: Any, value: Any, entry: Any = None) -> Any:
    """Accept an int for a float and a list for a tuple, whose values are like `entry`; otherwise
    require the same type.
    """
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        return tuple(_converted(where, entry, each) for each in value)
    if isinstance(default, float) and type(value) is int:
        with suppress(OverflowError):  # of an integer beyond all floats
            return float(value)
    if isinstance(value, bool) != isinstance(default, bool) or not isinstance(value, type(default)):
        raise ConfigError(f'{where}: {quoted(value)} is not {_FORMS[type(default)]}')
    return value


def _check_bounds(where: str, metadata: Mapping[str, Any], value: Any) -> None:
    choices = metadata['choices']
    low = metadata['low']
    high = metadata['high']
    if choices and value not in choices:
        names = ', '.join(filter(None, choices))
        raise ConfigError(f'{where}: {quoted(value)} is not one of {names}')
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f'{where}: {value!r} is not a finite number')
    if (low is not None and value < low) or (high is not None and value > high):
        raise ConfigError(f'{where}: {quoted(value)} is outside [{low}, {high}] {metadata["unit"]}')
