# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The five commands of README.md, as they stand, with a camera that no page describes.

It is a fisheye that leans, mounted aside and turned. Recording is simulated; the nodes that the
launch file starts run with its arguments, and the state is read where README.md reads it.
"""

import os
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_readme_commands import blocks, complete, program

from sfa_localization.bags.reader import Bag
from sfa_localization.camera.settings import LensCalibration
from sfa_localization.data.geometry import align, compose
from sfa_localization.data.run import Trajectory
from sfa_localization.place_model import PlaceModel
from sfa_localization.simulation.drive import drive, record
from sfa_localization.simulation.garden import Garden
from sfa_localization.simulation.settings import SimulationConfig

ROOT = Path(__file__).parents[1]
LENS = LensCalibration(
    camera_model='fisheye', image_width=560, image_height=480, fx=132.0, fy=132.0, cx=283.0,
    cy=236.0, distortion=(0.015, -0.002, 0.0, 0.0), radius_min=0.0, radius_max=234.0,
    mount_rpy=(4.0, -2.0, 115.0),
)  # fmt: skip
PLACE = np.array([0.12, -0.08, 0.0])
WORLD = SimulationConfig(
    world=6, seed=11, area=(7.0, 7.0), images='raw', compression='jpeg', odometry_rate=25.0
)
pytestmark = [pytest.mark.slow, pytest.mark.ros]


def simulated(path, config):
    """The bag that README.md records, of a robot whose camera sits at PLACE."""
    garden = Garden(config.world, config)
    driven = drive(garden, config)
    camera = Trajectory(driven.truth.stamps_ns, compose(driven.truth.poses, PLACE))
    record(replace(driven, truth=camera), garden, config, path, lens=LENS)


def test_five_commands_localize_a_robot_with_an_unknown_camera(tmp_path, monkeypatch):
    pytest.importorskip('rclpy')
    from sfa_localization.commands import live_nodes

    (block,) = blocks('own')
    record_bag, inspect, train, launch, echo = map(shlex.split, block.splitlines())
    assert record_bag[:3] == ['ros2', 'bag', 'record'] and echo[-1] == '/ekf/state'
    simulated(tmp_path / record_bag[record_bag.index('-o') + 1], WORLD)
    simulated(tmp_path / 'later', replace(WORLD, trajectory='test', length=18.0, seed=12))
    for command, *words in (inspect, train):
        assert command == 'sfa_localization'
        assert 'lens: fisheye, horizon at ' in complete(words, tmp_path)
    assert (tmp_path / 'report/lens.png').is_file()
    model = PlaceModel.load(tmp_path / 'my_garden.npz')
    roll, pitch, yaw = model.lens.mount_rpy
    assert (roll, pitch) == pytest.approx(LENS.mount_rpy[:2], abs=1.5)
    assert yaw % 360 == pytest.approx(LENS.mount_rpy[2], abs=2.0)
    assert abs(model.rig.lever - complex(*PLACE[:2])) < 0.06

    assert launch[:3] == ['ros2', 'launch', 'sfa_localization']
    arguments = dict(word.split(':=') for word in launch[4:])
    path = arguments['model'].replace('$PWD', str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('PYTHONPATH', str(ROOT))
    for name in ('DOMAIN_ID', 'AUTOMATIC_DISCOVERY_RANGE', 'LOG_DIR'):  # which run_live sets
        monkeypatch.setenv(f'ROS_{name}', os.environ.get(f'ROS_{name}', ''))
    of_model = ['--ros-args', '-p', f'model:={path}']
    transport = ['-p', f'image_transport:={arguments["image_transport"]}']
    programs = {
        'omnicam_node': program(['omnicam_node', *of_model, *transport]),
        'sfa_node': program(['sfa_node', *of_model]),
        'ekf_node': program(['ekf_node']),
        'play': program(['play', str(tmp_path / 'later'), '--rate', '2']),
    }
    live = live_nodes.run_live(programs, tmp_path / 'logs')
    with Bag(tmp_path / 'later') as bag:
        truth = bag.trajectory()  # of the camera
    base = compose(truth.at(live.ekf.stamps_ns), np.array([0.0, 0.0, 0.0]) - PLACE)[:, :2]
    error = align(live.ekf.poses[:, :2], base).apply(live.ekf.poses[:, :2]) - base
    assert np.hypot(*error.T).mean() < 0.12
