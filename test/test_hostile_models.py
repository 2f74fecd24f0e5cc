# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A model file whose parts do not fit each other is one error, when it is loaded."""

import json

import numpy as np
import pytest
from cylinder_worlds import place

from sfa_localization.data.array_files import read_arrays, write_arrays
from sfa_localization.data.errors import ModelError
from sfa_localization.place_model import FORMAT, VERSION, PlaceModel


def changed_header(arrays: dict, **changes: object) -> dict:
    header = json.loads(str(arrays['header']))
    return {**arrays, 'header': np.array(json.dumps({**header, **changes}))}


def filled(arrays: dict, name: str, value: object) -> dict:
    return {**arrays, name: np.full_like(arrays[name], value)}


CHANGES = {
    'not finite': lambda a: filled(a, 'network/1/slow', np.nan),
    'damaged': lambda a: {**a, 'keyframes/textures': a['keyframes/textures'][:, 1:]},
    'not fit': lambda a: {**a, 'network/0/linear': a['network/0/linear'][:9]},
    'turns neither way': lambda a: filled(a, 'turned/sign', 0),
    'outside': lambda a: changed_header(a, panorama={'width': 10**9, 'height': 60}),
    'different sizes': lambda a: changed_header(a, panorama={'width': 600, 'height': 60}),
    'delay is not that': lambda a: changed_header(a, quality={'camera_delay_s': [1e9]}),
    'impossible': lambda a: changed_header(a, error_correlation={'share': 2, 'distance_m': 1}),
}


def test_parts_that_do_not_fit_under_a_right_checksum(tmp_path):
    place().model.save(tmp_path / 'model.npz')
    arrays = read_arrays(tmp_path / 'model.npz', FORMAT, VERSION, '')
    for number, (reason, change) in enumerate(CHANGES.items()):
        path = tmp_path / f'{number}.npz'
        write_arrays(path, change(arrays))
        with pytest.raises(ModelError, match=reason) as raised:
            PlaceModel.load(path)
        text = str(raised.value)
        assert text.startswith(f'{path}: ') and 'train it' in text and '\n' not in text


def test_other_numbers_than_were_saved(tmp_path):
    """The zip is whole; only the checksum of the header shows the change."""
    place().model.save(tmp_path / 'model.npz')
    arrays = read_arrays(tmp_path / 'model.npz', FORMAT, VERSION, '')
    np.savez(tmp_path / 'bad.npz', **{**arrays, 'metric/scalars': 9 * arrays['metric/scalars']})
    with pytest.raises(ModelError, match='checksum'):
        PlaceModel.load(tmp_path / 'bad.npz')
