# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry and images merged in the order in which a filter receives them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sfa_localization.data.run import Stamps

ODOMETRY, IMAGE = range(2)
DELAY_LIMIT_NS = 500_000_000
"""Largest delay of the camera's stamps, of either sign, that is compensated."""
CLOCK_RANGE_S = 2.5
"""Largest difference of two clocks that turns show."""
CLOCK_JUMP_NS = 10_000_000_000
"""A difference this large (10 s) between stamp and reception is one of clocks: queues and networks
delay a message by less."""
LEAP_SECONDS = {18: 'GPS time', 19: 'TAI', 37: 'TAI'}
"""Seconds, since 2017, by which GPS time is ahead of UTC, TAI of GPS time, and TAI of UTC."""


def whole_leap(offset_ns: float) -> int:
    """An offset of clocks, ns, without its fraction of a second if it is one of LEAP_SECONDS."""
    seconds = round(offset_ns * 1e-9)
    return seconds * 1_000_000_000 if abs(seconds) in LEAP_SECONDS else round(offset_ns)


def clock_difference(ahead_ns: float, topic: str = 'images', odometry: str = 'odometry') -> str:
    """How far a topic is stamped ahead of the odometry, and which of them may be in another time
    scale, in words.
    """
    seconds = abs(ahead_ns) * 1e-9
    where = 'ahead of' if ahead_ns > 0 else 'behind'
    scale = LEAP_SECONDS.get(round(seconds))
    reason = f' ({topic if ahead_ns > 0 else odometry} in {scale}?)' if scale else ''
    return f'stamped {seconds:.1f} s {where} the odometry{reason}'


def merge_by_stamp(odometry_ns: Stamps, images_ns: Stamps) -> Iterator[tuple[int, int, int]]:
    """Stamp, ODOMETRY or IMAGE, and index in its own stream, for stamps (N,) and (M,).

    At equal stamps odometry comes first, and each stream keeps its order.
    """
    stamps = np.concatenate([odometry_ns, images_ns]).astype(np.int64)
    for position in np.argsort(stamps, kind='stable').tolist():
        kind = ODOMETRY if position < len(odometry_ns) else IMAGE
        yield int(stamps[position]), kind, position - kind * len(odometry_ns)
