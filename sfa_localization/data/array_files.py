# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Named arrays in one .npz file without pickle, with a header that names its kind and version."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import ModelError
from sfa_localization.data.files import atomic_write

Arrays = dict[str, NDArray[Any]]
Number = TypeVar('Number', bound=np.generic)


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays (N, ...) as .npz, completely or not at all. Raises ModelError."""
    plain: dict[str, Any] = dict(arrays)
    with atomic_write(Path(path), ModelError, make_folder=True) as file:
        np.savez(file, **plain)


def read_arrays(path: Path, kind: str, version: int, remedy: str) -> Arrays:
    """Arrays of an .npz file whose header names its kind and version. Raises ModelError."""
    if not path.is_file():
        raise ModelError(f'{path}: no such file: {remedy}')
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays['header']))
        found_kind, found_version = header['format'], header['version']
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, EOFError) as error:
        raise ModelError(f'{path}: not a {kind} ({type(error).__name__}): {remedy}') from None
    if found_kind != kind:
        raise ModelError(f'{path}: a {found_kind}, not a {kind}: {remedy}')
    if found_version != version:
        raise ModelError(
            f'{path}: version {found_version}, this software reads {version}: {remedy} again'
        )
    return arrays


def packed(lower: NDArray[Number]) -> NDArray[Number]:
    """The lower triangle (N (N + 1) / 2,) of a triangular matrix (N, N), row by row."""
    return np.asarray(lower[np.tril_indices(len(lower))])


def unpacked(triangle: NDArray[Number]) -> NDArray[Number]:
    """The lower triangular matrix (N, N), in Fortran order, of its packed triangle."""
    size = (round((8 * len(triangle) + 1) ** 0.5) - 1) // 2
    lower = np.zeros((size, size), triangle.dtype, order='F')
    lower[np.tril_indices(size)] = triangle
    return lower
