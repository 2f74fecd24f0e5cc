# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged bags, models, images and texts: each is read, or rejected by one line of our errors.

`make fuzz` tries thousands of each kind (FUZZ_INPUTS); the tests try some.
"""

import logging
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from bag_formats import FORMATS, drive, read_odometry, write_version
from test_calibration_files import OCAM, echoed

from sfa_localization.bags.reader import KINDS, Bag
from sfa_localization.bags.recording import METADATA, parse_metadata
from sfa_localization.camera.calibration_files import read_calibration
from sfa_localization.camera.encodings import decode_compressed
from sfa_localization.camera.panorama import read_mask
from sfa_localization.camera.settings import CameraConfig
from sfa_localization.config import load_changes, load_settings, render
from sfa_localization.data.errors import LocalizationError
from sfa_localization.data.messages import read_yaw_rate
from sfa_localization.inspection import inspect
from sfa_localization.place_model import PlaceModel

INPUTS = int(os.environ.get('FUZZ_INPUTS', '60'))
Random = np.random.Generator


def damaged(data: bytes, random: Random) -> bytes:
    """Bytes after one to six changes, half of them near the ends, where headers and indexes are."""
    for _ in range(random.integers(1, 7)):
        near, size = int(random.integers(0, 200)), int(random.integers(1, 60))
        at = int(random.choice([near, len(data) - near, random.integers(0, len(data) + 1)]))
        before, part, after = data[: max(at, 0)], data[at : at + size], data[at + size :]
        changes = (
            b'', after, bytes(size) + after, b'\xff' * size + after, random.bytes(size) + after,
            random.bytes(size) + part + after, part * 3 + after,
            bytes(byte ^ 1 for byte in part) + after,
        )  # fmt: skip
        data = before + changes[random.integers(len(changes))]
    return data


def spoilt(text: str, random: Random) -> str:
    """Text after one to six changes."""
    tokens = ['[', ']', '{', '- ', ': ', '&a ', '*a', '"', '|', '#', '!!int ', '---\n', '.nan',
              '1e999', '9' * 5001, '2001-99-99', '\t', '\n', '\0', '\ud7ff', '[' * 999]  # fmt: skip
    for _ in range(random.integers(1, 7)):
        at, size = int(random.integers(0, len(text) + 1)), int(random.integers(0, 30))
        put = [*tokens, text[at : at + size] * 3, ''][random.integers(len(tokens) + 2)]
        text = text[:at] + put + text[at + size * int(random.integers(2)) :]
    return text


def is_read(read: Callable[[], object], errors: type[Exception] = LocalizationError) -> bool:
    """Whether it is read; it may raise one of our errors, in one line, and no other."""
    try:
        read()
    except errors as error:
        assert '\n' not in str(error) and len(str(error)) < 1500
        return False
    return True


def check(use: Callable[[Random], bool], inputs: int = INPUTS) -> None:
    """Use inputs, each made of its own number; neither all nor none of them can be read."""
    readable = []
    for number in range(inputs):
        try:
            readable.append(use(np.random.default_rng(number)))
        except Exception as error:
            raise AssertionError(f'input {number}') from error
    assert 0.02 < np.mean(readable) < 0.98


@pytest.fixture(autouse=True)
def quiet(caplog):
    caplog.set_level(logging.CRITICAL, 'sfa_localization')


WHOLE = ['version 5', 'version 9', 'lone mcap, zstd', 'lone mcap, lz4', 'lone mcap, neither',
         'ROS 1 lz4', 'sqlite3 zstd file', 'mcap zstd file', 'mcap zstd message']  # fmt: skip


def read_streams(path: Path) -> None:
    with Bag(path) as bag:
        for kind in KINDS:
            is_read(lambda kind=kind: bag.find(kind))
        assert all(image.ndim == 3 for _, image in bag.images('/image_raw'))
        assert np.isfinite(read_odometry(bag, '/odom').poses).all()
        rates = bag.read([bag.stream(bag.find('imu', '/imu'), read_yaw_rate)])
        assert np.isfinite([rate for _, _, rate in rates]).all()
        bag.trajectory('/ground_truth')


def test_damaged_bags(tmp_path):
    """Of every format; their files and their metadata."""
    messages = drive(tmp_path)[:90]
    for name in WHOLE:
        FORMATS[name](tmp_path / name, messages)

    def use(random: Random) -> bool:
        whole = tmp_path / WHOLE[random.integers(len(WHOLE))]
        bag = Path(shutil.copytree(whole, tmp_path / f'bag {random.integers(10**9)}'))
        file = bag / random.choice(sorted(os.listdir(bag)))
        content = file.read_bytes()
        if file.name == METADATA and random.random() < 0.5:
            file.write_bytes(spoilt(content.decode(), random).encode())
        else:
            file.write_bytes(damaged(content, random))
        readable = is_read(lambda: read_streams(bag))
        readable = is_read(lambda: inspect(bag)) or readable
        shutil.rmtree(bag)
        return readable

    check(use)


def test_damaged_models(trained, tmp_path):
    """Hardly any can be read: each part has its checksum."""
    whole, path = trained.model.read_bytes(), tmp_path / 'model.npz'
    for number in range(INPUTS):
        path.write_bytes(damaged(whole, np.random.default_rng(number)))
        is_read(lambda: PlaceModel.load(path))


def test_damaged_texts(tmp_path):
    """Of parameter files, calibrations and metadata."""
    changes = 'sfa_node:\n  ros__parameters:\n    model: a.npz\n    map_frame: map\n'
    metadata = (write_version(tmp_path / 'bag', drive(tmp_path)[:20], 5) / METADATA).read_text()
    texts, path = [render(), changes, echoed(), OCAM, metadata], tmp_path / 'file.yaml'

    def use(random: Random) -> bool:
        text = spoilt(texts[random.integers(len(texts))], random)
        path.write_bytes(text.encode('utf-8', 'surrogatepass'))
        return any([
            is_read(lambda: load_changes(path)),
            is_read(lambda: load_settings(path, 'omnicam_node', CameraConfig)),
            is_read(lambda: read_calibration(path)),
            is_read(lambda: parse_metadata(text), ValueError),
        ])  # fmt: skip

    check(use)


def test_damaged_images(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (37, 53, 3), np.uint8)
    whole = [cv2.imencode(end, image)[1].tobytes() for end in ('.png', '.jpg', '.bmp', '.tiff')]
    path = tmp_path / 'mask.png'

    def use(random: Random) -> bool:
        data = damaged(whole[random.integers(len(whole))], random)
        path.write_bytes(data)
        readable = is_read(lambda: decode_compressed(data, 'bgr8; jpeg compressed bgr8'))
        return is_read(lambda: read_mask(str(path), (53, 37))) or readable

    check(use)
