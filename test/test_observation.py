# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which images are used, and what the filter gets of those that are not."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from picture_readers import PictureReader, panorama

from sfa_localization.camera.watch import ImageWatch
from sfa_localization.data.errors import ModelError
from sfa_localization.data.events import IMAGE, ODOMETRY, merge_by_stamp
from sfa_localization.data.run import BATCH, Odometry, PanoramaArray, Run
from sfa_localization.features.keyframes import Match, MatchNoise
from sfa_localization.features.local_regression import Nearby
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.localizer import Localizer, Observer, unusable_covariance
from sfa_localization.place_model import View

NEARBY = Nearby(np.zeros(2), 0.0, 0.1, np.zeros((2, 2)), 0.1, 0.0)


def test_a_good_picture_is_believed():
    watch = ImageWatch()
    assert [watch.judge(panorama(seed=seed)) for seed in range(20)] == [''] * 20


@pytest.mark.parametrize(('level', 'spread', 'reason'), [
    (2, 2, 'dark'), (0, 0, 'dark'), (120, 0, 'covered'), (250, 1, 'covered'),
])  # fmt: skip
def test_dark_and_covered_pictures_are_distinguished(level, spread, reason):
    picture = panorama(level=level, spread=spread)
    picture[0] = picture[1]
    assert reason in ImageWatch().judge(picture)


def test_a_repeated_picture_is_a_frozen_camera_until_it_changes():
    watch = ImageWatch()
    found = [watch.judge(panorama(seed=seed)) for seed in (1, 1, 1, 1, 1, 1, 2, 2, 1)]
    assert ['repeats' in text for text in found] == [False] + [True] * 5 + [False, True, False]
    assert ['frozen' in text for text in found] == [False] * 4 + [True] * 2 + [False] * 3


@pytest.mark.parametrize(('novelty', 'fine'), [(0.5, True), (3.0, True), (3.1, False),
                                              (math.nan, False)])  # fmt: skip
def test_foreign_pictures_are_not_believed(novelty, fine):
    assert (ImageWatch().judge_novelty(novelty) == '') == fine


def test_the_covariance_of_an_unusable_picture_makes_the_filter_leave_it_out():
    update = PoseFilter().add_measurement(10**9, [0, 0, 0], unusable_covariance())
    assert not update.accepted and update.reason == 'covariance means that nothing is known'


def test_a_believed_picture_gives_the_models_pose_and_covariance():
    seen = Observer(PictureReader()).observe(7, panorama((3.0, 40.0, 1.0)))
    assert seen.stamp_ns == 7 and seen.problem == ''
    assert seen.pose == pytest.approx([3.0, 40.0, 1.0], abs=1e-4)
    assert np.array_equal(seen.covariance, np.diag([0.02, 0.03, 0.002]))


def test_without_a_compass_the_yaw_is_zero_as_on_the_topic():
    reader = PictureReader(heading=False)
    reader.locate = lambda image: dataclasses.replace(PictureReader().locate(image), yaw=math.nan)
    assert Observer(reader).observe(7, panorama((3.0, 4.0, 1.0))).pose.tolist() == [3.0, 4.0, 0.0]


def test_an_estimate_that_is_not_finite_says_that_nothing_is_known():
    reader = PictureReader()
    reader.locate = lambda image: dataclasses.replace(
        PictureReader().locate(image), position=np.array([math.nan, 1.0])
    )
    seen = Observer(reader).observe(7, panorama())
    assert 'no finite estimate' in seen.problem
    assert np.array_equal(seen.pose, np.zeros(3))
    assert np.array_equal(seen.covariance, unusable_covariance())


def test_another_size_is_refused_with_the_remedy():
    for look in (
        lambda image: Observer(PictureReader()).observe(7, image),
        lambda image: Observer(PictureReader()).observe_all(np.array([7]), image[None]),
    ):
        with pytest.raises(ModelError, match=r'100x20.*64x16.*omnicam_node'):
            look(np.zeros((20, 100, 3), np.uint8))


def mixed_run(count=3 * BATCH + 5):
    """A run with all kinds of bad pictures, also across the borders of batches."""
    pictures = [panorama((0.1 * k, 2.0, 0.02 * k), seed=k) for k in range(count)]
    pictures[3] = np.zeros_like(pictures[3])
    pictures[BATCH - 3 : BATCH + 6] = [pictures[5]] * 9
    pictures[30] = panorama((1.0, 2.0, 3.0), seed=30, novelty=9.0)
    pictures[31] = np.full_like(pictures[3], 90)
    stamps = np.arange(1, count + 1, dtype=np.int64) * 10**8
    still = Odometry(stamps, np.zeros((count, 3)), np.zeros((count, 2)), np.zeros((count, 2)))
    return Run('mixed', PanoramaArray(stamps, np.array(pictures)), still)


def test_in_batches_and_one_by_one_images_are_judged_alike():
    run = mixed_run()
    batched = list(Observer(PictureReader()).observe_run(run))
    single = Observer(PictureReader())
    assert len(batched) == len(run.panoramas)
    for stamp_ns, image, seen in zip(
        run.panoramas.stamps_ns.tolist(), run.panoramas.images, batched, strict=True
    ):
        alone = single.observe(stamp_ns, image)
        assert (alone.stamp_ns, alone.problem) == (seen.stamp_ns, seen.problem)
        assert np.array_equal(alone.pose, seen.pose)
        assert np.array_equal(alone.covariance, seen.covariance)
    found = [seen.problem for seen in batched if seen.problem]
    assert len(found) == 1 + 3 + 5 + 1 + 1
    kinds = ('dark', 'covered', 'repeats the one', 'frozen', 'unlike')
    assert {next(kind for kind in kinds if kind in text) for text in found} == set(kinds)


@pytest.mark.parametrize('image', [
    None, 'image', b'bytes', [[1, 2, 3]], np.zeros((4, 8)), np.zeros((4, 8, 4), np.uint8),
    np.zeros((4, 8, 3), np.float32), np.zeros((4, 8, 3), np.uint16), np.array([None]),
])  # fmt: skip
def test_what_is_no_panorama_is_one_error(image):
    localizer = Localizer(PictureReader())
    with pytest.raises(ModelError, match=r'a panorama is \(H, W, 3\) uint8, not '):
        localizer.add_panorama(1, image)


def test_events_come_by_stamp_and_odometry_before_the_picture_of_the_same_stamp():
    odometry, pictures = np.array([5, 10, 20]), np.array([1, 10, 15, 30])
    assert list(merge_by_stamp(odometry, pictures)) == [
        (1, IMAGE, 0), (5, ODOMETRY, 0), (10, ODOMETRY, 1), (10, IMAGE, 1),
        (15, IMAGE, 2), (20, ODOMETRY, 2), (30, IMAGE, 3),
    ]  # fmt: skip
    assert [event[1] for event in merge_by_stamp(odometry, pictures[:0])] == [ODOMETRY] * 3


def test_a_view_without_a_finite_estimate_is_no_error():
    """Two estimates that are certain beyond all numbers have no mean."""
    match = Match(np.zeros(3), np.zeros((3, 3)), 0.9, 0.0, NEARBY, 0.0, 0.0)
    view = View(np.zeros(2), np.ones(2), 0.0, np.zeros((3, 3)), match, MatchNoise(), np.zeros(2))
    assert math.isnan(view.distance)
    estimate = view.estimate()
    assert np.isnan(estimate.position).all() and np.isnan(estimate.covariance).all()


def test_the_scale_of_the_map_is_uncertain_by_a_hundredth_about_its_center():
    center, place = np.array([1.0, 2.0]), np.array([11.0, 2.0])
    own = np.diag([0.01, 0.01, 0.001])
    match = Match(np.append(place, 0.0), own, 0.9, 0.0, NEARBY, 0.0, 0.0)
    noise = MatchNoise()
    at_border = View(np.zeros(2), place, 0.0, own, match, noise, center).estimate()
    at_center = View(np.zeros(2), place, 0.0, own, match, noise, place).estimate()
    more = at_border.covariance - at_center.covariance
    assert np.allclose(more, np.diag([0.1**2, 0.0, 0.0]))


def test_beyond_the_keyframes_both_estimates_are_wrong_together_and_light_is_no_distance():
    noise = MatchNoise(away_m=0.8)
    nearby = Nearby(np.zeros(2), 0.0, 1.0, 1e-4 * np.eye(2), 0.05, 0.7)
    own = np.diag([0.1**2, 0.1**2, 0.01])
    match = Match(np.zeros(3), own, 0.7, 0.0, nearby, 0.0, noise.beyond(nearby))
    view = View(np.zeros(2), np.zeros(2), 0.0, own, match, noise, np.zeros(2))
    assert noise.beyond(replace(nearby, aside=0.2)) == 0.0
    expected = (0.8 * np.log(2.0)) ** 2
    more = (
        view.estimate().covariance
        - replace(view, match=replace(match, beyond=0.0)).estimate().covariance
    )
    assert np.diag(more)[:2] == pytest.approx(expected)
    assert view.in_light(1.0).match.beyond == 0.0
    assert 0 < view.in_light(0.5).match.beyond < view.match.beyond


class InOtherLight(PictureReader):
    """Keyframes alone know the place; all images are unlike by their light."""

    def views(self, images):
        nearby = Nearby(np.zeros(2), 0.0, 0.6, 1e-4 * np.eye(2), 0.05, 0.0)
        noise = MatchNoise(floor_m=0.02, slope_m=0.4)
        own = np.diag([noise.variance(0.6) + 1e-4] * 2 + [0.01])
        match = Match(np.zeros(3), own, 0.7, 0.0, nearby, noise.by_place(0.6), 0.0)
        unknown = np.diag([1e4, 1e4, 3.0])
        return [View(np.zeros(2), np.zeros(2), 0.0, unknown, match, noise, np.zeros(2))] * len(
            images
        )


def test_what_is_unlike_by_light_is_no_uncertain_place_after_some_images():
    observer = Observer(InOtherLight())
    seen = [observer.observe(k, panorama(seed=k)) for k in range(1, 200)]
    std = np.array([np.sqrt(one.covariance[0, 0]) for one in seen])
    assert std[0] == pytest.approx(np.hypot(0.24, 0.0224), rel=0.02)
    assert np.all(np.diff(std) < 1e-6) and 0.02 < std[-1] < 0.3 * std[0]
    assert 0.4 < observer.other_light < 0.6


def test_slow_features_are_no_surer_where_the_place_makes_an_image_unlike():
    """Beside the trained area both extrapolate; in another light, where keyframes are near, not."""
    noise = MatchNoise(floor_m=0.02, slope_m=1.4)
    nearby = Nearby(np.zeros(2), 0.0, 0.6, 1e-4 * np.eye(2), 0.05, 0.0)
    own = np.diag([noise.variance(noise.by_place(0.6))] * 2 + [0.01])
    match = Match(np.zeros(3), own, 0.75, 0.0, nearby, noise.by_place(0.6), 0.0)
    sure, beside = np.diag([0.1**2, 0.1**2, 0.01]), np.array([0.3, 0.0])
    view = View(np.zeros(2), beside, 0.0, sure, match, noise, np.zeros(2))
    outside, in_light = view.estimate(), view.in_light(0.58).estimate()
    by_place_m = 1.4 * noise.by_place(0.6)
    assert np.sqrt(outside.covariance[0, 0]) == pytest.approx(0.45 * by_place_m, rel=0.1)
    assert np.sqrt(in_light.covariance[0, 0]) < 0.1
    assert np.hypot(*outside.position) < 0.9 * np.hypot(*beside)


class Contradicted(PictureReader):
    """Slow features are sure of a place 0.4 m from that of keyframes, which are as sure of it."""

    def __init__(self, score: float) -> None:
        super().__init__()
        self.score = score

    def views(self, images):
        own = np.diag([0.1**2, 0.1**2, 0.01])
        match = Match(np.zeros(3), own, self.score, 0.0, NEARBY, 0.0, 0.0)
        apart = np.array([0.4, 0.0])
        view = View(np.zeros(2), apart, 0.0, own, match, MatchNoise(), np.zeros(2))
        return [view] * len(images)


@pytest.mark.parametrize('known', [True, False])
def test_slow_features_that_contradict_known_places_for_long_do_not_count(known):
    observer = Observer(Contradicted(0.7 if known else 0.3))
    seen = [observer.observe(k, panorama(seed=k)).estimate.position[0] for k in range(1, 50)]
    assert seen[0] == pytest.approx(0.2 if known else 0.4, abs=0.02)
    assert seen[-1] == (0.0 if known else 0.4)


def test_another_model_may_know_the_light():
    observer = Observer(InOtherLight())
    for k in range(1, 100):
        observer.observe(k, panorama(seed=k))
    assert observer.other_light > 0.3
    observer.use(PictureReader())
    assert observer.other_light == 0.0
