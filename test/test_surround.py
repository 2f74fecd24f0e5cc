# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Several cameras are one panorama: geometry, seams, exposures, times, and cameras that fail."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rigs import camera, fisheye, picture, pinhole, rig, smooth, speckled

from sfa_localization.camera.joining import LATE, NO_IMAGE, StampJoiner
from sfa_localization.camera.panorama import panorama_rays
from sfa_localization.camera.sectors import MountedCamera, SurroundView, visible_elevations
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.camera.surround import Surround, TurnRates, sentence
from sfa_localization.camera.watch import FROZEN_IMAGES
from sfa_localization.camera.yaws import turned
from sfa_localization.data.errors import CameraError
from sfa_localization.data.rejections import short_line

PANORAMA = PanoramaConfig()
MS = 1_000_000
STEP = 100 * MS


def direct(scene=smooth, panorama=PANORAMA, heading=0.0):
    """The panorama of a scene at infinity."""
    rays = panorama_rays(panorama).reshape(-1, 3)
    c, s = np.cos(heading), np.sin(heading)
    turned = rays @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return scene(turned).reshape(panorama.height, panorama.width, 3)


def feed(surround, number, images, later_ms=None):
    """The panoramas that images of a time give."""
    made = []
    for name, image in images.items():
        at = 10 * STEP + number * STEP + round((later_ms or {}).get(name, 0) * MS)
        made += surround.add(name, at, image)
    return made


def pictures(cameras, **options):
    return {mounted.name: picture(mounted, **options) for mounted in cameras}


def composed(cameras, panorama=PANORAMA, **options):
    """A panorama of cameras, by images of three times."""
    surround = Surround(cameras, panorama, **options)
    made = [feed(surround, number, pictures(cameras)) for number in range(3)]
    return surround, made[-1][-1][1]


@pytest.mark.parametrize('clockwise', [True, False])
@pytest.mark.parametrize(
    ('lens', 'yaws'),
    [(pinhole(), (0, 90, 180, -90)), (fisheye(), (0, 180)), (fisheye(), (90, -90))],
)
def test_cameras_all_around_compose_the_panorama_of_a_distant_scene(lens, yaws, clockwise):
    panorama = PanoramaConfig(clockwise=clockwise)
    surround, image = composed(rig(yaws, lens), panorama)
    error = np.abs(image - direct(panorama=panorama))
    assert error.max() < 8 and error.mean() < 0.7  # the rim of a fisheye is blurred
    assert surround.visible.all() and surround.seen is None
    assert not surround.troubles


def test_a_pixel_lies_where_its_camera_looks():
    """The middle of the left camera is at 90 degrees, column 150 of 600; elevation 0 in row 40."""
    cameras = rig()
    images = {c.name: np.full((120, 200, 3), 100, np.uint8) for c in cameras}
    images['left'][58:62, 98:102] = 250
    surround = Surround(cameras, PANORAMA)
    feed(surround, 0, images)
    *_, (_, image) = feed(surround, 1, {n: image + 1 for n, image in images.items()})
    rows, columns = np.nonzero(image[..., 0] > 220)
    assert_allclose([rows.mean() + 0.5, columns.mean() + 0.5], [40, 150], atol=0.6)


def test_poses_of_optical_frames_give_axes_and_place():
    """REP 103: z of the optical frame looks ahead, here to the left; the place is the mean."""
    left = camera('left', 90, radius=0.3)
    assert_allclose(left.ahead, [0, 1, 0], atol=1e-12)
    assert np.degrees(left.yaw) == pytest.approx(90)
    ahead = camera('front', 0, radius=0.5)
    assert Surround([left, ahead], PANORAMA).place == pytest.approx(0.25 + 0.15j)
    assert sentence([ahead, left]) == (
        '2 cameras are one panorama, looking to front 0, left 90 degrees of yaw'
    )


def at_five_meters(mounted, inverse):
    """The image of a camera in a sphere of 5 m about the robot, and a camera for things there."""
    place = np.array(mounted.place)

    def scene(rays):
        along = rays @ place
        distance = np.sqrt(along**2 - place @ place + 25.0) - along
        return smooth((place + distance[:, None] * rays) / 5.0)

    return picture(mounted, scene), dataclasses.replace(mounted, inverse=inverse)


@pytest.mark.parametrize(('inverse', 'most'), [(0.2, 0.7), (0.0, 6.0)])
def test_things_at_the_composed_distance_lie_where_a_camera_in_the_middle_sees_them(inverse, most):
    """At infinity they lie up to 3 degrees aside, of cameras 0.4 m off the middle."""
    four = [camera(str(yaw), yaw, radius=0.4) for yaw in (0, 90, 180, 270)]
    images, cameras = zip(*(at_five_meters(mounted, inverse) for mounted in four), strict=True)
    surround = Surround(cameras, PANORAMA)
    for number in range(3):
        made = feed(surround, number, {c.name: i for c, i in zip(cameras, images, strict=True)})
    error = np.abs(made[-1][1] - direct()).mean()
    assert error < most and (error > 1.0) == (inverse == 0.0)


def test_a_camera_is_stored_as_plain_values():
    for mounted in rig():
        stored = json.loads(json.dumps(dataclasses.asdict(mounted)))
        assert MountedCamera.from_mapping(stored) == mounted


def test_what_no_camera_sees_repeats_the_nearest_pixel_of_its_row():
    """Three cameras of 100 degrees see from -50 to 230 degrees, 280 of 360."""
    surround, image = composed(rig()[:3])
    assert surround.visible.mean() == pytest.approx(280 / 360, abs=0.01)
    assert_array_equal(surround.seen, surround.visible)
    azimuth = np.degrees(PANORAMA.sphere.azimuths(PANORAMA.width)) % 360
    hidden = (azimuth > 231) & (azimuth < 309)
    assert not surround.visible[:, hidden].any() and surround.visible[:, ~hidden].mean() > 0.98
    edge = np.flatnonzero(np.diff(surround.visible[40].astype(int)) < 0)[0]
    assert_array_equal(image[40, edge + 1 : edge + 20], np.repeat(image[40, [edge]], 19, axis=0))


def test_blind_sectors_are_hidden_too():
    surround, _ = composed(rig(), blind_sectors=(170.0, 190.0))
    assert surround.visible.mean() == pytest.approx(340 / 360, abs=0.005)
    with pytest.raises(CameraError, match='blind_sectors hide all'):
        composed(rig(), blind_sectors=(0.0, 360.0))


def test_seams_pass_from_one_camera_to_the_other_within_their_overlap():
    """Front and left overlap from 40 to 50 degrees: half each at 45, one alone beyond."""
    view = SurroundView(rig(), PANORAMA).view({c.name: (120, 200) for c in rig()})
    azimuth = np.degrees(PANORAMA.sphere.azimuths(PANORAMA.width))
    tables = SurroundView(rig(), PANORAMA)
    total = np.zeros((60, 600))
    shares = {}
    for name, share in view.shares.items():
        whole = np.zeros((60, 600))
        whole[:, tables.sector(name, (120, 200)).columns] = share[..., 0]
        shares[name] = whole[40]
        total += whole
    assert_allclose(total, 1.0, atol=1e-5)
    at = np.abs(azimuth[:, None] - [45.0, 38.0, 52.0]).argmin(axis=0)
    assert_allclose(shares['front'][at], [0.5, 1.0, 0.0], atol=0.06)
    assert_allclose(shares['left'][at], [0.5, 0.0, 1.0], atol=0.06)
    assert np.abs(np.diff(shares['front'])).max() < 0.13  # no step


def exposed(gains, scene=smooth):
    """A panorama of cameras whose exposures have settled."""
    surround = Surround(rig(), PANORAMA)
    for number in range(3):
        images = {c.name: picture(c, scene, gain=gains[c.name]) for c in rig()}
        made = feed(surround, number, images)
    return made[-1][1].astype(float)


def test_exposures_are_balanced_where_views_overlap():
    """Factors up to 1.6 between neighbors vanish; the mean brightness stays."""
    gains = {'front': 1.0, 'left': 0.7, 'rear': 1.0, 'right': 1.1}
    ratio = exposed(gains)[..., 2] / direct()[..., 2]
    mean = np.exp(np.mean(np.log([*gains.values()])))
    assert_allclose(ratio, mean, rtol=0.04)


def test_a_sky_that_some_cameras_cut_off_is_the_same_in_all_headings():
    """A sky of 230 is 255 for a camera exposed 1.3 times as long, and 161 for one of 0.7."""
    gains = {'front': 1.0, 'left': 0.7, 'rear': 1.0, 'right': 1.3}
    scale = np.exp(np.mean(np.log([*gains.values()])))

    def scene(rays):
        return np.where(rays[:, 2:] > 0.2, 230.0, smooth(rays) / 2)

    panorama = exposed(gains, scene)
    assert_allclose(panorama[:15], 255 / 1.3 * scale, atol=4)
    ground = panorama[45:] / direct(lambda rays: smooth(rays) / 2)[45:]
    assert_allclose(np.median(ground, axis=(0, 1)), scale, rtol=0.03)


def test_one_camera_exposed_far_more_than_others_does_not_darken_them():
    gains = {'front': 0.4, 'left': 0.4, 'rear': 0.4, 'right': 1.2}
    ahead = exposed(gains)[:, 295:305]
    assert ahead.max() > 115  # the white of the right camera is 112


def test_a_turn_between_stamps_is_corrected():
    """At 0.6 rad/s, 40 ms are 2.3 columns."""
    cameras = rig()
    later = {'front': 0, 'left': 40, 'rear': -40, 'right': 20}
    errors = []
    for rate in (0.0, 0.6):
        surround = Surround(cameras, PANORAMA)
        for number in range(3):
            at = 10 * STEP + number * STEP
            surround.add_turn_rate(at, rate)
            taken = {c.name: 0.6 * (number * 0.1 + later[c.name] * 1e-3) for c in cameras}
            images = {c.name: picture(c, heading=taken[c.name]) for c in cameras}
            made = feed(surround, number, images, later)
        stamp_ns, image = made[-1]
        heading = 0.6 * (stamp_ns - 10 * STEP) * 1e-9
        errors.append(np.abs(image - direct(heading=heading))[:, :, :2].mean())
    assert errors[1] < 0.4 < 1.0 < errors[0]


def test_turns_are_known_where_a_bag_holds_all_odometry_before_the_images():
    rates = TurnRates()
    for number in range(10_000):
        rates.add(10 * STEP + number * 40 * MS, 0.1 + 1e-4 * number)
    for number in (0, 2000, 9999):
        at = 10 * STEP + number * 40 * MS
        assert rates.turn(at - MS, at + MS) == pytest.approx((0.1 + 1e-4 * number) * 2e-3, abs=1e-7)
    middle = 10 * STEP + 500 * 40 * MS + 20 * MS
    assert rates.turn(middle + MS, middle - MS) == pytest.approx(-0.15005 * 2e-3)
    assert rates.turn(9 * STEP, 9 * STEP + 50 * MS) == pytest.approx(
        0.005
    )  # within 200 ms of the first
    assert rates.turn(7 * STEP, 7 * STEP + 50 * MS) == TurnRates().turn(0, MS) == 0.0
    rates.add(10 * STEP, 1.0)  # the clock was set back
    assert rates.turn(10 * STEP, 10 * STEP + 10 * MS) == pytest.approx(0.01)
    assert rates.turn(20 * STEP, 20 * STEP + 10 * MS) == 0.0


@pytest.mark.parametrize(
    ('count', 'text'), [(1, '1 cameras: give 2 to 8'), (9, '9 cameras'), (2, 'one name')]
)
def test_other_numbers_of_cameras_are_refused(count, text):
    names = ['a'] * count if count == 2 else [str(number) for number in range(count)]
    cameras = [camera(name, 10 * number) for number, name in enumerate(names)]
    with pytest.raises(CameraError, match=text):
        Surround(cameras, PANORAMA)


def test_a_camera_that_sees_nothing_of_the_panorama_is_named():
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])  # looks down
    below = MountedCamera.at('below', pinhole(60.0), pose)
    with pytest.raises(CameraError, match='camera below sees no part'):
        Surround([*rig(), below], PANORAMA).check()
    surround = Surround(rig(), PANORAMA)
    feed(surround, 0, pictures(rig()))
    with pytest.raises(CameraError, match='calibrated for 200 x 120'):
        feed(surround, 1, {c.name: np.full((50, 200, 3), 99, np.uint8) for c in rig()})


def test_elevations_are_those_seen_nearly_all_around():
    """A pinhole of 100 x 71 degrees sees 35.5 degrees up on its axis, 26.7 at 45 degrees beside."""
    low, high = visible_elevations(rig())
    assert high == pytest.approx(26.7, abs=1.5) and low == pytest.approx(-high, abs=0.1)


# Joining by stamp.


def joined(joiner, *arrivals):
    """The stamps, ms, of joined images by camera, of arrivals (name, ms)."""
    done = []
    for name, ms in arrivals:
        done += joiner.add(name, round(ms * MS), None)
    return [{name: at / MS for name, (at, _) in images.images.items()} for images in done]


def test_images_of_one_time_are_joined_when_the_last_has_come():
    joiner = StampJoiner('ab')
    assert joined(joiner, ('a', 1000), ('b', 1030)) == []  # no period is known
    assert joined(joiner, ('a', 1100)) == [{'a': 1000, 'b': 1030}]
    (one,) = joiner.add('b', 1130 * MS, None)
    assert one.stamp_ns == 1115 * MS and one.absent == {}


def test_a_missing_image_costs_a_period_three_times_and_then_nothing():
    joiner = StampJoiner('ab')
    joined(joiner, ('a', 1000), ('b', 1000), ('a', 1100), ('b', 1100))
    assert joined(joiner, ('a', 1200)) == []
    assert joined(joiner, ('a', 1300)) == [{'a': 1200}]
    assert joined(joiner, ('a', 1400)) == [{'a': 1300}]
    assert joined(joiner, ('a', 1500)) == [{'a': 1400}, {'a': 1500}]
    (alone,) = joiner.add('a', 1600 * MS, None)
    assert alone.absent == {'b': NO_IMAGE}
    assert joined(joiner, ('b', 1700)) == []  # it is back
    assert joined(joiner, ('a', 1700)) == [{'a': 1700, 'b': 1700}]


def test_a_camera_whose_images_come_too_late_is_named_so():
    joiner = StampJoiner('ab')
    joined(joiner, ('a', 1000), ('b', 1000), ('a', 1100), ('b', 1100))
    joined(joiner, ('a', 1200), ('a', 1300))  # 1200 is complete without b
    assert joined(joiner, ('b', 1200)) == []
    ((late),) = joiner.add('a', 1400 * MS, None)
    assert late.absent == {'b': LATE}


def test_another_camera_leads_where_the_first_is_silent():
    joiner = StampJoiner('abc')
    start = [(name, at) for at in (1000, 1100) for name in 'abc']
    joined(joiner, *start)
    rest = [(name, at) for at in (1200, 1300, 1400, 1500) for name in 'bc']
    done = joined(joiner, *rest)
    assert done[-1]['c'] >= 1400 and all('a' not in images for images in done)
    assert len(done) >= 3


def test_images_at_irregular_times_are_joined_one_by_one():
    """Cameras that the way of the robot triggers: steps of 0.08 to 1.1 s."""
    joiner = StampJoiner('ab')
    times = np.cumsum([1000, 300, 250, 80, 90, 1100, 300, 120, 90])
    done = joined(joiner, *((name, at) for at in times for name in 'ab'))
    done += [{n: at / MS for n, (at, _) in j.images.items()} for j in joiner.flush()]
    assert done == [{'a': at, 'b': at} for at in times]


def test_of_a_faster_camera_the_nearest_images_are_used():
    joiner = StampJoiner('ab')
    slow = [('a', at) for at in range(1000, 1500, 100)]
    fast = [('b', at) for at in range(990, 1500, 33)]
    done = joined(joiner, *sorted([*slow, *fast], key=lambda arrival: arrival[1]))
    assert all(abs(pair['a'] - pair['b']) <= 17 for pair in done if 'b' in pair)
    assert [pair['a'] for pair in done] == [1000, 1100, 1200, 1300, 1400]
    assert sum('b' in pair for pair in done) >= 4


def test_time_that_steps_back_begins_anew():
    joiner = StampJoiner('ab')
    joined(joiner, *((name, at) for at in (5000, 5100, 5200) for name in 'ab'))
    again = joined(joiner, *((name, at) for at in (1000, 1100, 1200) for name in 'ab'))
    assert again == [{'a': at, 'b': at} for at in (1000, 1100, 1200)]


# Cameras that fail.


def noisy(cameras, number):
    """Images with noise, which never repeat."""
    rng = np.random.default_rng(number)
    return {
        c.name: np.clip(picture(c) + rng.integers(-2, 3, (120, 200, 3)), 0, 255).astype(np.uint8)
        for c in cameras
    }


def faulty(fault, numbers):
    """A rig whose rear camera has a fault from the third time on, after so many times."""
    cameras = rig()
    surround = Surround(cameras, PANORAMA)
    made = []
    for number in range(numbers):
        images = noisy(cameras, number)
        if number >= 3:
            if fault == 'gone':
                del images['rear']
            else:
                still = noisy(cameras, 2)['rear']
                images['rear'] = still if fault == 'frozen' else np.zeros_like(still)
        made += feed(surround, number, images)
    return surround, made


@pytest.mark.parametrize(
    ('fault', 'reason'), [('black', 'image is dark'), ('frozen', 'camera is frozen'),
                          ('gone', NO_IMAGE)]
)  # fmt: skip
def test_a_camera_that_fails_is_named_and_its_sector_hidden(fault, reason):
    surround, made = faulty(fault, 4 + FROZEN_IMAGES)
    assert [*surround.troubles] == ['rear']
    trouble = surround.troubles['rear']
    assert trouble.reason.startswith(reason)
    assert trouble.since_ns == pytest.approx(10 * STEP + 3 * STEP, abs=STEP / 2)
    azimuth = np.degrees(PANORAMA.sphere.azimuths(PANORAMA.width))
    assert_array_equal(surround.visible.all(axis=0), np.abs(azimuth) < 140)
    image = made[-1][1]
    ahead = np.abs(azimuth) < 130
    assert np.abs(image - direct())[:, ahead].max() < 8
    feed(surround, 20, noisy(rig(), 20))
    feed(surround, 21, noisy(rig(), 21))
    assert surround.troubles == {} and surround.visible.all()


def test_a_night_hides_no_camera():
    """All are dark: the panorama is judged as a whole."""
    cameras = rig()
    surround = Surround(cameras, PANORAMA)
    for number in range(3):
        black = {c.name: np.full((120, 200, 3), number, np.uint8) for c in cameras}
        feed(surround, number, black)
    assert surround.troubles == {} and surround.visible.all()


def test_texts_fit_into_a_line_of_diagnostics():
    assert short_line(LATE) == LATE and short_line(NO_IMAGE) == NO_IMAGE


def test_unused_images_are_counted_by_reason():
    surround, _ = faulty('black', 8)
    assert dict(surround.unused['rear']) == {'image is dark': 5}
    assert not surround.unused['front']


def test_a_camera_that_was_turned_since_training_is_named_while_the_robot_turns():
    """The left one by 10 degrees to the left; poses come before and after each image."""
    stated = rig()
    true = [stated[0], turned(stated[1], np.radians(10)), *stated[2:]]
    surround = Surround(stated, PANORAMA)
    for number in range(24):
        heading = 0.5 * number
        at = 10 * STEP + number * 6 * STEP
        for part in (-1, 0):
            surround.add_pose(at + part * STEP, np.array([0.0, 0.0, heading + 0.1 * part]))
        images = {c.name: picture(c, speckled, heading) for c in true}
        for name, image in images.items():
            surround.add(name, at, image)
        surround.finish()
    (sentence_of_left,) = surround.knocked
    assert sentence_of_left.startswith('camera left looks 10.')
    assert sentence_of_left.endswith('to the left of what it was in training')
