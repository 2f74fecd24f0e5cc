# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files: the package's own, and those of other tools.

The package's own is YAML with the fields of `LensCalibration`. Of other tools: camera_info as YAML
(also as printed by ``ros2 topic echo``, and camera_calibration's ost.yaml), what OpenCV's
FileStorage writes (pinhole, fisheye, omnidir; YAML or XML), Kalibr's camchain, camodocal's MEI and
KANNALA_BRANDT, stella_vslam, ORB-SLAM3, and OCamCalib's calib_results.txt.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from sfa_localization.camera.settings import CameraConfig, LensCalibration
from sfa_localization.data.errors import CameraError, ConfigError
from sfa_localization.data.files import read_regular
from sfa_localization.data.plain_yaml import load_yaml
from sfa_localization.data.rejections import short_line

_KNOWN = (
    'known are camera_info, OpenCV, Kalibr, camodocal, stella_vslam and ORB-SLAM3 YAML, OpenCV '
    'XML, OCamCalib calib_results.txt, and what the command calibrate writes'
)
_PLUMB_BOB = ('', 'none', 'plumb_bob', 'radtan', 'rational_polynomial')
_SLAM = {'Camera', 'Camera1'}
_FISHEYE = ('equidistant', 'equi', 'fisheye', 'kannala_brandt')
_OF_EVERY_CAMERA = (
    *('camera_model', 'image_width', 'image_height', 'cx', 'cy', 'radius_min', 'radius_max'),
    *('axis', 'mirrored'),
)
_OF_MODEL = {
    'mirror': ('fx', 'fy', 'xi', 'distortion'),
    'fisheye': ('fx', 'fy', 'distortion'),
    'ocam': ('polynomial', 'affine'),
    'polar': ('angle_min', 'angle_max'),
    'dual_fisheye': ('fx', 'fy', 'distortion', 'second_cx', 'second_cy', 'second_roll'),
}
LARGEST_FILE = 1 << 20
"""Bytes of a calibration file: hundreds of times the largest."""
CALIBRATION_TITLE = '# Calibration of an omnidirectional camera'
_HEAD = f"""\
{CALIBRATION_TITLE}; parameters of omnicam_node that go with it:
#   calibration_file: name of this file
#   mount_rpy: {{mount_rpy}}
"""


def calibration_of(camera: CameraConfig) -> LensCalibration:
    """The lens that the camera's parameters name: its calibration_file, or its camera_model.

    Raises CameraError where they name none.
    """
    if camera.calibration_file:
        return read_calibration(Path(camera.calibration_file))
    if not camera.camera_model:
        raise CameraError(
            'images are no panoramas, and no camera is described: in the parameter file set '
            'calibration_file (see the command calibrate), or camera_model to equirectangular or '
            'panorama, in the section /**/omnicam_node; inspect prints what to write'
        )
    return LensCalibration(camera_model=camera.camera_model)


def calibration_text(calibration: LensCalibration, mount_rpy: Sequence[float]) -> str:
    """The package's own calibration file (YAML): every field that the camera model uses."""
    names = _OF_EVERY_CAMERA + _OF_MODEL.get(calibration.camera_model, ())
    fields = {name: getattr(calibration, name) for name in names}
    plain = {n: list(value) if isinstance(value, tuple) else value for n, value in fields.items()}
    text = _HEAD.format(mount_rpy=list(mount_rpy))
    return text + str(yaml.safe_dump(plain, sort_keys=False))


def read_calibration(path: Path) -> LensCalibration:
    """Read a calibration file; radii that it does not name limit nothing.

    Raises CameraError naming the file when it is missing, of an unknown kind, or of a camera
    model that is not supported.
    """
    try:
        text = read_regular(path, LARGEST_FILE).decode('utf-8', errors='replace')
    except OSError as error:
        raise CameraError(f'{path}: {error.strerror or error}') from None
    try:
        fields = _from_yaml(text) if path.suffix.lower() != '.txt' else _from_ocam(text)
        return LensCalibration(**{'radius_min': 0.0, 'radius_max': 0.0, **fields})
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError) as error:
        reason = short_line(str(error) + (' is missing' if isinstance(error, KeyError) else ''))
        raise CameraError(f'{path}: no camera calibration ({reason}); {_KNOWN}') from None
    except (CameraError, ConfigError) as error:
        raise CameraError(f'{path}: {error}') from None


def _from_ocam(text: str) -> dict[str, Any]:
    """OCamCalib's rows: polynomial, its inverse, center (row, column), c d e, size (H, W)."""
    rows = [line.split() for line in text.splitlines() if line.strip() and line.strip()[0] != '#']
    numbers = [[float(entry) for entry in row] for row in rows]
    if len(numbers) < 5 or int(numbers[0][0]) != len(numbers[0]) - 1:
        raise CameraError('not the five rows of OCamCalib calib_results.txt')
    (cy, cx), (height, width) = numbers[2], numbers[4]
    return {
        'camera_model': 'ocam',
        'polynomial': tuple(numbers[0][1:]),
        'affine': tuple(numbers[3]),
        'cx': cx,
        'cy': cy,
        'image_width': int(width),
        'image_height': int(height),
    }


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Plain YAML, and the matrices of OpenCV's FileStorage as mappings."""


def _matrix_node(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    return dict(loader.construct_mapping(node, deep=True))


_Loader.add_constructor('tag:yaml.org,2002:opencv-matrix', _matrix_node)


def _from_yaml(text: str) -> dict[str, Any]:
    text = re.sub(r'\A%YAML:1\.0\s*', '', text)
    try:
        # A topic that is echoed ends each message with a document mark.
        content = _xml(text) if text[:1] == '<' else load_yaml(text, _Loader, first=True)
    except ValueError as error:
        raise CameraError(f'{error}; {_KNOWN}') from None
    if not isinstance(content, Mapping):
        raise CameraError(f'no camera calibration; {_KNOWN}')
    if any(str(key).partition('.')[0] in _SLAM for key in content):
        return _from_slam(content)
    if 'camera_model' in content and not {'camera_matrix', 'K', 'k'} & set(content):
        return _from_own(content)
    if 'cam0' in content:
        return _from_kalibr(content['cam0'])
    if 'model_type' in content:
        return _from_camodocal(content)
    return _from_matrix(content)


def _xml(text: str) -> dict[str, Any]:
    """What OpenCV's FileStorage writes as XML. Raises ValueError."""
    if '<!' in re.sub('<!--.*?-->', '', text, flags=re.DOTALL):
        raise ValueError('XML with definitions of its own')  # which may grow without limit
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f'is not XML ({error})') from None
    return {part.tag: (part.findtext('data') or part.text or '').split() for part in root}


def _from_slam(content: Mapping[str, Any]) -> dict[str, Any]:
    """stella_vslam, and ORB-SLAM3: entries Camera.fx or Camera1.fx, or fx below Camera."""
    camera: dict[str, Any] = {}
    for key, value in content.items():
        head, _, name = str(key).partition('.')
        if head in _SLAM:
            camera |= {name: value} if name else dict(value)
    model = str(camera.get('model', camera.get('type', ''))).lower()
    if model == 'equirectangular':
        return {'camera_model': model}
    names = {'perspective': ('k1', 'k2', 'p1', 'p2', 'k3'), 'fisheye': ('k1', 'k2', 'k3', 'k4')}
    names |= {'pinhole': names['perspective'], 'kannalabrandt8': names['fisheye']}
    if model not in names:
        raise CameraError(f'camera model {model!r} of a SLAM program is not supported')
    focal = [float(camera[key]) for key in ('fx', 'fy', 'cx', 'cy')]
    distortion = [float(camera.get(key, 0.0)) for key in names[model]]
    kind = 'fisheye' if names[model] == names['fisheye'] else 'plumb_bob'
    size = (camera.get(a, camera.get(b, 0)) for a, b in (('cols', 'width'), ('rows', 'height')))
    return {**_lens(kind, focal, distortion), **_size(*size)}


def _from_own(content: Mapping[str, Any]) -> dict[str, Any]:
    """What `calibration_text` wrote, or a person in its place."""
    model = content['camera_model']
    missing = [name for name in ('cx', 'cy', *_OF_MODEL.get(model, ())) if name not in content]
    if missing and model in _OF_MODEL:
        raise CameraError(f'{", ".join(missing)} missing, which the {model} model needs')
    LensCalibration.from_mapping(content, 'calibration')  # rejects unknown names
    return dict(content)


def _from_kalibr(camera: Mapping[str, Any]) -> dict[str, Any]:
    model = camera['camera_model']
    numbers = _numbers(camera['intrinsics'])
    if model not in ('omni', 'pinhole'):
        raise CameraError(
            f'Kalibr camera model {model!r} is not supported; calibrate with omni-radtan or '
            'pinhole-equi'
        )
    xi = numbers.pop(0) if model == 'omni' else 0.0
    distortion = _numbers(camera.get('distortion_coeffs', []))
    kind = str(camera.get('distortion_model', 'none'))
    return {
        **_lens(kind, numbers, distortion, xi, has_mirror=model == 'omni'),
        **_size(*camera['resolution']),
    }


def _from_camodocal(content: Mapping[str, Any]) -> dict[str, Any]:
    kind, projection = str(content['model_type']).upper(), content['projection_parameters']
    size = _size(content['image_width'], content['image_height'])
    if kind == 'MEI':
        focal = [projection[name] for name in ('gamma1', 'gamma2', 'u0', 'v0')]
        distortion = [content['distortion_parameters'][name] for name in ('k1', 'k2', 'p1', 'p2')]
        xi = float(content['mirror_parameters']['xi'])
        return {**_lens('radtan', _numbers(focal), _numbers(distortion), xi, True), **size}
    if kind == 'KANNALA_BRANDT':
        focal = [projection[name] for name in ('mu', 'mv', 'u0', 'v0')]
        distortion = [projection[name] for name in ('k2', 'k3', 'k4', 'k5')]
        return {**_lens('equidistant', _numbers(focal), _numbers(distortion)), **size}
    raise CameraError(f'camodocal model {kind} is not supported; use MEI or KANNALA_BRANDT')


def _from_matrix(content: Mapping[str, Any]) -> dict[str, Any]:
    """camera_info and OpenCV: a camera matrix, coefficients, and a name for their model."""
    matrix = _numbers(_first(content, 'camera_matrix', 'K', 'k', 'cameraMatrix', 'intrinsics'))
    if len(matrix) != 9:
        raise CameraError(f'the camera matrix has {len(matrix)} numbers, not 9')
    if matrix[0] == 0.0:
        raise CameraError('the camera is not calibrated: its focal length is 0')
    focal = [matrix[0], matrix[4], matrix[2], matrix[5]]
    names = ('distortion_coefficients', 'D', 'd', 'distCoeffs', 'dist_coeffs')
    distortion = _numbers(_first(content, *names))
    kind = str(content.get('distortion_model', content.get('camera_model', '')))
    if content.get('fisheye_model'):
        kind = 'fisheye'
    xi = _numbers(content.get('xi', [0.0]))[0]
    lens = _lens(kind, focal, distortion, xi, has_mirror='xi' in content)
    return {**lens, **_size_in(content)}


def _size_in(content: Mapping[str, Any]) -> dict[str, Any]:
    for names in (('image_width', 'image_height'), ('width', 'height')):
        if names[0] in content:
            return _size(*(_numbers(content[name])[0] for name in names))
    return _size(0, 0)


def _lens(
    kind: str,
    focal: list[float],
    distortion: list[float],
    xi: float = 0.0,
    has_mirror: bool = False,
) -> dict[str, Any]:
    """Fields of a lens with focal = [fx, fy, cx, cy]; `kind` is the name of the distortion."""
    if len(focal) != 4:
        raise CameraError(f'{len(focal)} numbers of focal lengths and center, not 4')
    lens = dict(zip(('fx', 'fy', 'cx', 'cy'), focal, strict=True))
    coefficients = tuple((distortion + [0.0] * 4)[:4]) if any(distortion) else ()
    if any(distortion[4:]):
        raise CameraError(f'{len(distortion)} coefficients of distortion; only 4 are supported')
    if kind.lower() in _FISHEYE and not has_mirror:
        return {'camera_model': 'fisheye', **lens, 'distortion': coefficients}
    if kind.lower() not in _PLUMB_BOB:
        raise CameraError(f'distortion model {kind!r} is not supported here')
    # A lens without a mirror shows the world as it is, and looks where it is pointed.
    plain = {} if has_mirror else {'mirrored': 'no', 'axis': 'forward'}
    return {'camera_model': 'mirror', 'xi': xi, **plain, **lens, 'distortion': coefficients}


def _size(width: Any, height: Any) -> dict[str, Any]:
    return {'image_width': int(width), 'image_height': int(height)}


def _first(content: Mapping[str, Any], *names: str) -> Any:
    for name in names:
        if name in content:
            return content[name]
    raise CameraError(f'none of {", ".join(names)} is given; {_KNOWN}')


def _numbers(value: Any) -> list[float]:
    """Flatten a number, nested lists, or a matrix with `data` to floats."""
    if isinstance(value, Mapping):
        return _numbers(value['data'])
    if isinstance(value, (list, tuple)):
        return [number for entry in value for number in _numbers(entry)]
    return [float(value)]
