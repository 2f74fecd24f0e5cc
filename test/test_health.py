# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The posterior of what may be wrong, on images with simulated errors."""

import cmath
import math
import warnings

import numpy as np
import pytest
from filter_drives import stamps, winding
from places import lengths

from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import integrate
from sfa_localization.fusion.belief import DrivenPath, PositionFix, remembered
from sfa_localization.fusion.health import LIKELY, health_of

RATE_HZ, EVERY, STD_M, STD_RAD = 20, 10, 0.1, 0.03
MAP = 30 - 10j, 2.0
"""Where the odometry's frame lies in the map, and how it is turned."""


def shows(late_s=0.0, lever=0j, turned=0.0, scale=1.0, factor=1.0):
    """What an image shows at a sample of the path (N, 3): place in its frame, and yaw, or None.
    The robot turns `factor` times as far as the path.
    """

    def camera(poses, i):
        at = max(i - round(late_s * RATE_HZ), 0)
        if at >= len(poses):
            return None
        x, y, yaw = poses[at]
        if factor != 1.0:
            yaws = factor * poses[: at + 1, 2]
            steps = lengths(np.diff(poses[: at + 1], axis=0))
            way = steps @ np.exp(1j * (yaws[1:] + yaws[:-1]) / 2)
            x, y, yaw = way.real, way.imag, yaws[-1]
        return scale * complex(x, y) + cmath.exp(1j * yaw) * lever, yaw + turned

    return camera


def anywhere(_, i):
    rng = np.random.default_rng(i)
    return complex(*rng.uniform(-5, 5, 2)), rng.uniform(-math.pi, math.pi)


def drive(seconds=20.0, turn=0.5, camera=None, seed=0, heading=True, std_m=STD_M):
    """The track, and what is remembered of images, after a drive at 1 m/s along a path that winds,
    with an image every EVERY samples.
    """
    twists = winding(seconds, RATE_HZ, 1.0, turn)
    at_ns = stamps(len(twists), RATE_HZ).tolist()
    poses = integrate(np.array(at_ns), twists, np.zeros(3))
    camera, rng, way_m = camera or shows(), np.random.default_rng(seed), 0.0
    track, images = DrivenPath(placed_m=(0.0,)), ()
    for i, reckoned in enumerate(poses.tolist()):
        way_m += math.hypot(*(poses[i, :2] - poses[max(i - 1, 0), :2]))
        track = track.driven(at_ns[i], reckoned, images[0].stamp_ns if images else at_ns[i])
        if i % EVERY == 0 and (seen := camera(poses, i)):
            place = MAP[0] + cmath.exp(1j * MAP[1]) * seen[0]
            place += std_m * complex(*rng.standard_normal(2))
            look = float(wrap_angle(seen[1] + MAP[1] + STD_RAD * rng.standard_normal()))
            look, variance = (look, STD_RAD**2) if heading else (math.nan, math.inf)
            image = PositionFix(at_ns[i], place, look, std_m**2, variance, reckoned, way_m)
            images = remembered(images, image)
    return track, images


@pytest.mark.parametrize('turn', [0.0, 0.5])
@pytest.mark.parametrize('heading', [True, False])
def test_where_all_is_well_two_meters_are_enough(heading, turn):
    for seconds in (2.6, 5.0, 30.0):
        health = health_of(*drive(seconds, turn, heading=heading))
        assert health.well > LIKELY and health.problems == []
    assert health_of(*drive(1.0)).problems  # not confirmed yet


FAULTS = {
    'late': (shows(late_s=2.0), 'late', 2.0, 's late'),
    'early': (shows(late_s=-1.0), 'late', -1.0, 's early'),
    'ahead': (shows(lever=1.5 + 0j), 'lever', 1.5, 'm ahead'),
    'to the left': (shows(lever=1.5j), 'lever', 1.5j, 'm left'),
    'turned': (shows(turned=math.radians(40)), 'turned', math.radians(40), 'degrees'),
    'less far': (shows(scale=0.5), 'scale', 0.5, '0.5 times'),
    'farther': (shows(scale=2.0), 'scale', 2.0, 'times as far'),
    'tracks that skid': (shows(factor=0.7), 'wheels', 0.7, 'times as far as the odometry'),
    'turns counted by half': (shows(factor=1.5), 'wheels', 1.5, 'do the wheels skid'),
    'unrelated': (anywhere, 'unrelated', 0.0, 'different motions'),
}


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('name', FAULTS)
def test_each_fault_is_found_with_its_size_and_named(name, seed):
    camera, fault, size, said = FAULTS[name]
    health = health_of(*drive(turn=1.0 if fault == 'wheels' else 0.5, camera=camera, seed=seed))
    assert health.well < 1 - LIKELY
    assert health.fault == fault and abs(health.size - size) < 0.25 * max(abs(size), 1.0)
    assert said in health.problems[0] and len(health.problems) == 1
    (busy,) = health._replace(waited_s=3.0).problems
    expected = 'messages have waited 3.0 s: this computer is too busy'
    assert busy == (expected if fault == 'late' else health.problems[0])


@pytest.mark.parametrize('camera', [
    shows(late_s=0.2), shows(late_s=-0.2), shows(lever=0.25 + 0j), shows(lever=0.25j),
    shows(factor=0.9), shows(factor=1.1), shows(turned=math.radians(6)), shows(scale=0.9),
    shows(scale=1.1),
    lambda *at: (anywhere if at[1] // EVERY % 4 == 1 else shows())(*at),  # a quarter of the images
])  # fmt: skip
def test_what_moves_the_robot_by_little_is_no_fault(camera):
    health = health_of(*drive(camera=camera, seed=1))
    assert health.well > LIKELY and health.problems == []


def test_who_is_placed_anew_is_confirmed_by_driving_and_twice_as_long_each_time():
    track, images = drive(10.0)
    needed = []
    for at_m in (7.0, 8.0, 9.0):
        track = track.placed(at_m)
        health = health_of(track, images)
        assert health.confirmed_m == pytest.approx(images[-1].traveled_m - at_m)
        needed.append(health.needed_m)
    assert needed == [2.0, 4.0, 8.0] and 'driving on confirms it' in health.problems[-1]
    assert health_of(track.placed(100.0), images).needed_m == 2.0  # it was right for long


def still(step_m=0.0, step_ns=1, yaw=0.0):
    """Nine images right beside each other, on a path of one knot."""
    places = [(1 + i * step_ns, i * step_m) for i in range(9)]
    images = [PositionFix(at, x, yaw, 0.01, 1e-3, (x, 0.0, 0.0), 0.0) for at, x in places]
    return DrivenPath(((1, 0.0, 0.0, 0.0),)), images


ODD = {
    'nothing': (DrivenPath(), ()),
    **{f'{n} images': drive(n / 2, heading=False) for n in range(1, 7)},
    'one place': still(),
    'one place, no heading': still(yaw=math.nan),
    'one stamp': still(step_m=1.0, step_ns=0),
    'no heading': drive(heading=False),
    'very sure': drive(std_m=1e-4, camera=anywhere),
}


@pytest.mark.parametrize('name', ODD)
def test_of_little_or_odd_evidence_the_answer_is_finite(name):
    with np.errstate(divide='raise', over='raise', invalid='raise'), warnings.catch_warnings():
        warnings.simplefilter('error')
        health = health_of(*ODD[name])
    assert 0.0 <= health.well <= 1.0 and cmath.isfinite(health.size + health.confirmed_m)
