# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every parameter of the project: typed, described, ranged, and with its only default.

ROS nodes declare their parameters from these classes, the trainer reads the same names from
the same YAML file, and ``config/localization.yaml`` is written from them.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from sfa_localization.errors import ConfigError

S = TypeVar('S', bound='Settings')


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
    """Base of the parameter groups: immutable and checked when made."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            value = _checked(type(self).__name__, item, getattr(self, item.name))
            object.__setattr__(self, item.name, value)

    @classmethod
    def from_mapping(cls: type[S], mapping: Mapping[str, Any], where: str) -> S:
        """Build from plain names and values; `where` names their origin in errors.

        Raises ConfigError for an unknown name, a wrong type or a value out of range.
        """
        known = {item.name for item in dataclasses.fields(cls)}
        for name in mapping:
            if name not in known:
                raise ConfigError(f'{where}: unknown parameter {name!r}{_did_you_mean(name, known)}')
        try:
            return cls(**mapping)
        except ConfigError as error:
            raise ConfigError(f'{where}: {error}') from None


def _did_you_mean(name: str, known: set[str]) -> str:
    close = difflib.get_close_matches(name, sorted(known), n=1)
    if close:
        return f'; did you mean {close[0]!r}?'
    return f'; known are {", ".join(sorted(known))}'


def _checked(group: str, item: dataclasses.Field[Any], value: Any) -> Any:
    """Return the value in the default's type, or raise ConfigError."""
    where = f'{group}.{item.name}'
    value = _converted(where, item.default, value)
    numbers = value if isinstance(value, tuple) else (value,)
    for number in numbers:
        _check_bounds(where, item.metadata, number)
    return value


def _converted(where: str, default: Any, value: Any) -> Any:
    """Accept an int where a float is expected, a list where a tuple is, and nothing else."""
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        kind = default[0] if default else 0.0
        return tuple(_converted(where, kind, entry) for entry in value)
    if isinstance(default, bool) or isinstance(value, bool):
        matches = isinstance(default, bool) and isinstance(value, bool)
    elif isinstance(default, float) and isinstance(value, (int, float)):
        return float(value)
    else:
        matches = isinstance(value, type(default))
    if not matches:
        raise ConfigError(f'{where}: {value!r} is not of type {type(default).__name__}')
    return value


def _check_bounds(where: str, metadata: Mapping[str, Any], value: Any) -> None:
    if metadata['choices'] and value not in metadata['choices']:
        raise ConfigError(f'{where}: {value!r} is not one of {", ".join(metadata["choices"])}')
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return
    if not math.isfinite(value):
        raise ConfigError(f'{where}: {value!r} is not a finite number')
    low, high = metadata['low'], metadata['high']
    if (low is not None and value < low) or (high is not None and value > high):
        raise ConfigError(f'{where}: {value!r} is outside [{low}, {high}] {metadata["unit"]}')


@dataclass(frozen=True, slots=True)
class PanoramaConfig(Settings):
    """Size and geometry of the panorama: what the network sees.

    The centre column looks along the robot's +x axis; columns grow clockwise seen from above.
    """

    width: int = setting(600, 'columns of the panorama', unit='px', low=16, high=8192)
    height: int = setting(60, 'rows of the panorama', unit='px', low=4, high=4096)
    elevation_min: float = setting(
        -12.0, 'elevation of the lower edge', unit='deg', low=-90.0, high=89.0
    )
    elevation_max: float = setting(
        24.0, 'elevation of the upper edge', unit='deg', low=-89.0, high=90.0
    )
    clockwise: bool = setting(True, 'columns grow clockwise seen from above')


@dataclass(frozen=True, slots=True)
class TopicNames(Settings):
    """Topics of a bag; an empty name is found by its type. Of /tf, name '/tf:CHILD_FRAME'."""

    image: str = setting('', 'pictures: Image or CompressedImage')
    odometry: str = setting('', 'wheel odometry: Odometry, or any pose when named')
    imu: str = setting('', 'yaw rate: Imu')
    ground_truth: str = setting('', 'true poses, read for evaluation only')


@dataclass(frozen=True, slots=True)
class BagConfig(Settings):
    """How the messages of a bag become a run."""

    stamp_source: str = setting(
        'header', 'time of a message: its header or its reception', choices=('header', 'receive')
    )
    odometry_tolerance: float = setting(
        0.5, 'pictures farther from an odometry message are skipped', unit='s', low=0.0, high=60.0
    )
    clock_jump: float = setting(
        10.0, 'a stamp off by more, against reception, is a jump', unit='s', low=0.1, high=1e6
    )
    odometry_jump: float = setting(
        2.0, 'odometry that moves this far beyond its twist was reset', unit='m', low=0.1, high=1e3
    )
