# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The documents name only existing commands, options, executables, topics, parameters and files.

Commands marked `run:` in the README are run in test_readme_commands.py; the others are checked
here, as far as possible without the ROS 2 command line.
"""

import ast
import dataclasses
import json
import math
import re
import runpy
import shlex
import subprocess
import sys
import types
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import yaml
from filter_drives import Drive
from study.__main__ import study_parser

from sfa_localization import cli
from sfa_localization.bags.reader import Bag
from sfa_localization.data.settings import Settings
from sfa_localization.nodes.settings import EkfNodeConfig
from sfa_localization.nodes.signals import CANNOT_START, DIED

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(
    [
        *ROOT.glob('*.md'),
        *ROOT.glob('config/*.md'),
        *ROOT.glob('bags/*.md'),
        ROOT / 'test/README.md',
        ROOT / 'test/EVALUATION.md',
    ]
)
README_LINES = 130
"""At most so many: a stranger decides in half a minute."""
NODES = ('omnicam_node', 'sfa_node', 'ekf_node')
NAMED = ('CITATION.cff', 'package.xml', 'setup.py')
COMMANDS = set(cli.COMMANDS)
BLOCK = re.compile(r'```(?:bash|sh)\n(.*?)```', re.DOTALL)
INLINE = re.compile(r'`([a-z_]+ [^`]+)`')
LINK = re.compile(r'\]\(([^)#\s]+)\)')
TOPIC = re.compile(r'\b((?:sfa|ekf)/[a-z_]+)\b')
# Programs of other packages, whose arguments are not checked.
FOREIGN = {'source', 'colcon', 'rviz2', 'rosdep', 'git', 'cd', 'mkdir', 'pip', 'sudo'}
OTHER_ROS = {
    ('run', 'robot_localization'),
    ('launch', 'nav2_bringup'),
    ('bag', 'record'),
    ('topic', 'echo'),
}


def commands() -> list:
    """Return every command line in the documents as words."""
    found = []
    for path in DOCUMENTS:
        text = path.read_text('utf-8')
        lines = [
            line
            for block in BLOCK.findall(text)
            for line in block.replace('\\\n', ' ').splitlines()
        ]
        lines += [
            code for code in INLINE.findall(text) if code.split()[0] in {'sfa_localization', 'make'}
        ]
        for line in lines:
            words = shlex.split(line, comments=True)
            if words:
                found.append(pytest.param(words, id=f'{path.name}: {line.strip()}'))
    return found


@pytest.mark.parametrize('words', commands())
def test_command_exists(words):
    check(words)


def check(words: list[str]) -> None:
    program, *rest = words
    if program == 'ros2':
        check_ros2(rest)
    elif program == 'make':
        targets = [word for word in rest if '=' not in word]
        if targets == ['study'] and rest[1:]:
            study_parser().parse_args(shlex.split(rest[1].removeprefix('ARGS=')))
        subprocess.run(['make', '--dry-run', *targets], cwd=ROOT, check=True, capture_output=True)
    elif words[:3] == ['python', '-m', 'sfa_localization']:
        check_command(*words[3:])
    elif program == 'sfa_localization':
        check_command(*rest)
    elif program in NODES:
        check_node(program, rest)
    else:
        assert program in FOREIGN, f'unknown program {program}'


def check_ros2(words: list[str]) -> None:
    if tuple(words[:2]) in OTHER_ROS:
        return
    if words[:2] == ['bag', 'play']:
        assert all((ROOT / path / 'metadata.yaml').is_file() for path in words[2:])
        return
    verb, package, name, *rest = words
    assert package == 'sfa_localization'
    if verb == 'launch':
        assert (ROOT / 'config' / name).is_file()
        known = launch_arguments(ROOT / 'config' / name)
        assert {word.partition(':=')[0] for word in rest} <= known
        return
    assert verb == 'run'
    check_command(name, *rest)


def launch_arguments(path: Path) -> set[str]:
    """Return the names that a launch file declares as arguments."""
    calls = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))
    return {
        call.args[0].value
        for call in calls
        if isinstance(call.func, ast.Name) and call.func.id == 'DeclareLaunchArgument'
    }


def check_command(name: str, *words: str) -> None:
    if name in NODES:
        check_node(name, list(words))
    elif name not in ('COMMAND', '--help') and words not in (('...',), ('--help',)):
        assert name in COMMANDS, f'unknown command {name}'
        cli.command_parser(name).parse_args(words)


def check_node(name: str, words: list[str]) -> None:
    """Parameters of a node are settings, and remapped topics are its own."""
    assert words[:1] in ([], ['--ros-args'], ['...'])
    for option, value in zip(words[1::2], words[2::2], strict=True):
        assert option in ('-p', '-r', '--params-file')
        if option == '-p':
            assert value.partition(':=')[0] in parameters()
        if option == '-r':
            assert value.partition(':=')[0].lstrip('/') in topics()


def parameters() -> set[str]:
    """Return the names of all settings, which the nodes' parameters are."""
    groups = Settings.__subclasses__()
    return {item.name for group in groups for item in dataclasses.fields(group)} | {'use_sim_time'}


def topics() -> set[str]:
    """Return the topics that the nodes name in their source, without leading slashes."""
    sources = [ROOT / 'sfa_localization' / 'nodes' / f'{name}.py' for name in NODES]
    strings = (
        node.value
        for path in sources
        for node in ast.walk(ast.parse(path.read_text('utf-8')))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    return {text.lstrip('/') for text in strings if re.fullmatch(r'/?[a-z_]+(/[a-z_]+)*', text)}


def test_the_readme_is_short_and_says_what_its_figures_are():
    lines = (ROOT / 'README.md').read_text('utf-8').splitlines()
    assert len(lines) <= README_LINES
    figures = [k for k, line in enumerate(lines) if line.startswith('![')]
    assert figures
    for k in figures:
        assert re.match(r'\*(Rendered|Half-real|Real)\b', lines[k + 2]), lines[k]


@pytest.mark.parametrize('path', [*DOCUMENTS, *(ROOT / n for n in NAMED)], ids=lambda p: p.name)
def test_no_placeholder_is_left(path):
    assert not re.search(r'REPOSITORY|example\.(org|com|net)|TODO|FIXME', path.read_text('utf-8'))


def test_the_cited_article_has_year_and_venue():
    (article,) = yaml.safe_load((ROOT / 'CITATION.cff').read_text('utf-8'))['references']
    assert isinstance(article['year'], int)
    assert str(article['year']) in article['conference']['name']
    assert f'Workshops, {article["year"]}' in (ROOT / 'README.md').read_text('utf-8').replace(
        '\n', ' '
    )


@pytest.mark.parametrize('path', DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_have_a_target(path):
    for target in LINK.findall(path.read_text('utf-8')):
        assert target.startswith('https://') or (path.parent / target).exists(), target


@pytest.mark.parametrize(
    'path', [*DOCUMENTS, *ROOT.glob('config/*.rviz')], ids=lambda path: path.name
)
def test_topics_exist(path):
    assert set(TOPIC.findall(path.read_text('utf-8'))) <= topics()


def test_foxglove_layout_is_complete_and_its_topics_exist():
    layout = json.loads((ROOT / 'config/foxglove_layout.json').read_text('utf-8'))
    panels = set(re.findall(r'"([A-Za-z0-9]+![a-z]+)"', json.dumps(layout['layout'])))
    assert panels == set(layout['configById'])
    named = set(layout['configById']['3D!map']['topics'])
    named.add(layout['configById']['Image!panorama']['imageMode']['imageTopic'])
    for panel in layout['configById'].values():
        named.update(path['value'].partition('.')[0] for path in panel.get('paths', ()))
    assert {name.lstrip('/') for name in named} <= topics()


def test_robot_localization_takes_position_and_heading_of_our_pose():
    text = (ROOT / 'config/robot_localization.yaml').read_text('utf-8')
    settings = yaml.safe_load(text)['ekf_filter_node_map']['ros__parameters']
    assert settings['pose0'].lstrip('/') in topics()
    assert len(settings['pose0_config']) == len(settings['odom0_config']) == 15
    used = [index for index, wanted in enumerate(settings['pose0_config']) if wanted]
    assert used == [0, 1, 5], 'x, y and yaw'


def test_the_page_leaves_out_ekf_node_where_robot_localization_is_alone(launch):
    text = (ROOT / 'config/robot_localization.md').read_text('utf-8')
    (line,) = (line for line in text.splitlines() if line.startswith('ros2 launch'))
    arguments = dict(word.split(':=') for word in shlex.split(line)[4:])
    assert [*launch(**arguments)] == ['omnicam_node', 'sfa_node']


def test_robot_localization_finds_a_robot_that_starts_anywhere():
    """A filter of x, y and yaw: predicted from zero; images that are too far off are rejected."""
    text = (ROOT / 'config/robot_localization.yaml').read_text('utf-8')
    settings = yaml.safe_load(text)['ekf_filter_node_map']['ros__parameters']
    given = np.reshape(settings.get('initial_estimate_covariance', 1e-9 * np.eye(15)), (15, 15))
    planar = np.ix_([0, 1, 5], [0, 1, 5])
    drive = Drive(seconds=20, start=(40.0, -25.0, 2.5), v_std=0.02, omega_std=0.01,
                  position_std=0.3, yaw_std=0.1)  # fmt: skip
    spread = np.diag([0.09, 0.09, 0.01])
    pose, covariance, errors = np.zeros(3), given[planar], []
    for _, kind, index in drive.events():
        if kind == 0:
            v, omega = drive.read[index] / drive.rate_hz
            turn = np.eye(3)
            turn[:2, 2] = [-v * math.sin(pose[2]), v * math.cos(pose[2])]
            pose += v * math.cos(pose[2]), v * math.sin(pose[2]), omega
            covariance = turn @ covariance @ turn.T + np.diag([1e-4, 1e-4, 1e-5])
            continue
        innovation = drive.seen[index] - pose
        innovation[2] = math.remainder(innovation[2], 2 * math.pi)
        expected = covariance + spread
        d2 = innovation @ np.linalg.solve(expected, innovation)
        if d2 <= settings['pose0_rejection_threshold'] ** 2:
            gain = np.linalg.solve(expected, covariance).T
            pose, covariance = pose + gain @ innovation, covariance - gain @ covariance
        truth = drive.poses[drive.pictures[index]]
        errors.append(math.hypot(*(pose - truth)[:2]))
    assert np.mean(errors) < 0.3


def test_nav2_uses_our_frames():
    settings = yaml.safe_load((ROOT / 'config/nav2.yaml').read_text('utf-8'))
    navigator = settings['bt_navigator']['ros__parameters']
    frames = EkfNodeConfig()
    assert navigator['global_frame'] == frames.map_frame
    assert navigator['robot_base_frame'] == frames.base_frame
    monitor = settings['collision_monitor']['ros__parameters']
    assert monitor['base_frame_id'] == frames.base_frame, "Nav2's default is base_footprint"
    assert monitor['odom_frame_id'] == frames.odom_frame
    for node in ('bt_navigator', 'controller_server'):
        topic = settings[node]['ros__parameters']['odom_topic']
        assert topic == 'odom', 'an absolute topic would be that of another robot'


def test_nav2_plans_without_a_map():
    """A rolling window whose layers wait for no map; Nav2's default has the static layer."""
    settings = yaml.safe_load((ROOT / 'config/nav2.yaml').read_text('utf-8'))
    window = settings['global_costmap']['global_costmap']['ros__parameters']
    assert window['rolling_window'] is True
    assert window['plugins'] == ['obstacle_layer', 'inflation_layer']


class Recorded:
    """Replaces every class of launch, and records its arguments."""

    def __init__(self, *given, **named):
        self.given, self.named = given, named


@pytest.fixture
def launch_file(monkeypatch):
    """Return what is in the launch file, with launch replaced by stand-ins."""
    names = {
        'launch': ['LaunchContext', 'LaunchDescription'],
        'launch.actions': ['DeclareLaunchArgument', 'OpaqueFunction'],
        'launch.conditions': ['IfCondition'],
        'launch.events': [],
        'launch.events.process': ['ProcessExited'],
        'launch.substitutions': ['LaunchConfiguration', 'PathJoinSubstitution'],
        'launch_ros.actions': ['Node', 'PushROSNamespace'],
        'launch_ros.parameter_descriptions': ['ParameterValue'],
        'launch_ros.substitutions': ['FindPackageShare'],
    }
    for name, classes in {'launch_ros': [], **names}.items():
        module = types.ModuleType(name)
        for each in classes:
            setattr(module, each, type(each, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    return runpy.run_path(str(ROOT / 'config/localization.launch.py'))


@pytest.fixture
def launch(launch_file):
    """Return a function that starts the launch file: the arguments of its nodes, by their names."""

    def start(**arguments):
        (actions,) = launch_file['generate_launch_description']().given
        *declared, nodes = actions
        given = {action.given[0]: action.named.get('default_value') for action in declared}
        assert set(arguments) <= set(given)
        given.update({'config': ROOT / 'config/localization.yaml', **arguments})
        context = types.SimpleNamespace(launch_configurations=given)
        namespace, *nodes = nodes.named['function'](context)
        assert namespace.given == (arguments.get('namespace', ''),)
        always = Recorded('true')
        return {
            node.named['executable']: node.named
            for node in nodes
            if node.named.get('condition', always).given == always.given
        }

    return start


def test_a_missing_parameter_file_stops_the_launch(launch):
    """launch_ros itself only warns, and starts the nodes with every default."""
    with pytest.raises(FileNotFoundError, match=r'config:=/nowhere\.yaml'):
        launch(config='/nowhere.yaml')


def test_launch_file_starts_all_nodes_with_known_parameters_and_topics(launch):
    launched = launch(model='model.npz')
    assert [*launched] == list(NODES)
    for node in [*launched.values(), *launch(panorama='/panorama').values()]:
        _file, given = node['parameters']
        assert set(given) <= parameters()
        known = topics() | {'image_raw', 'odom', '/tf'}
        assert {source for source, _ in node['remappings']} <= known


def test_the_launched_transform_is_in_the_namespace_unless_asked(launch):
    """Two robots whose frames have the same names must not meet on /tf; Nav2 looks there too."""
    assert ('/tf', 'tf') in launch()['ekf_node']['remappings']
    assert ('/tf', '/tf') in launch(tf='/tf')['ekf_node']['remappings']


def test_nodes_can_be_left_out_of_the_launch(launch):
    assert [*launch(ekf='false')] == ['omnicam_node', 'sfa_node']
    assert [*launch(panorama='/panorama')] == ['sfa_node', 'ekf_node']
    assert ('panorama', '/panorama') in launch(panorama='/panorama')['sfa_node']['remappings']


def test_a_launch_ends_with_what_cannot_start_and_starts_again_what_dies(launch, launch_file):
    """An exception makes launch end with exit code 1; a launch that ends already goes on."""
    for node in launch().values():
        assert node['respawn'].given == ('respawn',) and node['respawn_delay'] > 0
        assert node['on_exit'] is launch_file['_exited']
    running, ending = (types.SimpleNamespace(is_shutdown=over) for over in (False, True))

    def exited(code, context):
        event = types.SimpleNamespace(returncode=code, process_name='sfa_node-2')
        return launch_file['_exited'](event, context)

    with pytest.raises(RuntimeError, match='sfa_node-2 cannot start'):
        exited(CANNOT_START, running)
    for code in (0, DIED, -9, -11):
        assert exited(code, running) is None
    assert exited(CANNOT_START, ending) is None


def replay():
    """Return launch arguments and bag of the replay that the README shows."""
    text = (ROOT / 'README.md').read_text('utf-8')
    (block,) = (block for block in BLOCK.findall(text) if 'ros2 bag play' in block)
    launched, played = (shlex.split(line, comments=True) for line in block.splitlines())
    assert launched[:3] == ['ros2', 'launch', 'sfa_localization']
    assert played[:3] == ['ros2', 'bag', 'play'] and len(played) == 4
    return dict(word.split(':=') for word in launched[4:]), ROOT / played[3]


def test_the_replay_of_the_readme_feeds_the_launched_nodes(launch):
    arguments, path = replay()
    launched = launch(**arguments)
    assert [*launched] == ['sfa_node', 'ekf_node'], 'the bag holds panoramas'
    with Bag(path) as bag:
        played = {name: topic.kind for name, topic in bag.topics.items()}
    panorama = dict(launched['sfa_node']['remappings'])['panorama']
    assert launched['sfa_node']['parameters'][1]['image_transport'] == 'compressed'
    assert played[f'{panorama}/compressed'] == 'sensor_msgs/msg/CompressedImage'
    odometry = dict(launched['ekf_node']['remappings'])['odom']
    assert played[f'/{odometry}'] == 'nav_msgs/msg/Odometry'


def test_package_manifest_is_of_format_3():
    manifest = ET.parse(ROOT / 'package.xml').getroot()
    assert manifest.get('format') == '3'
    assert manifest.findtext('export/build_type') == 'ament_python'


def test_make_help_lists_every_target():
    text = (ROOT / 'Makefile').read_text('utf-8')
    targets = set(re.search(r'\.PHONY: (.*)', text).group(1).split())
    shown = subprocess.run(
        ['make', 'help'], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    assert set(re.findall(r'make (\w+)', shown)) == targets


BRITISH = r'(?:kilo)?metres?|colours?|centres?|neighbours?|behaviours?|learnt|towards'
BRITISH += r'|(?:normal|initial|organ|optim|minim|maxim|synchron|recogn|local)is(?:e|es|ed|ing)'
# Of data one says that it is an image, and that it shows, contains or gives something.
VAGUE = r'pictures?|tells?|told'
# Keys of JSON, in quotes, names of states, and the method of files are interfaces and stay.
OTHER_WORDS = re.compile(
    rf"(?<![\w'])(?<!(?<!\")\")(?:{BRITISH}|{VAGUE})(?![\w'\"])", re.IGNORECASE
)
INTERFACES = re.compile(r'UNINITIALISED|LOCALISED|\.tell\(\)')
PAGES = [
    *(path for path in DOCUMENTS if path.name != 'CHANGELOG.md'),
    *sorted((ROOT / 'sfa_localization').rglob('*.py')),
]


@pytest.mark.parametrize('path', PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_words_are_american_and_plain(path):
    lines = path.read_text('utf-8').splitlines()
    wrong = [line.strip() for line in lines if OTHER_WORDS.search(INTERFACES.sub('', line))]
    assert wrong == []
