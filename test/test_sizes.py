# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Panoramas of any size train and are judged: the network fits itself to them."""

import pytest

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.evaluation import evaluate
from sfa_localization.place_model import PlaceModel
from sfa_localization.simulation.drive import simulate
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import train

DRIVE = SimulationConfig(area=(6.0, 6.0), length=20.0, images='panorama', images_every=0.4)


@pytest.mark.slow
@pytest.mark.parametrize('size', [(120, 25), (720, 150)])
def test_a_drive_with_panoramas_of_any_size_trains_and_is_judged(size, tmp_path):
    simulate(DRIVE, tmp_path / 'bag', PanoramaConfig(width=size[0], height=size[1]))
    train([tmp_path / 'bag'], tmp_path / 'model.npz')
    model = PlaceModel.load(tmp_path / 'model.npz')
    assert (model.panorama.width, model.panorama.height) == size
    scores = evaluate(model, tmp_path / 'bag').scores
    assert scores['sfa']['mean'] < 0.5
