# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What a robot hears, in the order of arrival."""

from typing import NamedTuple

import numpy as np

SECOND_NS = 1_000_000_000


class Reading(NamedTuple):
    """What the wheels say: pose (3,), twist (2,) and variances (2,)."""

    pose: np.ndarray
    twist: np.ndarray
    variances: np.ndarray


class Picture(NamedTuple):
    """A picture (H, W, 3) uint8 BGR, or a JPEG file that may be damaged."""

    image: np.ndarray | None = None
    jpeg: bytes | None = None


class Seen(NamedTuple):
    """What sfa_node makes of an image: pose (3,), covariance (3, 3), and how far images turned."""

    pose: np.ndarray
    covariance: np.ndarray
    turned: float


class Restart(NamedTuple):
    """A node is killed, or has come back."""

    node: str
    up: bool


class Message(NamedTuple):
    """What arrives at `at_ns` with a stamp; `true` (3,) is the pose where it was measured."""

    at_ns: int
    stamp_ns: int
    content: Reading | Picture | Seen | Restart
    true: np.ndarray | None = None

    def later(self, at_s, stamp_s=0.0):
        """The same that arrives, and is stamped, so many seconds later."""
        at_ns, stamp_ns = (round(s * SECOND_NS) for s in (at_s, stamp_s))
        return self._replace(at_ns=self.at_ns + at_ns, stamp_ns=self.stamp_ns + stamp_ns)
