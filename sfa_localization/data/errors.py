# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can cause and remedy; the command line shows each as one line, exit 1."""


class LocalizationError(Exception):
    """Base of every expected error; its text names the cause and the remedy."""


class ConfigError(LocalizationError):
    """A parameter is unknown, of the wrong type, or out of range."""


class BagError(LocalizationError):
    """A bag cannot be read, or lacks required messages."""


class ModelError(LocalizationError):
    """A model file is missing, damaged, of another version, or does not fit the images."""


class DataError(LocalizationError):
    """The recorded data is insufficient (too little, degenerate, not overlapping)."""


class CameraError(LocalizationError):
    """A camera model or image is unusable."""


class MessageError(LocalizationError):
    """A message cannot be used; it is counted under the text of this error."""


class NodeError(LocalizationError):
    """A node process ended, or publishes nothing."""
