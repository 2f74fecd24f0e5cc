# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files of other tools, read into camera parameters."""

from __future__ import annotations


from sfa_localization.config import CameraConfig
from sfa_localization.errors import CameraError


def with_calibration(config: CameraConfig) -> CameraConfig:
    """Return the parameters with those of `calibration_file`, where one is named, filled in."""
    if not config.calibration_file:
        return config
    raise CameraError(f'calibration_file {config.calibration_file}: cannot be read yet')
