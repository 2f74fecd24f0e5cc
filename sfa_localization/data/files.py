# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Files that are written completely or not at all."""

from __future__ import annotations

import json
import os
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from sfa_localization.data.errors import LocalizationError

_NEW_FILE_MODE = 0o644


def absence(path: Path | str) -> str:
    """Why a path is no regular file: it is missing, a folder, or a pipe or device."""
    if os.path.isdir(path):
        return 'is a folder'
    return 'is no regular file' if os.path.exists(path) else 'no such file'


def read_regular(path: Path | str, largest: int) -> bytes:
    """The bytes of a regular file of at most `largest` bytes. Raises OSError.

    A pipe or device is no regular file: reading it may never end.
    """
    if '\0' in str(path):
        raise OSError('a path with a zero byte')
    if os.path.exists(path) and not os.path.isfile(path):
        raise OSError(f'it {absence(path)}')
    with open(path, 'rb') as file:
        data = file.read(largest + 1)
    if len(data) > largest:
        raise OSError(f'larger than {largest} bytes')
    return data


def read_text(path: Path | str, largest: int, error: type[LocalizationError]) -> str:
    """The text of a regular file of at most `largest` bytes. Raises `error` naming the path."""
    try:
        return read_regular(path, largest).decode('utf-8-sig')
    except OSError as reason:
        raise error(f'{path}: cannot be read: {reason.strerror or reason}') from None
    except UnicodeDecodeError as reason:
        raise error(f'{path}: cannot be read: {reason.reason}') from None


def first_bytes(path: Path, most: int = 1000) -> bytes:
    """The first bytes of a regular file, b'' where there is none. Raises OSError."""
    if not os.path.isfile(path):
        return b''
    with open(path, 'rb') as file:
        return file.read(most)


def resolved(path: Path) -> Path:
    """The file that a path leads to through links, even in a loop. Raises LocalizationError."""
    try:
        return Path(os.path.realpath(path))
    except FileNotFoundError:
        raise LocalizationError(
            f'{path}: the working directory was removed: go to another, or give an absolute path'
        ) from None


@contextmanager
def atomic_write(
    path: Path, error: type[LocalizationError] = LocalizationError
) -> Iterator[IO[bytes]]:
    """Write to a temporary file that becomes `path` at the end, or is removed after any error.

    Missing folders are made. A symbolic link stays, and its target is replaced; a file keeps its
    permissions. Raises `error` naming the path, also for a folder, a device or a pipe.
    """
    temporary = None
    try:
        target = Path(os.path.realpath(path))
        target.parent.mkdir(parents=True, exist_ok=True)
        mode = replaced_mode(path)
        handle, temporary = tempfile.mkstemp('.part', f'.{target.name}-', target.parent)
        with os.fdopen(handle, 'wb') as file:
            yield file
        os.chmod(temporary, mode)
        os.replace(temporary, target)
    except OSError as reason:
        raise error(f'{path}: cannot be written: {reason.strerror or reason}') from None
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


def write_bytes(
    path: Path, content: bytes, error: type[LocalizationError] = LocalizationError
) -> None:
    """Write a file as `atomic_write` does."""
    with atomic_write(path, error) as file:
        file.write(content)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON, completely or not at all. Raises LocalizationError."""
    write_bytes(path, f'{json.dumps(content, indent=2)}\n'.encode())


def replaced_mode(path: Path) -> int:
    """The permissions of the file that `path` replaces. Raises OSError for anything but a file."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return _NEW_FILE_MODE
    if not stat.S_ISREG(status.st_mode):
        raise OSError(f'it {absence(path)}')
    return stat.S_IMODE(status.st_mode)


def require_outputs(outputs: Iterable[Path], inputs: Iterable[Path | None]) -> None:
    """Raise LocalizationError if an output cannot be written, or replaces another or an input."""
    targets: set[Path] = set()
    for path in outputs:
        if resolved(path) in targets:
            raise LocalizationError(f'{path}: named for two outputs: give each its own')
        targets.add(resolved(path))
        try:
            replaced_mode(path)
            nearest = next(each for each in resolved(path).parents if each.exists())
            if not nearest.is_dir():
                raise OSError(f'{nearest} is no folder')
            if not os.access(nearest, os.W_OK | os.X_OK):
                raise OSError(f'no permission to write in {nearest}')
        except OSError as reason:
            why = reason.strerror or reason
            raise LocalizationError(f'{path}: cannot be written: {why}') from None
    for path in filter(None, inputs):
        if resolved(path) in targets:
            raise LocalizationError(
                f'{path}: would be replaced by an output: give that another name'
            )
