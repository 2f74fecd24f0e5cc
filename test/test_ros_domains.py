# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Two runs of the tests on one machine use different ROS domains."""

import subprocess
import sys
from pathlib import Path

from ros_domains import free_domain


def test_no_domain_is_given_twice():
    own = [free_domain() for _ in range(3)]
    code = 'from ros_domains import free_domain; print(free_domain(), free_domain())'
    done = subprocess.run(
        [sys.executable, '-c', code],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=True,
    )
    other = [int(word) for word in done.stdout.split()]
    assert len({*own, *other}) == 5
    assert all(0 < domain <= 100 for domain in (*own, *other))
