# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every option of every command, alone: it parses, it runs, and something comes of it."""

import argparse
import contextlib
import io
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from test_calibration import scene

from sfa_localization import cli
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.writer import BagWriter
from sfa_localization.commands.options import given
from sfa_localization.config import write_config
from sfa_localization.data.settings import Settings
from sfa_localization.place_model import PlaceModel
from sfa_localization.simulation import drive as simulation

parser_of = cli.command_parser


def options() -> list[tuple[str, str]]:
    """Return command and name of every option that there is."""
    return [
        (name, action.option_strings[-1])
        for name in cli.COMMANDS
        for action in parser_of(name)._actions
        if action.option_strings and action.dest != 'help'
    ]


def words_for(action: argparse.Action) -> list[str]:
    """Return words that the action takes, whatever they mean."""
    if action.nargs == 0:
        return []
    one = str(list(action.choices)[-1]) if action.choices else '7'
    count = action.nargs if isinstance(action.nargs, int) else 1
    return [one] * count


def test_an_option_reaches_one_group_of_settings_at_most():
    """Whichever groups a command reads, an option meant for one never appears in another."""
    every, wrong = options(), []
    groups = {group.__name__: group for group in Settings.__subclasses__()}
    for name, option in every:
        parser = parser_of(name)
        (meant,) = (a for a in parser._actions if option in a.option_strings)
        needed = [a for a in parser._actions if a.required and a is not meant]
        needed.sort(key=lambda action: bool(action.option_strings))  # BAG before --topics takes it
        words = [word for a in needed for word in [*a.option_strings[:1], *words_for(a)]]
        arguments = parser.parse_args([*words, option, *words_for(meant)])
        reached = {n: got for n, group in groups.items() if (got := given(group, arguments))}
        group, _, setting = meant.dest.partition('.')
        if reached != ({group: {setting: vars(arguments)[meant.dest]}} if setting else {}):
            wrong.append((name, option, reached))
    assert wrong == []


# Each option alone, on small inputs: what a command is given without it, and what comes of it.


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
                'topics': {topic.name: topic.kind for topic in bag.topics.values()},
                'truth': bag.trajectory(),
                'odometry': bag.odometry(),
                'turns': bag.yaw_rate().omega if '/imu' in bag.topics else np.zeros(0),
                'pictures': np.array([picture for _, picture in bag.images()]),
            }

    def model(self) -> PlaceModel:
        return PlaceModel.load(self.folder / 'model.npz')

    def yaml(self, section: str) -> dict[str, Any]:
        document = yaml.safe_load((self.folder / 'out.yaml').read_text())
        return next(
            part['ros__parameters']
            for key, part in document.items()
            if key.rpartition('/')[2] == section
        )

    def camera(self) -> dict[str, Any]:
        """Return the calibration that was printed, before it asks for a look."""
        return yaml.safe_load(self.text.partition('look at ')[0])


@dataclass(frozen=True)
class Case:
    """Words of one option, words given besides with and without it, and what tells them apart.

    `{data}` in words is the folder of inputs, `{out}` that of this run.
    """

    words: str
    differs: Callable[[Outcome, Outcome], bool]
    beside: str = ''
    base: str | None = None
    """Instead of what the command is given otherwise."""
    prepare: Callable[[Path], Any] = lambda out: None
    """What is done in the folder of the run before it."""


def says(text: str) -> Callable[[Outcome, Outcome], bool]:
    """Only with the option it works, and prints this."""
    return lambda a, b: b.code == 0 and text in b.text and text not in a.text


def refuses(text: str) -> Callable[[Outcome, Outcome], bool]:
    """Only with the option it ends with this error, in one line."""
    return lambda a, b: (
        a.code == 0 and b.code == 1 and text in b.text.split('error: ')[-1] and text not in a.text
    )


def differ(what: Callable[[Outcome], Any]) -> Callable[[Outcome, Outcome], bool]:
    """Both work, and this differs."""
    return lambda a, b: a.code == b.code == 0 and not same(what(a), what(b))


def same(a: Any, b: Any) -> bool:
    return np.shape(a) == np.shape(b) and bool(np.all(np.asarray(a) == np.asarray(b)))


def same_truth(a: Outcome, b: Outcome) -> bool:
    return same(a.bag()['truth'].poses, b.bag()['truth'].poses)


def of_pictures(a: Outcome, b: Outcome) -> bool:
    """The same drive in other pictures."""
    x, y = a.bag(), b.bag()
    return same_truth(a, b) and not same(x['pictures'], y['pictures'])


def of_wheels(a: Outcome, b: Outcome) -> bool:
    """The same drive, measured otherwise."""
    return same_truth(a, b) and not same(a.bag()['odometry'].poses, b.bag()['odometry'].poses)


def of_turns(a: Outcome, b: Outcome) -> bool:
    return same_truth(a, b) and not same(a.bag()['turns'], b.bag()['turns'])


def another_drive(a: Outcome, b: Outcome) -> bool:
    return not same_truth(a, b)


def seconds(outcome: Outcome) -> float:
    return float(np.ptp(outcome.bag()['truth'].stamps_ns)) * 1e-9


def width(outcome: Outcome) -> float:
    return float(np.ptp(outcome.bag()['truth'].poses[:, 0]))


def metres(outcome: Outcome) -> float:
    return float(np.hypot(*np.diff(outcome.bag()['truth'].poses[:, :2], axis=0).T).sum())


def check_image(outcome: Outcome) -> bytes:
    return (outcome.folder / 'check.png').read_bytes()


def written(name: str) -> Callable[[Outcome, Outcome], bool]:
    """Only with the option there is such a file, not empty."""
    return lambda a, b: (
        b.code == 0 and (b.folder / name).stat().st_size > 0 and not (a.folder / name).exists()
    )


def noted(*values: Any) -> Callable[[Outcome, Outcome], bool]:
    """Only with the option the stand-ins were handed these."""
    return lambda a, b: (
        a.code == b.code == 0
        and all(value in b.noted for value in values)
        and not all(value in a.noted for value in values)
    )


BASE = {
    'simulate': '{out}/bag --area 6x6 --length 4 --images panorama --size 32x8 --images-every 1',
    'train': '{data}/bag --output {out}/model.npz --config {data}/small.yaml',
    'evaluate': '{data}/model.npz {data}/test',
    'play': '{data}/test --rate 1000 --wait 0',
    'inspect': '{data}/bag',
    'calibrate': '{data}/mirror.png',
    'filter': '{data}/odom.csv {data}/positions.csv --output {out}/poses.tum',
    'tune': '{data}/test --model {data}/model.npz --output {out}/out.yaml --trials 10',
    'config': '',
    'demo': '--out {out}/demo',
}
DAMAGED = {name: BASE[name].replace('/bag', '/cut').replace('/test', '/cut') for name in BASE}
QUALITY = differ(lambda o: o.model().quality['left_out_error_m'])
PRINTED = differ(lambda o: o.text)
POSES = differ(lambda o: (o.folder / 'poses.tum').read_text())
CASES: dict[str, list[Case]] = {
    'simulate': [
        Case('--size 40x12', lambda a, b: b.bag()['pictures'].shape[1:3] == (12, 40)),
        Case('--compressed', lambda a, b: '/panorama/compressed' in {*b.bag()['topics']}),
        Case('--trajectory curves', another_drive),
        Case('--seed 2', another_drive),
        Case('--world 2', differ(lambda o: o.bag()['pictures'][0])),
        Case('--light evening', of_pictures),
        Case('--season winter', of_pictures),
        Case('--area 9x7', lambda a, b: width(b) > width(a), beside='--length 20'),
        Case('--length 8', lambda a, b: metres(b) > metres(a) + 2),
        Case('--images raw', lambda a, b: '/image_raw' in b.bag()['topics']),
        Case(
            '--images-every 0.5', lambda a, b: len(b.bag()['pictures']) > len(a.bag()['pictures'])
        ),
        Case(
            '--images-every-turn 5',
            lambda a, b: len(b.bag()['pictures']) > len(a.bag()['pictures']),
        ),
        Case(
            '--compression png',
            lambda a, b: b.bag()['topics']['/panorama/compressed'].endswith('CompressedImage'),
        ),
        Case('--storage sqlite3', lambda a, b: bool([*b.folder.glob('bag/*.db3')])),
        Case('--image-noise 0', of_pictures),
        Case('--illumination 1', of_pictures),
        Case('--speed 0.5', lambda a, b: seconds(b) > seconds(a) + 2),
        Case(
            '--odometry-rate 20', lambda a, b: len(b.bag()['turns']) < 0.5 * len(a.bag()['turns'])
        ),
        Case('--odometry-frame start', of_wheels),
        Case('--test-drift 1', of_wheels, beside='--trajectory test'),
        Case('--scale-error 0.1', of_wheels),
        Case('--slip 0.3', of_wheels),
        Case('--speed-noise 0.5', of_wheels),
        Case('--gyro-bias 0.05', of_turns),
        Case('--gyro-noise 0.1', of_turns),
    ],
    'train': [
        Case('--output {out}/other.npz', written('other.npz')),
        Case(
            '--config {data}/fewer.yaml',
            lambda a, b: b.model().quality['features_used'] < a.model().quality['features_used'],
        ),
        Case('--update {data}/model.npz', says('the model')),
        Case('--report {out}/report', written('report/index.html')),
        Case(
            '--resume',
            refuses('train without --resume'),
            prepare=lambda out: (out / '.model.npz.checkpoint.npz').write_bytes(b'of another'),
        ),
        Case('--strict', refuses('read without --strict'), base=DAMAGED['train']),
        Case('--image-topic /nothing', refuses('/nothing')),
        Case('--odom-topic /ground_truth', QUALITY),
        Case('--imu-topic /nothing', refuses('/nothing')),
        Case('--segments straight', QUALITY),
        Case('--solver paper', refuses('needs straight lines')),
        Case('--metric-map monomials', QUALITY),
        Case('--engine mdp', lambda a, b: 'pip install MDP' in b.text or QUALITY(a, b)),
        Case(
            '--normalization grey', differ(lambda o: o.model().network.architecture.normalization)
        ),
    ],
    'evaluate': [
        Case('--align {data}/bag', differ(lambda o: o.text.splitlines()[-1])),
        Case('--config {data}/start.yaml', PRINTED),
        Case('--smooth', PRINTED),
        Case('--report {out}/report', written('report/index.html')),
        Case('--json {out}/figures.json', written('figures.json')),
        Case('--image-topic /nothing', refuses('/nothing')),
        Case('--odom-topic /ground_truth', PRINTED),
        Case('--imu-topic /nothing', refuses('/nothing')),
        Case('--ground-truth-topic /odom', PRINTED),
    ],
    'play': [
        Case('--loop', PRINTED),
        Case('--clock', noted('/clock')),
        Case(
            '--topics /odom', lambda a, b: b.text.count('messages') == 1 < a.text.count('messages')
        ),
        Case('--wait-for /odom', noted(('wait for', ['/odom']))),
        Case('--strict', refuses('read without --strict'), base=DAMAGED['play']),
        Case('--rate 500', noted(('rate', 500.0))),
        Case('--start-offset 10', PRINTED),
        Case('--wait 0.01', noted(('wait', 0.01))),
    ],
    'inspect': [
        Case('--json {out}/found.json', written('found.json')),
        Case('--report {out}/report', written('report/index.html')),
        Case('--strict', refuses('read without --strict'), base=DAMAGED['inspect']),
        Case('--image-topic /nothing', lambda a, b: '/nothing' in b.text),
        Case('--odom-topic /ground_truth', says('by /ground_truth')),
        Case('--min-pictures 9999', says('drive until there are 9999')),
        Case('--max-spacing 0.1', PRINTED),
        Case('--reach 0.2', PRINTED),
    ],
    'calibrate': [
        Case('--image-topic /nothing', lambda a, b: '/nothing' in b.text, base='{data}/bag'),
        Case('--calibration {data}/info.yaml', says('fisheye')),
        Case('--center 300x200', lambda a, b: (b.camera()['cx'], b.camera()['cy']) == (300, 200)),
        Case(
            '--radii 50x180',
            lambda a, b: (b.camera()['radius_min'], b.camera()['radius_max']) == (50, 180),
        ),
        Case('--output {out}/camera.yaml', written('camera.yaml')),
        Case('--check {out}/check.png', written('check.png')),
        Case('--model fisheye', says('fisheye')),
        Case('--field-of-view 150', PRINTED, beside='--model fisheye'),
        Case('--angle-min 70', lambda a, b: b.camera()['angle_min'] == 70),
        Case('--angle-max 100', lambda a, b: b.camera()['angle_max'] == 100),
        Case('--axis up', lambda a, b: b.camera()['axis'] == 'up'),
        Case('--mirrored no', lambda a, b: b.camera()['mirrored'] == 'no'),
        Case(
            '--mount-rpy 0x0x90',
            lambda a, b: check_image(a) != check_image(b) and '[0.0, 0.0, 90.0]' in b.text,
            beside='--check {out}/check.png',
        ),
    ],
    'filter': [
        Case('--config {data}/start.yaml', POSES),
        Case('--initial-pose 1 2 3', POSES),
        Case('--smooth', POSES),
        Case('--truth {data}/positions.csv', says('inside 95 % regions')),
        Case('--output {out}/other.tum', written('other.tum')),
    ],
    'tune': [
        Case('--model {data}/other.npz', PRINTED),
        Case(
            '--config {data}/robot.yaml',
            lambda a, b: (
                b.code == 0
                and b.yaml('ekf_node')['use_sim_time'] is True
                and b.yaml('ekf_node')['qos_overrides'] == {'/odom': {'subscription': {'depth': 3}}}
                and b.yaml('training')['odometry'] == '/ground_truth'
                and b.text.splitlines()[-1] != a.text.splitlines()[-1]
            ),
        ),
        Case('--output {out}/tuned.yaml', written('tuned.yaml')),
        Case('--method grid', says('m mean error')),
        Case('--trials 14', PRINTED),
        Case('--image-topic /nothing', refuses('/nothing')),
        Case('--odom-topic /ground_truth', PRINTED),
        Case('--imu-topic /nothing', refuses('/nothing')),
        Case('--ground-truth-topic /nothing --method grid', refuses('/nothing')),
    ],
    'config': [Case('--output {out}/out.yaml', written('out.yaml'))],
    'demo': [
        Case('--out {out}/elsewhere', written('elsewhere/.sfa_localization_demo.json')),
        Case('--world 3', noted(('world', 3))),
        Case('--seed 4', noted(('seed', 4))),
        Case('--rate 2', noted(('--rate', '2.0'))),
    ],
}
OPTIONS = {name: {case.words.split()[0]: case for case in cases} for name, cases in CASES.items()}
pytestmark = pytest.mark.usefixtures('gardens', 'small_network')


@contextlib.contextmanager
def watched(name: str, notes: list[Any]) -> Iterator[None]:
    """Note what no output shows; minutes of work of `demo` are left out."""
    with pytest.MonkeyPatch.context() as patch:
        if name == 'play':
            watch_play(patch, notes)
        if name == 'demo':
            watch_demo(patch, notes)
        yield


def watch_play(patch: pytest.MonkeyPatch, notes: list[Any]) -> None:
    """Note pace and patience; an endless replay ends in its third round."""
    from sfa_localization.commands import bag_player

    class Player(bag_player.Player):
        rounds = 0

        def wait_for_subscribers(self, topics=()):
            notes.extend([('rate', self.pace.rate), ('wait', self._config.wait)])
            notes.append(('wait for', list(topics)))
            return super().wait_for_subscribers(topics)

        def _play_once(self):
            self.rounds += 1
            if self.rounds == 3:
                self._node.context.try_shutdown()
            return super()._play_once()

    class Ticker(bag_player.Ticker):
        def tick(self, time_ns):
            super().tick(time_ns)
            notes.append('/clock')

    patch.setattr(bag_player, 'Player', Player)
    patch.setattr(bag_player, 'Ticker', Ticker)


def watch_demo(patch: pytest.MonkeyPatch, notes: list[Any]) -> None:
    """Only the demo's own steps run, with nothing in their places."""
    from sfa_localization import training
    from sfa_localization.commands import demo, live_nodes

    def run_live(programs, logs, on_end):
        notes.extend(pair for words in programs.values() for pair in pairwise(words))

    def simulated(settings, out, progress):
        notes.extend([('world', settings.world), ('seed', settings.seed)])

    patch.setattr(simulation, 'simulate', simulated)
    patch.setattr(training, 'train', lambda *_args, **_named: None)
    patch.setattr(live_nodes, 'run_live', run_live)
    patch.setattr(demo, '_compare', lambda *_args: (SimpleNamespace(scores={}), 0.0))
    patch.setattr(demo, '_write_results', lambda *_args: None)


def run(name: str, words: str, folder: Path, **places: Any) -> Outcome:
    """Run a command in this process."""
    text, notes = io.StringIO(), []
    filled = [word.format(out=folder, **places) for word in words.split()]
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text), watched(name, notes):
        code = cli.main([name, *filled])
    return Outcome(code, text.getvalue(), folder, notes)


@pytest.fixture(scope='module')
def data(tmp_path_factory: pytest.TempPathFactory, gardens: None, small_network: None) -> Path:
    """Return a folder with every kind of input, each as small as it may be."""
    folder = tmp_path_factory.mktemp('data')
    world = '--area 6x6 --images panorama --size 160x16 --odometry-rate 10 --images-every 0.3'
    drives = {
        'bag': '--length 30', 'test': '--length 12 --seed 2 --trajectory test --compressed',
    }  # fmt: skip
    for name, more in drives.items():
        made = run('simulate', f'{{out}}/{name} {world} {more}', folder)
        assert made.code == 0, made.text
    for name, count in {'small': 6, 'fewer': 4}.items():
        text = f'training:\n  ros__parameters:\n    slow_features: {count}\n'
        (folder / f'{name}.yaml').write_text(text)
    (folder / 'start.yaml').write_text(
        'ekf_node:\n  ros__parameters:\n    measurement_factor: 9.0\n'
    )
    (folder / 'robot.yaml').write_text(
        'ekf_node:\n  ros__parameters:\n    use_sim_time: true\n'
        '    qos_overrides: {/odom: {subscription: {depth: 3}}}\n'
        'training:\n  ros__parameters:\n    odometry: /ground_truth\n'
    )
    for name, kind in (('model', 'small'), ('other', 'fewer')):
        words = f'{{out}}/bag --output {{out}}/{name}.npz --config {{out}}/{kind}.yaml'
        made = run('train', words, folder)
        assert made.code == 0, made.text
    cut = folder / 'cut'
    shutil.copytree(folder / 'bag', cut)
    (file,) = cut.glob('*.mcap')
    file.write_bytes(file.read_bytes()[: int(0.9 * file.stat().st_size)])
    cv2.imwrite(str(folder / 'mirror.png'), scene(1))
    (folder / 'info.yaml').write_text(
        'image_width: 640\nimage_height: 480\ndistortion_model: equidistant\n'
        'camera_matrix: {rows: 3, cols: 3, data: [200, 0, 320, 0, 200, 240, 0, 0, 1]}\n'
        'distortion_coefficients: {rows: 1, cols: 4, data: [0.01, 0, 0, 0]}\n'
    )
    write_tables(folder)
    return folder


def write_tables(folder: Path) -> None:
    """Write the test drive as the two logs of `filter`."""
    with Bag(folder / 'test') as bag:
        odometry, truth = bag.odometry(), bag.trajectory()
    rows = zip(odometry.stamps_ns * 1e-9, *odometry.twists.T, strict=True)
    lines = ['stamp_s,v_mps,omega_radps', *(f'{t:.3f},{v},{w}' for t, v, w in rows)]
    (folder / 'odom.csv').write_text('\n'.join(lines))
    rows = zip(truth.stamps_ns[::5] * 1e-9, *truth.poses[::5].T, strict=True)
    lines = ['stamp_s,x_m,y_m,yaw_rad', *(f'{t:.3f},{x},{y},{yaw}' for t, x, y, yaw in rows)]
    (folder / 'positions.csv').write_text('\n'.join(lines))


def test_every_option_has_a_case_and_every_case_an_option():
    named = {(name, option) for name, cases in OPTIONS.items() for option in cases}
    assert named == set(options()), 'a new option needs a case in OPTIONS'


@pytest.fixture(scope='module')
def without(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Outcome]:
    """Return what a command does without an option: the same for many options, so run once."""
    known: dict[tuple[str, ...], Outcome] = {}

    def outcome(name: str, words: str, case: Case) -> Outcome:
        if (name, words) not in known:
            folder = tmp_path_factory.mktemp(f'{name}_')
            case.prepare(folder)
            known[name, words] = run(name, words, folder, data=data)
        return known[name, words]

    return outcome


@pytest.mark.parametrize('name', cli.COMMANDS)
def test_each_option_alone_has_its_effect(name, data, without, tmp_path):
    if name in ('play', 'demo'):
        pytest.importorskip('rclpy')
    failed = []
    for option, case in OPTIONS[name].items():
        words = f'{BASE[name] if case.base is None else case.base} {case.beside}'
        places, folder = {'data': data}, tmp_path / option
        folder.mkdir()
        plain = without(name, words, case)
        case.prepare(folder)
        changed = run(name, f'{words} {case.words}', folder, **places)
        if changed.code not in (0, 1) or not case.differs(plain, changed):
            failed.append(f'{plain.text}\n-- with {case.words}:\n{changed.text}')
    assert not failed, '\n'.join(failed)


@pytest.mark.parametrize(('size', 'entry'), [
    ((98, 98), None), ((48, 96), 'equirectangular'), ((48, 96), None),
])  # fmt: skip
def test_raw_images_are_trained_on_only_with_a_description(tmp_path, capsys, size, entry):
    """What train asks for is what helps: square images of any camera, and equirectangular ones."""
    rng = np.random.default_rng(0)
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(1, 4):
            picture = rng.integers(0, 256, (*size, 3), np.uint8)
            bag.image('/image_raw', k * 10**9, picture, 'camera')
            bag.odometry('/odom', k * 10**9, [0.2 * k, 0.0, 0.0], [0.2, 0.0], [0.01, 0.01])
    write_config(tmp_path / 'own.yaml', {'omnicam_node': {'camera_model': entry or ''}})
    words = ['train', str(tmp_path / 'bag'), '--config', str(tmp_path / 'own.yaml')]
    assert cli.main([*words, '--output', str(tmp_path / 'model.npz')]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    asked = 'no camera is described: in the parameter file set calibration_file' in error
    assert asked == (entry is None) and ('equirectangular' in error) == asked, error
    assert not (tmp_path / 'model.npz').exists()
