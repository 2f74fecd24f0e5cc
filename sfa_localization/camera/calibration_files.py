# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files: the package's native ones, and those of other tools.

A native file is YAML with the fields of `LensCalibration`. Others: camera_info as YAML (as printed
by ``ros2 topic echo``, or ost.yaml), OpenCV's FileStorage (pinhole, fisheye, omnidir; YAML or XML),
Kalibr's camchain, camodocal, stella_vslam, ORB-SLAM3, and OCamCalib's calib_results.txt.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from sfa_localization.camera.settings import NEEDS_CALIBRATION, CameraConfig, LensCalibration
from sfa_localization.data.errors import CameraError, ConfigError
from sfa_localization.data.files import read_regular
from sfa_localization.data.plain_yaml import load_yaml
from sfa_localization.data.rejections import quoted, short_line

_SUPPORTED = (
    'supported are camera_info, OpenCV, Kalibr, camodocal, stella_vslam and ORB-SLAM3 YAML, OpenCV '
    'XML, OCamCalib calib_results.txt, and what the command calibrate writes'
)
_OF_EVERY_CAMERA = ('camera_model', 'image_width', 'image_height', 'cx', 'cy', 'radius_min',
                    'radius_max', 'axis', 'mirrored', 'mount_rpy')  # fmt: skip
_OF_MODEL = {
    'mirror': ('fx', 'fy', 'xi', 'distortion'),
    'fisheye': ('fx', 'fy', 'distortion'),
    'ocam': ('polynomial', 'affine'),
    'polar': ('angle_min', 'angle_max'),
    'dual_fisheye': (
        'fx',
        'fy',
        'distortion',
        'second_cx',
        'second_cy',
        'second_focal',
        'second_distortion',
        'second_roll',
        'second_tilt',
    ),
    'equirectangular': ('elevation_min', 'elevation_max'),
}
_OPTIONAL = {'distortion', 'affine', 'second_focal', 'second_distortion', 'second_tilt'}
_LARGEST_FILE = 1 << 20  # bytes: hundreds of times the largest calibration
CALIBRATION_TITLE = '# Calibration of an omnidirectional camera'
_HEAD = f"""\
{CALIBRATION_TITLE}; omnicam_node reads it by its parameter calibration_file.
"""

# Names that programs give to the same things; the first in a file counts.
_PARTS = {'Camera', 'Camera1', 'cam0', 'mirror_parameters', 'distortion_parameters',
          'projection_parameters'}  # fmt: skip
_MATRIX = ('camera_matrix', 'K', 'k', 'cameraMatrix', 'intrinsics')
_FOCAL = (('fx', 'gamma1', 'mu'), ('fy', 'gamma2', 'mv'), ('cx', 'u0'), ('cy', 'v0'))
_COEFFICIENTS = ('distortion_coefficients', 'D', 'd', 'distCoeffs', 'dist_coeffs',
                 'distortion_coeffs')  # fmt: skip
_SIZES = (('image_width', 'width', 'cols'), ('image_height', 'height', 'rows'))
_KINDS = ('camera_model', 'model_type', 'model', 'type', 'distortion_model')
_MIRRORS = {'mei', 'omni'}
_FISHEYES = {'equidistant', 'equi', 'fisheye', 'kannala_brandt', 'kannalabrandt8'}
_PLAIN = {'none', 'pinhole', 'perspective'}
_PINHOLES = _PLAIN | {'', 'plumb_bob', 'radtan', 'rational_polynomial'}


def calibration_of(camera: CameraConfig) -> LensCalibration:
    """The lens that the camera's parameters name: its calibration_file, or its camera_model.

    Raises CameraError where they name none.
    """
    if camera.calibration_file:
        return read_calibration(Path(camera.calibration_file))
    if not camera.camera_model:
        raise CameraError(
            'images are no panoramas, and no camera is described: set the parameter model to the '
            'model that was trained on images of this camera; or describe its lens by '
            'calibration_file or camera_model, or by camera_info beside the images'
        )
    return LensCalibration(camera_model=camera.camera_model)


def calibration_text(calibration: LensCalibration) -> str:
    """The native calibration file (YAML): every field that the camera model uses."""
    names = _OF_EVERY_CAMERA + _OF_MODEL.get(calibration.camera_model, ())
    values = [getattr(calibration, name) for name in names]
    plain = [list(value) if isinstance(value, tuple) else value for value in values]
    fields = yaml.safe_dump(dict(zip(names, plain, strict=True)), sort_keys=False)
    return _HEAD + str(fields)


def read_calibration(path: Path) -> LensCalibration:
    """Read a calibration file; without radii in it, all of the image is visible.

    Raises CameraError naming the file when it is missing, or of an unknown kind or camera model.
    """
    try:
        text = read_regular(path, _LARGEST_FILE).decode('utf-8', errors='replace')
        fields = _from_ocam(text) if path.suffix.lower() == '.txt' else _from_names(text)
        return LensCalibration(**{'radius_min': 0.0, 'radius_max': 0.0, **fields})
    except OSError as error:
        raise CameraError(f'{path}: {error.strerror or error}') from None
    except (TypeError, ValueError, OverflowError) as error:
        raise CameraError(
            f'{path}: no camera calibration ({short_line(str(error))}); {_SUPPORTED}'
        ) from None
    except (CameraError, ConfigError) as error:
        raise CameraError(f'{path}: {error}') from None


def calibration_of_info(info: Any) -> LensCalibration:
    """The lens in a message with the fields of sensor_msgs/CameraInfo. Raises CameraError."""
    named = {name: getattr(info, name) for name in ('width', 'height', 'distortion_model')}
    try:
        lens = _from_others({**named, 'k': list(info.k), 'd': list(info.d)})
        if info.roi.width and info.roi.height:  # columns and rows that the image has
            lens['cx'], lens['cy'] = lens['cx'] - info.roi.x_offset, lens['cy'] - info.roi.y_offset
            lens['image_width'] = info.roi.width
            lens['image_height'] = info.roi.height
        return LensCalibration(**{'radius_min': 0.0, 'radius_max': 0.0, **lens})
    except (ConfigError, CameraError) as error:
        raise CameraError(f'{error}; or describe the camera by a calibration_file') from None


def _from_ocam(text: str) -> dict[str, Any]:
    """OCamCalib's rows: polynomial, its inverse, center (row, column), c d e, size (H, W)."""
    rows = [line.split() for line in text.splitlines() if line.strip() and line.strip()[0] != '#']
    numbers = [[float(entry) for entry in row] for row in rows]
    if len(numbers) < 5 or int(numbers[0][0]) != len(numbers[0]) - 1:
        raise CameraError('not the five rows of OCamCalib calib_results.txt')
    cy, cx = numbers[2]
    height, width = numbers[4]
    size = {'image_width': int(width), 'image_height': int(height)}
    lens = {'polynomial': tuple(numbers[0][1:]), 'affine': tuple(numbers[3])}
    return {'camera_model': 'ocam', 'cx': cx, 'cy': cy, **size, **lens}


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Plain YAML, and the matrices of OpenCV's FileStorage as mappings."""


_Loader.add_constructor(
    'tag:yaml.org,2002:opencv-matrix',
    _Loader.construct_yaml_map,  # type: ignore[type-var]
)


def _from_names(text: str) -> dict[str, Any]:
    """A file of names and values, YAML or XML."""
    text = re.sub(r'\A%YAML:1\.0\s*', '', text)
    try:
        # A topic that is echoed ends each message with a document mark.
        content = _xml(text) if text[:1] == '<' else load_yaml(text, _Loader, first=True)
    except ValueError as error:
        raise CameraError(f'{error}; {_SUPPORTED}') from None
    if not isinstance(content, Mapping):
        raise CameraError(f'no camera calibration; {_SUPPORTED}')
    if 'camera_model' not in content or set(_MATRIX) & set(content):
        return _from_others(_flat(content))
    model = content['camera_model']
    needed = ('cx', 'cy', *_OF_MODEL.get(model, ())) if model in NEEDS_CALIBRATION else ()
    missing = [name for name in needed if name not in {*content, *_OPTIONAL}]
    if missing:
        raise CameraError(f'{", ".join(missing)} missing, which the {model} model needs')
    LensCalibration.from_mapping(content, 'calibration')  # rejects unknown names
    return dict(content)


def _xml(text: str) -> dict[str, Any]:
    """What OpenCV's FileStorage writes as XML. Raises ValueError."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f'is not XML ({error})') from None
    return {part.tag: (part.findtext('data') or part.text or '').split() for part in root}


def _flat(content: Mapping[Any, Any]) -> dict[str, Any]:
    """Names and values of a file, with those of its parts about the camera."""
    named: dict[str, Any] = {}
    for key, value in content.items():
        part, _, name = str(key).partition('.')
        if part in _PARTS and isinstance(value, Mapping):
            named = {**_flat(value), **named}
        else:
            named.setdefault(name if part in _PARTS and name else str(key), value)
    return named


def _from_others(named: Mapping[str, Any]) -> dict[str, Any]:
    """The lens in a file of another program."""
    kinds = {str(named[name]).lower() for name in _KINDS if name in named}
    if 'equirectangular' in kinds:
        return {'camera_model': 'equirectangular'}
    if any(_given(named, 'fisheye_model')):
        kinds = {'fisheye'}
    numbers = _given(named, *_MATRIX)
    xi = _given(named, 'xi')
    has_mirror = bool(xi or kinds & _MIRRORS)
    unknown = kinds - _PINHOLES - (_MIRRORS if has_mirror else _FISHEYES)
    if unknown:
        raise CameraError(
            f'camera model {quoted(" ".join(sorted(unknown)))} is not supported; use another: '
            'omni or MEI, equidistant or KANNALA_BRANDT, or a pinhole with radtan'
        )
    if has_mirror and len(numbers) == 5:
        xi = numbers[:1]
        numbers = numbers[1:]
    fisheye = not has_mirror and bool(kinds & _FISHEYES)
    lens = {
        **_focal_and_center(named, numbers),
        **dict(zip(('image_width', 'image_height'), _size(named), strict=True)),
        'distortion': _distortion(named, kinds, fisheye),
    }
    if fisheye:
        return {'camera_model': 'fisheye', **lens}
    if has_mirror:
        return {'camera_model': 'mirror', 'xi': _required({'xi': xi}, 'xi'), **lens}
    # A pinhole camera: not mirrored, and pointed forward.
    return {'camera_model': 'mirror', 'xi': 0.0, 'mirrored': 'no', 'axis': 'forward', **lens}


def _focal_and_center(named: Mapping[str, Any], numbers: list[float]) -> dict[str, float]:
    """Focal lengths and center by the numbers of a matrix or, without any, by their names."""
    if len(numbers) == 9:
        numbers = [numbers[0], numbers[4], numbers[2], numbers[5]]
    numbers = numbers or [_required(named, *names) for names in _FOCAL]
    if len(numbers) != 4:
        raise CameraError(f'{len(numbers)} numbers of focal lengths and center, not 4')
    if numbers[0] == 0.0:
        raise CameraError('the camera is not calibrated: its focal length is 0')
    return dict(zip(('fx', 'fy', 'cx', 'cy'), numbers, strict=True))


def _distortion(named: Mapping[str, Any], kinds: set[str], fisheye: bool) -> tuple[float, ...]:
    """The four coefficients, none where all are 0; only a plain pinhole may omit them."""
    names = ('k1', 'k2', 'k3', 'k4') if fisheye else ('k1', 'k2', 'p1', 'p2')
    names = ('k2', 'k3', 'k4', 'k5') if fisheye and 'k5' in named else names  # camodocal's
    if set(_COEFFICIENTS) & set(named):
        numbers = _given(named, *_COEFFICIENTS)
    elif kinds and kinds <= _PLAIN:
        numbers = [_required({name: 0.0, **named}, name) for name in (*names, 'k3')]
    else:
        numbers = [_required(named, name) for name in names]
    if any(numbers[4:]):
        raise CameraError(f'{len(numbers)} coefficients of distortion; only 4 are supported')
    return tuple((numbers + [0.0] * 4)[:4]) if any(numbers) else ()


def _size(named: Mapping[str, Any]) -> list[int]:
    """Columns and rows, 0 where they are not given."""
    size = _given(named, 'resolution')
    if not size and any(_given(named, *names) for names in _SIZES):
        size = [_required(named, *names) for names in _SIZES]
    return [int(number) for number in size or (0, 0)]


def _given(named: Mapping[str, Any], *names: str) -> list[float]:
    """The numbers of the first of the names in the file; none without any of them."""
    return next((_numbers(named[name]) for name in names if name in named), [])


def _required(named: Mapping[str, Any], *names: str) -> float:
    numbers = _given(named, *names)
    if len(numbers) != 1:
        raise CameraError(f'no number {" or ".join(names)} is given; {_SUPPORTED}')
    return numbers[0]


def _numbers(value: Any) -> list[float]:
    """Flatten a number, nested lists, or a matrix with `data` to floats."""
    if isinstance(value, Mapping):
        return _given(value, 'data')
    if isinstance(value, (list, tuple)):
        return [number for entry in value for number in _numbers(entry)]
    return [float(value)]
