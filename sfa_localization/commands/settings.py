# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings that only the commands have."""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.data.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class PlayConfig(Settings):
    """How a bag is replayed."""

    rate: float = setting(1.0, 'speed of the replay', unit='x', low=1e-3, high=1e6)
    wait: float = setting(20.0, 'longest wait for subscribers', unit='s', low=0.0, high=3600.0)
