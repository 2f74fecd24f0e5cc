# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The posterior over what may be the matter, on images whose errors are known."""

import cmath
import math
import warnings

import numpy as np
import pytest
from filter_drives import stamps, true_path, winding

from sfa_localization.data.geometry import wrap_angle
from sfa_localization.fusion.health import HARMLESS_M, LIKELY, health_of
from sfa_localization.fusion.track import Image, Track

RATE_HZ, EVERY, STD_M, STD_RAD = 20, 10, 0.1, 0.03
MORE_M = np.arange(0.5, 20.0, 0.5).tolist()
MAP = 30 - 10j, 2.0
"""Where the odometry's frame lies in the map, and how it is turned."""


def shows(late_s=0.0, lever=0j, turned=0.0, scale=1.0):
    """What an image shows at a sample of the path (N, 3): place in its frame, and yaw, or None."""

    def shown(poses, i):
        at = max(i - round(late_s * RATE_HZ), 0)
        if at >= len(poses):
            return None
        x, y, yaw = poses[at]
        return scale * complex(x, y) + cmath.exp(1j * yaw) * lever, yaw + turned

    return shown


def anywhere(_, i):
    rng = np.random.default_rng(i)
    return complex(*rng.uniform(-5, 5, 2)), rng.uniform(-math.pi, math.pi)


def carried(at, shift=4 - 3j, turn=1.5, further=()):
    """From the sample `at` on, and from each of those that follow, the robot is elsewhere."""

    def shown(poses, i):
        times = sum(i >= other for other in (at, *further))
        place = complex(*poses[i, :2])
        return place * cmath.exp(1j * turn * times) + shift * times, poses[i, 2] + turn * times

    return shown


def drive(
    seconds=20.0, turn=0.5, shown=None, seed=0, heading=True, placed=(), frame=(0j, 0.0),
    mapped=MAP, std_m=STD_M,
):  # fmt: skip
    """A track after a drive at 1 m/s along a path that winds, with an image every EVERY samples;
    the filter is placed anew at samples `placed`.

    `frame` is where the odometry was switched on, `mapped` where its frame lies in the map.
    """
    twists = winding(seconds, RATE_HZ, 1.0, turn)
    at_ns = stamps(len(twists), RATE_HZ).tolist()
    poses = true_path(np.array(at_ns), twists)
    shown, rng, track, way_m = shown or shows(), np.random.default_rng(seed), Track(), 0.0
    for i, (x, y, yaw) in enumerate(poses.tolist()):
        at = frame[0] + cmath.exp(1j * frame[1]) * complex(x, y)
        reckoned = at.real, at.imag, float(wrap_angle(yaw + frame[1]))
        way_m += math.hypot(*(poses[i, :2] - poses[max(i - 1, 0), :2]))
        track = track.driven(at_ns[i], reckoned)
        if i in placed:
            track = track.placed(at_ns[i], way_m)
        if i % EVERY == 0 and (found := shown(poses, i)):
            place = mapped[0] + cmath.exp(1j * mapped[1]) * found[0]
            place += std_m * complex(*rng.standard_normal(2))
            look = float(wrap_angle(found[1] + mapped[1] + STD_RAD * rng.standard_normal()))
            look, variance = (look, STD_RAD**2) if heading else (math.nan, math.inf)
            track = track.seen(Image(at_ns[i], place, look, std_m**2, variance, reckoned, way_m))
    return track


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('turn', [0.0, 0.5])
@pytest.mark.parametrize('heading', [True, False])
def test_where_all_is_well_two_meters_are_enough(heading, turn, seed):
    for seconds in (2.6, 5.0, 30.0):
        health = health_of(drive(seconds, turn, seed=seed, heading=heading))
        assert health.well > LIKELY and health.problems == []
    assert health_of(drive(1.0, seed=seed)).problems  # not confirmed yet


FAULTS = {
    'late': (shows(late_s=2.0), 'late', 2.0, 's late'),
    'early': (shows(late_s=-1.0), 'late', -1.0, 's early'),
    'ahead': (shows(lever=1.5 + 0j), 'lever', 1.5, 'm ahead'),
    'to the left': (shows(lever=1.5j), 'lever', 1.5j, 'm left'),
    'turned': (shows(turned=math.radians(40)), 'turned', math.radians(40), 'degrees'),
    'less far': (shows(scale=0.5), 'scale', 0.5, '0.5 times'),
    'farther': (shows(scale=2.0), 'scale', 2.0, 'times as far'),
    'unrelated': (anywhere, 'unrelated', 0.0, 'different motions'),
}


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('name', FAULTS)
def test_each_fault_is_found_with_its_size_and_named(name, seed):
    shown, fault, size, said = FAULTS[name]
    health = health_of(drive(shown=shown, seed=seed))
    assert health.well < 1 - LIKELY
    assert health.fault == fault and abs(health.size - size) < 0.25 * max(abs(size), 1.0)
    assert said in health.problems[0] and len(health.problems) == 1


def test_what_a_fault_may_move_the_robot_by_widens_the_estimate():
    for name in ('late', 'ahead', 'farther'):
        assert min(health_of(drive(shown=FAULTS[name][0])).variances[:2]) > HARMLESS_M**2
    assert math.sqrt(health_of(drive(shown=FAULTS['turned'][0])).variances[2]) > 0.5
    assert max(health_of(drive()).variances) < 0.01


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('shown', [
    shows(late_s=0.2), shows(late_s=-0.2), shows(lever=0.25 + 0j), shows(lever=0.25j),
    shows(turned=math.radians(6)), shows(scale=0.9), shows(scale=1.1),
])  # fmt: skip
def test_what_moves_the_robot_by_little_is_no_fault(shown, seed):
    health = health_of(drive(shown=shown, seed=seed))
    assert health.well > LIKELY and health.problems == []


def test_a_quarter_of_wrong_images_is_no_fault():
    mixed = drive(shown=lambda *at: (anywhere if at[1] // EVERY % 4 == 1 else shows())(*at))
    assert health_of(mixed).well > LIKELY


def meters_to_confirm(shown, placed):
    """Driven from the last placing on until nothing is in the way."""
    tracks = ((m, drive(placed[-1] / RATE_HZ + m, shown=shown, placed=placed)) for m in MORE_M)
    return next((m for m, track in tracks if not health_of(track).problems), math.inf)


def test_who_was_carried_is_confirmed_by_driving_and_twice_as_long_each_time():
    first, again = 200, 320  # samples, 6 m apart
    once = meters_to_confirm(carried(first), (first + 40,))
    assert once <= 2.0
    twice = meters_to_confirm(carried(first, further=[again]), (first + 40, again + 40))
    assert 2.0 <= twice <= 4.0
    at_once = health_of(drive(12.0, shown=carried(first + 20), placed=(first + 39,)))
    assert 'driving on confirms it' in at_once.problems[-1]


def test_an_estimate_that_is_placed_and_right_for_long_is_confirmed_as_at_first():
    track = drive(10.0)
    for at_m in (0.0, 1.0, 2.0):
        track = track.placed(int(at_m * 1e9), at_m)
    assert health_of(track).needed_m == 4 * health_of(drive(10.0)).needed_m
    assert len(track.placed(10**11, 100.0).placings) == 1
    assert health_of(track.trusted()).problems == []  # it was set from outside


def still(step_m=0.0, step_ns=1, yaw=0.0):
    """Nine images right beside each other, on a path of one knot."""
    images = (
        Image(1 + i * step_ns, complex(i * step_m), yaw, 0.01, 1e-3, (i * step_m, 0.0, 0.0), 0.0)
        for i in range(9)
    )
    return Track(((1, 0.0, 0.0, 0.0),), tuple(images))


ODD = {
    'nothing': Track(),
    **{f'{n} images': drive(n / 2, heading=False) for n in range(1, 7)},
    'one place': still(),
    'one place, no heading': still(yaw=math.nan),
    'one stamp': still(step_m=1.0, step_ns=0),
    'no heading': drive(heading=False),
    'very sure': drive(std_m=1e-4, shown=anywhere),
    'placed at each image': drive(placed=range(0, 400, EVERY)),
}


@pytest.mark.parametrize('name', ODD)
def test_of_little_or_odd_evidence_the_answer_is_finite(name):
    with np.errstate(divide='raise', over='raise', invalid='raise'), warnings.catch_warnings():
        warnings.simplefilter('error')
        health = health_of(ODD[name])
    assert 0.0 <= health.well <= 1.0 and cmath.isfinite(health.size)
    assert np.isfinite(health.variances).all() and min(health.variances) >= 0.0
    assert not math.isnan(health.confirmed_m) and math.isfinite(health.needed_m)


@pytest.mark.parametrize('name', FAULTS)
def test_neither_map_nor_odometry_has_a_direction_that_matters(name):
    shown, exact = FAULTS[name][0], 1e-9  # noise is drawn in the map's axes
    first = health_of(drive(shown=shown, std_m=exact))
    assert health_of(drive(shown=shown, std_m=exact)) == first
    for moved in ({'frame': (-500 + 80j, -2.5)}, {'mapped': (0j, -1.0)}):
        health = health_of(drive(shown=shown, std_m=exact, **moved))
        assert health.fault == first.fault and health.well == pytest.approx(first.well, abs=1e-6)
        assert health.size == pytest.approx(first.size, abs=1e-5)
        assert health.variances == pytest.approx(first.variances, rel=1e-5, abs=1e-9)
