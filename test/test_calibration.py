# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Finding the mirror, and the command `calibrate` from another file to a calibration file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from real_cameras import DESK_CENTER, DESK_RADII, desk_mirror, ordinary
from test_calibration_files import kalibr

from sfa_localization import cli
from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera.calibration import check_image, find_circles
from sfa_localization.camera.calibration_files import read_calibration
from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.settings import CameraConfig, PanoramaConfig
from sfa_localization.data.errors import CameraError

CENTER, RADII = (330.3, 241.7), (42.0, 205.0)


def scene(seed, background=10.0, center=CENTER, radii=RADII, size=(480, 640)):
    """A textured ring, as a mirror shows the world, before a background; sub-pixel edges."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(70, 256, (24, 32, 3), np.uint8)
    texture = cv2.resize(coarse, size[::-1], interpolation=cv2.INTER_CUBIC).astype(float)
    rows, columns = np.mgrid[: size[0], : size[1]]
    radius = np.hypot(columns - center[0], rows - center[1])
    ring = np.clip(radius - radii[0] + 0.5, 0, 1) * np.clip(radii[1] - radius + 0.5, 0, 1)
    picture = texture * ring[..., None] + background * (1 - ring[..., None])
    return np.clip(picture + rng.normal(0, 3, picture.shape), 0, 255).astype(np.uint8)


def assert_circles(circles, center=CENTER, radii=RADII, atol=1.0, hole_atol=2.0):
    rim, hole = circles.rim, circles.hole
    assert_allclose((rim.column, rim.row, rim.radius), (*center, radii[1]), atol=atol)
    assert_allclose((hole.column, hole.row, hole.radius), (*center, radii[0]), atol=hole_atol)


def test_a_mirror_on_a_dark_and_on_a_bright_still_background():
    """The latter is brighter than the mirror; only change distinguishes it."""
    circles = find_circles([scene(1)])
    assert_circles(circles)
    assert find_circles([scene(1)]) == circles
    still = np.full((480, 640, 1), 200.0)
    still[::8] = 60
    assert_circles(find_circles([scene(n, still) for n in range(8)]), atol=3.0)


def test_a_rim_that_the_image_cuts_off_and_a_mirror_without_a_hole():
    rim = find_circles([scene(1, center=(330.0, 200.0), radii=(42.0, 260.0))]).rim
    assert_allclose((rim.column, rim.row, rim.radius), (330, 200, 260), atol=2.0)
    assert find_circles([scene(1, radii=(0.0, 200.0))]).hole is None


def test_images_without_a_mirror_are_rejected():
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    for picture in (0 * noise, 0 * noise + 255, noise, np.full((3, 9000, 3), 10, np.uint8)):
        with pytest.raises(CameraError, match='stands out'):
            find_circles([picture])


@pytest.mark.parametrize('soft', [0.03, 0.1])
def test_a_soft_rim_is_detected_at_any_resolution(soft):
    center, radius = (240.7, 239.0), 245.8  # the border cuts it off by 2 %
    rows, columns = np.mgrid[:480, :480]
    off = np.hypot(columns - center[0], rows - center[1]) / radius - 1
    texture = np.random.default_rng(0).uniform(40, 230, (24, 24, 3)).astype(np.float32)
    light = 1 / (1 + np.exp(np.clip(4 * off / soft, -50, 50)))
    picture = cv2.resize(texture, (480, 480), interpolation=cv2.INTER_CUBIC) * light[..., None]
    for side in (480, 2880):
        image = cv2.resize(np.clip(picture, 0, 255).astype(np.uint8), (side, side))
        rim, scale = find_circles([image]).rim, side / 480
        circle = np.array([rim.column, rim.row, rim.radius]) / scale
        assert_allclose(circle, (*center, radius), atol=0.015 * radius)


@pytest.mark.parametrize(('count', 'turns'), [(1, 'mirror'), (8, 'mirror'), (8, 'picture')])
def test_a_real_mirror_in_its_housing(count, turns):
    """Around it lie a dark tube and bright walls, and it shows dark things, too."""
    circles = find_circles(list(desk_mirror(count, turns=turns)))
    assert_circles(circles, DESK_CENTER, DESK_RADII, atol=3.0, hole_atol=3.0)


@pytest.mark.parametrize('count', [1, 8])
@pytest.mark.parametrize('size', [(240, 320), (320, 320)])
def test_an_ordinary_camera_has_no_circle(count, size):
    with pytest.raises(CameraError, match='3 or more, not 1' if count == 1 else 'others'):
        find_circles(list(ordinary(count, size=size)))


@pytest.fixture
def picture(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cv2.imwrite('raw.png', scene(1))
    return 'raw.png'


INFO = """\
{image_width: 640, image_height: 480, distortion_model: equidistant,
 camera_matrix: {data: [130, 0, 330, 0, 130, 241, 0, 0, 1]},
 distortion_coefficients: {data: [0.01, 0, 0, 0]}}
"""


def test_from_another_file_to_a_calibration_file(picture, capsys):
    Path('info.yaml').write_text(INFO)
    words = ['calibrate', picture, '--calibration', 'info.yaml', '--radii', '40x200']
    words += ['--output', 'made/camera.yaml', '--check', 'check.png', '--mount-rpy', '0x0x90']
    assert cli.main(words) == 0
    lens = read_calibration(Path('made/camera.yaml'))
    assert (lens.camera_model, lens.cx, lens.radius_max) == ('fisheye', 330.0, 200.0)
    assert lens.mount_rpy == (0.0, 0.0, 90.0)
    assert capsys.readouterr().out == Path('made/camera.yaml').read_text()
    result = Unwrapper(CameraConfig(calibration_file='made/camera.yaml'), PanoramaConfig())
    other = CameraConfig(calibration_file='made/camera.yaml', mount_rpy=(0.0, 0.0, 45.0))
    turned = Unwrapper(other, PanoramaConfig())
    shifted = np.roll(turned(scene(1)), -75, axis=1).astype(int)
    assert np.abs(shifted - result(scene(1))).mean() < 2.0


def test_bad_input_is_one_line_and_nothing_written(picture, tmp_path, capsys):
    with BagWriter(tmp_path / 'bag') as bag:
        for index, image in enumerate(desk_mirror(4)):
            bag.image('/images', (index + 1) * 10**8, image, 'camera', 'jpeg')
    Path('other.yaml').write_text(kalibr('pinhole', [1, 2, 3, 4], 'radtan', (480, 480)))
    for arguments, words in {
        '': 'give the bag of one drive', 'raw.png': 'images alone do not show the lens',
        'missing.png --calibration other.yaml': 'missing.png', 'bag bag': 'the bag of one drive',
        'bag': 'has no odometry', 'bag --axis up': 'give --calibration',
        'raw.png --calibration other.yaml': 'add the columns and rows cut off',
        'raw.png --calibration other.yaml --radii 9x3': '--radii takes INNERxOUTER',
        '--calibration other.yaml --check a.png': '--check needs an image',
    }.items():  # fmt: skip
        assert cli.main(['calibrate', *arguments.split(), '--output', 'camera.yaml']) == 1
        printed, error = capsys.readouterr()
        assert words in error and printed == '', arguments
        assert not Path('camera.yaml').exists()


def test_the_check_image_marks_the_directions():
    """Red spokes leave the center upwards (front) and to the right (left, in a mirror)."""
    unwrapper = Unwrapper(CameraConfig(camera_model='mirror'), PanoramaConfig())
    drawn = check_image(np.zeros((640, 640, 3), np.uint8), unwrapper)
    assert drawn.shape[1] == 1200
    raw = drawn[:640, 280:920].astype(int)
    red = (raw[..., 2] > 150) & (raw[..., 1] < 100)
    assert red[60:180, 319:321].any(axis=1).all()
    assert red[319:321, 460:590].any(axis=0).all()
