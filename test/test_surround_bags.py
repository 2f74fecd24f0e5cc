# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Bags with the images of several cameras: which belong together, their panoramas, their yaws."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rigs import START, camera, fisheye, rig, smooth, speckled, write_bag
from test_surround import direct

from sfa_localization import cli
from sfa_localization.bags.drives import ReadingRecipe, as_live, images_at, read_drive
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.settings import TopicNames
from sfa_localization.bags.surround_drive import with_cameras, yaws_of
from sfa_localization.bags.surround_topics import camera_name, cameras_of
from sfa_localization.camera.encodings import read_image
from sfa_localization.camera.settings import CameraConfig, PanoramaConfig
from sfa_localization.camera.yaws import (
    AS_TRAINED,
    KNOCKED_RAD,
    Sighting,
    YawComparison,
    pairs,
    turned,
)
from sfa_localization.data.errors import BagError, CameraError
from sfa_localization.inspection import inspect

TURNING = 0.05 * np.arange(8)


@pytest.fixture(scope='module')
def four(tmp_path_factory):
    """A bag of four cameras of a robot that turns on the spot at 0.5 rad/s."""
    return write_bag(tmp_path_factory.mktemp('four') / 'bag', rig(), TURNING)


def read(bag, tmp_path, recipe=None):
    recipe = recipe or with_cameras(bag, ReadingRecipe())
    return read_drive(bag, tmp_path / 'cache', recipe)


def errors(run, headings):
    """Mean differences of panoramas from the scene, at the headings (N,) of the robot."""
    images = run.panoramas.read(0, len(run.panoramas))
    return [
        np.abs(image - direct(heading=heading)).mean()
        for image, heading in zip(images, headings, strict=True)
    ]


@pytest.mark.parametrize(
    ('topic', 'name'),
    [('/front/image_raw', 'front'), ('/robot/left/color/image_raw/compressed', 'robot/left/color'),
     ('/front/image_raw/ffmpeg', 'front'), ('/image_raw', 'image_raw'),
     ('/front/raw', 'front'), ('/front/compressed', 'front')],
)  # fmt: skip
def test_cameras_are_named_by_their_topics(topic, name):
    assert camera_name(topic) == name


def test_topics_with_lenses_and_poses_are_one_rig(four):
    recipe = with_cameras(four, ReadingRecipe())
    assert [c.name for c in recipe.surround] == ['front', 'left', 'rear', 'right']
    for found, written in zip(recipe.surround, rig(), strict=True):
        assert_allclose(np.array(found.rotation), np.array(written.rotation), atol=1e-12)
        assert_allclose(found.place, written.place, atol=1e-12)
        assert (found.lens.fx, found.lens.cx) == (written.lens.fx, written.lens.cx)
    assert recipe.panorama == PanoramaConfig()  # all of the usual elevations are seen


def test_a_drive_of_four_cameras_is_one_of_panoramas(four, tmp_path):
    run = read(four, tmp_path)
    assert run.panoramas.shape == (60, 600, 3) and len(run.panoramas) == 8
    assert max(errors(run, TURNING)) < 1.0
    assert run.camera == pytest.approx(0.0) and run.seen is None
    assert run.counts['images'].used == run.counts['images of rear'].used == 8


def test_two_fisheyes_on_two_topics_are_one_rig(tmp_path):
    two = rig((0, 180), fisheye(), ('front', 'back'))
    bag = write_bag(tmp_path / 'bag', two, TURNING)
    assert max(errors(read(bag, tmp_path), TURNING)) < 1.0


def test_cameras_of_other_times_are_turned_back_by_the_odometry(tmp_path):
    """At 0.5 rad/s a camera that is 40 ms late shows the scene 2 columns aside."""
    later = {'left': 0.04, 'rear': -0.04, 'right': 0.02}
    bag = write_bag(tmp_path / 'bag', rig(), TURNING, later_s=later)
    run = read(bag, tmp_path)
    stamps_ns = run.panoramas.stamps_ns
    assert_array_equal(stamps_ns - START, np.arange(8) * 100_000_000 + 5_000_000)
    assert max(errors(run, TURNING + 0.5 * 0.005)[1:-1]) < 1.0


def test_a_lost_image_hides_a_sector_of_one_panorama(tmp_path):
    bag = write_bag(tmp_path / 'bag', rig(), TURNING, skipped={('rear', 3)})
    run = read(bag, tmp_path)
    wrong = np.array(errors(run, TURNING))
    assert wrong[3] > 3 > 1 > np.delete(wrong, 3).max()
    assert run.seen is None and run.counts['images of rear'].used == 7


def test_a_drive_says_of_which_images_a_camera_was_missing_for_seconds(tmp_path):
    """The rear camera ends at 1.5 s, and its last image waits for a next one in vain."""
    skipped = {('rear', number) for number in range(4, 16)}
    bag = write_bag(tmp_path / 'bag', rig(), 0.05 * np.arange(16), period_s=0.5, skipped=skipped)
    lacking = read(bag, tmp_path).lacking
    assert lacking[:15] == ('',) * 10 + ('camera rear: it sends no images',) * 5


def test_a_camera_that_a_model_has_and_a_bag_lacks_is_hidden(four, tmp_path):
    recipe = with_cameras(four, ReadingRecipe())
    bag = write_bag(tmp_path / 'bag', rig()[:3], TURNING)
    live = as_live(recipe, recipe.panorama, None, recipe.surround)
    run = read(bag, tmp_path, live)
    assert len(run.panoramas) == 8
    assert run.seen is not None and run.seen.mean() == pytest.approx(280 / 360, abs=0.01)
    other = write_bag(tmp_path / 'other', [camera('mast', 0)], TURNING)
    with pytest.raises(BagError, match='front, left, rear, right, and the bag has images of mast'):
        read(other, tmp_path, live)


def test_named_topics_are_the_rig_or_the_only_camera(four):
    named = ReadingRecipe(TopicNames(image='front/image_raw, rear/image_raw'))
    assert [c.name for c in with_cameras(four, named).surround] == ['front', 'rear']
    single = ReadingRecipe(TopicNames(image='/front/image_raw'))
    assert with_cameras(four, single).surround == ()


@pytest.mark.parametrize(
    ('options', 'text'),
    [
        ({'with_info': False}, 'no /front/camera_info .* tells the lens: record camera_info'),
        ({'with_tf': False}, 'no /tf_static from base_link to front_optical.*: record it'),
        ({'cameras': [camera('left', 0), camera('right', 5)]}, 'left and right look the same way'),
        (
            {'skipped': {('rear', n) for n in range(30) if n % 3}, 'headings': np.zeros(30)},
            'their rates differ: .*/rear/image_raw 3 Hz',
        ),
    ],
)
def test_topics_that_do_not_belong_together_are_refused_with_the_reason(tmp_path, options, text):
    given = {'cameras': rig(), 'headings': TURNING, **options}
    bag = write_bag(tmp_path / 'bag', **given)
    with Bag(bag) as opened, pytest.raises(BagError, match=text) as told:
        cameras_of(opened, '', '/odom')
    assert 'choose one with --image-topic' in str(told.value)


def test_parameters_of_one_camera_are_refused(four):
    camera_config = CameraConfig(mount_rpy=(0.0, 0.0, 90.0))
    with pytest.raises(CameraError, match='mount_rpy and mask_file are of one camera'):
        with_cameras(four, ReadingRecipe(camera=camera_config))


def test_panoramas_at_stamps_are_those_of_the_drive(four, tmp_path):
    recipe = with_cameras(four, ReadingRecipe())
    run = read(four, tmp_path, recipe)
    stamps = run.panoramas.stamps_ns[[2, 5]].tolist()
    images = images_at(four, stamps, recipe)
    for row, stamp in zip((2, 5), stamps, strict=True):
        difference = images[stamp].astype(int) - run.panoramas.read(row, row + 1)[0]
        assert np.abs(difference).max() <= 2


def test_inspect_says_which_cameras_are_one_panorama(four):
    report = inspect(four)
    assert report.cameras.startswith('4 cameras are one panorama, looking to front')
    assert report.camera.is_panorama and (report.camera.width, report.camera.height) == (600, 60)
    assert '  cameras: 4 cameras are one panorama' in report.as_text()
    counts = {topic.name: topic.count for topic in report.topics}
    assert counts['/rear/image_raw'] == counts['/front/camera_info'] == 8


def test_inspect_says_why_topics_make_no_panorama(tmp_path):
    bag = write_bag(tmp_path / 'bag', rig(), TURNING, with_info=False)
    assert any('record camera_info' in lack for lack in inspect(bag).lacks)


# Yaws.


def test_pairs_show_one_place_in_two_headings_soon_after_each_other():
    second = 1_000_000_000
    stamps = np.array([0, 1, 2, 3, 100]) * second
    poses = np.array([[0, 0, 0], [0.2, 0, 1], [5, 0, 2], [0.1, 0, 0.1], [0, 0, 1.0]])
    assert sorted(pairs(stamps, poses)) == [(0, 1), (1, 3)]


def test_errors_of_yaws_are_recovered_beside_parallax_and_turns():
    """Of exact sightings; the median is that of the stated yaws."""
    cameras = rig()
    rng = np.random.default_rng(3)
    errors = np.radians([2.0, 0.0, -3.0, 0.0])
    names = [c.name for c in cameras]
    sightings = []
    for pair in range(40):
        turn = np.radians(rng.normal(0, 0.5))
        for _ in range(6):
            first, second = rng.integers(0, 4, 2)
            parallax = rng.normal(0, 0.3)
            shift = errors[first] - errors[second] + turn + 0.2 * parallax
            sightings.append(Sighting(names[first], names[second], pair, shift, parallax))
    yaws = YawComparison(cameras, PanoramaConfig()).fit(sightings)
    estimated = np.degrees([yaws.errors[name].value for name in names])
    assert_allclose(estimated, np.degrees(errors), atol=0.1)
    assert yaws.inverse == pytest.approx(0.2, abs=0.01)
    texts = yaws.sentences('was stated')
    assert [text.split(' (')[0] for text in texts] == [
        'camera front looks 2.0 degrees', 'camera rear looks 3.0 degrees',
    ]  # fmt: skip
    assert 'to the left of what was stated' in texts[0] and 'to the right of' in texts[1]


def test_without_sightings_no_yaw_is_certain():
    yaws = YawComparison(rig(), PanoramaConfig()).fit([])
    assert yaws.sentences('') == [] and yaws.corrected(rig()) == tuple(rig())


@pytest.fixture(scope='module')
def whirl(tmp_path_factory):
    """A robot that turns twice; its front camera looks 3 degrees further left than /tf_static says,
    its rear one 11 degrees further right.
    """
    true = [turned(rig()[0], np.radians(3)), rig()[1], turned(rig()[2], np.radians(-11)), rig()[3]]
    headings = np.linspace(0, 4 * np.pi, 50)
    path = tmp_path_factory.mktemp('whirl') / 'bag'
    options = {'stated': rig(), 'scene': speckled, 'period_s': 0.5}
    return write_bag(path, true, headings, **options), true


def test_a_turning_robot_shows_the_yaws_of_its_cameras(whirl):
    bag, true = whirl
    recipe = with_cameras(bag, ReadingRecipe())
    yaws = yaws_of(bag, recipe)
    estimated = [np.degrees(yaws.errors[c.name].value) for c in true]
    assert_allclose(estimated, [3, 0, -11, 0], atol=0.4)
    for corrected, right in zip(yaws.corrected(recipe.surround), true, strict=True):
        assert corrected.yaw == pytest.approx(right.yaw, abs=np.radians(0.4))
    (knocked,) = yaws.sentences(AS_TRAINED, KNOCKED_RAD)
    assert knocked.startswith('camera rear looks 1') and 'to the right of what it was in' in knocked


def test_a_drive_says_since_when_a_camera_looks_elsewhere_than_in_training(whirl, tmp_path):
    bag, _ = whirl
    recipe = with_cameras(bag, ReadingRecipe())
    lacking = read(bag, tmp_path, as_live(recipe, recipe.panorama, None, recipe.surround)).lacking
    assert lacking[0] == '' and lacking[-1].startswith('camera rear looks 1')
    training = replace(recipe, distinct=True)
    assert {*read(bag, tmp_path, training).lacking} == {''}


def strangers(views, alike):
    """What is said after so many views of each pair of cameras, which are `alike` by a share."""
    pairs_of = itertools.combinations_with_replacement(['front', 'left', 'rear', 'right'], 2)
    sightings = [
        Sighting(one, other, number, 0.0 if number < alike(one, other) * views else np.nan, 0.1)
        for one, other in pairs_of
        for number in range(views)
    ]
    return [
        text.split()[1]
        for text in YawComparison(rig(), PanoramaConfig()).fit(sightings).sentences('')
    ]


def test_a_camera_that_shows_nothing_of_what_others_see_is_named():
    def damaged(one, other):
        return 0.0 if 'rear' in (one, other) else 0.8

    assert strangers(10, damaged) == ['rear'] and strangers(3, damaged) == []
    assert strangers(10, lambda one, other: damaged(one, other) or 0.3) == []
    # Where hardly anything is to be seen.
    assert strangers(10, lambda one, other: 0.4 * damaged(one, other)) == []


def test_cameras_whose_images_were_exchanged_are_named():
    sides = {'left', 'right'}

    def exchanged(one, other):
        return 0.9 if len(sides & {one, other}) != 1 or one == other else 0.0

    assert strangers(10, exchanged) == ['left', 'right']


def test_yaws_of_the_right_cameras_stay(whirl):
    bag, true = whirl
    recipe = replace(with_cameras(bag, ReadingRecipe()), surround=tuple(true))
    assert yaws_of(bag, recipe).sentences('', np.radians(0.5)) == []


def test_calibrate_draws_the_seams_and_says_how_the_cameras_look(whirl, tmp_path, capsys):
    bag, _ = whirl
    check = tmp_path / 'check.png'
    assert cli.main(['calibrate', str(bag), '--check', str(check)]) == 0
    told = capsys.readouterr().out
    assert told.startswith('4 cameras are one panorama, looking to front 3, left 90, rear 169')
    assert 'camera rear looks 1' in told and 'of what /tf_static says' in told
    image = read_image(check)
    assert image.shape == (200, 1200, 3)
    yellow = (image == (60, 230, 250)).all(axis=2).mean(axis=0)
    seams = np.flatnonzero(yellow > 0.5)
    azimuth = 180 - (seams + 0.5) * 0.3
    assert all(np.abs(azimuth - seam).min() < 4 for seam in (46.5, 129, -46.5, -140))
    assert cli.main(['calibrate', str(bag), '--output', str(tmp_path / 'camera.yaml')]) == 1
    assert 'give only --check' in capsys.readouterr().err


def test_scenes_of_the_tests_tell_directions_apart():
    rays = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert len({tuple(color) for color in smooth(rays)}) == 3
