# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The place model: where a picture was taken, and how it is saved and loaded."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from cylinder_worlds import place, visit
from numpy.testing import assert_array_equal
from places import lengths
from rigs import rig
from threadpoolctl import threadpool_info, threadpool_limits

from sfa_localization import evaluation, training, updating
from sfa_localization.camera.panorama import Unwrapper, repeated_pixels
from sfa_localization.camera.settings import CameraConfig, LensCalibration
from sfa_localization.data.array_files import read_arrays, write_arrays
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError, ModelError
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.keyframes.light import Conditions
from sfa_localization.keyframes.observation import UNKNOWN_YAW_VARIANCE
from sfa_localization.localizer import Localizer
from sfa_localization.observer import Observer
from sfa_localization.place_model import FORMAT, VERSION, PlaceModel, camera_of, surround_of


@pytest.fixture(scope='module')
def model():
    return place(True).model


@pytest.fixture(scope='module')
def pictures():
    return visit().panoramas.read(0, 43)


@pytest.fixture
def saved(model, tmp_path):
    model.save(tmp_path / 'model.npz')
    return tmp_path / 'model.npz'


ENTRIES = {
    'locate': lambda model, image, path: model.locate(image),
    'localizer': lambda model, image, path: Localizer(model).add_panorama(1, image),
    'train': lambda model, image, path: training.train([path], path / 'new.npz'),
    'update': lambda model, image, path: updating.update(model, [path], path / 'new.npz'),
    'evaluate': lambda model, image, path: evaluation.evaluate(model, path),
}


@pytest.mark.parametrize('entry', ENTRIES)
def test_linear_algebra_uses_a_single_core(model, pictures, entry, tmp_path, monkeypatch):
    threads = []

    def look(*_, **__):
        threads.append({pool['num_threads'] for pool in threadpool_info()})
        raise DataError('seen')

    names = 'training.with_lens', 'updating.read_drive', 'evaluation.read_drive'
    for name in (*names, 'sfa.network.input_map'):
        monkeypatch.setattr(f'sfa_localization.{name}', look)
    with threadpool_limits(2), pytest.raises(DataError, match='seen'):
        ENTRIES[entry](model, pictures[0], tmp_path)
    assert threads == [{1}]


@pytest.mark.parametrize('clockwise', [True, False])
def test_images_are_located(clockwise):
    """Yaw by REP-103, whichever way the columns go: checked against the true headings."""
    truth, images = visit(clockwise).odometry.poses, visit(clockwise).panoramas.read(0, 43)
    estimates = place(clockwise).model.locate_all(images)
    error = np.array([e.pose for e in estimates]) - truth
    assert np.median(lengths(error)) < 0.3
    assert np.degrees(np.median(np.abs(wrap_angle(error[:, 2])))) < 3
    for image, together in zip(images[::9], estimates[::9], strict=True):
        alone = place(clockwise).model.locate(image)
        # Float32 rounds their headings differently, and the position follows.
        assert np.allclose(alone.pose, together.pose, atol=1e-4)
        assert np.allclose(alone.covariance, together.covariance, rtol=1e-2, atol=1e-6)
        assert alone.explained == pytest.approx(together.explained, rel=1e-4)


def test_covariances_are_positive_definite(model, pictures):
    pictures = pictures[::3]
    strange = np.random.default_rng(0).integers(0, 256, pictures.shape, np.uint8)
    for estimate in model.locate_all(np.concatenate([pictures, strange])):
        assert np.allclose(estimate.covariance, estimate.covariance.T)
        assert np.linalg.eigvalsh(estimate.covariance).min() > 0
        assert 0 < estimate.covariance[2, 2] <= UNKNOWN_YAW_VARIANCE
    familiar, foreign = (
        np.median([np.trace(e.covariance[:2, :2]) for e in model.locate_all(p)])
        for p in (pictures, strange)
    )
    assert foreign > 10 * familiar


def test_at_an_uncertain_heading_the_map_knows_little(model, pictures):
    """It is given turned images; the heading is the less certain the less is explained."""
    (view,) = model.views(pictures[:1])
    sure = model.located(view, Conditions()).fit
    certain, uncertain = model._slow_places(view, [sure, replace(sure, unlike=100.0)])[1]
    assert uncertain > 10 * certain


def test_other_pictures_are_refused(model, pictures):
    for picture in (pictures[0, ..., 0], pictures[0] / 1.0, pictures[0, :, 12:], pictures[:1]):
        with pytest.raises(ModelError):
            model.locate(picture)


def test_a_model_is_the_same_after_it_was_saved(model, saved, pictures, tmp_path):
    again = PlaceModel.load(saved)
    for before, after in zip(model.locate_all(pictures), again.locate_all(pictures), strict=True):
        assert np.allclose(before.position, after.position, rtol=0, atol=1e-6)
        assert np.allclose(before.covariance, after.covariance, rtol=1e-2)
        assert before.yaw == pytest.approx(after.yaw, abs=1e-5)
        assert before.explained == pytest.approx(after.explained, abs=1e-6)
    assert again.quality == json.loads(json.dumps(model.quality))
    assert again.error_correlation == model.error_correlation != ErrorCorrelation()
    assert Localizer(again).filter.correlation.share == pytest.approx(again.error_correlation.share)
    again.save(tmp_path / 'again.npz')
    assert (tmp_path / 'again.npz').read_bytes() == saved.read_bytes()


def test_a_model_keeps_several_cameras_and_does_without_one_that_is_missing(
    model, pictures, tmp_path
):
    """Its sector repeats the columns at its edges; a model of one camera takes it for the view."""
    several = replace(model, surround=tuple(rig()))
    several.save(tmp_path / 'several.npz')
    assert (
        surround_of(tmp_path / 'several.npz')
        == PlaceModel.load(tmp_path / 'several.npz').surround
        == tuple(rig())
    )
    model.save(tmp_path / 'one.npz')
    assert surround_of(tmp_path / 'one.npz') == ()
    blind = Unwrapper(CameraConfig(blind_sectors=(140.0, 220.0)), model.panorama)
    hidden = np.stack([blind(picture) for picture in pictures])
    whole = np.array([at.pose for at in model.locate_all(pictures)])

    def off(by):
        poses = np.array([at.pose for at in by.locate_all(hidden)])
        return np.median(np.hypot(*(poses - whole)[:, :2].T))

    assert off(several) < 0.6 * off(model)
    for one, other in zip(several.locate_all(pictures), model.locate_all(pictures), strict=True):
        assert_array_equal(one.pose, other.pose)  # where nothing is hidden, nothing changes


LENS = LensCalibration(
    camera_model='fisheye', distortion=(0.1, 0.0, 0.0, 0.0), mount_rpy=(5.0, 0.0, 30.0)
)


def test_a_model_masks_what_it_has_not_seen_in_training(model, pictures, tmp_path):
    """Whoever gives it panoramas: masked or not, they show the same."""
    camera = Unwrapper(CameraConfig(blind_sectors=(150.0, 210.0)), model.panorama)
    repeated = repeated_pixels(camera.visible((1, 4)))
    masked = replace(model, repeated=repeated, lens=LENS)
    masked.save(tmp_path / 'masked.npz')
    masked = PlaceModel.load(tmp_path / 'masked.npz')
    assert masked.lens == LENS and camera_of(tmp_path / 'masked.npz') == (model.panorama, LENS)
    covered, blind = pictures[:2].copy(), ~camera.visible((1, 4))
    covered[:, blind] = 200
    expected = model.locate_all(np.stack([camera(picture) for picture in pictures[:2]]))
    for given in (pictures[:2], covered):
        stamps = np.arange(len(given))
        for seen in (masked.locate_all(given), Observer(masked).observe_all(stamps, given)):
            for one, other in zip(seen, expected, strict=True):
                assert np.allclose(one.slow_features, other.slow_features, atol=1e-5)
    with pytest.raises(ModelError, match='expects panoramas of'):
        masked.locate(pictures[0, :, 12:])


def test_what_is_no_model_is_refused_with_the_remedy(tmp_path):
    os.mkfifo(tmp_path / 'pipe.npz')
    np.savez(tmp_path / 'other.npz', a=np.zeros(3))
    (tmp_path / 'empty.npz').write_bytes(b'')
    (tmp_path / 'broken.npz').write_bytes(b'PK\x03\x04 broken')
    refused(tmp_path / 'none.npz', 'no such file: train it')
    refused(tmp_path / 'pipe.npz', 'is no regular file')
    refused(tmp_path, 'is a folder')
    for name in ('other.npz', 'empty.npz', 'broken.npz'):
        refused(tmp_path / name, 'not a sfa_localization place model')


def test_a_damaged_model_is_refused_with_the_remedy(saved):
    whole, arrays = saved.read_bytes(), read_arrays(saved, FORMAT, VERSION, '')
    saved.write_bytes(whole[: int(len(whole) * 0.99)])
    refused(saved, 'not a sfa_localization place model')
    for name in ('metric/linear', 'keyframes/values', 'turned/axes'):
        data = bytearray(whole)
        data[whole.index(arrays[name].tobytes()) + 9] ^= 16
        saved.write_bytes(data)
        refused(saved, 'damaged.*: copy it again, or train it')
    for changes, told in (
        ({'without': 'network/1/slow'}, 'train'),
        ({'without': 'metric/linear'}, 'train'),
        ({'without': 'keyframes/errors'}, 'train'),
        ({'format': 'something else'}, 'a something else, not a'),
        ({'version': VERSION + 1}, f'version {VERSION + 1}, this software reads {VERSION}: train'),
        ({'panorama': {'nonsense': 1}}, 'damaged.*train it again'),
    ):
        saved.write_bytes(whole)
        rewrite(saved, **changes)
        refused(saved, told)
    np.savez(saved, **{**arrays, 'evil': np.array([object()], dtype=object)})
    refused(saved, 'not a sfa_localization place model')


def rewrite(path, without='', **header):
    """Change the header of a saved model, or leave an array out."""
    arrays = read_arrays(path, FORMAT, VERSION, '')
    arrays['header'] = np.array(json.dumps({**json.loads(str(arrays['header'])), **header}))
    write_arrays(path, {name: array for name, array in arrays.items() if name != without})


def refused(path, told):
    with pytest.raises(ModelError, match=told) as error:
        PlaceModel.load(path)
    assert str(path) in str(error.value)
    assert 'train' in str(error.value) and '\n' not in str(error.value)
