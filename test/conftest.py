# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""For all tests: ROS stays on this machine, checks messages, logs elsewhere; one core is used."""

import os
import signal
import tempfile
from types import SimpleNamespace

import pytest
from robustness.promises import PROMISES

# Before rclpy is imported by any test; a user's own choice stands.
_LOGS = tempfile.TemporaryDirectory(prefix='sfa_localization_ros_log_')
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
os.environ.setdefault('ROS_LOG_DIR', _LOGS.name)
# Small products on many cores of a busy machine wait for each other.
os.environ.setdefault('OMP_NUM_THREADS', '1')
# Background jobs ignore Ctrl-C or a hang-up, and so would every process that the tests start.
for _number, _handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)


def pytest_addoption(parser):
    """An option for environments in which the same tests run once more."""
    parser.addoption(
        '--one-each', action='store_true', help='run the first case only of tests with several'
    )


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(config, items):
    """Mark the tests of faults; then, with --one-each, keep the first case of each test that `-m`
    and `-k` select.
    """
    for item in items:
        if f'{item.path.name}::{getattr(item, "originalname", item.name)}' in PROMISES:
            item.add_marker(pytest.mark.robustness)
    yield
    if config.getoption('--one-each'):
        first, others, seen = [], [], set()
        for item in items:
            test = item.nodeid.partition('[')[0]
            (others if test in seen else first).append(item)
            seen.add(test)
        items[:] = first
        config.hook.pytest_deselected(items=others)


@pytest.fixture
def bench():
    """Nodes under test, and one that feeds and hears them, in a domain of this process."""
    from ros_bench import Bench

    made = Bench()
    yield made
    made.close()


@pytest.fixture(scope='module')
def gardens():
    """Build a garden once for all drives in it: seed, area, light and season make it."""
    from sfa_localization.simulation import drive

    garden = drive.Garden

    def again(seed, settings):
        place = (seed, settings.area, settings.light, settings.season)
        if place not in _GARDENS:
            _GARDENS[place] = garden(seed, settings)
        return _GARDENS[place]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drive, 'Garden', again)
        yield


_GARDENS = {}


@pytest.fixture(scope='module')
def small_network():
    """One layer for panoramas of 160x16, and few inducing points: training takes seconds."""
    from sfa_localization.mapping import selection
    from sfa_localization.sfa import network

    layer = network.Layer(field=(16, 16), stride=(1, 8), linear=16, outputs=10)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network, 'STANDARD_NETWORKS', {(16, 160): (layer,)})
        patch.setattr(selection, '_SEARCH_POINTS', 60)
        patch.setattr(selection, 'INDUCING_POINTS', 100)
        yield


@pytest.fixture(scope='session')
def trained(tmp_path_factory):
    """A small training as `bag` to `model`, paths, by SMALL_RECIPE; its `result`."""
    from cylinder_worlds import SMALL_RECIPE, write_bag

    from sfa_localization.training import train

    folder = tmp_path_factory.mktemp('training')
    bag, model = write_bag(folder / 'drive'), folder / 'new' / 'model.npz'
    return SimpleNamespace(bag=bag, model=model, result=train([bag], model, SMALL_RECIPE))


@pytest.fixture(scope='session')
def messages(tmp_path_factory):
    """The small drive of `bag_formats`, as messages."""
    from bag_formats import drive

    return drive(tmp_path_factory.mktemp('drive'))
