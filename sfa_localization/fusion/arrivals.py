# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How late images arrive, by the stamps of the odometry that has come before them.

An image that is stamped a second before the odometry of the same time arrives at least a second
late by it; so does one that a slow computer took a second for. Only turns show which it is. But
images that arrive in time are stamped in time, or not more than a little early.
"""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.fusion.pace import TOLERATED_S

_COUNT = 3
"""Images in a row that are late: one may have been held up."""


@dataclass(frozen=True, slots=True)
class Arrivals:
    """By how many seconds the last images were `behind_s` the newest odometry when they arrived,
    and `late_s`, by how much all of them are late; 0 while they are not.
    """

    behind_s: tuple[float, ...] = ()
    late_s: float = 0.0

    def after(self, behind_s: float) -> Arrivals:
        """With one more image; `late_s` stays where it differs little."""
        behind = (*self.behind_s, behind_s)[-_COUNT:]
        late_s = min(behind) if min(behind) > TOLERATED_S else 0.0
        settled = len(behind) == _COUNT and abs(late_s - self.late_s) > TOLERATED_S
        return Arrivals(behind, late_s if settled else self.late_s)
