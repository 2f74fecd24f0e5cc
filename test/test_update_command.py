# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What `train --update` writes and refuses."""

import numpy as np
import pytest
from test_commands import data, run  # noqa: F401

from sfa_localization import updating
from sfa_localization.place_model import PlaceModel
from sfa_localization.updating import Additions


def unchanging(monkeypatch, data):  # noqa: F811
    """Nothing is new; the inputs of the command."""
    shape = PlaceModel.load(data / 'model.npz').keyframes.textures.shape[1:]
    nothing = Additions(np.zeros((0, *shape), np.int8), np.zeros((0, 3)))
    monkeypatch.setattr(updating, 'new_views', lambda *_args, **_named: nothing)
    return '{data}/bag --update {data}/model.npz --output {out}/same.npz'


@pytest.mark.slow
def test_where_nothing_is_new_the_same_bytes_are_written(data, tmp_path, monkeypatch):  # noqa: F811
    done = run('train', unchanging(monkeypatch, data), tmp_path, data=data)
    assert done.code == 0 and 'no image of these drives is both new' in done.text
    assert (tmp_path / 'same.npz').read_bytes() == (data / 'model.npz').read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize('option', ['--resume', '--report {out}/r', '--segments straight'])
def test_options_without_effect_are_refused(option, data, tmp_path):  # noqa: F811
    words = f'{{data}}/bag --update {{data}}/model.npz --output {{out}}/same.npz {option}'
    done = run('train', words, tmp_path, data=data)
    assert done.code == 1 and f'{option.split()[0]} has no effect' in done.text
    assert list(tmp_path.iterdir()) == []
