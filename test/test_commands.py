# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every option of every command, alone: it parses, it runs, and something comes of it."""

import contextlib
import io
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from bag_formats import read_odometry
from test_calibration import scene

from sfa_localization import cli, training, tuning
from sfa_localization.bags.reader import Bag
from sfa_localization.data.errors import DataError, NodeError
from sfa_localization.data.messages import read_yaw_rate
from sfa_localization.place_model import PlaceModel
from sfa_localization.simulation import drive as simulation

parser_of = cli.command_parser
pytestmark = pytest.mark.usefixtures('gardens', 'small_network')


def options() -> dict[tuple[str, str], Any]:
    """Return the action of every option that there is, by command and name."""
    return {
        (name, action.option_strings[-1]): action
        for name in cli.COMMANDS
        for action in parser_of(name)._actions
        if action.option_strings and action.dest != 'help'
    }


# Each option alone, on small inputs: what a command is given without it, and what comes of it.


def rates(bag: Bag) -> list[float]:
    """The yaw rates of a bag."""
    return [omega for _, _, (omega, _) in bag.read([bag.stream('/imu', read_yaw_rate)])]


@dataclass
class Outcome:
    """What a command did: its exit code, what it printed, and the folder it may have written to."""

    code: int
    text: str
    folder: Path
    noted: list[Any] = field(default_factory=list)
    """What stand-ins of slow parts were handed."""

    def bag(self) -> dict[str, Any]:
        """Return what a bag that it recorded holds."""
        with Bag(self.folder / 'bag') as bag:
            return {
                'topics': [*bag.topics],
                'truth': bag.trajectory().poses,
                'stamps': bag.trajectory().stamps_ns,
                'odometry': read_odometry(bag).poses,
                'turns': rates(bag) if '/imu' in bag.topics else np.zeros(0),
                'pictures': np.array([picture for _, picture in bag.images()]),
            }

    def model(self) -> PlaceModel:
        return PlaceModel.load(self.folder / 'model.npz')

    def camera(self) -> dict[str, Any]:
        """Return the calibration that was printed, before it asks for a look."""
        return yaml.safe_load(self.text.partition('look at ')[0])


Check = Callable[[Outcome, Outcome], bool]


@dataclass(frozen=True)
class Case:
    """What tells apart without and with an option; words besides, `base` instead of the usual ones.

    `{data}` in words is the folder of inputs, `{out}` that of this run.
    """

    differs: Check
    beside: str = ''
    base: str | None = None


def says(text: str) -> Check:
    """Only with the option it works, and prints this."""
    return lambda a, b: b.code == 0 and text in b.text and text not in a.text


def refuses(text: str) -> Check:
    """Only with the option it ends with this error."""
    return lambda a, b: (
        a.code == 0 and b.code == 1 and text in b.text.split('error: ')[-1] and text not in a.text
    )


def differ(what: Callable[[Outcome], Any]) -> Check:
    """Both work, and this differs."""
    return lambda a, b: a.code == b.code == 0 and not same(what(a), what(b))


def same(a: Any, b: Any) -> bool:
    return np.shape(a) == np.shape(b) and bool(np.all(np.asarray(a) == np.asarray(b)))


def of_drive(key: str) -> Check:
    """The same drive with other pictures, wheels or turn rates; or another one, of the truth."""
    return lambda a, b: (
        same(a.bag()['truth'], b.bag()['truth']) == (key != 'truth')
        and not same(a.bag()[key], b.bag()[key])
    )


def more(what: Callable[[dict[str, Any]], float], least: float = 0.0) -> Check:
    return lambda a, b: what(b.bag()) > what(a.bag()) + least


def written(name: str) -> Check:
    """Only with the option there is such a file, not empty."""
    return lambda a, b: (
        b.code == 0 and (b.folder / name).stat().st_size > 0 and not (a.folder / name).exists()
    )


def noted(value: Any) -> Check:
    """Only with the option the stand-ins were handed this."""
    return lambda a, b: a.code == b.code and value in b.noted and value not in a.noted


def calibrated(**values: Any) -> Check:
    wanted = values.items()
    return lambda a, b: wanted <= b.camera().items() and not wanted <= a.camera().items()


BASE = {
    'simulate': '{out}/bag --area 6x6 --length 4 --images panorama --size 32x8 --images-every 1',
    'train': '{data}/bag --output {out}/model.npz --config {data}/small.yaml',
    'evaluate': '{data}/model.npz {data}/test',
    'play': '{data}/test --rate 1000 --wait 0',
    'inspect': '{data}/bag',
    'calibrate': '{data}/mirror.png',
    'filter': '{data}/odom.csv {data}/positions.csv --output {out}/poses.tum',
    'tune': '{data}/test --model {data}/model.npz --output {out}/out.yaml',
    'config': '',
    'demo': '--out {out}/demo',
}
DAMAGED = {name: BASE[name].replace('/bag', '/cut') for name in BASE}
PICTURES, WHEELS, TURNS = of_drive('pictures'), of_drive('odometry'), of_drive('turns')
QUALITY = differ(lambda o: o.model().quality['left_out_error_m'])
PRINTED = differ(lambda o: o.text)
POSES = differ(lambda o: (o.folder / 'poses.tum').read_text())
CASES: dict[str, dict[str, Check | Case]] = {
    'simulate': {
        '--size 40x12': lambda a, b: b.bag()['pictures'].shape[1:3] == (12, 40),
        '--trajectory mower': of_drive('truth'),
        '--seed 2': of_drive('truth'),
        '--world 2': differ(lambda o: o.bag()['pictures'][0]),
        '--light evening': PICTURES,
        '--season winter': PICTURES,
        '--area 9x7': Case(more(lambda bag: np.ptp(bag['truth'][:, 0])), '--length 20'),
        '--length 8': more(lambda bag: len(bag['stamps']), 50),
        '--images raw': lambda a, b: '/image_raw' in b.bag()['topics'],
        '--images-every 0.5': more(lambda bag: len(bag['pictures'])),
        '--images-every-turn 5': more(lambda bag: len(bag['pictures'])),
        '--compression png': lambda a, b: '/panorama/compressed' in b.bag()['topics'],
        '--storage sqlite3': lambda a, b: bool([*b.folder.glob('bag/*.db3')]),
        '--image-noise 0': PICTURES,
        '--illumination 1': PICTURES,
        '--terrain 3': PICTURES,
        '--speed 0.5': more(lambda bag: np.ptp(bag['stamps']), 2e9),
        '--odometry-rate 20': lambda a, b: len(b.bag()['turns']) < 0.5 * len(a.bag()['turns']),
        '--test-drift 1': Case(WHEELS, '--trajectory test'),
        '--scale-error 0.1': WHEELS,
        '--slip 0.3': WHEELS,
        '--speed-noise 0.5': WHEELS,
        '--gyro-bias 0.05': TURNS,
        '--gyro-noise 0.1': TURNS,
    },
    'train': {
        '--output {out}/other.npz': written('other.npz'),
        '--config {data}/fewer.yaml': differ(lambda o: o.model().quality['features_used']),
        '--update {data}/model.npz': says('the model'),
        '--report {out}/report': written('report/index.html'),
        '--resume': noted('resume'),
        '--strict': Case(refuses('read without --strict'), base=DAMAGED['train']),
        '--force': Case(
            lambda a, b: (a.code, b.code) == (1, 0),
            base=BASE['train'].replace('small', 'counterclockwise'),
        ),
        '--image-topic /nothing': refuses('/nothing'),
        '--odom-topic /ground_truth': QUALITY,
        '--imu-topic /nothing': refuses('/nothing'),
        '--points-topic /nothing': refuses('/nothing'),
        '--points {data}/fewer.yaml': refuses('is no point'),
        '--segments straight': QUALITY,
        '--solver paper': refuses('needs straight lines'),
        '--metric-map monomials': QUALITY,
        '--engine mdp': lambda a, b: 'mdp' in b.noted and 'mdp' not in a.noted,
        '--normalization grey': differ(lambda o: o.model().network.architecture.normalization),
    },
    'evaluate': {
        '--align {data}/bag': differ(lambda o: o.text.splitlines()[-1]),
        '--config {data}/start.yaml': PRINTED,
        '--smooth': PRINTED,
        '--report {out}/report': written('report/index.html'),
        '--json {out}/figures.json': written('figures.json'),
        '--image-topic /nothing': refuses('/nothing'),
        '--odom-topic /ground_truth': PRINTED,
        '--imu-topic /nothing': refuses('/nothing'),
        '--ground-truth-topic /odom': PRINTED,
    },
    'play': {
        '--loop': noted(('loop', True)),
        '--clock': noted(('clock', True)),
        '--topics /odom': noted(('topics', ['/odom'])),
        '--rate 500': noted(500.0),
        '--wait 0.01': noted(0.01),
    },
    'inspect': {
        '--json {out}/found.json': written('found.json'),
        '--report {out}/report': written('report/index.html'),
        '--strict': Case(refuses('read without --strict'), base=DAMAGED['inspect']),
        '--config {data}/counterclockwise.yaml': says('images turn opposite to odometry'),
        '--imu-topic /nothing': lambda a, b: '/nothing' in b.text,
        '--image-topic /nothing': lambda a, b: '/nothing' in b.text,
        '--odom-topic /ground_truth': says('by /ground_truth'),
        '--min-pictures 9999': says('drive until there are 9999'),
        '--max-spacing 0.1': PRINTED,
        '--reach 0.2': PRINTED,
    },
    'calibrate': {
        '--image-topic /nothing': Case(lambda a, b: '/nothing' in b.text, base='{data}/bag'),
        '--calibration {data}/info.yaml': says('fisheye'),
        '--center 300x200': calibrated(cx=300, cy=200),
        '--radii 50x180': calibrated(radius_min=50, radius_max=180),
        '--output {out}/camera.yaml': written('camera.yaml'),
        '--check {out}/check.png': written('check.png'),
        '--model fisheye': says('fisheye'),
        '--field-of-view 150': Case(PRINTED, '--model fisheye'),
        '--angle-min 70': calibrated(angle_min=70),
        '--angle-max 100': calibrated(angle_max=100),
        '--axis up': calibrated(axis='up'),
        '--mirrored no': calibrated(mirrored='no'),
        '--mount-rpy 0x0x90': Case(
            differ(lambda o: (o.folder / 'check.png').read_bytes()), '--check {out}/check.png'
        ),
    },
    'filter': {
        '--config {data}/start.yaml': POSES,
        '--output {out}/other.tum': written('other.tum'),
    },
    'tune': {
        '--model {data}/other.npz': PRINTED,
        '--config {data}/robot.yaml': differ(lambda o: o.text.splitlines()[-1]),
        '--output {out}/tuned.yaml': written('tuned.yaml'),
        '--method grid': says('m mean error'),
        '--image-topic /nothing': refuses('/nothing'),
        '--odom-topic /ground_truth': PRINTED,
        '--imu-topic /nothing': refuses('/nothing'),
        '--ground-truth-topic /nothing --method grid': refuses('/nothing'),
    },
    'config': {'--output {out}/out.yaml': written('out.yaml')},
    'demo': {
        '--out {out}/elsewhere': lambda a, b: (b.folder / 'elsewhere').is_dir(),
        '--world 3': noted(('world', 3)),
    },
}
OPTIONS = {name: {words.split()[0]: words for words in cases} for name, cases in CASES.items()}


def watch(name: str, notes: list[Any], patch: pytest.MonkeyPatch) -> None:
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


def run(name: str, words: str, folder: Path, **places: Any) -> Outcome:
    """Run a command in this process."""
    text, notes = io.StringIO(), []
    filled = [word.format(out=folder, **places) for word in words.split()]
    with pytest.MonkeyPatch.context() as patch:
        watch(name, notes, patch)
        with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
            code = cli.main([name, *filled])
    return Outcome(code, text.getvalue(), folder, notes)


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
def data(tmp_path_factory: pytest.TempPathFactory, gardens: None, small_network: None) -> Path:
    """Return a folder with every kind of input, each as small as it may be."""
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
    shutil.copytree(folder / 'bag', folder / 'cut')
    (file,) = (folder / 'cut').glob('*.mcap')
    file.write_bytes(file.read_bytes()[: int(0.9 * file.stat().st_size)])
    cv2.imwrite(str(folder / 'mirror.png'), scene(1))
    write_tables(folder)
    return folder


def write_tables(folder: Path) -> None:
    """Write the test drive as the two logs of `filter`."""
    with Bag(folder / 'test') as bag:
        odometry, truth = read_odometry(bag), bag.trajectory()
    rows = zip(odometry.stamps_ns * 1e-9, *odometry.twists.T, strict=True)
    lines = ['stamp_s,v_mps,omega_radps', *(f'{t:.3f},{v},{w}' for t, v, w in rows)]
    (folder / 'odom.csv').write_text('\n'.join(lines))
    rows = zip(truth.stamps_ns[::5] * 1e-9, *truth.poses[::5].T, strict=True)
    lines = ['stamp_s,x_m,y_m,yaw_rad', *(f'{t:.3f},{x},{y},{yaw}' for t, x, y, yaw in rows)]
    (folder / 'positions.csv').write_text('\n'.join(lines))


def test_every_option_has_a_case_and_every_case_an_option():
    named = {(name, option) for name, cases in OPTIONS.items() for option in cases}
    assert named == set(options()), 'a new option needs a case in CASES'


@pytest.mark.parametrize('name', cli.COMMANDS)
def test_each_option_alone_has_its_effect(name, data, tmp_path):
    if name in ('play', 'demo'):
        pytest.importorskip('rclpy')
    failed, outcomes = [], {}
    for words, check in CASES[name].items():
        case = check if isinstance(check, Case) else Case(check)
        base = f'{BASE[name] if case.base is None else case.base} {case.beside}'
        for part in (base, f'{base} {words}'):
            if part not in outcomes:
                folder = tmp_path / str(len(outcomes))
                folder.mkdir()
                outcomes[part] = run(name, part, folder, data=data)
        plain, changed = outcomes[base], outcomes[f'{base} {words}']
        if changed.code not in (0, 1) or not case.differs(plain, changed):
            failed.append(f'{plain.text}\n-- with {words}:\n{changed.text}')
    assert not failed, '\n'.join(failed)
