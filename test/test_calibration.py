# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Finding the mirror, and the command `calibrate` from images to a calibration file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from real_cameras import DESK_CENTER, DESK_RADII, desk_mirror, ordinary
from test_calibration_files import kalibr

from sfa_localization import cli
from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera.calibration import (
    calibrate,
    check_image,
    find_circles,
    given_circle,
)
from sfa_localization.camera.calibration_files import read_calibration
from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.settings import CalibrationConfig, CameraConfig, PanoramaConfig
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
    np.testing.assert_allclose((rim.column, rim.row, rim.radius), (*center, radii[1]), atol=atol)
    np.testing.assert_allclose(
        (hole.column, hole.row, hole.radius), (*center, radii[0]), atol=hole_atol
    )


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
    np.testing.assert_allclose((rim.column, rim.row, rim.radius), (330, 200, 260), atol=2.0)
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
        np.testing.assert_allclose(circle, (*center, radius), atol=0.015 * radius)


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


def test_from_images_to_a_calibration_file(picture, capsys):
    arguments = ['calibrate', picture, '--output', 'made/camera.yaml', '--check', 'check.png']
    assert cli.main([*arguments, '--angle-min', '70', '--angle-max', '120']) == 0
    lens = read_calibration(Path('made/camera.yaml'))
    assert (lens.camera_model, lens.image_width, lens.image_height) == ('polar', 640, 480)
    assert lens.cx == pytest.approx(CENTER[0], abs=1.0)
    assert lens.radius_max == pytest.approx(RADII[1], abs=1.0)
    assert (lens.angle_min, lens.angle_max) == (70.0, 120.0)
    result = Unwrapper(CameraConfig(calibration_file='made/camera.yaml'), PanoramaConfig())
    assert result(scene(1)).min() > 30  # no background inside the panorama
    assert 'camera_model: polar' in capsys.readouterr().out
    arguments = ['calibrate', picture, '--output', 'camera.yaml']
    assert cli.main([*arguments, '--model', 'fisheye', '--field-of-view', '200']) == 0
    lens = read_calibration(Path('camera.yaml'))
    assert lens.camera_model == 'fisheye'
    assert lens.fx == pytest.approx(RADII[1] / np.radians(100), rel=0.01)


def test_from_a_bag_to_a_calibration_file_and_a_look(tmp_path, capsys):
    """The circle of a real mirror; where the horizon lies nobody knows, so a look is asked for."""
    check = tmp_path / 'check.png'
    with BagWriter(tmp_path / 'bag') as bag:
        for index, picture in enumerate(desk_mirror(8)):
            bag.image('/images', (index + 1) * 10**8, picture, 'camera', 'jpeg')
    words = ['calibrate', str(tmp_path / 'bag'), '--output', str(tmp_path / 'camera.yaml')]
    assert cli.main([*words, '--check', str(check)]) == 0
    printed, asked = capsys.readouterr()
    assert yaml.safe_load(printed)['radius_max'] == pytest.approx(DESK_RADII[1], abs=2.0)
    assert asked.splitlines()[-1] == f'look at {check}: does the horizon lie on its line?'
    strip = cv2.imread(str(check))[270:].astype(int)
    green = (strip[..., 1] > 150) & (strip[..., 2] < 120)
    lines = np.flatnonzero(green.mean(axis=1) > 0.7) / len(strip) * 36 - 24  # degrees down
    assert [np.abs(lines - angle).min() < 0.5 for angle in (-20, -10, 0, 10)] == [True] * 4
    assert cli.main([*words, str(tmp_path / 'bag')]) == 1
    assert 'give one bag, or images' in capsys.readouterr().err


def test_bad_input_is_one_line_and_nothing_written(picture, capsys):
    cv2.imwrite('small.png', scene(1)[:100])
    cv2.imwrite('filled.png', scene(1, radii=(0.0, 200.0)))
    Path('other.yaml').write_text(kalibr('pinhole', [1, 2, 3, 4], 'radtan', (480, 480)))
    for arguments, words in {
        '': 'give images', 'missing.png': 'missing.png', 'other.yaml': 'other.yaml',
        'raw.png small.png': 'image 2 differs in size', 'raw.png --center 3': '--radii',
        'filled.png': 'inner circle', 'raw.png --angle-min 120 --angle-max 80': 'angle_min',
        'raw.png --calibration other.yaml': 'add the columns and rows cut off',
    }.items():  # fmt: skip
        assert cli.main(['calibrate', *arguments.split(), '--output', 'camera.yaml']) == 1
        printed, error = capsys.readouterr()
        assert words in error and printed == '' and '\n' not in error.strip()
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


def test_a_rim_may_lie_partly_outside_the_image_but_not_wholly():
    picture = np.zeros((480, 640, 3), np.uint8)
    for center in ((0.0, 480.0), (640.0, 240.0)):
        farthest = float(np.hypot(max(center[0], 640 - center[0]), max(center[1], 480 - center[1])))
        circle = given_circle(center, (40.0, farthest - 1))
        assert calibrate([picture], None, CalibrationConfig(), circle).cx == center[0]
        for wrong in ((center, (40.0, farthest + 1)), ((-1.0, 240.0), (4.0, 9.0))):
            with pytest.raises(CameraError, match='not in an image of 640x480 pixels'):
                calibrate([picture], None, CalibrationConfig(), given_circle(*wrong))
    for center, radii in (((1.0, 2.0), (5.0, 4.0)), ((9.0,), None), (None, (1.0, float('nan')))):
        with pytest.raises(CameraError, match='--radii takes INNERxOUTER'):
            given_circle(center, radii)
