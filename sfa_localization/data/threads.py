# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Small matrices on one core: on a busy machine, threads would wait for each other."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from threadpoolctl import ThreadpoolController


@contextmanager
def one_core() -> Iterator[None]:
    """Keep linear algebra on the calling core inside the block, or the function it decorates."""
    with _libraries('scipy.linalg' in sys.modules).limit(limits=1):
        yield


@lru_cache(maxsize=1)
def _libraries(with_scipy: bool) -> ThreadpoolController:
    """The BLAS of NumPy, and of SciPy once imported; finding them takes longer than an image."""
    return ThreadpoolController()
