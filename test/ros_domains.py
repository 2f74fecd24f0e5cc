# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A ROS domain that no other test run on this machine uses: two runs at once never meet."""

import fcntl
import os
import tempfile
from pathlib import Path

_DOMAINS = range(1, 101)  # above, ports may be those of the system
_held = []


def free_domain():
    """A domain of this process alone, until it ends."""
    for domain in _DOMAINS:
        path = Path(tempfile.gettempdir()) / f'sfa_localization_domain_{domain}.lock'
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except PermissionError:  # another user's
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            continue
        _held.append(handle)
        return domain
    raise RuntimeError('all ROS domains are in use by tests')
