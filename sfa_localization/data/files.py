# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Files that are written completely or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from sfa_localization.data.errors import LocalizationError


@contextmanager
def atomic_write(
    path: Path, error: type[LocalizationError] = LocalizationError, *, make_folder: bool = False
) -> Iterator[IO[bytes]]:
    """Write to a temporary file that becomes `path` at the end, or is removed after any error.

    `make_folder` creates missing folders first. Raises `error`, naming the path.
    """
    temporary = None
    try:
        if make_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp('.part', f'.{path.name}-', path.parent)
        with os.fdopen(handle, 'wb') as file:
            yield file
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as reason:
        raise error(f'{path}: cannot be written: {reason.strerror or reason}') from None
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
