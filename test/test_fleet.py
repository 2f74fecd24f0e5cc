# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Many gardens: each in its own process, what is left is the state, and a page tells of all."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from unittest import mock

import psutil
import pytest
from cylinder_worlds import SMALL_RECIPE, write_bag

from sfa_localization import cli
from sfa_localization.commands import fleet, garden, options
from sfa_localization.commands.garden import Garden
from sfa_localization.reports.fleet import write_fleet_page


def pretended(place):
    """The work on a garden whose file `script` says what happens; a garden writes its pid."""
    script, tries = (place.folder / 'script').read_text(), place.folder / '.tries'
    with open(tries, 'a') as file:
        file.write(f'{os.getpid()}\n')
    if script == 'dies' or (script == 'dies once' and len(tries.read_text().split()) == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if script == 'fails':
        raise ValueError('a fault\nof two lines')
    grade = 'bad' if script == 'refuses' else 'good'
    place.model.parent.mkdir(parents=True, exist_ok=True)
    place.model.touch()
    return place.write({'inputs': place.inputs()}, [{'grade': grade, 'sentence': script}])


@pytest.fixture
def gardens(tmp_path, monkeypatch):
    """A folder of gardens with a script each; `run()` returns exit code and results by name."""
    monkeypatch.setattr(garden, 'work', pretended)

    def run(*words, **scripts):
        for name, script in scripts.items():
            (tmp_path / 'gardens' / name).mkdir(parents=True, exist_ok=True)
            (tmp_path / 'gardens' / name / 'script').write_text(script)
        file, output = tmp_path / 'all.json', tmp_path / 'models'
        named = [str(tmp_path / 'gardens'), '--output', str(output), '--json', str(file)]
        code = cli.main(['fleet', *named, *words])
        return code, {row['garden']: row for row in json.loads(file.read_text())['gardens']}

    run.tries = lambda name: (tmp_path / 'gardens' / name / '.tries').read_text().split()
    run.page = tmp_path / 'models/index.html'
    return run


def test_a_process_that_dies_loses_only_its_garden_and_what_is_done_is_not_done_again(
    gardens, capsys
):
    code, results = gardens('--workers', '2', a='good', b='dies', c='dies once', e='refuses')
    states = {name: row['state'] for name, row in results.items()}
    assert states == dict.fromkeys('ac', 'good') | dict.fromkeys('be', 'refused') and code == 1
    assert [len(set(gardens.tries(name))) for name in 'abce'] == [1, 2, 2, 1]
    assert len({pid for name in 'abce' for pid in gardens.tries(name)}) == 6, 'a process each'
    told = capsys.readouterr()
    assert 'b: refused: ' in told.out and 'BrokenProcessPool' in told.out

    code, results = gardens('--workers', '1', b='fails')
    assert [len(gardens.tries(name)) for name in 'abce'] == [1, 4, 2, 1] and code == 1
    assert 'ValueError: a fault of two lines' in results['b']['sentences'][0]
    text = gardens.page.read_text()
    assert text.index('>b<') < text.index('>e<') < text.index('>a<') and '2 good' in text


def test_a_cluster_works_by_the_same_rules(gardens):
    distributed = pytest.importorskip('distributed')
    one = {'n_workers': 1, 'threads_per_worker': 1, 'dashboard_address': None}
    with distributed.LocalCluster(processes=False, **one) as cluster:
        code, results = gardens('--scheduler', cluster.scheduler_address, a='good', b='fails')
    assert (code, results['a']['state'], results['b']['state']) == (1, 'good', 'refused')
    assert [len(gardens.tries(name)) for name in 'ab'] == [1, 2]


def test_a_long_work_says_that_it_goes_on(gardens, monkeypatch, capsys):
    """Also before the first garden is done."""
    monkeypatch.setattr(fleet, 'LOG_PERIOD_S', 0.05)
    gardens('--workers', '1', a='good')
    assert 'running 1, refused 0: 0% of 1 gardens' in capsys.readouterr().err


def test_ctrl_c_ends_the_processes_and_leaves_a_page(gardens, monkeypatch):
    monkeypatch.setattr(fleet, 'wait', mock.Mock(side_effect=KeyboardInterrupt))
    code, results = gardens('--workers', '1', a='good', b='good')
    assert code == 130 and results == {} and '0 of 2 gardens' in gardens.page.read_text()
    assert all(child.join(60) is None for child in fleet.multiprocessing.active_children())


def test_a_process_ends_with_a_parent_that_is_killed():
    script = (
        'import multiprocessing, os, time\n'
        'from sfa_localization.commands import fleet\n'
        'with fleet._processes(1) as (submit, _):\n'
        '    submit(time.sleep, 600)\n'
        '    print(multiprocessing.active_children()[0].pid, flush=True)\n'
        '    time.sleep(3)\n'
        '    os._exit(1)\n'
    )
    ended = subprocess.run([sys.executable, '-c', script], stdout=subprocess.PIPE, check=False)
    assert ended.returncode == 1
    with contextlib.suppress(psutil.NoSuchProcess):
        psutil.Process(int(ended.stdout)).wait(timeout=60)


@pytest.fixture
def place(trained, tmp_path, monkeypatch):
    """A garden with the small drive, learned by the small recipe."""
    monkeypatch.setattr(options, 'recipe', lambda arguments: SMALL_RECIPE)
    shutil.copytree(trained.bag, tmp_path / 'bags' / trained.bag.name)
    return Garden(tmp_path / 'bags', tmp_path / 'models' / 'one')


def test_a_garden_is_trained_as_by_train_then_updated_and_never_loses_its_model(place, trained):
    shutil.copytree(trained.bag, place.folder / 'test' / 'again')
    (place.folder / 'notes.txt').write_text('the gate was open')
    assert not place.is_up_to_date()
    state = garden.work(place)
    first, data = place.result(), place.model.read_bytes()
    assert data == trained.model.read_bytes() and place.is_up_to_date()
    assert first['state'] == state == 'weak' and 'has no true poses' in first['sentences'][0]
    assert (place.output / 'training/index.html').is_file()

    shutil.rmtree(place.folder / 'test')
    write_bag(place.folder / 'later', seed=3)
    assert not place.is_up_to_date()
    garden.work(place)
    later = place.result()
    assert 'later: ' in later['sentences'][1] and place.is_up_to_date()
    assert (place.output / 'update_later/index.html').is_file()
    assert later['sentences'][0] == first['sentences'][1]
    assert later['trained_s'] == first['trained_s'] != 0
    assert 'change_m' not in first and later['change_m'] == 0

    data = place.model.read_bytes()
    shutil.copytree(trained.bag, place.folder / 'december' / 'drive')
    assert not place.is_up_to_date() and garden.work(place) == 'weak'
    assert 'december/drive: not used: bags lie directly' in place.result()['sentences'][0]
    shutil.rmtree(place.folder / 'december')
    shutil.rmtree(place.folder / 'drive')
    (place.folder / 'later' / 'later.mcap').write_bytes(b'nothing')
    assert garden.work(place) == 'refused' and place.model.read_bytes() == data
    assert place.is_up_to_date()
    assert place.result()['expected_error_m'] == later['expected_error_m']


def test_the_worst_tested_error_of_a_garden_is_among_its_results():
    tests = [{'grade': 'good', 'ekf': {'mean': mean, 'p95': 2 * mean, 'max': 3 * mean, 'n': 5}}
             for mean in (0.1, 0.25)]  # fmt: skip
    tests += [{'grade': 'weak', 'sentence': 'not used'}, {'ekf': {'mean': None}}]
    assert garden._tested(tests) == {'mean_m': 0.25, 'p95_m': 0.5, 'max_m': 0.75}
    assert garden._tested(tests[2:]) == {}


def test_a_drive_that_an_update_cannot_use_is_named_and_the_model_stays(place, monkeypatch):
    garden.work(place)
    data = place.model.read_bytes()
    write_bag(place.folder / 'later', seed=3)
    (place.folder / 'later' / 'later.mcap').write_bytes(b'nothing')
    assert garden.work(place) == 'weak' and place.model.read_bytes() == data
    assert 'later.mcap' in place.result()['sentences'][0] and place.is_up_to_date()


def test_a_training_that_was_interrupted_with_other_bags_starts_anew(place, trained):
    checkpoint = place.output / '.model.npz.checkpoint.npz'
    checkpoint.parent.mkdir(parents=True)
    shutil.copy(trained.model, checkpoint)
    garden.work(place)
    assert place.model.read_bytes() == trained.model.read_bytes() and not checkpoint.exists()


def test_files_of_the_garden_are_its_options(trained, tmp_path):
    place = Garden(tmp_path / 'bags', tmp_path / 'models')
    shutil.copytree(trained.bag, place.folder / 'drive')
    (place.folder / 'points.csv').write_text('nothing')
    assert garden.work(place) == 'refused' and 'points.csv' in place.result()['sentences'][0]
    config = place.folder / 'localization.yaml'
    config.write_text('training: {ros__parameters: {slow: 5}}')
    assert not place.is_up_to_date() and garden.work(place) == 'refused'
    assert str(config) in place.result()['sentences'][0]


@pytest.mark.parametrize(('text', 'words'), [
    ('a: 1', 'must be a list'), ('', 'must be a list'), ('[', 'is not YAML'),
    ('[a/x, b/x]', 'two folders have the name x'), ('[models]', 'holds no folder'),
])  # fmt: skip
def test_a_bad_list_of_gardens_is_an_error(text, words, tmp_path, capsys):
    (tmp_path / 'gardens.yaml').write_text(text)
    listed, models = str(tmp_path / 'gardens.yaml'), tmp_path / 'models'
    assert cli.main(['fleet', listed, '--output', str(models)]) == 1
    assert words in capsys.readouterr().err and not models.exists()


def test_the_page_is_in_order_escaped_and_needs_no_other_file(tmp_path):
    (tmp_path / 'a<b & c' / 'inspection').mkdir(parents=True)
    (tmp_path / 'a<b & c' / 'inspection' / 'index.html').touch()
    good = {'garden': 'good', 'grade': 'good', 'state': 'good', 'sentences': ['The map is good']}
    weak = {**good, 'garden': 'weak', 'grade': 'weak', 'state': 'weak', 'expected_error_m': 0.8}
    tested = {'mean_m': 0.05, 'p95_m': 0.125, 'max_m': 0.3}
    rows = [
        {**good, 'expected_error_m': 0.1, 'change_m': -0.2, 'area_m2': 50.4, 'trained_s': 8.64e4},
        {'garden': 'a<b & c', 'grade': 'bad', 'state': 'refused', 'sentences': ['no <bag>']},
        weak,
        {**weak, 'garden': 'weaker', 'expected_error_m': 0.9},
        {**weak, 'garden': 'tested', 'expected_error_m': 0.1, 'tested': tested},
        {**weak, 'garden': 'worst', 'expected_error_m': 0.1, 'tested': {**tested, 'mean_m': 0.06}},
    ]
    write_fleet_page(tmp_path, rows, 7, 3 * 8.64e4)
    text = (tmp_path / 'index.html').read_text()
    cells = [re.findall('<td>(.*?)</td>', row) for row in re.findall('<tr.*?</tr>', text)[1:]]
    order = ['a&lt;b &amp; c', 'worst', 'tested', 'weaker', 'weak', 'good']
    assert [row[0] for row in cells] == order
    assert cells[0][3] == 'no &lt;bag&gt;' and set(cells[0][4:]) == {'-'}
    assert cells[2][4:7] == ['0.05', '0.12', '0.10']
    assert cells[5][4:] == ['-', '-', '0.10', '50', '2.0', '-0.20']
    assert 'href="a%3Cb%20%26%20c/inspection/index.html"' in cells[0][2]
    assert '6 of 7 gardens: 1 refused, 4 weak, 1 good' in text
    assert not re.search('src=|<link|http', text)
