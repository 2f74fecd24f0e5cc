# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Named arrays in one .npz file without pickle; a header names kind, version and checksum.

Files are checked as if they came from a stranger: nothing is allocated that the file does not hold,
and whatever is wrong with it is one ModelError.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from sfa_localization.data.errors import ModelError
from sfa_localization.data.files import absence, atomic_write, is_regular
from sfa_localization.data.rejections import short_line

Arrays = dict[str, NDArray[Any]]
Number = TypeVar('Number', bound=np.generic)

LARGEST_FILE = 1 << 28
"""Bytes of a file: twenty times a model of a large garden. In use a model is ten times its file."""
MOST_ARRAYS = 1000
"""Arrays in a file: a model has about ten for each of its parts."""
LARGEST_NUMBER = 1e15
"""Magnitude of a number: those of models stay below 1e9, and squares of larger ones overflow."""
_HEADER, _CHECKSUM = 'header', 'sha256'
_LONGEST_HEADER = 1 << 20
"""Characters of the header: a thousand times the usual."""
_TYPES = frozenset(
    np.dtype(kind) for kind in ('?', 'f2', 'f4', 'f8', 'c8', 'c16', 'i1', 'u1', 'i2', 'i4', 'i8')
)
# End of a zip without a comment: signature, disks, entries here and in all, directory, comment.
_END = struct.Struct('<4s4H2LH')
_END_MARK, _ZIP64_MARK, _ZIP64_SIZE = b'PK\x05\x06', b'PK\x06\x07', 20
_ENTRY_SIZE = 512
"""Bytes of the directory for each array, with its name."""


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays (N, ...) as .npz, completely or not at all. Raises ModelError.

    The array `header` is a JSON object as text; the checksum of all arrays is added to it.
    """
    plain: dict[str, Any] = dict(arrays)
    if _HEADER in plain:
        header = json.loads(str(plain[_HEADER]))
        header[_CHECKSUM] = checksum(plain, header)
        plain[_HEADER] = np.array(json.dumps(header, sort_keys=True))
    with atomic_write(Path(path), ModelError) as file:
        np.savez(file, **plain)


def read_arrays(path: Path, kind: str, version: int, remedy: str) -> Arrays:
    """Arrays of an .npz file whose header names its kind and version. Raises ModelError."""
    if not is_regular(path):
        raise ModelError(f'{path}: {absence(path)}: {remedy}')
    try:
        with path.open('rb') as file:
            arrays = _arrays(file, path.stat().st_size)
        header = json.loads(str(arrays[_HEADER]))
        found_kind, found_version = header['format'], header['version']
        intact = header.get(_CHECKSUM) == checksum(arrays, header)
    except _Unusable as error:
        raise ModelError(f'{path}: not a {kind} ({error}): {remedy}') from None
    except zipfile.BadZipFile:  # a checksum of the zip, or its directory, is wrong
        damaged = f'{path}: not a {kind}, or a damaged one: copy it again'
        raise ModelError(f'{damaged}, or {remedy}') from None
    except Exception:  # zip, numpy and json fail in many ways on foreign bytes
        raise ModelError(f'{path}: not a {kind}: {remedy}') from None
    if found_kind != kind:
        raise ModelError(f'{path}: a {short_line(str(found_kind))}, not a {kind}: {remedy}')
    if found_version != version:
        found = short_line(str(found_version))
        raise ModelError(f'{path}: version {found}, this software reads {version}: {remedy} again')
    if not intact:
        raise ModelError(f'{path}: damaged (its checksum is wrong or missing): {remedy} again')
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


def checksum(arrays: Mapping[str, NDArray[Any]], header: Mapping[str, Any]) -> str:
    """SHA-256 of arrays (N, ...), by name, and of the header without its own checksum."""
    rest = {name: value for name, value in header.items() if name != _CHECKSUM}
    digest = hashlib.sha256(json.dumps(rest, sort_keys=True).encode())
    for name in sorted(set(arrays) - {_HEADER}):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f'\n{name} {array.dtype.str} {np.shape(arrays[name])}\n'.encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


class _Unusable(Exception):
    """The file contradicts its format or a limit; the text says how."""


def _arrays(file: IO[bytes], size: int) -> Arrays:
    _check_directory(file, size)
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        if len({entry.filename for entry in entries}) < len(entries):
            raise _Unusable('it holds arrays of the same name')
        # Without compression every array lies in the file: their sum bounds the memory.
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise _Unusable('its arrays are compressed')
        if sum(entry.file_size for entry in entries) > size:
            raise _Unusable('its arrays are larger than the file')
        return {entry.filename.removesuffix('.npy'): _array(archive, entry) for entry in entries}


def _check_directory(file: IO[bytes], size: int) -> None:
    """Bound the zip directory, which is read as a whole, before it is read."""
    if not size:
        raise _Unusable('it is empty')
    if size > LARGEST_FILE:
        raise _Unusable(f'it has {size} bytes, more than {LARGEST_FILE}')
    file.seek(max(size - _END.size - _ZIP64_SIZE, 0))
    end = file.read()
    if len(end) < _END.size or end[-_END.size :][:4] != _END_MARK:
        raise _Unusable('its end is missing')
    if end[:4] == _ZIP64_MARK:
        raise _Unusable('it is a zip64 archive')
    _, _, _, _, count, directory, _, _ = _END.unpack(end[-_END.size :])
    if count > MOST_ARRAYS or directory > MOST_ARRAYS * _ENTRY_SIZE:
        raise _Unusable(f'it holds {count} arrays, more than {MOST_ARRAYS}')


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    """One array, of a plain type, all of whose bytes are there, and finite."""
    with archive.open(entry) as member:
        read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        shape, by_column, dtype = read[npy.read_magic(member)](member)
        text = dtype.kind == 'U' and shape == () and dtype.itemsize <= 4 * _LONGEST_HEADER
        if not text and dtype not in _TYPES:
            raise _Unusable(f'an array is of type {dtype.str}')
        size = math.prod(shape) * dtype.itemsize
        if min(shape, default=1) < 0 or size != entry.file_size - member.tell():
            raise _Unusable('an array is not as large as its shape')
        # One byte more: the checksum of the zip is checked at the end of the member.
        array = np.frombuffer(bytearray(member.read(size + 1)), dtype)
    array = array.reshape(shape, order='F' if by_column else 'C')
    if not text and not np.isfinite(array).all():
        raise _Unusable('an array holds values that are not finite')
    if not text and np.abs([array.real, array.imag]).max(initial=0) > LARGEST_NUMBER:
        raise _Unusable(f'an array holds numbers beyond {LARGEST_NUMBER:g}')
    return array
