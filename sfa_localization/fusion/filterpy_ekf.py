# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""filterpy's extended Kalman filter without the rest of filterpy.

Its packages import all of its filters, and scipy.stats for a likelihood that is not asked for here:
half of the CPU, and of the memory, of a node that starts. Measurements are not copied.
"""

import builtins
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np


def _inverse(matrix: Any) -> Any:
    """Of a covariance of two or three, in numbers: LAPACK takes longer than half of an update."""
    if len(matrix) == 2:
        (a, b), (c, d) = matrix.tolist()
        return np.array(((d, -b), (-c, a))) / (a * d - b * c)
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    others = (p, c * h - b * i, b * f - c * e), (q, a * i - c * g, c * d - a * f)
    last = r, b * g - a * h, a * e - b * d
    return np.array((*others, last)) / (a * p + b * q + c * r)


_STAND_INS = {
    'copy': SimpleNamespace(deepcopy=lambda z: z),
    'filterpy.common': SimpleNamespace(pretty_str=None, reshape_z=lambda z, *_: z),
    'filterpy.stats': SimpleNamespace(logpdf=None),
    'scipy.linalg': SimpleNamespace(linalg=SimpleNamespace(inv=_inverse)),
}


def _import(name: str, *of: Any) -> Any:
    return _STAND_INS.get(name) or __import__(name, *of)


def _alone() -> Any:
    """The class by its own file, which imports stand-ins."""
    spec = find_spec('filterpy')
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("No module named 'filterpy'", name='filterpy')
    path = Path(spec.origin).parent / 'kalman' / 'EKF.py'
    importing = {**vars(builtins), '__import__': _import}
    names: dict[str, Any] = {'__name__': __name__, '__builtins__': importing}
    exec(compile(path.read_text('utf-8'), path, 'exec'), names)
    return names['ExtendedKalmanFilter']


ExtendedKalmanFilter = _alone()
