# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The package as a whole: imports between rooms, one version, what is installed, exit codes."""

import ast
import re
import runpy
import subprocess
import sys
import xml.etree.ElementTree as ET
from functools import cache, partial
from pathlib import Path
from unittest import mock

import pytest
import setuptools
from page_tables import ROOT

import sfa_localization
from sfa_localization import cli, training
from sfa_localization.cli import COMMANDS, EXECUTABLES
from sfa_localization.nodes.process import NODES

NAME = 'sfa_localization'
PACKAGE = ROOT / NAME
MODULES = {
    '.'.join(path.relative_to(ROOT).with_suffix('').parts).removesuffix('.__init__'): path
    for path in PACKAGE.rglob('*.py')
}
ROS = {'rclpy', 'ament_index_python', 'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs',
       'lifecycle_msgs', 'nav_msgs', 'rcl_interfaces', 'rosgraph_msgs', 'sensor_msgs', 'std_msgs',
       'std_srvs', 'tf2_msgs', 'visualization_msgs'}  # fmt: skip
# The rooms: which other rooms each may import (always its own), and which packages beyond the
# standard library. A module belongs to its folder, or is a room of its own; there is no
# default, so a new one must be added here, and to the diagram of CONTRIBUTING.
NUMERIC = {'numpy', 'scipy'}
METHOD = {'motion', 'metric', 'mapping'}
CORE = {'data', 'camera', 'sfa', 'keyframes', 'fusion', 'bags'} | METHOD
ROOMS: dict[str, tuple[set[str], set[str]]] = {
    '__init__': (set(), set()),
    '__main__': ({'cli', '__init__'}, set()),
    'data': (set(), {'numpy', 'threadpoolctl', 'tqdm', 'yaml'}),
    'camera': ({'data'}, NUMERIC | {'cv2', 'yaml', 'av'}),
    'sfa': ({'data', 'camera', 'keyframes'}, NUMERIC | {'cv2', 'mdp'}),
    'keyframes': ({'data', 'camera'}, NUMERIC | {'cv2'}),
    'fusion': ({'data'}, NUMERIC),
    'bags': ({'data', 'camera'}, {'numpy', 'rosbags', 'mcap', 'lz4', 'zstandard', 'yaml'}),
    'motion': ({'data', 'keyframes'}, NUMERIC),
    'metric': ({'data', 'keyframes', 'motion'}, NUMERIC),
    'mapping': ({'data', 'sfa', 'keyframes', 'motion', 'metric'}, NUMERIC),
    'place_model': ({'data', 'camera', 'sfa', 'keyframes', 'mapping'}, {'numpy'}),
    'library': ({'data', 'camera', 'bags', 'place_model'}, set()),
    'observer': ({'data', 'camera', 'keyframes', 'place_model'}, {'numpy'}),
    'localizer': ({'data', 'camera', 'fusion', 'place_model', 'observer'}, set()),
    'simulation': ({'data', 'camera', 'bags'}, NUMERIC | {'cv2', 'trimesh', 'embreex'}),
    'training_input': (CORE, NUMERIC),
    'training': (CORE | {'place_model', 'training_input'}, {'numpy'}),
    'evaluation': (CORE | {'place_model', 'observer', 'localizer', 'training'}, NUMERIC),
    'tuning': (CORE | {'place_model', 'observer', 'localizer', 'training', 'evaluation'}, NUMERIC),
    'updating': (CORE - METHOD | {'place_model', 'observer', 'localizer'}, NUMERIC),
    'inspection': (CORE - {'sfa'}, NUMERIC | {'cv2'}),
    'filtering': ({'data', 'fusion'}, {'numpy'}),
    'reports': (
        {'data', 'camera', 'keyframes', 'training', 'inspection'} | METHOD,
        {'numpy', 'matplotlib', 'plotly', 'PIL'},  # PIL comes with matplotlib
    ),
    'nodes': (
        {'data', 'camera', 'fusion', 'bags', 'mapping', 'place_model', 'observer', 'config'},
        {'numpy', 'yaml', 'nav2_msgs'} | ROS,  # nav2_msgs where it is installed
    ),
    'config': (CORE | {'nodes'}, {'yaml'}),
    'commands': (
        CORE
        | {'config', 'place_model', 'localizer', 'training', 'evaluation', 'tuning', 'inspection'}
        | {'updating', 'filtering', 'simulation', 'reports', 'nodes', '__init__'},
        {'numpy', 'rosbags', 'distributed'} | ROS,
    ),
    'cli': ({'data', 'commands', 'nodes', '__init__'}, set()),
}
# From these rooms only the settings may be imported, which need no ROS.
SETTINGS_ONLY = {('config', 'nodes')}
# Never at run time on the robot, nor in anything its nodes import.
NOT_ON_THE_ROBOT = {'mdp', 'pickle', 'matplotlib', 'plotly', 'trimesh', 'embreex', 'rosbags',
                    'tqdm'}  # fmt: skip
OFFLINE = {f'{NAME}.{room}' for room in ('training', 'evaluation', 'updating', 'simulation')}
# Modules that run code from the files that they read.
UNSAFE = {'pickle', 'marshal', 'shelve', 'dill', 'joblib'}


@cache
def imports(module):
    """Return the full names a module imports, anywhere in it, but not for type checkers only."""
    names: set[str] = set()
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.If) and 'TYPE_CHECKING' in ast.unparse(node.test):
            skipped.update(inner for line in node.body for inner in ast.walk(line))
        elif isinstance(node, ast.Import) and node not in skipped:
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node not in skipped:
            assert node.level == 0, f'{module}: relative import'
            names.update(f'{node.module}.{alias.name}' for alias in node.names)
    return frozenset(names)


@cache
def tree(module):
    return ast.parse(MODULES[module].read_text(encoding='utf-8'))


def internal(module):
    """Return the modules of this package that a module imports."""
    return {
        max((m for m in MODULES if f'{name}.'.startswith(f'{m}.')), key=len)
        for name in imports(module)
        if name.split('.')[0] == NAME
    }


def external(module):
    """Return the top-level packages, neither this nor standard, that a module imports."""
    return {name.split('.')[0] for name in imports(module)} - {NAME} - set(sys.stdlib_module_names)


def reached(start):
    """Return the modules of this package that importing `start` brings in, itself included."""
    seen, todo = set(), {start}
    while todo:
        module = todo.pop()
        seen.add(module)
        todo |= internal(module) - seen
    return seen


def room(module):
    """Return the room of a module: its folder, or itself where it lies beside the rooms."""
    return module.split('.')[1] if '.' in module else '__init__'


def wrong_imports(module):
    """Return the modules and packages that a module imports, but its room may not."""
    here, (rooms, packages) = room(module), ROOMS[room(module)]
    wrong = {
        target
        for target in internal(module)
        if room(target) not in rooms | {here}
        or ((here, room(target)) in SETTINGS_ONLY and not target.endswith('.settings'))
    }
    return wrong | external(module) - packages


def test_modules_import_only_what_their_rooms_may():
    """And nothing runs code from files that it reads; only nodes and commands know ROS."""
    assert set(ROOMS) == {room(module) for module in MODULES}
    assert {m: wrong for m in MODULES if (wrong := wrong_imports(m))} == {}
    assert [m for m in MODULES if {name.split('.')[0] for name in imports(m)} & UNSAFE] == []
    assert {room(module) for module in MODULES if external(module) & ROS} == {'nodes', 'commands'}
    circles = [m for m in MODULES if any(m in reached(other) for other in internal(m) - {m})]
    assert circles == []
    diagram = (ROOT / 'CONTRIBUTING.md').read_text('utf-8').split('```')[1]
    assert [name for name in ROOMS if name[0] != '_' and name not in diagram] == []


"""Lines, with signature and docstring: the most that one has, and the most that the median has."""


def test_a_cluster_is_for_the_fleet_alone():
    dask = [m for m in MODULES if external(m) & {'dask', 'distributed'}]
    assert dask == [f'{NAME}.commands.fleet']


def test_no_files_import_each_other_in_a_circle():
    """Also not for type checkers, or by name."""
    names = {f"'{module}'": module for module in MODULES}
    reached = {module: internal(module) - {module} for module in MODULES}
    for module, inner in reached.items():
        inner |= {names[text] for text in map(ast.unparse, ast.walk(tree(module))) if text in names}
        inner |= {
            max((m for m in MODULES if f'{node.module}.{name.name}.'.startswith(f'{m}.')), key=len)
            for node in ast.walk(tree(module))
            if isinstance(node, ast.ImportFrom) and (node.module or '').startswith(NAME)
            for name in node.names
        }
    ends = set()
    while leaves := {module for module, inner in reached.items() if inner <= ends} - ends:
        ends |= leaves
    assert set(MODULES) - ends == set()


def test_robot_needs_no_training_code():
    modules = set().union(*(reached(f'{NAME}.nodes.{node}') for node in NODES))
    assert not modules & OFFLINE
    assert {m: bad for m in modules if (bad := external(m) & NOT_ON_THE_ROBOT)} == {}


def test_versions_agree():
    manifest = ET.parse(ROOT / 'package.xml').getroot()
    assert (manifest.get('format'), manifest.findtext('export/build_type')) == ('3', 'ament_python')
    assert manifest.findtext('version') == setup_arguments()['version']
    assert setup_arguments()['version'] == sfa_localization.__version__
    changes = (ROOT / 'CHANGELOG.rst').read_text('utf-8')
    assert f'Changelog for package {NAME}\n' in changes and '\nForthcoming\n---' in changes
    citation = (ROOT / 'CITATION.cff').read_text('utf-8')
    assert f'version: {sfa_localization.__version__}\n' in citation


@cache
def setup_arguments(command='bdist_wheel'):
    """Return the arguments of setuptools.setup when setup.py runs a command."""
    arguments: dict = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(setuptools, 'setup', arguments.update)
        patch.setattr(sys, 'argv', ['setup.py', command])
        runpy.run_path(str(ROOT / 'setup.py'))
    return arguments


def test_pip_installs_a_command_and_the_nodes_and_colcon_all_commands():
    for command in ('bdist_wheel', 'editable_wheel', 'dist_info', 'install', 'develop'):
        arguments = setup_arguments(command)
        lines = arguments['entry_points']['console_scripts']
        executables = {Path(name).name for name in arguments.get('scripts', ())}
        executables |= {line.split(' = ')[0] for line in lines}
        commands = set(COMMANDS) if command in ('install', 'develop') else set()
        assert executables == {NAME, *EXECUTABLES, *commands}
        assert not [name for name in arguments['packages'] if 'test' in name or 'study' in name]


def test_the_environment_of_the_tests_has_all_extras():
    """So that no test is skipped but those of a ROS installation."""
    needed = set(setup_arguments()['extras_require']) - {'ros', 'kilted'}
    script = (ROOT / '.ci/env').read_text('utf-8')
    for line in re.findall(r'extras=(\S+)', script):
        assert needed <= set(line.split(','))


MAIN = 'from sfa_localization import cli\ntry: cli.main({})\nexcept SystemExit: pass'


@pytest.mark.parametrize(('code', 'unwanted'), [
    ('import sfa_localization', {'numpy', f'{NAME}.library', f'{NAME}.place_model'}),
    ('from sfa_localization import PlaceModel', {'mdp', 'rosbags', 'filterpy', 'matplotlib'}),
    ('import sfa_localization.fusion.pose_filter', {'cv2', 'mdp', 'rosbags', 'scipy', 'filterpy'}),
    ('import sfa_localization.camera.panorama', {'scipy', 'filterpy', 'mdp', 'matplotlib'}),
    ('import sfa_localization.observer', {'scipy', 'filterpy', 'mdp', 'trimesh', 'rosbags'}),
    ('import sfa_localization.camera.rim_watch', {'scipy'}),
    ('import sfa_localization.camera.surround', {'scipy'}),
    ('import sfa_localization.localizer', {'mdp', 'trimesh', 'rosbags', f'{NAME}.training'}),
    (MAIN.format(['--help']), {'matplotlib', 'rclpy', 'numpy', 'cv2'}),
    (MAIN.format(['inspect', 'bags/sample']), {'matplotlib', 'rclpy'}),
])  # fmt: skip
def test_only_what_is_needed_is_imported(code, unwanted):
    command = [sys.executable, '-c', f'import sys\n{code}\nprint(*sys.modules)']
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    modules = set(done.stdout.splitlines()[-1].split())
    assert NAME in modules and unwanted & modules == set(), done.stderr


def test_an_executable_runs_the_command_it_is_named_after(monkeypatch, capsys):
    """And a wrong command ends with exit code 2."""
    monkeypatch.setattr(sys, 'argv', ['/workspace/lib/sfa_localization/config'])
    assert cli.main() == 0
    assert 'ekf_node:' in capsys.readouterr().out
    for words in ([], ['trian'], ['--', 'train']):
        with pytest.raises(SystemExit) as raised:
            sys.exit(cli.main(words))
        assert raised.value.code == 2


def test_what_is_installed_exists():
    arguments = setup_arguments()
    files = [ROOT / name for _, names in arguments['data_files'] for name in names]
    assert ROOT / 'package.xml' in files
    assert ROOT / f'resource/{NAME}' in files
    assert [path for path in files if not path.is_file()] == []
    assert (PACKAGE / 'py.typed').is_file()
    keys = {item.text for item in ET.parse(ROOT / 'package.xml').getroot().iter('exec_depend')}
    assert set().union(*(external(module) & ROS for module in MODULES)) <= keys


def test_the_help_of_each_command_shows_examples_and_what_it_writes():
    for name in COMMANDS:
        text = cli.command_parser(name).format_help()
        assert f'  {name}' in text[text.index('examples:') : text.index('options:')]
        assert 'writes: ' in text


def test_a_missing_package_is_named_with_its_remedy_if_it_is_optional(capsys):
    def run(name):
        raise ModuleNotFoundError(f'No module named {name!r}', name=name)

    for package in ('trimesh', 'mdp', 'rclpy'):
        assert cli.guarded(partial(run, f'{package}.inner')) == 1
        error = capsys.readouterr().err
        assert error.startswith(f'error: {package} ') and 'pip install' in error
        assert error.count('\n') == 1
    with pytest.raises(ModuleNotFoundError):
        cli.guarded(partial(run, 'numpy'))


INTERRUPTED = """
import os, signal, sys
class Finder:
    @staticmethod
    def find_spec(name, *_):
        if name == {!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder)
sys.argv = ['/bin/ekf_node']
from sfa_localization import __main__
sys.exit(__main__.main())
"""


@pytest.mark.parametrize('module', ['sfa_localization.cli', 'sfa_localization.nodes.entry'])
def test_ctrl_c_while_python_imports_leaves_no_traceback(module):
    command = [sys.executable, '-c', INTERRUPTED.format(module)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (130, '', '')


def test_ctrl_c_while_a_command_is_imported_prints_a_line(monkeypatch, capsys):
    """As pybind11 does it, with a cause: ImportError('initialization failed')."""
    caused = ImportError('initialization failed')
    caused.__cause__ = KeyboardInterrupt()
    for error, words in ((KeyboardInterrupt, ['config']), (caused, ['ekf_node'])):
        monkeypatch.setattr(cli.importlib, 'import_module', mock.Mock(side_effect=error))
        assert cli.main(words) == 130
        assert capsys.readouterr().err == 'interrupted\n'


def test_a_training_that_is_interrupted_says_how_to_go_on(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(training, 'train', mock.Mock(side_effect=KeyboardInterrupt))
    assert cli.main(['train', 'bag', '--output', str(tmp_path / 'model.npz')]) == 130
    assert capsys.readouterr().err.startswith('interrupted: the same command with --resume')
