# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Localization from one omnidirectional camera and odometry, learned without ground truth.

`PlaceModel` locates a panorama, `Localizer` fuses its pose with odometry, `read_bag` gives arrays,
and `panorama` unwraps a raw image. They are imported when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sfa_localization.library import panorama as panorama
    from sfa_localization.library import read_bag as read_bag
    from sfa_localization.localizer import Localizer as Localizer
    from sfa_localization.place_model import PlaceModel as PlaceModel

__version__ = '0.1.0'
_MODULES = {
    'Localizer': 'localizer',
    'PlaceModel': 'place_model',
    'panorama': 'library',
    'read_bag': 'library',
}
__all__ = ['Localizer', 'PlaceModel', 'panorama', 'read_bag']


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(importlib.import_module(f'{__name__}.{_MODULES[name]}'), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULES])
