# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every parameter changes something.

Those of the filter are set to another value than their default, one by one, along a drive that is
rich enough: a new one needs no entry here. Other tests set the others.
"""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from filter_drives import START_NS, FilterDrive

from sfa_localization.config import SECTIONS
from sfa_localization.data.errors import ConfigError
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.nodes.settings import EkfNodeConfig


def believed(settings: FilterConfig) -> str:
    """What a filter believes along a drive with everything that may happen to one."""
    fused, weak = PoseFilter(settings), PoseFilter(settings)
    seen = [weak.add_measurement(START_NS, np.zeros(3), np.diag([9.0, 9.0, 0.1])).reason]
    rng = np.random.default_rng(1)
    moving = [(1.0, 0.5 * np.sin(0.05 * i)) for i in range(1200)]
    twists = np.array(moving[:300] + [(5e-4, 1e-3)] * 40 + moving[300:])
    trip = FilterDrive(twists=twists, rate_hz=20.0, v_std=0.03, omega_std=0.02, position_std=0.2,
                 yaw_std=0.1, bias=0.01, scale=0.98)  # fmt: skip
    trip.read[300:320], trip.read[320:340] = (1.5e-3, 1e-3), (5e-4, 3e-3)
    trip.kidnap(200, (2.5, 1.5, 0.0))
    for event in trip.events():
        stamp, kind, index = event
        t = (stamp - START_NS) * 1e-9
        if kind == 0:
            if 20 < t < 26 or 40 < t < 40.8:
                continue
            told = (-1.0, -1.0) if 10 < t < 14 or 30 < t < 32 else (1e-8, 1e-8)
            told = (4e-3, 4e-3) if 14 < t < 17 else told
            fused.add_odometry(stamp, *trip.read[index], told)
        elif 20.5 < t < 25.5 or 33 < t < 38:
            continue
        else:
            value, spread = trip.seen[index].copy(), np.diag([0.04, 0.04, 0.01])
            if t < 3 or 12 < t < 13.5 or 25.5 < t < 26.5 or t > 55:
                value, spread = value[:2], np.zeros((2, 2))
            if 5 < t < 7:
                spread = spread * 1e-4
            if 17 < t < 18:
                spread[2, 2] = 1.5
            value[:2] += (rng.random() < 0.1) * 3.0
            late = stamp - 6 * 10**9 if index % 40 == 39 else stamp
            update = fused.add_measurement(late, value, spread)
            seen.append((update.d2, update.reason))
        state = fused.at(stamp)
        seen.append((fused.status, None if state is None else
                     (state.pose.tolist(), state.covariance.tolist())))  # fmt: skip
    return repr(seen)


SPECIAL = {
    'initial_pose': (1.0, -1.0, 0.5), 'initial_position_std': 1.0, 'initial_yaw_std': 1.0,
    'lost_yaw_std': 0.1,
}  # fmt: skip
"""Other values than twice the default."""


def another(item):
    """Return a value that is allowed, and differs from the default."""
    default, meta = item.default, item.metadata
    if item.name in SPECIAL or isinstance(default, (bool, str)):
        return SPECIAL.get(item.name) or not default
    higher = default * 2 if default else 1
    within = meta['high'] is None or higher <= meta['high']
    return type(default)(higher if within else (default + (meta['low'] or 0)) / 2)


def test_every_parameter_of_the_filter_changes_something():
    """And without another value nothing differs, else any would seem to change something."""
    placed = {'initial_pose': (0.0, 0.0, 0.0)}
    plain, started = believed(FilterConfig()), believed(FilterConfig(**placed))
    assert believed(FilterConfig()) == plain != started
    without_effect = []
    for item in dataclasses.fields(FilterConfig):
        at_start = item.name in ('initial_position_std', 'initial_yaw_std')
        given = {**(placed if at_start else {}), item.name: another(item)}
        if believed(FilterConfig(**given)) == (started if at_start else plain):
            without_effect.append(item.name)
    assert without_effect == []


def test_every_parameter_is_set_in_some_test():
    here, words = Path(__file__), set()
    for path in here.parent.glob('test_*.py'):
        words |= set(re.findall(r'\w+', path.read_text('utf-8'))) if path != here else set()
    kinds = {kind for kinds in SECTIONS.values() for kind in kinds} - {FilterConfig}
    names = {item.name for kind in kinds for item in dataclasses.fields(kind)}
    assert names - words == set(), 'nothing shows that these do anything'


def test_frames_that_are_one_are_rejected():
    for given in ({'odom_frame': 'map'}, {'map_frame': 'base_link'}):
        with pytest.raises(ConfigError, match='three different frames'):
            EkfNodeConfig.from_mapping(given, 'parameters')
