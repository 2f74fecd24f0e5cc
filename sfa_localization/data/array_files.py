# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Named arrays in one .npz file without pickle; a header names kind, version and checksum."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import ModelError
from sfa_localization.data.files import absence, atomic_write
from sfa_localization.data.rejections import short_line

Arrays = dict[str, NDArray[Any]]
_HEADER = 'header'
_CHECKSUM = 'sha256'


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays (N, ...) as .npz, completely or not at all. Raises ModelError.

    The array `header` is a JSON object as text; the checksum of all arrays is added to it.
    """
    header = json.loads(str(arrays[_HEADER]))
    header[_CHECKSUM] = _checksum(arrays, header)
    text = np.array(json.dumps(header, sort_keys=True))
    with atomic_write(Path(path), ModelError) as file:
        np.savez(file, **{**arrays, _HEADER: text})  # type: ignore[arg-type]


def read_arrays(path: Path, kind: str, version: int, remedy: str) -> Arrays:
    """Arrays of an .npz file whose header names its kind and version. Raises ModelError."""
    header = read_header(path, kind, version, remedy)
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        intact = header.get(_CHECKSUM) == _checksum(arrays, header)
    except Exception:  # zip and numpy fail in many ways on foreign bytes
        raise _unreadable(path, kind, remedy) from None
    if not intact:
        raise ModelError(f'{path}: damaged (its checksum is wrong or missing): {remedy} again')
    return arrays


def read_header(path: Path, kind: str, version: int, remedy: str) -> dict[str, Any]:
    """The header of such a file, without reading the rest. Raises ModelError."""
    if not os.path.isfile(path):
        raise ModelError(f'{path}: {absence(path)}: {remedy}')
    try:
        with np.load(path, allow_pickle=False) as file:
            header: dict[str, Any] = json.loads(str(file[_HEADER]))
        stored = {name: short_line(str(header[name])) for name in ('format', 'version')}
    except Exception:  # zip, numpy and json fail in many ways on foreign bytes
        raise _unreadable(path, kind, remedy) from None
    if stored['format'] != kind:
        raise ModelError(f'{path}: a {stored["format"]}, not a {kind}: {remedy}')
    if header['version'] != version:
        reads = f'version {stored["version"]}, this software reads {version}'
        raise ModelError(f'{path}: {reads}: {remedy} again')
    return header


def _unreadable(path: Path, kind: str, remedy: str) -> ModelError:
    return ModelError(f'{path}: not a {kind}, or a damaged one: copy it again, or {remedy}')


def packed(lower: NDArray[Any]) -> NDArray[Any]:
    """The lower triangle (N (N + 1) / 2,) of a triangular matrix (N, N), row by row."""
    return np.asarray(lower[np.tril_indices(len(lower))])


def unpacked(triangle: NDArray[Any]) -> NDArray[Any]:
    """The lower triangular matrix (N, N), in Fortran order, of its packed triangle."""
    size = (round((8 * len(triangle) + 1) ** 0.5) - 1) // 2
    lower = np.zeros((size, size), triangle.dtype, order='F')
    lower[np.tril_indices(size)] = triangle
    return lower


def _checksum(arrays: Mapping[str, NDArray[Any]], header: Mapping[str, Any]) -> str:
    """SHA-256 of arrays (N, ...), by name, and of the header without its checksum."""
    rest = {name: value for name, value in header.items() if name != _CHECKSUM}
    digest = hashlib.sha256(json.dumps(rest, sort_keys=True).encode())
    for name in sorted(set(arrays) - {_HEADER}):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f'\n{name} {array.dtype.str} {np.shape(arrays[name])}\n'.encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
