# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Each number of the recovery: a situation on either side of it, and what follows."""

import math

import numpy as np
import pytest
from filter_drives import Drive, winding

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.fusion import evidence, recover
from sfa_localization.fusion.belief import LARGEST_STD_M, Evidence, PoseEvent, Update, capped
from sfa_localization.fusion.camera_clock import CameraClock
from sfa_localization.fusion.consistency import lies_far
from sfa_localization.fusion.evidence import Relocation, consistent, relocate, remember
from sfa_localization.fusion.kalman import Kalman
from sfa_localization.fusion.motion import SIZE
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.recover import Recovery, displaced, outweighs, shows_heading
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import Level, silence_limit_s, status_of
from sfa_localization.fusion.update import Correction, measurement_event

SECOND = 1_000_000_000
CORRELATION = ErrorCorrelation(0.7, 1.0)
RECOVERY = Recovery(FilterConfig(), CORRELATION)
CORRECTION = Correction(FilterConfig().lost_yaw_std, Kalman(), RECOVERY)


def belief_at(pose=(0.0, 0.0, 0.0), std=0.1, **memory):
    """A located belief; `memory` as its record of measurements."""
    event = PoseEvent(SECOND, np.array(pose, float), std**2 * np.eye(3))
    placed = RECOVERY.placed(RECOVERY.blank(SECOND), event)
    return placed._replace(memory=placed.memory._replace(**memory))


def image(value, std=0.1, stamp_ns=SECOND):
    covariance = std**2 * np.eye(len(value))
    return measurement_event(stamp_ns, np.array(value, float), covariance, CORRELATION.share)


def agreement(**changes):
    """Enough images with heading that put the robot 10 m away, over 5 m."""
    usual = Relocation(np.array([10.0, 0.0, 0.0]), 0.01 * np.eye(3), 5, 5.0, 0.1, 0.05, 0, 0)
    return usual._replace(**changes)


def seen_along(positions, yaw=math.nan, std=0.1, traveled=None, accepted=False):
    """Evidence at positions of a robot that dead reckoning moves along x."""
    if traveled is None:
        traveled = [x for x, _ in positions]
    yaw_variance = math.inf if math.isnan(yaw) else std**2
    return tuple(
        Evidence((d, 0.0, 0.0), d, (x, y), yaw, std**2, yaw_variance, accepted)
        for d, (x, y) in zip(traveled, positions, strict=True)
    )


# The belief before the first message.


def test_before_any_image_bias_and_scale_are_those_of_cheap_sensors():
    """100 m in 10 s with exact odometry: 3 % of the distance, and 0.01 rad/s of the time."""
    exact = FilterConfig(slip_per_metre=0.0, yaw_per_radian=0.0)
    fused = PoseFilter(exact, CORRELATION)
    fused.set_pose(SECOND, np.zeros(3), 1e-8 * np.eye(3))
    for stamp_ns in range(SECOND, 11 * SECOND + 1, SECOND // 10):
        fused.add_odometry(stamp_ns, 10.0, 0.0, (1e-6, 1e-6))
    variance_x, _, variance_yaw = np.diag(fused.state.pose_covariance)
    assert math.sqrt(variance_x) == pytest.approx(3.0, rel=0.02)
    # YAW_PER_METER adds 0.005 rad per square root of a meter: 0.05 rad.
    assert math.sqrt(variance_yaw - 0.05**2) == pytest.approx(0.1, rel=0.03)


# Whether agreeing images outweigh the estimate.

ESTABLISHED = {'support': 5}
SMALL = {'pose': np.array([1.0, 0.0, 0.0])}
NO_YAW = {'yaw_std': math.inf}


@pytest.mark.parametrize(('memory', 'inside', 'outside'), [
    # ENOUGH_IMAGES against an established estimate, fewer against one that rests on fewer.
    ({'support': 9}, {'images': 5}, {'images': 4}),
    ({'support': 2}, {'images': 3}, {'images': 2}),
    ({'support': 0}, {'images': 2}, {'images': 1}),
    # AGREEING_PER_ACCEPTED
    (ESTABLISHED, {'images': 6, 'contradicting': 2}, {'images': 5, 'contradicting': 2}),
    # START_YAW_STD
    (ESTABLISHED, {'covariance': 0.29**2 * np.eye(3)}, {'covariance': 0.31**2 * np.eye(3)}),
    # No more may disagree than agree.
    (ESTABLISHED, {'dissenting': 4}, {'dissenting': 5}),
    # A displacement is obvious, or images must agree over AGREEING_DISTANCE_M.
    (ESTABLISHED, {**SMALL, 'distance_m': 2.0}, {**SMALL, 'distance_m': 1.9}),
    (ESTABLISHED, {'distance_m': 0.0}, {**SMALL, 'distance_m': 0.0}),
    # The distance grows with OBVIOUS_STDS of the images' standard deviation.
    (ESTABLISHED, {**NO_YAW, 'position_std': 0.5, 'distance_m': 4.0},
     {**NO_YAW, 'position_std': 0.5, 'distance_m': 3.9}),
    # FEW_IMAGES suffice over FEW_DISTANCE times it.
    (ESTABLISHED, {**NO_YAW, 'images': 3, 'distance_m': 2.5},
     {**NO_YAW, 'images': 3, 'distance_m': 2.4}),
    (ESTABLISHED, {**NO_YAW, 'images': 3}, {**NO_YAW, 'images': 2}),
    # OUTAGE_DISTANCE, unless there are MANY_IMAGES.
    ({**ESTABLISHED, 'outage': True}, {'distance_m': 2.8}, {'distance_m': 2.7}),
    ({**ESTABLISHED, 'outage': True}, {'images': 20, 'distance_m': 0.0},
     {'images': 19, 'distance_m': 0.0}),
])  # fmt: skip
def test_agreeing_images_outweigh_the_estimate_from_here_on(memory, inside, outside):
    assert outweighs(agreement(**inside), belief_at(**memory))
    assert not outweighs(agreement(**outside), belief_at(**memory))


@pytest.mark.parametrize(('inside', 'outside'), [
    ({'pose': [1.6, 0, 0]}, {'pose': [1.4, 0, 0]}),  # OBVIOUS_JUMP_M
    ({'pose': [4.1, 0, 0], 'position_std': 0.5}, {'pose': [3.9, 0, 0], 'position_std': 0.5}),
    ({'pose': [0, 0, 0.51]}, {'pose': [0, 0, 0.49]}),  # OBVIOUS_TURN_RAD
    ({'pose': [0, 0, 0.9], 'yaw_std': 0.1}, {'pose': [0, 0, 0.7], 'yaw_std': 0.1}),
    ({'pose': [0, 0, 2 * math.pi - 0.6]}, {'pose': [0, 0, 2 * math.pi - 0.4]}),
])  # fmt: skip
def test_a_displacement_is_obvious_from_here_on(inside, outside):
    for changes, obvious in ((inside, True), (outside, False)):
        changes = {**changes, 'pose': np.array(changes['pose'], float)}
        assert displaced(agreement(**changes), np.zeros(10)) is obvious


@pytest.mark.parametrize(('images', 'remembered', 'yaw_std', 'enough'), [
    (3, 3, 0.1, True), (2, 2, 0.1, False),  # FEW_IMAGES
    (6, 10, 0.1, True), (5, 10, 0.1, False),  # AGREEING_SHARE
    (6, 10, 0.29, True), (6, 10, 0.31, False),  # START_YAW_STD
])  # fmt: skip
def test_positions_show_the_heading_from_here_on(images, remembered, yaw_std, enough):
    found = agreement(images=images, covariance=np.diag([0.01, 0.01, yaw_std**2]))
    assert shows_heading(found, remembered) is enough


# What a rejected image changes.


def reject(belief, d2=20.0, threshold=10.0, innovation=(3.0, 4.0, 0.6)):
    event = image([9.0, 9.0, 1.0], stamp_ns=belief.stamp_ns)
    update = Update(event.stamp_ns, False, d2, threshold, '', np.array(innovation), np.eye(3))
    return RECOVERY.weighed(belief, event, update)


@pytest.mark.parametrize(('rejected', 'widens'), [(1, False), (2, True)])
def test_from_three_rejected_images_on_the_estimate_widens(rejected, widens):
    before = belief_at(support=50, rejected=rejected)
    after = reject(before)
    assert after.memory.rejected == rejected + 1
    assert bool(after.covariance[0, 0] > before.covariance[0, 0]) is widens


@pytest.mark.parametrize(('moved_m', 'growth'), [
    (0.0, 1 + 0.3 * 0.1),  # WIDENING_STANDING
    (20.0, 1.3),  # WIDENING: a new place
])  # fmt: skip
def test_the_variance_grows_with_every_new_place(moved_m, growth):
    accepted = seen_along([(0.0, 0.0)], accepted=True)
    before = belief_at(support=50, rejected=5, evidence=accepted)._replace(traveled_m=moved_m)
    # The last measurement must not be forgotten with the distance.
    event = image([9.0, 9.0], std=1.0, stamp_ns=SECOND)
    update = Update(SECOND, False, 20.0, 10.0, '', np.ones(2), np.eye(2))
    after = RECOVERY.weighed(before, event, update)
    for i in range(3):
        assert after.covariance[i, i] == pytest.approx(growth * before.covariance[i, i], rel=1e-6)
    assert np.allclose(after.covariance[3:, 3:], before.covariance[3:, 3:])


def test_an_image_inside_the_gate_that_is_not_confirmed_widens_nothing():
    before = belief_at(support=50, rejected=9)
    after = reject(before, d2=5.0)
    assert after.memory.rejected == 9 and np.array_equal(after.covariance, before.covariance)


@pytest.mark.parametrize(('rejected', 'doubted'), [(3, False), (4, True)])
def test_from_five_rejected_images_on_the_published_covariance_covers_the_difference(
    rejected, doubted
):
    after = reject(belief_at(support=50, rejected=rejected))
    # Half the difference, DOUBT_STDS: 5 m and 0.6 rad.
    expected = (2.5**2, 2.5**2, 0.3**2) if doubted else (0.0, 0.0, 0.0)
    assert after.memory.doubt == pytest.approx(expected)
    published = after.state.covariance - after.covariance
    assert np.diag(published)[:3] == pytest.approx(expected)


@pytest.mark.parametrize(('silence_s', 'outage'), [(2.9, False), (3.1, True)])
def test_images_after_a_silence_follow_an_outage(silence_s, outage):
    stamp_ns = SECOND + round(silence_s * 1e9)
    before = belief_at(support=50, accepted_ns=SECOND)._replace(stamp_ns=stamp_ns)
    assert reject(before).memory.outage is outage


def test_the_standard_deviation_is_capped():
    huge = np.diag([1e8, 4e4, 100.0, *[1.0] * (SIZE - 3)])
    limits = [LARGEST_STD_M, LARGEST_STD_M, math.pi]
    assert np.sqrt(np.diag(capped(huge))[:3]) == pytest.approx(limits)
    assert np.array_equal(capped(np.eye(SIZE)), np.eye(SIZE))


# Agreement of measurements.


def test_three_sigma_agree_and_more_does_not():
    # Two of 0.1 m differ by up to 3 sqrt(2) 0.1 m, and the odometry's 5 % of the way between.
    limit = 3 * math.hypot(math.sqrt(2) * 0.1, evidence.ODOMETRY_DRIFT * 2.0)
    for miss, count in ((0.98 * limit, 2), (1.02 * limit, 1)):
        assert consistent(seen_along([(0.0, miss), (2.0, 0.0)]), 0.0, 0.0) == count


def test_a_drift_of_the_odometry_is_allowed_for():
    """20 m back, 5 % are 1 m: 3 m of difference are no contradiction, 4 m are."""
    for miss, count in ((2.9, 2), (3.3, 1)):
        assert consistent(seen_along([(0.0, miss), (20.0, 0.0)]), 0.0, 0.0) == count


@pytest.mark.parametrize(('length', 'found'), [(0.40, False), (0.45, True)])
def test_two_positions_show_a_heading_where_they_lie_far_enough_apart(length, found):
    # BASELINE_STDS: 3 sqrt(2) 0.1 m = 0.42 m.
    pair = seen_along([(0.0, 0.0), (length, 0.0)])
    assert (relocate(pair, 1.0) is not None) is found


def test_neighbors_that_err_alike_count_as_fewer():
    along = seen_along([(0.1 * k, 0.0) for k in range(21)], yaw=0.0)
    white, alike = relocate(along, 1e-3), relocate(along, 2.0)
    assert white.images == alike.images == 21
    assert np.allclose(alike.covariance, white.covariance * 21 / 2)  # 1 + 2 m / 2 m independent


def test_what_lies_far_behind_is_forgotten():
    for std, reach in ((0.1, 6.0), (1.0, 30.0)):
        old = seen_along([(0.0, 0.0), (0.2, 0.0)])
        belief = belief_at(evidence=old)._replace(traveled_m=reach + 0.1)
        assert len(remember(belief, image([0.0, 0.0], std), accepted=False)) == 2


def test_decisions_ask_for_less_than_is_remembered():
    longest = recover.FEW_DISTANCE * recover.OUTAGE_DISTANCE
    assert 1.5 * longest * evidence.AGREEING_DISTANCE_M < evidence.REMEMBERED_M
    assert 1.5 * longest * recover.OBVIOUS_STDS < evidence.REMEMBERED_STDS


def test_the_memory_is_bounded_and_its_newer_half_complete():
    kept = ()
    for k in range(500):
        belief = belief_at(evidence=kept)._replace(traveled_m=0.001 * k)
        kept = remember(belief, image([k, 0.0]), accepted=False)
        assert len(kept) <= 60
    newest = [item.position[0] for item in kept[-30:]]
    assert newest == list(range(500 - len(newest), 500))


# What the state says.


@pytest.mark.parametrize(('memory', 'moved_m', 'level'), [
    ({'rejected': 5, 'gate_excess': 4.1}, 0.0, Level.LOST),
    ({'rejected': 5, 'gate_excess': 3.9}, 0.0, Level.DEGRADED),  # LOST_EXCESS
    ({'rejected': 5, 'gate_excess': 1.1}, 0.6, Level.LOST),
    ({'rejected': 5, 'gate_excess': 1.1}, 0.4, Level.DEGRADED),  # LOST_DISTANCE_M
    ({'rejected': 4, 'gate_excess': 9.0}, 9.0, Level.DEGRADED),  # ENOUGH_IMAGES
    ({'rejected': 2, 'gate_excess': 9.0, 'support': 3}, 9.0, Level.LOCALISED),  # FEW_IMAGES
    ({'rejected': 1, 'gate_excess': 9.0, 'support': 2}, 9.0, Level.DEGRADED),  # FEW_IMAGES
    ({'rejected': 9, 'gate_excess': 9.0, 'doubt': (0.2, 0.2, 0.0)}, 9.0, Level.DEGRADED),  # LOST_M
    ({'rejected': 9, 'gate_excess': 9.0, 'doubt': (0.0, 0.0, 0.1)}, 9.0, Level.LOST),  # LOST_RAD
])  # fmt: skip
def test_contradictions_make_the_estimate_degraded_then_lost(memory, moved_m, level):
    if memory['rejected'] >= 5:
        memory = {'doubt': (1.0, 1.0, 0.0), **memory}
    belief = belief_at(accepted_ns=SECOND, precise_ns=SECOND, **memory)
    belief = belief._replace(traveled_m=moved_m, odometry_ns=SECOND)
    assert status_of(belief, CameraClock(), FilterConfig(), SECOND).level is level


@pytest.mark.parametrize(('offset', 'std', 'last', 'far'), [
    ((0.8, 0.8, 0.0), 0.5, False, True), ((0.6, -0.6, 0.0), 0.1, False, False),  # LOST_M
    ((0.6, -0.6, 0.0), 0.1, True, True), ((0.2, 0.4, 0.0), 0.1, True, False),  # RELEASED
    ((0.0, 0.0, -0.4), 0.1, False, True), ((0.0, 0.0, 0.2), 0.1, False, False),  # LOST_RAD
    ((9.0, 0.0), 5.0, False, False), ((9.0, 0.0), 4.9, False, True),  # FAR_D2
    ((9.0, 0.0), 9.0, True, True), ((9.0, 0.0), 9.95, True, False),
])  # fmt: skip
def test_an_image_far_off_puts_the_estimate_in_doubt_until_one_is_near(offset, std, last, far):
    covariance = std**2 * np.eye(len(offset))
    assert lies_far(np.array(offset), covariance, last) == far


@pytest.mark.parametrize('accepted', [False, True])
@pytest.mark.parametrize('far', [False, True])
def test_the_first_image_that_shows_the_robot_far_away_counts(far, accepted):
    """Also where it is so weak that it lies inside the gate, and is fused."""
    update = Update(SECOND, accepted, 0.5 if accepted else 4.1, 1.0, 'a reason', far=far)
    memory = {'support': 9, 'rejected': int(not accepted), 'update': update}
    belief = belief_at(accepted_ns=SECOND, precise_ns=SECOND, **memory)
    belief = belief._replace(odometry_ns=SECOND)
    level = status_of(belief, CameraClock(), FilterConfig(), SECOND).level
    assert level is (Level.DEGRADED if far else Level.LOCALISED)


@pytest.mark.parametrize('speed', [0.0, 0.1])
@pytest.mark.parametrize('std', [0.35, 0.45])
@pytest.mark.parametrize('every', [10, 100])
def test_a_robot_pushed_where_images_are_weak_is_never_localised_and_wrong(every, std, speed):
    """They show the place well, but claim little: the estimate does not follow, nor reject them."""
    twists = winding(90.0, speed=0.6)
    twists[1500:, 0], twists[1500:, 1] = speed, 0.0
    drive = Drive(twists=twists, every=every, position_std=0.1, yaw_std=0.02, share=0.7)
    pushed = 2500 // every
    drive.kidnap(pushed, (0.9, -1.1, 0.0))
    fused = PoseFilter(FilterConfig(), ErrorCorrelation(0.7, 0.6))
    levels = []
    for event in drive.events():
        covariance = np.square([0.1, 0.1, 0.02])
        if event[1] == 1 and event[2] >= pushed:
            covariance[:2] = std**2
        if event[1] == 0:
            drive.give(fused, event, True)
            continue
        fused.add_measurement(event[0], drive.seen[event[2]], np.diag(covariance))
        error, _ = drive.error(fused, drive.pictures[event[2]])
        levels.append((fused.status.level, error))
    assert levels[pushed - 1][0] is Level.LOCALISED
    assert all(level is not Level.LOCALISED or error < 1.0 for level, error in levels)


@pytest.mark.parametrize(('silences_s', 'level'), [
    ((1.9, 0.4), Level.LOCALISED), ((2.1, 0.4), Level.DEGRADED), ((1.9, 0.6), Level.DEGRADED),
])  # fmt: skip
def test_silence_makes_the_estimate_degraded(silences_s, level):
    images_ns, odometry_ns = (round(5e9 - 1e9 * silence_s) for silence_s in silences_s)
    belief = belief_at(accepted_ns=images_ns, precise_ns=images_ns)
    belief = belief._replace(stamp_ns=5 * SECOND, odometry_ns=odometry_ns)
    assert status_of(belief, CameraClock(), FilterConfig(), SECOND).level is level


@pytest.mark.parametrize(('period_s', 'limit_s'), [
    (0.1, 1.5), (0.6, 1.5), (0.7, 1.75), (1.0, 2.0), (1.5, 2.0), (2.0, 2.5), (5.0, 3.0),
])  # fmt: skip
def test_images_are_missed_after_a_few_periods_and_soon(period_s, limit_s):
    assert silence_limit_s(period_s, 1.0) == pytest.approx(limit_s)


@pytest.mark.parametrize(('moved_m', 'period_s', 'level'), [
    (2.9, 0.3, Level.LOCALISED), (3.1, 0.3, Level.DEGRADED),  # SILENT_M
    (3.1, 0.5, Level.LOCALISED),  # FEW_PERIODS
])  # fmt: skip
def test_of_a_fast_robot_images_are_missed_after_meters(moved_m, period_s, level):
    images_ns = 4 * SECOND
    belief = belief_at(accepted_ns=images_ns, precise_ns=images_ns, period_s=period_s)
    belief = belief._replace(stamp_ns=5 * SECOND, odometry_ns=5 * SECOND, traveled_m=moved_m)
    assert status_of(belief, CameraClock(), FilterConfig(), SECOND).level is level


@pytest.mark.parametrize(('waited_s', 'level'), [(0.9, Level.LOCALISED), (1.1, Level.DEGRADED)])
def test_of_a_slow_camera_the_first_image_that_contradicts_counts(waited_s, level):
    """NOTICED_S after the last one that fitted; sooner it may be an outlier."""
    images_ns = round(5e9 - 1e9 * waited_s)
    belief = belief_at(accepted_ns=images_ns, precise_ns=images_ns, support=9, rejected=1)
    belief = belief._replace(stamp_ns=5 * SECOND, odometry_ns=5 * SECOND)
    assert status_of(belief, CameraClock(), FilterConfig(), SECOND).level is level


@pytest.mark.parametrize(
    ('precise_ns', 'level'),
    [(None, Level.DEGRADED), (round(2.9e9), Level.DEGRADED), (round(3.1e9), Level.LOCALISED)],
)
def test_weak_images_make_the_estimate_degraded_as_silence_does(precise_ns, level):
    belief = belief_at(accepted_ns=5 * SECOND, precise_ns=precise_ns)
    belief = belief._replace(stamp_ns=5 * SECOND, odometry_ns=5 * SECOND)
    assert status_of(belief, CameraClock(), FilterConfig(), SECOND).level is level


# The gate.


@pytest.mark.parametrize(('prior_std', 'reason'), [
    (0.19, 'accepted'), (0.21, 'not confirmed after an outage yet'),  # WIDE_GATE: 4 x 0.1^2
])  # fmt: skip
def test_a_wide_gate_needs_confirmation(prior_std, reason):
    # 0.45 m: inside the gate of the prior, beyond that of the image alone (0.37 m).
    after = CORRECTION.fuse(belief_at(std=prior_std, support=5), image([0.45, 0.0]))
    assert after.memory.update.reason == reason
    reasons = status_of(after, CameraClock(), FilterConfig(), SECOND).reasons
    waits = 'images lie far from the estimate: others must confirm them' in reasons
    assert waits is (reason != 'accepted')


@pytest.mark.parametrize(('count', 'way', 'confirmed'), [
    (3, 2.1, True), (2, 2.1, False),  # FEW_IMAGES
    (3, 1.9, False), (10, 1.9, False), (20, 0.0, True), (19, 0.0, False),  # MANY_IMAGES
])  # fmt: skip
def test_images_confirm_each_other_from_here_on(count, way, confirmed):
    traveled = np.linspace(-way, 0.0, count)[:-1]
    earlier = seen_along([(1.0 + d, 0.0) for d in traveled], traveled=traveled + 0.0)
    belief = belief_at(std=0.5, support=5, evidence=earlier)
    after = CORRECTION.fuse(belief, image([1.0, 0.0]))
    assert (after.memory.update.reason == 'accepted') is confirmed


@pytest.mark.parametrize(('d2', 'accepted'), [(10.7, True), (10.9, False)])
def test_the_gate_lets_all_but_one_in_a_thousand_in(d2, accepted):
    # chi2 with 2 degrees of freedom: -2 log(0.001) = 13.8; scaled to test its border.
    reach = math.sqrt(d2 / 10.8 * -2 * math.log(0.001))
    prior, own = 0.1**2, 0.1**2
    event = image([reach * math.sqrt(prior + own), 0.0])
    after = CORRECTION.fuse(belief_at(std=0.1, support=5), event)
    assert after.memory.update.accepted is accepted
