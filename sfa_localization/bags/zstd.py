# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Decompression of zstd by the package that is there.

Python has it from 3.14 on, and `backports.zstd` brings the same to older ones. rosbags before
0.11.7 came with `zstandard`, the only one there when it was rosdep that installed it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

__all__ = ['ZstdError', 'decompressor']


def _found() -> tuple[Callable[[], Any], type[Exception]]:
    for name in ('compression.zstd', 'backports.zstd'):
        try:
            standard = importlib.import_module(name)
        except ModuleNotFoundError:
            continue
        return standard.ZstdDecompressor, standard.ZstdError
    other = importlib.import_module('zstandard')
    return lambda: other.ZstdDecompressor().decompressobj(), other.ZstdError


decompressor, ZstdError = _found()
"""What makes a decompressor of one frame, with `decompress(bytes)`, `eof` and `unused_data` as in
bz2, and the error that damaged data raises."""
