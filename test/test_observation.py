# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which images are used, and what the filter gets of those that are not."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from picture_readers import PictureReader, panorama

from sfa_localization.camera.watch import ImageWatch
from sfa_localization.data.errors import ModelError
from sfa_localization.data.events import IMAGE, ODOMETRY, merge_by_stamp
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.data.run import BATCH, Odometry, PanoramaArray, Run
from sfa_localization.features.observation import (
    Match,
    MatchNoise,
    Observation,
    combine,
    distance,
)
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.localizer import Localizer, Observer, unusable_covariance
from sfa_localization.place_model import PlaceModel


def test_a_repeated_picture_is_a_frozen_camera_until_it_changes():
    watch = ImageWatch()
    found = [watch.judge(panorama(seed=seed)) for seed in (1, 1, 1, 1, 1, 1, 2, 2, 1)]
    assert ['repeats' in text for text in found] == [False] + [True] * 5 + [False, True, False]
    assert ['frozen' in text for text in found] == [False] * 4 + [True] * 2 + [False] * 3


def test_a_believed_picture_gives_the_models_pose_and_covariance():
    seen = Observer(PictureReader()).observe(7, panorama((3.0, 40.0, 1.0)))
    assert seen.stamp_ns == 7 and seen.problem == ''
    assert seen.pose == pytest.approx([3.0, 40.0, 1.0], abs=1e-4)
    assert np.array_equal(seen.covariance, np.diag([0.02, 0.03, 0.002]))
    seen = Observer(PictureReader(heading=False)).observe(7, panorama((3.0, 4.0, 1.0)))
    assert seen.pose.tolist() == [3.0, 4.0, 0.0] and math.isnan(seen.yaw), 'as on the topic'


def test_an_estimate_that_is_not_finite_says_that_nothing_is_known_and_the_filter_leaves_it_out():
    reader = PictureReader()
    reader.locate = lambda image: replace(PictureReader().locate(image), pose=np.full(3, np.nan))
    seen = Observer(reader).observe(7, panorama())
    assert 'no finite estimate' in seen.problem
    assert np.array_equal(seen.pose, np.zeros(3))
    assert np.array_equal(seen.covariance, unusable_covariance())
    update = PoseFilter().add_measurement(10**9, seen.pose, seen.covariance)
    assert not update.accepted and update.reason == 'covariance means that nothing is known'


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


def test_what_is_no_panorama_or_has_another_size_is_one_error():
    localizer = Localizer(PictureReader())
    for image in (
        None, 'image', b'bytes', [[1, 2, 3]], np.zeros((4, 8)), np.zeros((4, 8, 4), np.uint8),
        np.zeros((4, 8, 3), np.float32), np.zeros((4, 8, 3), np.uint16), np.array([None]),
    ):  # fmt: skip
        with pytest.raises(ModelError, match=r'a panorama is \(H, W, 3\) uint8, not '):
            localizer.add_panorama(1, image)
    other = np.zeros((20, 100, 3), np.uint8)
    for look in (localizer.observer.observe, localizer.observer.observe_all):
        stamp, images = (np.array([7]), other[None]) if 'all' in look.__name__ else (7, other)
        with pytest.raises(ModelError, match=r'100x20.*64x16.*omnicam_node'):
            look(stamp, images)


def test_events_come_by_stamp_and_odometry_before_the_picture_of_the_same_stamp():
    odometry, pictures = np.array([5, 10, 20]), np.array([1, 10, 15, 30])
    assert list(merge_by_stamp(odometry, pictures)) == [
        (1, IMAGE, 0), (5, ODOMETRY, 0), (10, ODOMETRY, 1), (10, IMAGE, 1),
        (15, IMAGE, 2), (20, ODOMETRY, 2), (30, IMAGE, 3),
    ]  # fmt: skip
    assert [event[1] for event in merge_by_stamp(odometry, pictures[:0])] == [ODOMETRY] * 3


def slow_at(x: float, std_m: float, yaw: float = 0.0) -> Observation:
    """Slow features put an image on the x axis."""
    return Observation(np.array([x, 0.0, yaw]), np.diag([std_m, std_m, 0.1]) ** 2, np.zeros(2))


def match_at(std_m: float, **more) -> Match:
    """Keyframes put it at the origin, by what is left of the image."""
    return Match(**{**MATCHED, 'noise': std_m**2 * np.eye(2), **more})


MATCHED = {
    'pose': np.zeros(3), 'unlike': 0.0, 'variation': 0.05, 'aside': 0.0,
    'score': 0.9, 'known': True,
}  # fmt: skip
EXACT = MatchNoise(floor_m=1e-6, yaw_std=0.1)


def test_two_that_agree_are_weighted_by_their_information_and_keyframes_know_the_yaw():
    pose, covariance = combine(slow_at(0.2, 0.1, yaw=0.1), match_at(0.2), EXACT)
    assert pose == pytest.approx([0.16, 0.0, 0.0], abs=1e-6)
    assert np.diag(covariance) == pytest.approx([0.2**2 * 0.1**2 / 0.05] * 2 + [0.01], rel=1e-3)


def test_the_farther_apart_the_less_sure_and_where_they_contradict_keyframes_count():
    near, far = (combine(slow_at(x, 0.1), match_at(0.1), EXACT)[1][0, 0] for x in (0.0, 0.4))
    assert far == pytest.approx(near * 0.4**2 / 0.02 / 2, rel=1e-3)
    for x, doubt in (0.6, 1.0), (0.1, 1.1), (math.nan, 1.0):
        pose, covariance = combine(slow_at(x, 0.1), match_at(0.1), EXACT, doubt=doubt)
        assert np.array_equal(pose, np.zeros(3))
        assert np.array_equal(covariance, EXACT.covariance(match_at(0.1)))


def test_an_unknown_place_is_left_to_slow_features():
    slow = slow_at(3.0, 0.1)
    pose, covariance = combine(slow, match_at(0.1, known=False), EXACT, doubt=4.0)
    assert np.array_equal(pose, slow.pose) and covariance == pytest.approx(4.0 * slow.covariance)
    assert math.isnan(distance(slow, match_at(0.1, known=False), EXACT, 0.0)[0])


def test_slow_features_are_no_surer_where_the_place_makes_an_image_unlike():
    """Beside the trained area both extrapolate; in another light, where keyframes are near, not."""
    noise, match = MatchNoise(floor_m=0.02, slope_m=1.4), match_at(0.0, unlike=0.6, score=0.75)
    slow = slow_at(0.3, 0.1)
    outside, in_light = combine(slow, match, noise), combine(slow, match, noise, 0.58)
    by_place_m = 1.4 * noise.by_place(match)
    assert np.sqrt(outside[1][0, 0]) == pytest.approx(0.45 * by_place_m, rel=0.1)
    assert np.sqrt(in_light[1][0, 0]) < 0.1
    assert outside[0][0] < 0.9 * 0.3


class Matched(PictureReader):
    """A model whose slow features and keyframes are given."""

    def __init__(self, slow: Observation, match: Match, noise: MatchNoise, center=(0.0, 0.0)):
        super().__init__()
        self.slow, self.found, self.quality = slow, match, {}
        self.rig = Rig(wheel_scale=Quantity(1.0, 0.01))
        self.keyframes = SimpleNamespace(noise=noise, poses=np.array([[*center, 0.0]]))

    def match(self, view, pattern=None):
        return self.found

    def slow_pose(self, view, match):
        return self.slow

    combined = PlaceModel.combined

    def told(self, light: float = 0.0) -> np.ndarray:
        return self.combined(self.slow, self.found, light).covariance


def test_the_scale_of_the_map_is_uncertain_by_a_hundredth_about_its_center():
    slow, match = slow_at(0.0, 0.1), match_at(0.1)
    more = Matched(slow, match, EXACT, (10.0, 0.0)).told() - Matched(slow, match, EXACT).told()
    assert np.allclose(more, np.diag([0.1**2, 0.0, 0.0]))


def test_beyond_the_keyframes_both_estimates_are_wrong_together_and_light_is_no_distance():
    noise, slow = MatchNoise(away_m=0.8), slow_at(0.0, 0.1)
    among, border = (match_at(0.1, unlike=1.0, score=0.7, aside=aside) for aside in (0.2, 0.7))
    more = Matched(slow, border, noise).told() - Matched(slow, among, noise).told()
    assert np.diag(more)[:2] == pytest.approx((0.8 * np.log(2.0)) ** 2)
    assert noise.beyond(among) == noise.beyond(border, 1.0) == 0.0
    assert 0 < noise.beyond(border, 0.5) < noise.beyond(border)


def in_other_light() -> Matched:
    """Keyframes alone know the place; all images are unlike by their light."""
    noise, match = MatchNoise(floor_m=0.02, slope_m=0.4), match_at(0.01, unlike=0.6, score=0.7)
    return Matched(slow_at(0.0, 100.0), match, noise)


def test_what_is_unlike_by_light_is_no_uncertain_place_after_some_images():
    observer = Observer(in_other_light())
    seen = [observer.observe(k, panorama(seed=k)) for k in range(1, 200)]
    std = np.array([np.sqrt(one.covariance[0, 0]) for one in seen])
    assert std[0] == pytest.approx(np.hypot(0.24, 0.0224), rel=0.02)
    assert np.all(np.diff(std) < 1e-6) and 0.02 < std[-1] < 0.3 * std[0]
    assert 0.4 < observer.other_light < 0.6
    observer.use(PictureReader())
    assert observer.other_light == 0.0, 'another model may know the light'


@pytest.mark.parametrize('known', [True, False])
def test_slow_features_that_contradict_known_places_for_long_do_not_count(known):
    """Both are as sure of places 0.4 m apart."""
    match = match_at(0.1, score=0.7 if known else 0.3, known=known)
    observer = Observer(Matched(slow_at(0.4, 0.1), match, EXACT))
    seen = [observer.observe(k, panorama(seed=k)).position[0] for k in range(1, 50)]
    assert seen[0] == pytest.approx(0.2 if known else 0.4, abs=0.02)
    assert seen[-1] == (0.0 if known else 0.4)


@pytest.mark.parametrize(('own_m', 'its_m', 'shown'), [(0.1, 0.6, 0.0), (0.6, 0.1, 36 / 37)])
def test_slow_features_are_not_blamed_for_errors_of_uncertain_keyframes(own_m, its_m, shown):
    """Beside all keyframes these err by more than slow features, as they say."""
    model = Matched(slow_at(0.0, 0.1), match_at(0.1), EXACT)
    observer = Observer(model)
    for k in range(1, 50):
        if k == 30:
            model.slow, model.found = slow_at(1.0, its_m), match_at(own_m)
        seen = observer.observe(k, panorama(seed=k))
    assert seen.position[0] == pytest.approx(shown, abs=1e-3)
