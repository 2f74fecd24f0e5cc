# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Limits linear algebra to one core where the matrices are small.

Several threads gain nothing there, and on a busy robot they wait for each other.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext


def one_core() -> AbstractContextManager[object]:
    """Keep linear algebra on the calling core inside the block.

    Does nothing where threadpoolctl is not installed; the results are the same.
    """
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return nullcontext()
    limits: AbstractContextManager[object] = threadpool_limits(limits=1)
    return limits
