# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Learning on the job: what a later drive adds to a model, and what stays as it was."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cylinder_worlds import Spheres, place, recipe, run_in, wander
from numpy.testing import assert_allclose, assert_array_equal

from sfa_localization import updating
from sfa_localization.camera.leveling import tilted
from sfa_localization.camera.settings import WatchConfig
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import align, wrap_angle
from sfa_localization.data.run import Odometry
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.update import write_update_report
from sfa_localization.updating import Additions, extended, new_views, usual_explained


def repainted(share):
    """The trained world with so much of other colors."""
    world = Spheres.about(1)
    other = np.random.default_rng(7).uniform(-90, 90, world.colors.shape)
    return replace(world, colors=(1 - share) * world.colors + share * other)


@cache
def drive(share=0.5, seed=5, count=240):
    """A drive in the trained place in another season, with truth for odometry."""
    return run_in(repainted(share), wander(count, seed, hz=4.0), recipe().panorama, 'later')


@cache
def updated():
    """The model of the place, and with what `drive()` adds."""
    model = place().model
    new = new_views(model, drive())
    return model, new, extended(model, new, 'later')


@cache
def map_of_truth():
    """The transform that lays the true poses of the training on the map."""
    model = place().model
    run = run_in(Spheres.about(1), wander(400, 2, hz=4.0), recipe().panorama)
    places = [e.position for e in model.locate_all(run.panoramas.read(0, 400))]
    return align(run.odometry.poses[:, :2], np.array(places))


def some_images(run):
    return run.panoramas.read(0, len(run.panoramas))[::3]


def errors(model, run):
    """Distances (N,) m of single images' positions from the truth."""
    places = [e.position for e in model.locate_all(some_images(run))]
    truth = map_of_truth().apply(run.odometry.poses[::3, :2])
    return np.hypot(*(np.array(places) - truth).T)


def test_what_a_changed_place_adds_lies_where_it_was_seen():
    _, new, _ = updated()
    assert 20 < len(new) <= updating.MOST_OF_DRIVE
    textures = textures_of(drive()).astype(float)  # of which some were leveled
    likest = [np.square(textures - added).sum((1, 2)).argmin() for added in new.textures]
    at, truth = drive().odometry.poses[likest], map_of_truth()
    distances = np.hypot(*(new.poses[:, :2] - truth.apply(at[:, :2])).T)
    assert np.percentile(distances, 95) < 2 * updating.CERTAIN_M
    assert np.abs(wrap_angle(new.poses[:, 2] - at[:, 2] - truth.yaw_rad)).max() < 0.1


def test_the_page_of_an_update_shows_what_each_drive_added(tmp_path):
    _, new, later = updated()
    again = extended(later, Additions(new.textures[:5], new.poses[:5]), 'a <later> $one')
    keyframes = updating.Updated(again, ()).keyframes
    write_update_report(tmp_path, 'model.npz', 'added as keyframes', keyframes)
    text = (tmp_path / 'index.html').read_text()
    first = int(again.keyframes.first.sum())
    for line in (f'training: {first}', f'later: {len(new)}', 'a &lt;later&gt; $one: 5'):
        assert f'<li>{line} keyframes</li>' in text
    assert 'added as keyframes' in text and text.count('<img ') == 1
    assert_allclose(keyframes[2][1], new.poses[:5])


def textures_of(run):
    images = run.panoramas.read(0, len(run.panoramas))
    return updating.quantized(np.stack([updating.texture(image) for image in images]))


def test_added_keyframes_are_level():
    """Of a drive over uneven ground they are nearer to the images of level ground."""
    level, sphere = drive(), recipe().panorama.sphere
    tilts = np.radians(4.0) * np.random.default_rng(0).normal(size=(len(level.panoramas), 2))
    images = zip(level.panoramas.images, tilts, strict=True)
    seen = np.stack([tilted(image, tilt, sphere) for image, tilt in images])
    run = replace(level, panoramas=replace(level.panoramas, images=seen))
    new = new_views(place().model, run)
    flat, steep, added = (t.astype(float).reshape(len(t), -1) for t in (
        textures_of(level), textures_of(run), new.textures))  # fmt: skip
    like = [np.corrcoef(added, kind)[: len(new), len(new) :].max(1) for kind in (flat, steep)]
    assert len(new) > 20 and like[0].mean() > like[1].mean()


def test_an_updated_model_still_knows_the_place_when_the_season_goes_on():
    """And the old season no worse."""

    def usable(model, run):
        explained = [e.explained for e in model.locate_all(some_images(run))]
        return np.mean(np.array(explained) >= WatchConfig().least_explained)

    model, _, newer = updated()
    further, before = drive(share=0.7, seed=8), drive(share=0.0, seed=8)
    assert usable(model, further) < 0.5 < 0.9 < usable(newer, further)
    assert errors(newer, further).mean() < errors(model, further).mean()
    assert errors(newer, before).mean() < 1.05 * errors(model, before).mean()


def test_network_maps_and_first_keyframes_stay_also_in_its_file(tmp_path):
    model, new, newer = updated()
    assert newer.network is model.network and newer.metric is model.metric
    assert newer.turned is model.turned and newer.keyframes.errors == model.keyframes.errors
    first = len(model.keyframes.poses)
    assert_array_equal(newer.keyframes.values[:first], model.keyframes.values)
    assert_array_equal(newer.keyframes.poses[first:], new.poses)
    assert newer.keyframes.first.sum() == first and 'updates' not in model.quality
    newer.save(tmp_path / 'model.npz')
    read = PlaceModel.load(tmp_path / 'model.npz')
    assert_array_equal(read.keyframes.lights, newer.keyframes.lights)
    assert read.keyframes.trained == newer.keyframes.trained == 1
    assert read.quality['updates'] == [{'bag': 'later', 'images': len(new)}]
    assert usual_explained(read) == pytest.approx(usual_explained(model))
    image = drive().panoramas.read(30, 31)[0]
    assert_allclose(read.locate(image).position, newer.locate(image).position)


def test_familiar_images_are_not_new():
    """The same drive a second time."""
    _, new, newer = updated()
    assert len(new_views(newer, drive())) < 0.5 * len(new)


def test_a_place_that_was_never_trained_is_refused_with_the_remedy():
    foreign = run_in(Spheres.about(99), wander(120, 5, hz=4.0), recipe().panorama, 'elsewhere')
    with pytest.raises(DataError, match=r'elsewhere: .* never LOCALISED .* train anew'):
        new_views(place().model, foreign)


def test_images_stamped_late_are_placed_where_they_were_taken():
    """The driver stamps images 0.2 s late: the same keyframes, not 0.16 m farther along."""
    run = replace(drive(count=200), odometry=finer(drive(count=200).odometry))
    stamps_ns = run.panoramas.stamps_ns + 200_000_000
    late = replace(run, panoramas=replace(run.panoramas, stamps_ns=stamps_ns))
    additions = [new_views(place().model, r) for r in (run, late)]
    right, placed = (dict(zip(map(bytes, n.textures), n.poses, strict=True)) for n in additions)
    both = right.keys() & placed.keys()
    assert len(both) > 20
    assert np.mean([np.hypot(*(right[key] - placed[key])[:2]) for key in both]) < 0.06


def finer(odometry, times=10):
    """Odometry (N,) with so many messages for each, of the same motion."""
    stamps = np.linspace(
        odometry.stamps_ns[0], odometry.stamps_ns[-1], times * (len(odometry.stamps_ns) - 1) + 1
    ).astype(np.int64)
    held = np.minimum(-(-np.arange(len(stamps)) // times), len(odometry.twists) - 1)
    twists, variances = odometry.twists[held], odometry.variances[held]
    return Odometry(stamps, odometry.trajectory.at(stamps), twists, variances)


def test_added_keyframes_are_bounded_and_the_old_near_ones_give_way():
    def added(model, count, x_m):
        """With so many more keyframes in a row that begins at x."""
        poses = np.column_stack([x_m + 0.01 * np.arange(count), np.zeros((count, 2))])
        texture = np.fft.irfft(model.keyframes.spectrum(0)[None], model.keyframes.columns)
        textures = np.repeat(updating.quantized(texture), count, 0)
        return extended(model, Additions(textures, poses), 'later')

    model = place().model
    first = len(model.keyframes.poses)
    full = added(added(model, 500, 100.0), 500, 200.0)
    assert len(full.keyframes.poses) == first + updating.MOST_ADDED
    newer = added(full, 100, 101.0)
    x = newer.keyframes.poses[first:, 0]
    assert_array_equal(newer.keyframes.poses[:first], model.keyframes.poses[:first])
    assert len(x) == updating.MOST_ADDED
    assert np.count_nonzero(x >= 200.0) == 500, 'the newer half stays'
    assert np.count_nonzero(x < 101.0) == 100, 'of the oldest 200 those far from new ones stay'
    assert [update['images'] for update in newer.quality['updates']] == [500, 500, 100]
