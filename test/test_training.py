# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Training from bags: what it leaves behind, how it goes on, and what it refuses."""

import logging
import os
import warnings
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from cylinder_worlds import (
    PICTURES,
    PLACE_ARCHITECTURE,
    SMALL_ARCHITECTURE,
    SMALL_RECIPE,
    Spheres,
    recipe,
    run_in,
    write_bag,
)

from sfa_localization import training
from sfa_localization.data.errors import DataError, LocalizationError, ModelError
from sfa_localization.data.run import Count, Odometry, PanoramaArray, Run, integrate
from sfa_localization.mapping import learning
from sfa_localization.mapping.drive_check import ROUTE
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.summary import summary
from sfa_localization.sfa import checkpoint as checkpoints
from sfa_localization.sfa.network_training import ImageSequence, train_network
from sfa_localization.training import learn_place, train


class Cut(Exception):
    """As a kill would, it passes through everything."""


def cut_off(bag: Path, output: Path, stages: int, error: BaseException) -> None:
    """Train until `stages` stages are finished, and be cut off there."""
    write, done = checkpoints.Checkpoint.write, []

    def write_then_fail(self, partial):
        write(self, partial)
        done.append(partial)
        if len(done) == stages:
            raise error

    replaced = mock.patch.object(checkpoints.Checkpoint, 'write', write_then_fail)
    with replaced, pytest.raises(type(error)):
        train([bag], output, SMALL_RECIPE)


def test_a_training_leaves_the_model_and_says_what_error_to_expect(trained):
    """And where it is worst; what is reported is of the map that the model holds."""
    model, result = PlaceModel.load(trained.model), trained.result
    quality, told = model.quality, summary(result)
    assert os.listdir(trained.model.parent) == ['model.npz']
    assert quality['pictures'] == PICTURES and quality['certified'] and quality['turned']
    worst = quality['worst']
    assert 0.0 < quality['expected_error_m'] < worst['expected_error_m']
    assert f'position: expect {quality["expected_error_m"]:.2f} m mean error of one image' in told
    assert f'worst near x {worst["x_m"]:.1f} m, y {worst["y_m"]:.1f} m' in told
    assert f'expect {quality["expected_yaw_error_deg"]:.1f} degrees' in told
    assert '4 slow features, then turned maps, directions' in told
    places = result.metric.poses[:, :2]
    assert np.hypot(*(places - [worst['x_m'], worst['y_m']]).T).min() < 1.0
    assert result.metric.map is result.model.metric


def test_without_turned_maps_it_learns_without(trained, tmp_path, monkeypatch, caplog):
    bottom, _, top = SMALL_ARCHITECTURE.layers
    two = replace(SMALL_ARCHITECTURE, layers=(bottom, replace(top, field=(3, 6))))
    shallow = replace(SMALL_RECIPE, architecture=two)
    for module, name, value, by, said in (
        (learning, 'learn_metric', _fail, SMALL_RECIPE, 'not turned maps: the drive'),
        (training, 'STEPS', training.STEPS, shallow, ''),
    ):
        caplog.clear()
        with monkeypatch.context() as patch:
            patch.setattr(module, name, value)
            learned = train([trained.bag], tmp_path / 'model.npz', by)
        assert said in caplog.text
        assert learned.model.turned is None and 'turned' not in summary(learned)


@pytest.mark.parametrize(('stages', 'error'), [(1, KeyboardInterrupt()), (6, Cut())])
def test_resuming_gives_the_same_bytes(trained, tmp_path, stages, error):
    """As a training that was not interrupted."""
    output = tmp_path / 'model.npz'
    cut_off(trained.bag, output, stages, error)
    assert os.listdir(tmp_path) == ['.model.npz.checkpoint.npz']
    train([trained.bag], output, SMALL_RECIPE, resume=True)
    assert output.read_bytes() == trained.model.read_bytes()
    assert os.listdir(tmp_path) == ['model.npz']


def test_a_damaged_checkpoint_and_that_of_another_training_are_named(trained, tmp_path, caplog):
    """And the training starts anew."""
    output, checkpoint = tmp_path / 'model.npz', tmp_path / '.model.npz.checkpoint.npz'
    cut_off(trained.bag, output, 2, Cut())
    cut = checkpoint.read_bytes()
    changed = replace(SMALL_RECIPE, network=replace(SMALL_RECIPE.network, seed=5))
    other = write_bag(tmp_path / 'other', seed=8)
    for bag, by, data, why in (
        (trained.bag, changed, cut, 'made from other bags or parameters'),
        (other, SMALL_RECIPE, cut, 'made from other bags or parameters'),
        (trained.bag, SMALL_RECIPE, cut[:500], 'damaged'),
    ):
        checkpoint.write_bytes(data)
        caplog.clear()
        train([bag], output, by, resume=True)
        assert why in caplog.text and 'the training starts anew' in caplog.text
    assert output.read_bytes() == trained.model.read_bytes()


@pytest.mark.parametrize('late', [False, True])
def test_after_an_error_no_model_is_left(trained, tmp_path, late, monkeypatch):
    if late:
        monkeypatch.setattr(training, 'learn_map', _fail)
    wrong = replace(SMALL_ARCHITECTURE, size=(12, 36))
    by = SMALL_RECIPE if late else replace(SMALL_RECIPE, architecture=wrong)
    with pytest.raises(LocalizationError):
        train([trained.bag], tmp_path / 'model.npz', by)
    assert not any('cache' in name or name == 'model.npz' for name in os.listdir(tmp_path))


def _fail(*args, **kwargs):
    raise DataError('the drive cannot fix a map')


def test_bags_and_outputs_that_cannot_be_are_refused(trained, tmp_path):
    """Of a copy, what is left out would be known, and the forecast would promise too much."""
    other, bag = write_bag(tmp_path / 'other', size=(12, 96)), trained.bag
    for bags, output, error, why in (
        ([bag, other], 'm.npz', DataError, r'different sizes \(drive: 72x12, other: 96x12\)'),
        ([bag, bag], 'm.npz', DataError, r'the same drive as .*: name each drive once'),
        ([bag], 'other/metadata.yaml/m.npz', ModelError, 'cannot be written'),
    ):
        with pytest.raises(error, match=why):
            train(bags, tmp_path / output, SMALL_RECIPE)
    assert os.listdir(tmp_path) == ['other']


def test_the_mdp_engine_learns_the_same_place(trained, tmp_path):
    pytest.importorskip('future', reason='the extra mdp is not installed')
    config = replace(SMALL_RECIPE, network=replace(SMALL_RECIPE.network, engine='mdp'))
    theirs = train([trained.bag], tmp_path / 'theirs.npz', config)
    for a, b in zip(trained.result.features.T, theirs.features.T, strict=True):
        assert abs(np.corrcoef(a, b)[0, 1]) > 0.999


@pytest.mark.slow
def test_a_straight_route_gives_a_model_and_a_warning(caplog):
    """Of 12 m, with odometry that states no variance."""
    count, speed = 250, 0.12
    stamps = 10**9 + np.arange(count) * round(12e9 / speed / count)
    twists = np.tile([speed, 0.0], (count, 1))
    poses = integrate(stamps, twists, np.array([-6.0, 0.0, 0.0]))
    odometry = Odometry(stamps, poses, twists, np.zeros((count, 2)))
    run = run_in(Spheres.about(1), odometry, recipe().panorama)
    network = train_network(PLACE_ARCHITECTURE, [ImageSequence.of(run)])
    with warnings.catch_warnings(), caplog.at_level(logging.WARNING):
        warnings.simplefilter('error')
        trained = learn_place(network, [run], recipe())
    assert [record.message for record in caplog.records].count(ROUTE) == 1
    assert trained.segments.images.skipped == {}
    aside = np.array([[x, 1.5, 0.0] for x in (-2.0, 0.0, 2.0)])
    on = trained.model.locate_all(run.panoramas.read(90, 160))
    off = trained.model.locate_all(Spheres.about(1).panoramas(aside, recipe().panorama))
    places = np.array([image.position for image in on])
    assert np.hypot(*(places - run.odometry.poses[90:160, :2]).T).mean() < 0.1
    on_route, off_route = ([np.trace(e.covariance[:2, :2]) for e in part] for part in (on, off))
    assert min(off_route) > 10 * max(on_route)
    with pytest.raises(DataError, match='no track crosses another'):
        learn_place(network, [run], recipe(), strict=True)


def test_pauses_and_jumps_of_a_drive_are_breaks_between_its_images():
    seconds, x_m = np.array([0, 1, 2, 9, 10, 11]), np.array([0, 0.1, 0.4, 0.5, 3.0, 3.1])
    stamps, none = (seconds * 1e9).astype(np.int64), np.zeros((6, 2))
    images = PanoramaArray(stamps, np.zeros((6, 12, 72, 3), np.uint8))
    odometry = Odometry(stamps, np.column_stack([x_m, none]), none, none)
    run = Run('run', images, odometry, counts={'images': Count()})
    assert ImageSequence.of(run).joined.tolist() == [True, True, False, False, True]
