# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which arrays a file may hold: the names of each group, and the type, shape and sign of each."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import ModelError
from sfa_localization.data.rejections import short_line


class ArrayRule(NamedTuple):
    """What one array must be.

    `shape` has a number or a letter for each axis: its length, or any length, the same everywhere
    in the group. `kind` is that of its dtype: f real, c complex, i integer, u unsigned,
    b boolean, U text. The numbers at the places `positive`, in order, must be > 0;
    `all_positive`: all. None is larger than `largest`, either way.
    """

    shape: str
    kind: str = 'f'
    positive: tuple[int, ...] = ()
    all_positive: bool = False
    largest: float = math.inf


Group = Mapping[str, ArrayRule]
Schema = Mapping[str, Sequence[Group]]
"""Prefix of a group, where # stands for a number -> the alternatives of what it holds."""


def check_arrays(arrays: Mapping[str, NDArray[Any]], schema: Schema) -> None:
    """Require that every array (N, ...) is in a group of the schema, and every group complete.

    Raises ModelError, naming the array.
    """
    groups: dict[str, dict[str, NDArray[Any]]] = {}
    for name, array in arrays.items():
        groups.setdefault(_prefix(name, schema), {})[name] = array
    for prefix, group in groups.items():
        own = {name[len(prefix) :]: array for name, array in group.items()}
        rules = _alternative(prefix, own, schema[_pattern(prefix)])
        lengths: dict[str, int] = {}
        for name, rule in rules.items():
            _check(prefix + name, own[name], rule, lengths)


def _pattern(name: str) -> str:
    """The name with # for its numbers."""
    return re.sub(r'(?<=/)\d+(?=/)', '#', name)


def _prefix(name: str, schema: Schema) -> str:
    """The longest prefix of the schema that a name has."""
    fitting = [prefix for prefix in schema if _pattern(name).startswith(prefix)]
    if not fitting:
        raise ModelError(f'the array {short_line(name)} is unknown')
    longest = max(fitting, key=len)
    # A number may have more digits than the # that stands for it.
    return name[: len(name) - len(_pattern(name)) + len(longest)]


def _alternative(prefix: str, names: Mapping[str, Any], groups: Sequence[Group]) -> Group:
    """The group with exactly these names."""
    for group in groups:
        if set(group) == set(names):
            return group
    nearest = min(groups, key=lambda group: len(set(group) ^ set(names)))
    wrong = min(set(nearest) ^ set(names))
    how = 'is missing' if wrong in nearest else 'is unknown'
    raise ModelError(f'the array {short_line(prefix + wrong)} {how}')


def _check(name: str, array: NDArray[Any], rule: ArrayRule, lengths: dict[str, int]) -> None:
    if array.dtype.kind != rule.kind:
        raise ModelError(f'the array {name} is of type {array.dtype}')
    axes = re.findall(r'\d+|\D', rule.shape)
    fits = array.ndim == len(axes) and all(
        length == (int(axis) if axis.isdigit() else lengths.setdefault(axis, length))
        for axis, length in zip(axes, array.shape, strict=False)
    )
    if not fits:
        raise ModelError(f'the array {name} has the shape {array.shape}')
    numbers = array.ravel() if rule.all_positive else array.ravel()[list(rule.positive)]
    if rule.kind in 'fiu' and not np.all(numbers > 0):
        raise ModelError(f'the array {name} holds a number that must be positive')
    if rule.kind in 'fiuc' and array.size and np.abs(array).max() > rule.largest:
        raise ModelError(f'the array {name} holds a number beyond {rule.largest:g}')
