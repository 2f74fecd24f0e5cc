# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Images that arrive late may be stamped early: until a turn shows which, nothing is certain."""

import math

import numpy as np
import pytest
from filter_drives import START_NS, Drive, from_rest
from test_turn_watch import EVERY, HZ, NOISY, curve

from sfa_localization.fusion.arrivals import Arrivals
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import Level


def straight(seconds):
    return np.zeros(round(seconds * HZ))


def driven(omega, held_s=lambda k: 0.0, ahead_s=lambda t: 0.0, useless_ns=(), rested=False):
    """Time s, status and error m at each image of a filter that receives image k held_s(k) after
    it was taken, and odometry that is stamped ahead_s(t) too far ahead, as they come; after each
    image come some with stamps `useless_ns`. A robot that has not `rested` is under way before.
    """
    twists = np.column_stack([np.ones(len(omega)), omega])
    drive = Drive(every=EVERY, twists=from_rest(twists, HZ) if rested else twists, **NOISY)
    coming = []
    for stamp_ns, kind, index in drive.events():
        t = (stamp_ns - START_NS) * 1e-9
        stamped_ns = stamp_ns + (0 if kind else round(ahead_s(t) * 1e9))
        coming.append((t + (held_s(index) if kind else 0.0), kind, stamped_ns, index))
    fused, found, now = PoseFilter(FilterConfig()), [], 0
    for t, kind, stamp_ns, index in sorted(coming):
        if kind == 0:
            drive.give(fused, (stamp_ns, kind, index))
            now = index
            continue
        fused.add_turned(stamp_ns, float(drive.poses[drive.pictures[index], 2]))
        for seen_ns in (stamp_ns, *useless_ns):
            fused.add_measurement(seen_ns, drive.seen[index], drive.covariance(True))
        if fused.state is not None:
            apart = fused.state.pose - drive.poses[now]
            found.append((t, fused.status, math.hypot(apart[0], apart[1])))
    return found


def localised(found, start_s=0.0):
    """Share of the images after `start_s`, as long as there is odometry."""
    return np.mean([s.level is Level.LOCALISED for t, s, _ in found if start_s <= t < 20.0])


def test_three_late_images_in_a_row_are_late_and_one_is_not():
    arrivals, late = Arrivals(), []
    for behind_s in (0.1, 1.0, 0.1, 1.0, 1.2, 1.1, 1.2, 0.2):
        arrivals = arrivals.after(behind_s)
        late.append(arrivals.late_s)
    assert late == [0.0] * 5 + [1.0, 1.0, 0.0]


@pytest.mark.parametrize('ahead_s', [1.0, 1.4, 2.0])
def test_on_a_straight_line_images_that_are_stamped_early_are_never_trusted(ahead_s):
    found = driven(straight(20.0), ahead_s=lambda t: ahead_s)
    assert max(error for *_, error in found[25:]) > 0.8 * ahead_s
    assert localised(found) == 0.0
    assert any('synchronize the clocks' in why for why in found[-1][1].reasons)


def test_a_clock_of_the_odometry_that_steps_ahead_on_a_straight_line_is_noticed():
    found = driven(straight(20.0), ahead_s=lambda t: 1.2 if t > 8.0 else 0.0)
    wrong = [s.level is Level.LOCALISED and error > 1.0 for _, s, error in found]
    assert max(error for *_, error in found) > 1.0
    assert sum(wrong) <= 1.0 * HZ / EVERY


@pytest.mark.parametrize('useless_ns', [(), (0, 0, 0)])
def test_images_in_time_need_no_turn_whatever_unusable_ones_come(useless_ns):
    found = driven(straight(20.0), lambda k: 0.2, useless_ns=useless_ns, rested=True)
    assert localised(found, 4.0) == 1.0


@pytest.mark.parametrize('held_s', [0.6, 1.0])
def test_images_that_are_held_up_are_trusted_once_turns_have_shown_when_they_were_taken(held_s):
    found = driven(curve(20.0), lambda k: held_s)
    assert localised(found, 12.0) > 0.9
    assert localised(driven(straight(20.0), lambda k: held_s)) == 0.0


def test_images_that_are_held_up_for_any_time_do_not_put_the_start_off():
    """Some are suspected of being stamped early, for as long as they come late."""
    held_s = np.random.default_rng(0).uniform(0.0, 3.0, 400)
    assert localised(driven(curve(20.0), held_s.item), 4.0) > 0.4


def test_images_that_are_no_longer_late_are_trusted_again_at_once():
    arrived = driven(straight(20.0), lambda k: 0.8 * (k < 8.0 * HZ / EVERY), rested=True)
    during = [status.level for t, status, _ in arrived if 4.0 < t < 8.0]
    assert Level.LOCALISED not in during and localised(arrived, 10.0) == 1.0
