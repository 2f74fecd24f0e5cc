# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The last reliable pose in a small file: where a robot looks first after a restart."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.files import read_regular, write_bytes
from sfa_localization.data.geometry import Array
from sfa_localization.fusion.inputs import read_pose

SAVE_PERIOD_S = 10.0
"""Time between two writes: rare enough for a flash card to last for years."""
MOVED_STD_M = 0.5
MOVED_YAW_STD = 0.3
"""m and rad by which a robot may be moved while it is off, as when it is pushed to its charger. The
pose is a hypothesis: images overrule it where the robot was moved farther."""
_LARGEST_FILE = 65536  # bytes, many times the size of a pose
_VERSION = 1


class SavedPose(NamedTuple):
    """A pose (3,) of x m, y m, yaw rad in `frame`, with its covariance (3, 3), at a stamp."""

    stamp_ns: int
    frame: str
    pose: Array
    covariance: Array

    def moved(self) -> Array:
        """The covariance (3, 3) when the robot is switched on again."""
        added = np.diag(np.square([MOVED_STD_M, MOVED_STD_M, MOVED_YAW_STD]))
        return np.asarray(self.covariance + added)


def save_pose(path: Path, saved: SavedPose) -> None:
    """Write the file, completely or not at all.

    Raises LocalizationError; a file that holds something else than a pose is not written over.
    """
    _content(path)
    content = {'version': _VERSION, **saved._asdict()}
    write_bytes(path, (json.dumps(content, default=np.ndarray.tolist) + '\n').encode())


def load_pose(path: Path, frame: str) -> SavedPose | None:
    """Read and check the file; None if there is none yet. Raises DataError."""
    content = _content(path)
    if content is None:
        return None
    try:
        if content['version'] != _VERSION or content['frame'] != frame:
            raise DataError(f'it is no pose of version {_VERSION} in the frame {frame!r}')
        pose, covariance = read_pose(content['pose'], content['covariance'])
        return SavedPose(int(content['stamp_ns']), frame, pose, covariance)
    except (DataError, ValueError, TypeError, LookupError, OverflowError) as error:
        raise DataError(f'{path}: cannot be used: {error}; remove it') from None


def _content(path: Path) -> Any:
    """A file's content, of any version; None if it is empty or missing. Raises DataError."""
    try:
        text = read_regular(path, _LARGEST_FILE)
        content = json.loads(text) if text else None
        if content is None or {'version', 'frame', 'pose'} <= set(content):
            return content
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, RecursionError):
        pass
    raise DataError(f'{path}: holds no saved pose, and stays: remove it or choose another file')
