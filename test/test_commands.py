# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every option of every command, alone: it parses, it runs, and something comes of it."""

import contextlib
import io
import shutil
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from bag_formats import read_odometry
from test_calibration import scene

from sfa_localization import cli, training, tuning
from sfa_localization.bags.reader import Bag
from sfa_localization.commands import fleet
from sfa_localization.data.errors import DataError, NodeError
from sfa_localization.simulation import drive as simulation

pytestmark = pytest.mark.usefixtures('gardens', 'small_network')


# Each option alone, on small inputs: what a command is given without it, and the option.

CAMERAS = '{out}/bag --area 6x6 --length 4 --images-every 2 --cameras 2'
BASE = {
    'simulate': '{out}/bag --area 6x6 --length 4 --images panorama --size 32x8 --images-every 1',
    'train': '{data}/bag --output {out}/model.npz --config {data}/small.yaml',
    'evaluate': '{data}/model.npz {data}/test',
    'play': '{data}/test --rate 1000 --wait 0',
    'inspect': '{data}/bag',
    'calibrate': '{data}/mirror.png --calibration {data}/info.yaml',
    'filter': '{data}/odom.csv {data}/positions.csv --output {out}/poses.tum',
    'tune': '{data}/test --model {data}/model.npz --output {out}/out.yaml',
    'map': '{data}/model.npz --output {out}/garden.yaml',
    'config': '',
    'fleet': '{data}/gardens --output {out}/models',
    'demo': '--out {out}/demo',
    # For these options something else.
    'simulate --trajectory': '{out}/bag --area 6x6 --images panorama --size 32x8 --images-every 10',
    'simulate --cameras': '{out}/bag --area 6x6 --length 4 --images-every 2',
    'simulate --camera-size': f'{CAMERAS} --camera-fov 150',
    'simulate --camera-fov': f'{CAMERAS} --camera-size 32x24',
    'simulate --camera-radius': f'{CAMERAS} --camera-size 32x24',
    'simulate --camera-exposures': f'{CAMERAS} --camera-size 32x24',
    'simulate --camera-skew': f'{CAMERAS} --camera-size 32x24',
    'simulate --camera-yaws': f'{CAMERAS} --camera-size 32x24',
    'simulate --test-drift': '{out}/bag --area 6x6 --trajectory test --size 32x8 --images-every 9',
    'train --strict': '{data}/cut --output {out}/model.npz --config {data}/small.yaml',
    'train --force': '{data}/bag --output {out}/model.npz --config {data}/counterclockwise.yaml',
    'inspect --strict': '{data}/cut',
    'calibrate --image-topic': '{data}/bag',
    'calibrate --odom-topic': '{data}/bag',
    'calibrate --calibration': '{data}/mirror.png',
}
CASES = {
    'simulate': """
        --size 40x12; --trajectory mower; --seed 2; --world 2; --light evening; --season winter
        --area 9x7; --length 8; --images raw; --images-every 0.5; --images-every-turn 5
        --compression png; --storage sqlite3; --image-noise 0; --illumination 1; --terrain 3
        --speed 0.5; --odometry-rate 20; --test-drift 1; --scale-error 0.1; --slip 0.3
        --speed-noise 0.5; --gyro-bias 0.05; --gyro-noise 0.1
        --cameras 3; --camera-fov 190; --camera-radius 1; --camera-size 40x24
        --camera-exposures 1x0.5; --camera-skew 0x33; --camera-yaws 0x10""",
    'train': """
        --output {out}/other.npz; --config {data}/fewer.yaml; --report {out}/report; --resume
        --json {out}/judgment.json
        --update {data}/model.npz => the model; --strict => read without --strict
        --force => written; --image-topic /nothing => /nothing; --odom-topic /ground_truth
        --imu-topic /nothing => /nothing; --points-topic /nothing => /nothing
        --points {data}/fewer.yaml => is no point; --segments straight; --metric-map monomials
        --solver paper => needs straight lines; --engine mdp => all is noted
        --normalization grey""",
    'evaluate': """
        --align {data}/bag; --config {data}/start.yaml; --smooth; --report {out}/report
        --json {out}/figures.json; --image-topic /nothing => /nothing; --odom-topic /ground_truth
        --imu-topic /nothing => /nothing; --ground-truth-topic /odom; --tum {out}/tum
        --bag {out}/replay""",
    'map': '--output {out}/other.yaml; --width 0.5; --cell 0.1',
    'play': '--loop; --clock; --topics /odom; --rate 500; --wait 0.01',
    'inspect': """
        --json {out}/found.json; --report {out}/report; --strict => read without --strict
        --config {data}/counterclockwise.yaml => images turn opposite to odometry
        --imu-topic /nothing => /nothing; --image-topic /nothing => /nothing
        --odom-topic /ground_truth => by /ground_truth; --max-spacing 0.1; --reach 0.2
        --min-pictures 9999 => drive until there are 9999""",
    'calibrate': """
        --image-topic /nothing => /nothing; --odom-topic /nothing => /nothing
        --calibration {data}/info.yaml => fisheye; --radii 50x300 => radius_min: 50
        --output {out}/camera.yaml; --check {out}/check.png; --axis up => axis: up
        --mirrored no => mirrored: 'no'; --mount-rpy 0x0x90""",
    'filter': '--config {data}/start.yaml; --output {out}/other.tum',
    'tune': """
        --model {data}/other.npz; --config {data}/robot.yaml; --output {out}/tuned.yaml
        --method grid => m mean error; --image-topic /nothing => /nothing
        --odom-topic /ground_truth; --imu-topic /nothing => /nothing
        --ground-truth-topic /nothing --method grid => /nothing""",
    'config': '--output {out}/out.yaml',
    'fleet': '--output {out}/others; --json {out}/all.json; --workers 7; --scheduler tcp://a:1',
    'demo': '--out {out}/elsewhere; --world 3',
}
"""The options, and what a command prints only with one; if nothing is named, the texts, files or
notes differ.
"""


def cases(name):
    """The words of each option of a command, and what it prints with them."""
    parts = (part.partition('=>') for part in CASES[name].replace('\n', ';').split(';'))
    return [(words.strip(), text.strip()) for words, _, text in parts if words.strip()]


class Outcome(NamedTuple):
    """What a command did: its exit code, what it printed, the files that it wrote, and what
    stand-ins of slow parts were handed.
    """

    code: int
    text: str
    files: dict
    notes: list


@contextlib.contextmanager
def threads(notes, place):
    """In the place of processes and clusters."""
    notes.append(place)
    yield ThreadPoolExecutor(1).submit, lambda: 1


def watch(name, notes, patch):
    """Note what no output shows; minutes of work of `demo`, and the replay, are left out."""
    train = training.train

    def trained(*args, **named):
        notes.extend(['resume'] * named['resume'])
        if args[2].network.engine == 'mdp':  # slow; test_training.py learns with it
            notes.append('mdp')
            raise DataError('all is noted')
        return None if name == 'demo' else train(*args, **{**named, 'resume': False})

    patch.setattr(training, 'train', trained)
    patch.setattr(tuning, 'TRIALS', 10)
    patch.setattr(tuning, 'FACTORS', (0.5, 2.0))
    for place in ('_processes', '_cluster'):
        patch.setattr(fleet, place, partial(threads, notes))
    if name not in ('play', 'demo'):
        return
    from sfa_localization.commands import bag_player, live_nodes

    def play(path, config, **named):
        notes.extend([config.rate, config.wait, *named.items()])
        return Counter()

    def run_live(programs, logs):
        notes.extend(word for words in programs.values() for word in words)
        raise NodeError('all is noted')

    patch.setattr(bag_player, 'play', play)
    patch.setattr(live_nodes, 'run_live', run_live)
    if name == 'demo':
        patch.setattr(simulation, 'simulate', lambda used, *_, **__: notes.extend(
            [('world', used.world), ('seed', used.seed)]))  # fmt: skip


def run(name, words, folder, **places):
    """Run a command in this process: its outcome."""
    text, notes = io.StringIO(), []
    filled = [word.format(out=folder, **places) for word in words.split()]
    with pytest.MonkeyPatch.context() as patch:
        watch(name, notes, patch)
        with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
            code = cli.main([name, *filled])
    paths = [path for path in folder.rglob('*') if path.is_file()]
    files = {str(path.relative_to(folder)): path.read_bytes() for path in paths}
    place = str(folder)
    notes = [str(note).replace(place, '.') for note in notes]
    return Outcome(code, text.getvalue().replace(place, '.'), files, notes)


PARAMETERS = {
    'small': 'training: {ros__parameters: {slow_features: 6}}',
    'fewer': 'training: {ros__parameters: {slow_features: 4}}',
    'counterclockwise': '/**: {ros__parameters: {clockwise: false, slow_features: 6}}',
    'start': 'ekf_node: {ros__parameters: {measurement_factor: 9.0}}',
    'robot': 'training: {ros__parameters: {odometry: /ground_truth}}',
    'info': '{image_width: 640, image_height: 480, distortion_model: equidistant, '
    'camera_matrix: {data: [200, 0, 320, 0, 200, 240, 0, 0, 1]}, '
    'distortion_coefficients: {data: [0.01, 0, 0, 0]}}',
}
"""Files of parameters, and a calibration."""


@pytest.fixture(scope='module')
def data(tmp_path_factory, gardens, small_network):
    """A folder with every kind of input, each as small as it may be."""
    folder = tmp_path_factory.mktemp('data')
    for name, text in PARAMETERS.items():
        (folder / f'{name}.yaml').write_text(text)
    world = '--area 6x6 --images panorama --size 160x16 --odometry-rate 10 --images-every 0.4'
    for command in (
        f'simulate {{out}}/bag {world} --length 30',
        f'simulate {{out}}/test {world} --length 14 --seed 2 --compression jpeg',
        'train {out}/bag --output {out}/model.npz --config {out}/small.yaml',
        'train {out}/bag --output {out}/other.npz --config {out}/fewer.yaml',
    ):
        name, _, words = command.partition(' ')
        made = run(name, words, folder)
        assert made.code == 0, made.text
    (folder / 'gardens' / 'empty').mkdir(parents=True)
    shutil.copytree(folder / 'bag', folder / 'cut')
    (file,) = (folder / 'cut').glob('*.mcap')
    file.write_bytes(file.read_bytes()[: int(0.9 * file.stat().st_size)])
    cv2.imwrite(str(folder / 'mirror.png'), scene(1))
    # The logs of `filter`.
    with Bag(folder / 'test') as bag:
        odometry, truth = read_odometry(bag), bag.trajectory()
    for name, columns, stamps_ns, rows in (
        ('odom', 'stamp_s,v_mps,omega_radps', odometry.stamps_ns, odometry.twists),
        ('positions', 'stamp_s,x_m,y_m,yaw_rad', truth.stamps_ns[::5], truth.poses[::5]),
    ):
        table = np.column_stack([stamps_ns * 1e-9, rows])
        np.savetxt(folder / f'{name}.csv', table, '%.6f', ',', header=columns, comments='')
    return folder


def test_every_option_has_a_case_and_every_case_an_option():
    options = {
        (name, action.option_strings[-1])
        for name in cli.COMMANDS
        for action in cli.command_parser(name)._actions
        if action.option_strings and action.dest != 'help'
    }
    listed = {(name, words.split()[0]) for name in CASES for words, _ in cases(name)}
    assert listed == options, 'a new option needs a case in CASES'


def test_a_model_that_is_replaced_is_named(data, tmp_path):
    shutil.copy(data / 'model.npz', tmp_path / 'model.npz')
    made = run('train', BASE['train'], tmp_path, data=data)
    assert 'model.npz: written, the model that was there is replaced' in made.text


@pytest.mark.parametrize('name', cli.COMMANDS)
def test_each_option_alone_has_its_effect(name, data, tmp_path):
    if name in ('play', 'demo'):
        pytest.importorskip('rclpy')
    outcomes = {}

    def outcome(words):
        if words not in outcomes:
            folder = tmp_path / str(len(outcomes))
            folder.mkdir()
            outcomes[words] = run(name, words, folder, data=data)
        return outcomes[words]

    base = BASE[name]
    assert outcome(base) == outcome(f'{base} '), 'without an option, the same twice'
    for words, text in cases(name):
        base = BASE.get(f'{name} {words.split()[0]}', BASE[name])
        plain, changed = outcome(base), outcome(f'{base} {words}')
        assert changed.code in (0, 1, 3), words
        if text:
            assert text in changed.text and text not in plain.text, f'{words}\n{changed.text}'
        else:
            assert changed.code == plain.code and changed != plain, f'{words}\n{changed.text}'
