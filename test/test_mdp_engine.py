# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The engine made of MDP's nodes learns the same network; its shim leaves nothing behind."""

import subprocess
import sys

import numpy as np
import pytest
from cylinder_worlds import ARCHITECTURE, drive
from test_hierarchy import assert_alike

from sfa_localization.data.errors import ConfigError
from sfa_localization.sfa import mdp_engine, mdp_shim
from sfa_localization.sfa import network_training as hierarchy

try:
    mdp = mdp_shim.import_mdp()
except ConfigError as error:
    pytest.skip(str(error), allow_module_level=True)


@pytest.mark.parametrize('relative_cut', [1e-2, 1e-7])
def test_engines_learn_the_same_features(relative_cut):
    of, options = drive(24), {'light_std': 0.0, 'relative_cut': relative_cut}
    of.joined[[7, 15]] = False
    images = of.panoramas.read(0, 24)
    ours = hierarchy.train_network(ARCHITECTURE, [of], **options)
    theirs = mdp_engine.train_network(ARCHITECTURE, [of], **options)
    assert ours.ranks == theirs.ranks
    assert_alike(ours.maps(images), theirs.maps(images), 0.9999)
    for pair in zip(ours.deltas, theirs.deltas, strict=True):
        assert np.allclose(*pair, rtol=2e-3)


def test_shim_leaves_no_patch_behind():
    """In a fresh interpreter."""
    code = (
        'import inspect, numpy\n'
        'before = set(vars(numpy)), inspect.getfullargspec\n'
        'from sfa_localization.sfa.mdp_shim import import_mdp\n'
        'mdp = import_mdp()\n'
        'assert import_mdp() is mdp\n'
        'gone = set(vars(numpy)) - before[0]\n'
        "assert 'typeDict' not in gone, gone\n"
        'assert inspect.getfullargspec is before[1]\n'
        'mdp.nodes.SFANode(output_dim=1).train(numpy.eye(9).cumsum(0))\n'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_missing_mdp_tells_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, 'mdp', None)
    with pytest.raises(ConfigError, match=r'pip install "sfa_localization\[mdp\]"'):
        mdp_shim.import_mdp()
