# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Decompression of zstd by whichever package is installed.

Python has it from 3.14 on, and `backports.zstd` brings the same to older versions. rosbags before
0.11.7 depends on `zstandard` instead, the only one installed where rosdep chose such a version.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

__all__ = ['ZstdError', 'decompressor']


def _load_package() -> tuple[Callable[[], Any], type[Exception]]:
    for name in ('compression.zstd', 'backports.zstd'):
        try:
            standard = importlib.import_module(name)
        except ModuleNotFoundError:
            continue
        return standard.ZstdDecompressor, standard.ZstdError
    other = importlib.import_module('zstandard')
    return lambda: other.ZstdDecompressor().decompressobj(), other.ZstdError


decompressor, ZstdError = _load_package()
"""The factory of decompressors of one frame, with `decompress(bytes)`, `eof` and `unused_data` as
in bz2, and the error that they raise for damaged data."""
