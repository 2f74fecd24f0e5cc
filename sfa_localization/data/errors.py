# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The errors a user can cause and remedy; the command line shows each as one line, exit 1."""


class LocalizationError(Exception):
    """Base of every expected error; its text names the culprit and the remedy."""


class ConfigError(LocalizationError):
    """A parameter is unknown, of the wrong type, or out of range."""


class BagError(LocalizationError):
    """A bag cannot be read, or lacks what is asked of it."""


class ModelError(LocalizationError):
    """A model file is missing, damaged, of another version, or does not fit the pictures."""


class DataError(LocalizationError):
    """The recorded data cannot answer the question put to it (too little, degenerate)."""


class CameraError(LocalizationError):
    """A camera model or picture is unusable."""


class MessageError(LocalizationError):
    """A message cannot be used; the text is the reason it is counted under."""


class NodeError(LocalizationError):
    """A node process ended, or stays silent."""
