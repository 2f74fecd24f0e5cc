# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The commands of README.md and config/README.md, in order: from a recording to live nodes.

They are read from the text and run unchanged; only the replay is faster than real time.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from robustness.recorded import model_file

from sfa_localization.bags.reader import Bag
from sfa_localization.data.files import atomic_write
from sfa_localization.data.geometry import align

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / 'README.md', ROOT / 'config/README.md')
BLOCK = re.compile(r'<!-- run: (\w+) -->\s*```\w+\n(.*?)```', re.DOTALL)
NODES = ('omnicam_node', 'sfa_node', 'ekf_node')
pytestmark = pytest.mark.slow


def blocks(kind):
    text = '\n'.join(page.read_text('utf-8') for page in PAGES)
    return [code for name, code in BLOCK.findall(text) if name == kind]


def commands(kind):
    lines = '\n'.join(blocks(kind)).splitlines()
    return [shlex.split(line.removeprefix('sfa_localization ')) for line in lines if line.strip()]


def raw_drive():
    """The command that made the sample's second drive, but with raw images of the mirror."""
    text = (ROOT / 'bags/README.md').read_text('utf-8').replace('\\\n', ' ')
    (line,) = (line for line in text.splitlines() if 'simulate bags/sample_test' in line)
    words = shlex.split(line.partition('-m sfa_localization ')[2])
    return [{'bags/sample_test': 'demo/test', 'panorama': 'raw'}.get(w, w) for w in words]


def program(words):
    """The command line with this interpreter and without an installed package."""
    return [sys.executable, '-m', 'sfa_localization', *words]


def complete(words, folder):
    """Run a command in a folder, until it ends; what it prints."""
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    done = subprocess.run(
        program(words), cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, f'{shlex.join(words)}\n{done.stdout}{done.stderr}'
    return done.stdout


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A folder like a clone, in which all commands without ROS have been run, in order."""
    folder = tmp_path_factory.mktemp('newcomer')
    (folder / 'bags').symlink_to(ROOT / 'bags')
    for words in commands('offline'):
        if words[0] == 'train' and model_file().exists():  # minutes, with the same bytes
            shutil.copy(model_file(), folder / words[-1])
        else:
            complete(words, folder)
    with atomic_write(model_file()) as file:
        file.write((folder / 'model.npz').read_bytes())
    assert (folder / 'report/index.html').is_file() and (folder / 'results.json').is_file()
    return folder


@pytest.mark.ros
def test_nodes_run_as_described(folder, monkeypatch):
    pytest.importorskip('rclpy')
    from sfa_localization.commands import live_nodes

    monkeypatch.chdir(folder)
    monkeypatch.setenv('PYTHONPATH', str(ROOT))
    for name in ('DOMAIN_ID', 'AUTOMATIC_DISCOVERY_RANGE', 'LOG_DIR'):  # which run_live sets
        monkeypatch.setenv(f'ROS_{name}', os.environ.get(f'ROS_{name}', ''))
    complete(raw_drive(), folder)
    os.link(folder / 'model.npz', folder / 'demo/model.npz')
    extra = {
        'omnicam_node': ['-p', 'camera_model:=mirror'],  # the sample's images are panoramas
        'play': ['--rate', '4'],
    }
    programs = {words[0]: program(words + extra.get(words[0], [])) for words in commands('live')}
    assert [*programs] == [*NODES, 'play']
    live = live_nodes.run_live(programs, folder / 'logs')
    with Bag(folder / 'demo/test') as bag:
        truth = bag.trajectory()
    assert len(live.sfa) > 2, 'how many images are located depends on the speed of the machine'
    for name, estimate in {'sfa': live.sfa, 'ekf': live.ekf}.items():
        true = truth.at(estimate.stamps_ns)[:, :2]
        aligned = align(estimate.poses[:, :2], true).apply(estimate.poses[:, :2])
        assert np.hypot(*(aligned - true).T).mean() < 0.5, name


def test_library_examples_run(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    examples = blocks('library')
    assert len(examples) == 2
    names: dict = {}
    exec(compile('\n'.join(examples), 'README.md', 'exec'), names)
    assert 'placed, confirmed over' in capsys.readouterr().out
    poses, truth = names['track'].poses, names['drive'].ground_truth
    true = truth.at(poses.stamps_ns)[:, :2]
    aligned = align(poses.poses[:, :2], true).apply(poses.poses[:, :2])
    assert np.hypot(*(aligned - true).T).mean() < 0.1
