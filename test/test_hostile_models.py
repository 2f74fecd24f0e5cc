# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A model file from a stranger: whatever is in it, it is a model or one ModelError."""

import io
import json
import os
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cylinder_worlds import place

from sfa_localization.data import array_files
from sfa_localization.data.array_files import read_arrays, write_arrays
from sfa_localization.data.errors import ModelError
from sfa_localization.place_model import FORMAT, VERSION, PlaceModel


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('model') / 'model.npz'
    place().model.save(path)
    return path


@pytest.fixture
def arrays(whole: Path) -> dict:
    return read_arrays(whole, FORMAT, VERSION, '')


def driven(arrays: dict, drive: int = 0, trained: int = 1) -> dict:
    """With keyframes that are all of one drive."""
    count = len(arrays['keyframes/poses'])
    return {
        **arrays,
        'keyframes/drives': np.full(count, drive),
        'keyframes/trained': np.array(trained),
    }


def rejected(path: Path, reason: str) -> None:
    with pytest.raises(ModelError, match=reason) as raised:
        PlaceModel.load(path)
    text = str(raised.value)
    assert text.startswith(f'{path}: ') and 'train' in text and '\n' not in text
    assert len(text) < len(str(path)) + 500
    assert text.count('train it') == 1
    assert not re.search(r'\b\w*(Error|Exception)\b', text)


def changed_header(arrays: dict, **changes: object) -> dict:
    header = json.loads(str(arrays['header']))
    return {**arrays, 'header': np.array(json.dumps({**header, **changes}))}


def architecture(arrays: dict, **changes: object) -> dict:
    spec = json.loads(str(arrays['header']))['architecture']
    return changed_header(arrays, architecture={**spec, **changes})


def first_layer(arrays: dict, **changes: object) -> dict:
    layers = json.loads(str(arrays['header']))['architecture']['layers']
    return architecture(arrays, layers=[{**layers[0], **changes}, *layers[1:]])


def spoilt(array: np.ndarray, value: float) -> np.ndarray:
    copy = array.copy()
    copy.ravel()[-1] = value
    return copy


CHANGES: dict[str, tuple[Callable[[dict], dict], str]] = {
    'NaN weights': (
        lambda a: {**a, 'network/1/slow': spoilt(a['network/1/slow'], np.nan)},
        'not finite',
    ),
    'no variance at all': (
        lambda a: {**a, 'metric/scalars': a['metric/scalars'] * [1, 0, 1]},
        'metric/scalars.*must be positive',
    ),
    'keyframes of other images': (
        lambda a: {**a, 'keyframes/textures': a['keyframes/textures'][:, 1:]},
        'damaged',
    ),
    'keyframes of more drives than there are': (
        lambda a: driven(a, drive=2**40),
        'keyframes/drives holds a number beyond 1e',
    ),
    'no drive of the training': (
        lambda a: driven(a, trained=0),
        'keyframes/trained.*must be positive',
    ),
    'enormous weights': (
        lambda a: {**a, 'metric/linear': 1e30 * a['metric/linear'] + 1e31},
        'beyond 1e',
    ),
    'text for numbers': (lambda a: {**a, 'compass/weights': np.array('x')}, 'is of type'),
    'transposed': (lambda a: {**a, 'network/0/slow': a['network/0/slow'].T}, 'has the shape'),
    'other network': (lambda a: {**a, 'network/0/linear': a['network/0/linear'][:9]}, 'not fit'),
    'unknown array': (lambda a: {**a, 'extra/one': np.zeros(3)}, 'extra/one is unknown'),
    'a thousandth layer': (
        lambda a: {**a, **{k.replace('/0/', '/999/'): v for k, v in a.items() if '/0/' in k}},
        'damaged',
    ),
    'unknown map': (lambda a: {**a, 'metric/kind': np.array('?')}, 'damaged'),
    'a larger triangle': (lambda a: {**a, 'refinement/metric_factor': np.ones(10**6)}, 'damaged'),
    'a refinement that turns neither way': (
        lambda a: {**a, 'refinement/scalars': a['refinement/scalars'] * [0, 1]},
        'turns neither way',
    ),
    'huge panorama': (
        lambda a: changed_header(a, panorama={'width': 10**9, 'height': 60}),
        'outside',
    ),
    'another panorama': (
        lambda a: changed_header(a, panorama={'width': 600, 'height': 60}),
        'different sizes',
    ),
    'a panorama that shows nothing': (
        lambda a: changed_header(
            a, panorama={'width': 300, 'height': 30, 'elevation_min': 9.0, 'elevation_max': -9.0}
        ),
        'elevation_min of the panorama must be below',
    ),
    'no stride': (lambda a: first_layer(a, stride=[0, 1]), 'sizes are from 1'),
    'no grid': (lambda a: architecture(a, grid=[0, 40]), 'sizes are from 1'),
    'NaN limit': (lambda a: first_layer(a, clip=float('nan')), 'clip'),
    'layers beyond': (lambda a: changed_header(a, heading_layers=[99]), 'damaged'),
    'NaN delay': (
        lambda a: changed_header(a, quality={'camera_delay_s': [float('nan')]}),
        'delay is not that of a camera',
    ),
    'impossible correlation': (
        lambda a: changed_header(a, error_correlation={'share': 2.0, 'distance_m': 1.0}),
        'impossible',
    ),
    'kind of a page': (lambda a: changed_header(a, format='x' * 10**5), 'a xxx'),
    'version of a page': (lambda a: changed_header(a, version='9' * 10**5), 'version 999'),
}


def test_wrong_content_with_a_right_checksum(arrays, tmp_path):
    for name, (change, reason) in CHANGES.items():
        path = tmp_path / f'{name}.npz'
        write_arrays(path, change(arrays))
        rejected(path, reason)


def test_other_numbers_than_were_saved_and_headers_that_json_does_not_survive(arrays, tmp_path):
    """The zip is whole; only the checksum of the header shows the change of numbers."""
    path = tmp_path / 'bad.npz'
    np.savez(path, **{**arrays, 'metric/scalars': 9 * arrays['metric/scalars']})
    rejected(path, 'checksum')
    for text in ('[' * 100_000, '9' * 5001, '[]', '7', '{"format": [' + '[' * 900):
        np.savez(path, **{**arrays, 'header': np.array(text)})
        rejected(path, 'not a sfa_localization place model')


def npy(shape: str, dtype: str = '<f8', data: bytes = b'') -> bytes:
    """An .npy member whose header declares any shape."""
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}}}".encode()
    text += b' ' * (-(len(text) + 11) % 64) + b'\n'
    return b'\x93NUMPY\x01\x00' + struct.pack('<H', len(text)) + text + data


def archive(members: list[tuple[str, bytes]], compression: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, 'w', compression) as made:
        for name, data in members:
            made.writestr(name, data)
    return file.getvalue()


BOMBS = {
    'huge shape': archive([('a.npy', npy('(1000000000000,)'))]),
    'shape beyond integers': archive([('a.npy', npy(f'({10**30}, {10**30})'))]),
    'negative shape': archive([('a.npy', npy('(-1, -8)', data=bytes(64)))]),
    'shape of nothing': archive([('a.npy', npy('(0, 1000000000000)', data=bytes(8)))]),
    'nested shape': archive([('a.npy', npy('(' * 3000))]),
    'objects': archive([('a.npy', npy('(1,)', '|O', bytes(8)))]),
    'text of 4 GB': archive([('header.npy', npy('()', '<U1000000000'))]),
    'structured': archive([('a.npy', npy('(1,)', '|V8', bytes(8)))]),
    'compressed': archive([('a.npy', npy('(8000000,)', data=bytes(64_000_000)))], 8),
    'the same name twice': archive([('a.npy', npy('(0,)'))] * 2),
    'no array': archive([('a.npy', b'text')]),
    'no arrays': archive([]),
    'many arrays': archive([(f'{i}.npy', b'') for i in range(2000)]),
    'zip64': archive([('a.npy', npy('(0,)'))])[:-22] + b'PK\x06\x07' + bytes(16) + bytes(22),
    'zip64 before the end': b'PK\x06\x07' + bytes(16) + archive([]),
}


@pytest.mark.filterwarnings('ignore:Duplicate name')
def test_bombs_end_before_anything_is_allocated(tmp_path):
    for name, data in BOMBS.items():
        path = tmp_path / f'{name}.npz'
        path.write_bytes(data)
        rejected(path, 'not a sfa_localization place model')
    with (tmp_path / 'sparse.npz').open('wb') as file:
        file.truncate(array_files.LARGEST_FILE + 1)
    rejected(tmp_path / 'sparse.npz', 'more than')


def test_paths_that_are_no_file(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    for path, what in {
        tmp_path / 'pipe': 'is no regular file', tmp_path: 'is a folder',
        Path(300 * 'x'): 'no such file', Path('a\0b'): 'no such file',
        Path('/dev/zero'): 'is no regular file',
    }.items():  # fmt: skip
        rejected(path, f'{what}: train it')


def test_damaged_models_give_one_kind_of_error(whole, tmp_path):
    data, random = whole.read_bytes(), np.random.default_rng(0)
    path = tmp_path / 'bad.npz'
    ends = data.index(b'network/0/'), len(data)
    noticed = 0
    for _ in range(100):
        bad = bytearray(data)
        # Half of the changes in the directory, which is at the end.
        low = ends[0] if random.random() < 0.5 else ends[1] - 4000
        for at in random.integers(low, ends[1], random.integers(1, 8)):
            bad[at] ^= int(random.integers(1, 256))
        path.write_bytes(bad)
        try:
            PlaceModel.load(path)
        except ModelError as error:
            assert '\n' not in str(error)
            noticed += 1
    assert noticed > 80, 'the rest are dates and sizes of the zip that nobody reads'
