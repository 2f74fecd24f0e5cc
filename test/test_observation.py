# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which images are used, and what the filter gets of those that are not."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from picture_readers import PictureReader, fit_at, panorama

from sfa_localization.data.errors import ModelError
from sfa_localization.data.events import IMAGE, ODOMETRY, merge_by_stamp
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.data.run import BATCH, Odometry, PanoramaArray, Run
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.keyframes.errors import ErrorModel
from sfa_localization.keyframes.light import Conditions
from sfa_localization.keyframes.location import located
from sfa_localization.localizer import Localizer
from sfa_localization.observer import Observer, unusable_covariance
from sfa_localization.place_model import PlaceModel


def test_a_believed_picture_gives_the_models_pose_and_covariance():
    seen = Observer(PictureReader()).observe(7, panorama((3.0, 40.0, 1.0)))
    assert seen.stamp_ns == 7 and seen.problem == ''
    assert seen.pose == pytest.approx([3.0, 40.0, 1.0], abs=1e-4)
    assert np.array_equal(seen.covariance, np.diag([0.02, 0.03, 0.002]))
    seen = Observer(PictureReader(heading=False)).observe(7, panorama((3.0, 4.0, 1.0)))
    assert seen.pose.tolist() == [3.0, 4.0, 0.0] and math.isnan(seen.yaw), 'as on the topic'


def test_an_estimate_that_is_not_finite_is_left_out_by_the_filter():
    reader = PictureReader()
    reader.locate = lambda image: replace(PictureReader().locate(image), pose=np.full(3, np.nan))
    seen = Observer(reader).observe(7, panorama())
    assert 'no finite estimate' in seen.problem
    assert np.array_equal(seen.covariance, unusable_covariance())
    update = PoseFilter().add_measurement(10**9, seen.pose, seen.covariance)
    assert not update.accepted and update.reason == 'covariance means that nothing is known'


def mixed_run(count=3 * BATCH + 5):
    """A run with all kinds of bad pictures, also across the borders of batches."""
    pictures = [panorama((0.1 * k, 2.0, 0.02 * k), seed=k) for k in range(count)]
    pictures[3] = np.zeros_like(pictures[3])
    pictures[BATCH - 3 : BATCH + 6] = [pictures[5]] * 9
    pictures[30] = panorama((1.0, 2.0, 3.0), seed=30, explained=0.05)
    pictures[31] = np.full_like(pictures[3], 90)
    stamps = np.arange(1, count + 1, dtype=np.int64) * 10**8
    still = Odometry(stamps, np.zeros((count, 3)), np.zeros((count, 2)), np.zeros((count, 2)))
    return Run('mixed', PanoramaArray(stamps, np.array(pictures)), still)


def test_images_are_judged_alike_in_batches_and_singly():
    run = mixed_run()
    batched = list(Observer(PictureReader()).observe_run(run))
    single = Observer(PictureReader())
    assert len(batched) == len(run.panoramas)
    for stamp_ns, image, seen in zip(
        run.panoramas.stamps_ns.tolist(), run.panoramas.images, batched, strict=True
    ):
        alone = single.observe(stamp_ns, image)
        assert (alone.stamp_ns, alone.problem) == (seen.stamp_ns, seen.problem)
        assert np.array_equal(alone.covariance, seen.covariance)
    problems = [seen.problem for seen in batched if seen.problem]
    assert len(problems) == 1 + 3 + 5 + 1 + 1
    kinds = ('dark', 'covered', 'repeats the one', 'frozen', 'unlike')
    assert {next(kind for kind in kinds if kind in text) for text in problems} == set(kinds)


def test_other_objects_and_sizes_are_the_same_error():
    localizer, image = Localizer(PictureReader()), np.zeros((20, 100, 3), np.uint8)
    for other in (None, [[1, 2, 3]], image[0], image[..., :2], image.astype(float), [None]):
        with pytest.raises(ModelError, match=r'a panorama is \(H, W, 3\) uint8, not '):
            localizer.add_panorama(1, other)
    for look, *seen in (
        (localizer.observer.observe, 7, image),
        (localizer.observer.observe_all, np.array([7]), image[None]),
    ):
        with pytest.raises(ModelError, match=r'100x20.*64x16.*omnicam_node'):
            look(*seen)


def test_events_come_by_stamp_and_odometry_before_the_picture_of_the_same_stamp():
    odometry, pictures = np.array([5, 10, 20]), np.array([1, 10, 15, 30])
    assert list(merge_by_stamp(odometry, pictures)) == [
        (1, IMAGE, 0), (5, ODOMETRY, 0), (10, ODOMETRY, 1), (10, IMAGE, 1),
        (15, IMAGE, 2), (20, ODOMETRY, 2), (30, IMAGE, 3),
    ]  # fmt: skip


# Many images, one after the other; test_location.py has the single ones.

EXACT = ErrorModel(floor_m=0.0, residual=1.0, outward_m=0.0, slow=1.0, slow_m=0.0, yaw_std=0.1)
"""Both err by what they claim."""


class Matched(PictureReader):
    """A model whose keyframes put images at the origin, and whose slow features at x (m)."""

    def __init__(self, x=3.0, unlike=0.25, errors=EXACT, center=(0.0, 0.0)):
        super().__init__()
        self.x, self.unlike = x, unlike
        self.rig = Rig(wheel_scale=Quantity(1.0, 0.01))
        self.keyframes = SimpleNamespace(errors=errors, poses=np.array([[*center, 0.0]]))

    def views(self, images):
        view = SimpleNamespace(slow_features=np.zeros(2), drowned=np.zeros(1, bool))
        return [view] * len(images)

    def located(self, view, conditions):
        fit = fit_at([0.0, 0.0], 1 / (1 + self.unlike), variance=0.1**2, outward=0.2)
        slow = np.array([[self.x, 0.0]]), np.array([0.1**2])
        return located([fit], slow, conditions.scales, self.keyframes.errors, np.zeros(2))

    observed = PlaceModel.observed


def test_the_errors_of_the_map_and_of_its_scale_about_its_center_are_in_the_covariance():
    others = {'center': (10.0, 0.0)}, {'errors': replace(EXACT, map_m=0.2, turn_std=0.03)}
    plain, aside, wrong = (
        Observer(Matched(0.0, **more)).observe(1, panorama()).covariance for more in ({}, *others)
    )
    assert np.allclose(aside - plain, np.diag([0.1**2, 0.0, 0.0]))
    assert np.allclose(wrong - plain, np.diag([0.2, 0.2, 0.03]) ** 2)


@pytest.mark.parametrize('kind', ['unlike', 'dark', 'repeats', 'used'])
def test_only_images_that_are_used_teach_how_wrong_slow_features_are(kind):
    """What is nowhere seems to be anywhere, and slow features as wrong."""
    model, picture = Matched(unlike=9.0 if kind == 'unlike' else 0.25), panorama()
    observer = Observer(model)
    if kind == 'repeats':
        observer.watch.judge(picture)
    for k in range(1, 30):
        image = {'dark': 0 * picture, 'repeats': picture}.get(kind, panorama(seed=k))
        assert (observer.observe(k, image).problem == '') == (kind == 'used')
    if kind == 'used':
        assert 10 < observer.slow_error_factor < 50
        observer.use(model)
    assert observer.slow_error_factor == Conditions().slow_error_factor
