# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of commands that have no room of their own."""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.data.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class DemoConfig(Settings):
    """The demonstration: which garden and drives, and how long its nodes may stay silent."""

    world: int = setting(1, 'garden', low=0, high=2**63 - 1)
    seed: int = setting(1, 'drives and sensor errors', low=0, high=2**63 - 1)
    rate: float = setting(1.0, 'speed of the replay', unit='x real time', low=0.1, high=20.0)
    start_timeout: float = setting(
        60.0, 'longest time that a node may take to start', unit='s', low=1.0, high=600.0
    )
    silence_timeout: float = setting(
        15.0, 'longest silence of a node during the replay', unit='s', low=1.0, high=600.0
    )
    settle_time: float = setting(
        2.0, 'silence that ends the recording after the replay', unit='s', low=0.1, high=60.0
    )
    stop_timeout: float = setting(
        10.0, 'longest time that a process may take to stop', unit='s', low=0.1, high=60.0
    )


@dataclass(frozen=True, slots=True)
class PlayConfig(Settings):
    """How a bag is replayed."""

    rate: float = setting(1.0, 'speed of the replay', unit='x', low=1e-3, high=1e6)
    start_offset: float = setting(0.0, 'begin this far into the bag', unit='s', low=0.0, high=1e9)
    clock_rate: float = setting(40.0, 'messages on /clock', unit='Hz', low=0.1, high=1e4)
    wait: float = setting(
        20.0,
        'time given to subscribers of images and odometry to appear before it starts',
        unit='s',
        low=0.0,
        high=3600.0,
    )
