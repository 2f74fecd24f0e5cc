# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What `make soak` finds wrong: nodes that hold more and more, or answer later and later."""

import importlib.util
import os
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy')


@pytest.fixture(scope='module')
def soak():
    path = Path(__file__).parent / 'benchmarks/soak.py'
    spec = importlib.util.spec_from_file_location('soak', path)
    module = importlib.util.module_from_spec(spec)
    sys.modules['soak'] = module  # where its data classes look for their types
    spec.loader.exec_module(module)
    yield module
    del sys.modules['soak']


def course(soak, *, memory=0.0, handles=0, threads=0):
    """Forty looks at a node that holds so much more at the end."""
    held = [
        soak.Held(100 + memory * k / 39, round(18 + handles * k / 39), round(14 + threads * k / 39))
        for k in range(40)
    ]
    return [(float(k), {'a_node': one}) for k, one in enumerate(held)]


def test_what_stays_is_right(soak):
    assert soak.worse(course(soak, memory=5.0, handles=2), [40.0, 55.0]) == []


@pytest.mark.parametrize(
    ('more', 'said'),
    [
        ({'memory': 30.0}, 'a_node grew by'),
        ({'handles': 9}, 'a_node has 27 handles, after 22'),
        ({'threads': 9}, 'a_node has 23 threads, after 18'),
    ],
)
def test_what_grows_is_wrong(soak, more, said):
    (wrong,) = soak.worse(course(soak, **more), [40.0, 40.0])
    assert wrong.startswith(said)


def test_answers_that_come_later_are_wrong(soak):
    assert soak.worse(course(soak), [40.0, 90.0]) == ['the slowest answers take 90 ms, after 40 ms']
    # Of fast answers twice the time is the machine's.
    assert soak.worse(course(soak), [2.0, 9.0]) == []


def test_handles_and_threads_are_those_of_the_process(soak, tmp_path):
    before = soak.Held.of(os.getpid())
    with open(tmp_path / 'one', 'w'), open(tmp_path / 'two', 'w'):
        after = soak.Held.of(os.getpid())
    assert after.handles == before.handles + 2
    assert before.memory_mib > 10 and before.threads >= 1
