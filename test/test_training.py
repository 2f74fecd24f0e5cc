# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Training from bags: what it leaves behind, how it goes on, and what it refuses."""

import logging
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cylinder_worlds import PLACE_ARCHITECTURE, Spheres, panorama_config, recipe, run_in, wander

from sfa_localization import training
from sfa_localization.bags.writer import BagWriter
from sfa_localization.data.errors import DataError, LocalizationError, ModelError
from sfa_localization.data.run import Count, Odometry, PanoramaArray, Run, integrate
from sfa_localization.features import checkpoint as checkpoints
from sfa_localization.features import image_features
from sfa_localization.features.network_training import ImageSequence, train_network
from sfa_localization.metric import refinement
from sfa_localization.metric.drive_check import ROUTE
from sfa_localization.metric.learning import positions
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.summary import summary
from sfa_localization.training import learn_place, train

PICTURES = 160
ARCHITECTURE = replace(
    recipe().architecture,
    layers=tuple(
        replace(layer, linear=linear, outputs=6)
        for layer, linear in zip(recipe().architecture.layers, (6, 6, 8), strict=True)
    ),
)
RECIPE = replace(
    recipe(), architecture=ARCHITECTURE, metric=replace(recipe().metric, slow_features=4)
)


def write_bag(path: Path, seed: int = 2, size: tuple[int, int] = (12, 72)) -> Path:
    run = run_in(Spheres.about(1), wander(PICTURES, seed, hz=4.0), panorama_config(size))
    odometry = run.odometry
    with BagWriter(path) as bag:
        for stamp, pose, twist, image in zip(
            odometry.stamps_ns.tolist(),
            odometry.poses,
            odometry.twists,
            run.panoramas.read(0, PICTURES),
            strict=True,
        ):
            bag.odometry('/odom', stamp, pose, twist, np.array([1e-4, 1e-4]))
            bag.image('/panorama', stamp, image, 'base_link')
    return path


@pytest.fixture(scope='module')
def bag(tmp_path_factory) -> Path:
    return write_bag(tmp_path_factory.mktemp('bags') / 'drive')


@pytest.fixture(scope='module')
def whole(bag, tmp_path_factory) -> bytes:
    """The bytes of an undisturbed training."""
    output = tmp_path_factory.mktemp('whole') / 'model.npz'
    train([bag], output, RECIPE)
    return output.read_bytes()


class Cut(Exception):
    """As a kill would, it passes through everything."""


def cut_off(bag: Path, output: Path, stages: int, error: BaseException) -> None:
    """Train until `stages` stages are finished, and be cut off there."""
    with pytest.MonkeyPatch.context() as patch:
        write, done = checkpoints.Checkpoint.write, []

        def write_then_fail(self, partial):
            write(self, partial)
            done.append(partial)
            if len(done) == stages:
                raise error

        patch.setattr(checkpoints.Checkpoint, 'write', write_then_fail)
        with pytest.raises(type(error)):
            train([bag], output, RECIPE)


def test_it_says_what_error_to_expect_and_where_it_is_worst(bag, tmp_path):
    trained = train([bag], tmp_path / 'model.npz', RECIPE)
    quality = PlaceModel.load(tmp_path / 'model.npz').quality
    worst = quality['worst']
    assert 0.0 < quality['expected_error_m'] < worst['expected_error_m']
    told = (
        f'position: expect {quality["expected_error_m"]:.2f} m mean error of one image on paths '
        f'between the trained ones; worst near x {worst["x_m"]:.1f} m, y {worst["y_m"]:.1f} m: '
        f'{worst["expected_error_m"]:.2f} m'
    )
    assert told in summary(trained).splitlines()
    assert f'expect {quality["expected_yaw_error_deg"]:.1f} degrees' in summary(trained)
    _, places = positions(trained.metric, trained.segments)
    assert np.hypot(*(places - [worst['x_m'], worst['y_m']]).T).min() < 1.0


def test_with_too_few_headings_it_learns_and_expects_none(bag, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(image_features, 'SAMPLES', 15)
    trained = train([bag], tmp_path / 'model.npz', RECIPE)
    assert 'too few to learn a compass' in caplog.text
    assert trained.model.compass is None
    assert trained.model.refinement is None and not trained.model.quality['refined']
    assert 'expected_yaw_error_deg' not in trained.model.quality
    assert 'heading' not in summary(trained)


def test_turned_maps_refine_the_map(bag, tmp_path):
    trained = train([bag], tmp_path / 'model.npz', RECIPE)
    assert trained.model.quality['refined']
    assert '4 slow features refined by turned maps' in summary(trained)
    # What is expected, and reported, is what the finer map was learned from.
    finest = trained.metric.map, trained.model.refinement.metric
    places = [each.predict(np.zeros((1, 32)))[0] for each in finest]
    np.testing.assert_allclose(*places, atol=1e-6)


def test_maps_that_cannot_refine_leave_the_first_map(bag, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(refinement, 'learn_metric', _fail)
    trained = train([bag], tmp_path / 'model.npz', RECIPE)
    assert 'positions are not refined: the drive cannot fix a map' in caplog.text
    assert trained.model.compass is not None and trained.model.refinement is None
    assert 'refined' not in summary(trained)


def test_two_layers_have_none_to_refine_with(bag, tmp_path):
    bottom, _, top = ARCHITECTURE.layers
    two = replace(ARCHITECTURE, layers=(bottom, replace(top, field=(3, 6))))
    trained = train([bag], tmp_path / 'model.npz', replace(RECIPE, architecture=two))
    assert trained.model.compass is not None and trained.model.refinement is None


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_only_the_model_is_left(bag, tmp_path):
    trained = train([bag], tmp_path / 'new' / 'model.npz', RECIPE)
    assert names(tmp_path / 'new') == ['model.npz']
    model = PlaceModel.load(tmp_path / 'new' / 'model.npz')
    assert model.quality['pictures'] == PICTURES
    assert model.quality['certified']
    assert trained.features.shape == (PICTURES, 6)


def test_same_bag_same_bytes(bag, whole, tmp_path):
    train([bag], tmp_path / 'model.npz', RECIPE)
    assert (tmp_path / 'model.npz').read_bytes() == whole


@pytest.mark.parametrize('stages', [1, 4, 6])
@pytest.mark.parametrize('error', [Cut(), KeyboardInterrupt()])
def test_resuming_gives_the_same_bytes(bag, whole, tmp_path, stages, error):
    output = tmp_path / 'model.npz'
    cut_off(bag, output, stages, error)
    assert names(tmp_path) == ['.model.npz.checkpoint.npz']
    train([bag], output, RECIPE, resume=True)
    assert output.read_bytes() == whole
    assert names(tmp_path) == ['model.npz']


@pytest.mark.parametrize('other', ['recipe', 'bag'])
def test_a_checkpoint_of_something_else_is_refused(bag, tmp_path, other):
    cut_off(bag, tmp_path / 'model.npz', 2, Cut())
    changed = replace(RECIPE, network=replace(RECIPE.network, seed=5))
    bags = [write_bag(tmp_path / 'other', seed=8)] if other == 'bag' else [bag]
    with pytest.raises(ModelError, match='other bags or parameters: train without --resume'):
        train(bags, tmp_path / 'model.npz', changed if other == 'recipe' else RECIPE, resume=True)


def test_a_damaged_checkpoint_is_refused(bag, tmp_path):
    cut_off(bag, tmp_path / 'model.npz', 2, Cut())
    checkpoint = tmp_path / '.model.npz.checkpoint.npz'
    checkpoint.write_bytes(checkpoint.read_bytes()[:500])
    with pytest.raises(ModelError, match='train without --resume'):
        train([bag], tmp_path / 'model.npz', RECIPE, resume=True)


@pytest.mark.parametrize('late', [False, True])
def test_after_an_error_no_model_is_left(bag, tmp_path, late, monkeypatch):
    if late:
        monkeypatch.setattr(training, 'learn_map', _fail)
    wrong = replace(ARCHITECTURE, size=(12, 36))
    recipe = RECIPE if late else replace(RECIPE, architecture=wrong)
    with pytest.raises(LocalizationError):
        train([bag], tmp_path / 'model.npz', recipe)
    assert 'model.npz' not in names(tmp_path)
    assert not any('cache' in name for name in names(tmp_path))


def _fail(*args, **kwargs):
    raise DataError('the drive cannot fix a map')


def test_bags_of_other_sizes_are_refused(bag, tmp_path):
    other = write_bag(tmp_path / 'other', size=(12, 96))
    with pytest.raises(DataError, match=r'different sizes \(drive: 72x12, other: 96x12\)'):
        train([bag, other], tmp_path / 'model.npz', RECIPE)


def test_an_output_that_cannot_be(bag, tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(ModelError, match='cannot be written'):
        train([bag], tmp_path / 'file' / 'model.npz', RECIPE)


def test_the_mdp_engine_learns_the_same_place(bag, tmp_path):
    pytest.importorskip('future', reason='the extra mdp is not installed')
    ours = train([bag], tmp_path / 'ours.npz', RECIPE)
    config = replace(RECIPE, network=replace(RECIPE.network, engine='mdp'))
    theirs = train([bag], tmp_path / 'theirs.npz', config)
    for a, b in zip(ours.features.T, theirs.features.T, strict=True):
        assert abs(np.corrcoef(a, b)[0, 1]) > 0.999


def test_a_drive_given_twice_is_refused(bag, tmp_path):
    """What is left out would be known from its copy, and the forecast would promise too much."""
    with pytest.raises(DataError, match=r'the same drive as .*: name each drive once'):
        train([bag, bag], tmp_path / 'm.npz', RECIPE)
    assert not (tmp_path / 'm.npz').exists()


def straight_route(speed):
    """A drive straight ahead of 12 m at 4 Hz and less, whose odometry states no variance."""
    count = 400
    stamps = 10**9 + np.arange(count) * round(12e9 / speed / count)
    twists = np.tile([speed, 0.0], (count, 1))
    poses = integrate(stamps, twists, np.array([-6.0, 0.0, 0.0]))
    odometry = Odometry(stamps, poses, twists, np.zeros((count, 2)))
    return run_in(Spheres.about(1), odometry, recipe().panorama)


@pytest.mark.slow
@pytest.mark.parametrize('speed', [0.03, 0.12])
def test_one_straight_route_gives_a_model_and_one_sentence(speed, caplog):
    run = straight_route(speed)
    network = train_network(PLACE_ARCHITECTURE, [ImageSequence.of(run)])
    with warnings.catch_warnings(), caplog.at_level(logging.WARNING):
        warnings.simplefilter('error')
        trained = learn_place(network, [run], recipe())
    assert [record.message for record in caplog.records].count(ROUTE) == 1
    assert trained.segments.images.skipped == {}
    aside = np.array([[x, 1.5, 0.0] for x in (-2.0, 0.0, 2.0)])
    on = trained.model.locate_all(run.panoramas.read(150, 250))
    off = trained.model.locate_all(Spheres.about(1).panoramas(aside, recipe().panorama))
    places = np.array([one.position for one in on])
    assert np.hypot(*(places - run.odometry.poses[150:250, :2]).T).mean() < 0.1
    surest, least = (
        pick(np.trace(one.covariance[:2, :2]) for one in part)
        for pick, part in ((max, on), (min, off))
    )
    assert least > 10 * surest
    with pytest.raises(DataError, match='no track crosses another'):
        learn_place(network, [run], recipe(), strict=True)


def test_pauses_and_jumps_of_a_drive_are_breaks_between_its_images():
    seconds, x_m = np.array([0, 1, 2, 9, 10, 11]), np.array([0, 0.1, 0.4, 0.5, 3.0, 3.1])
    stamps, none = (seconds * 1e9).astype(np.int64), np.zeros((6, 2))
    images = PanoramaArray(stamps, np.zeros((6, 12, 72, 3), np.uint8))
    odometry = Odometry(stamps, np.column_stack([x_m, none]), none, none)
    run = Run('run', images, odometry, counts={'images': Count()})
    assert ImageSequence.of(run).joined.tolist() == [True, True, False, False, True]
