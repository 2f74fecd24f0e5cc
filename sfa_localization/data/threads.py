# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Small matrices on one core: beside other work, threads wait for each other 20 times as long."""

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
    """NumPy's, and SciPy's where it is imported: to find them takes longer than an image does."""
    return ThreadpoolController()
