# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A share of the hostile inputs of `make fuzz`, and whether it finds what it looks for."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
import time
from pathlib import Path

import fuzz_inputs
import numpy as np
import pytest

SHARE = {'messages': 500, 'models': 150, 'bags': 150, 'yaml': 300, 'images': 600}
"""Inputs of each kind: some seconds; `make fuzz` makes 10,000."""


def load_fuzz():
    path = Path(__file__).parent / 'benchmarks' / 'fuzz.py'
    spec = importlib.util.spec_from_file_location('fuzz', path)
    module = importlib.util.module_from_spec(spec)
    sys.modules['fuzz'] = module  # dataclasses look it up
    spec.loader.exec_module(module)
    return module


fuzz = load_fuzz()


@pytest.mark.slow
@pytest.mark.parametrize('name', SHARE)
def test_a_share_of_the_inputs(name):
    total = fuzz.Fuzzer(name).run(0, SHARE[name])
    assert total.failures == []
    assert total.inputs == SHARE[name]
    assert 0.05 < total.read / total.inputs < 0.95, 'the inputs are neither intact nor rubbish'
    assert 0 < total.peak_mb < 1000


class Faulty:
    """A kind whose fifth input does what is asked of it in `FAULT`."""

    def prepare(self, folder: Path) -> None:
        (folder / 'intact').touch()

    def open(self, folder: Path) -> None:
        assert (folder / 'intact').exists()
        self._fault, self._used = os.environ['FAULT'], 0

    def use(self, random: np.random.Generator, folder: Path) -> bool:
        self._used += 1
        if random.integers(10**9) != FIFTH:
            return True
        if self._fault == 'death':
            os.kill(os.getpid(), signal.SIGSEGV)
        elif self._fault == 'hang':
            time.sleep(60)
        elif self._fault == 'memory':
            bytearray(fuzz.MEMORY)
        elif self._fault == 'exit':
            sys.exit('enough')
        else:
            raise KeyError('unexpected')
        return False


FIFTH = int(np.random.default_rng([4, *b'faulty']).integers(10**9))
fuzz_inputs.KINDS['faulty'] = Faulty


@pytest.mark.parametrize(
    ('fault', 'found', 'text'),
    [
        ('death', 'deaths', 'exit code -11'),
        ('hang', 'hangs', 'no end after 2 s'),
        ('memory', 'tracebacks', 'MemoryError'),
        ('exit', 'tracebacks', 'SystemExit: enough'),
        ('error', 'tracebacks', "KeyError: 'unexpected'"),
    ],
)
def test_what_goes_wrong_is_found_and_the_rest_goes_on(fault, found, text, monkeypatch):
    monkeypatch.setenv('FAULT', fault)
    total = fuzz.Fuzzer('faulty', 2.0, [__file__]).run(0, 10)
    (failure,) = total.failures
    assert getattr(total, found) == [failure]
    assert failure.startswith('faulty 4: ') and text in failure
    assert (total.inputs, total.read) == (10, 9)
    line = fuzz.table({'faulty': total}).splitlines()[1].split()
    assert line[:3] == ['faulty', '10', '9']
    assert [int(number) for number in line[3:6]] == [
        int(found == column) for column in ('deaths', 'tracebacks', 'hangs')
    ]


if __name__ == '__main__':
    fuzz.run_inputs(sys.argv[1:])
