# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The pages name only existing commands, options, topics, parameters, files and tests.

Commands marked `run:` are run in test_readme_commands.py; the others are checked here, as far as
possible without the ROS 2 command line.
"""

import dataclasses
import json
import math
import re
import runpy
import shlex
import subprocess
import sys
import types

import numpy as np
import pytest
import yaml
from page_tables import ROOT
from picture_readers import load_pictures
from robustness import promises
from study import page as results_page
from study.__main__ import study_parser

from sfa_localization import __version__, cli
from sfa_localization.bags.reader import Bag
from sfa_localization.config import SECTIONS
from sfa_localization.data.settings import Settings
from sfa_localization.nodes.process import CANNOT_START, DIED, EXECUTABLES
from sfa_localization.nodes.settings import EkfNodeConfig

PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text('utf-8')
    for pattern in ('*.md', 'config/*.md', 'bags/*.md', 'test/*.md')
    for path in ROOT.glob(pattern)
}
EVALUATION = 'test/EVALUATION.md'
STUDIES = PAGES[EVALUATION] + PAGES['test/PAPER.md'] + PAGES['config/cameras.md']
NODES = ('omnicam_node', 'sfa_node', 'ekf_node')
BLOCK = re.compile(r'```(?:bash|sh)\n(.*?)```', re.DOTALL)
INLINE = re.compile(r'`((?:sfa_localization|make) [^`]+)`')
LINK = re.compile(r'\]\(([^)\s]+)\)')
HEADING = re.compile(r'^#+ (.+)$', re.MULTILINE)
TOPIC = re.compile(r'\b((?:sfa|ekf)/[a-z_]+)\b')
TOPIC_ROW = re.compile(r'^\| `/?([\w/]+)` \| (\w+) \|([^|]+)\|([^|]+)\|', re.MULTILINE)
OTHER_TOPICS = re.compile(
    r'/(rosout|parameter_events|diagnostics|tf(_static)?|\w+/transition_event)'
)
TEST_NAME = re.compile(r'`(test_\w+\.py)::(\w+)`')
# Programs of other packages, whose arguments are not checked.
FOREIGN = {
    'dask',
    'export',
    'source',
    'colcon',
    'rviz2',
    'rosdep',
    'git',
    'cd',
    'mkdir',
    'pip',
    'sudo',
}
FOREIGN_ROS = {
    'run robot_localization',
    'launch nav2_bringup',
    'bag record',
    'topic echo',
    'service call',
}


def test_every_command_exists():
    blocks = ''.join(''.join(BLOCK.findall(text)) for text in PAGES.values()).replace('\\\n', ' ')
    inline = [line for text in PAGES.values() for line in INLINE.findall(text)]
    count, wrong = 0, {}
    for line in [*blocks.splitlines(), *inline]:
        words = shlex.split(line, comments=True)
        count += bool(words)
        try:
            check(*words) if words else None
        except (AssertionError, SystemExit, ValueError, subprocess.CalledProcessError) as error:
            wrong[line] = repr(error)
    assert count > 50 and wrong == {}


def check(program, *words):
    if program == 'ros2':
        check_ros2(*words)
    elif program == 'make':
        targets = [word for word in words if '=' not in word]
        if targets == ['study'] and words[1:]:
            study_parser().parse_args(shlex.split(words[1].removeprefix('ARGS=')))
        subprocess.run(['make', '--dry-run', *targets], cwd=ROOT, check=True, capture_output=True)
    elif (program, *words[:2]) == ('python', '-m', 'sfa_localization'):
        check_command(*words[2:])
    elif program == 'sfa_localization':
        check_command(*words)
    elif program in NODES:
        check_command(program, *words)
    else:
        assert program in FOREIGN, f'unknown program {program}'


def check_ros2(*words):
    if ' '.join(words[:2]) in FOREIGN_ROS:
        return
    if words[:2] == ('bag', 'play'):
        assert all((ROOT / path / 'metadata.yaml').is_file() for path in words[2:])
        return
    verb, package, name, *rest = words
    assert package == 'sfa_localization' and verb in ('launch', 'run')
    if verb == 'run':
        check_command(name, *rest)
        return
    source = (ROOT / 'config' / name).read_text('utf-8')
    arguments = set(re.findall(r"DeclareLaunchArgument\(\s*'(\w+)'", source))
    assert {word.partition(':=')[0] for word in rest} <= arguments | {'--show-args'}


def check_command(name, *words):
    if name in NODES:  # with parameters that are settings, and remapped topics of its own
        assert words[:1] in ((), ('--ros-args',), ('...',))
        for option, value in zip(words[1::2], words[2::2], strict=True):
            names = {'-p': parameters(), '-r': topics(), '--params-file': {value}}[option]
            assert value.partition(':=')[0].lstrip('/') in names
    elif name not in ('COMMAND', '--help') and words not in (('...',), ('--help',)):
        assert name in cli.COMMANDS, f'unknown command {name}'
        cli.command_parser(name).parse_args(words)


def parameters():
    """Return the names of all settings, which the nodes' parameters are."""
    groups = Settings.__subclasses__()
    return {item.name for group in groups for item in dataclasses.fields(group)} | {'use_sim_time'}


def topics():
    """Return the topics in the table of config/topics.md, which those of the nodes are."""
    return {topic for topic, *_ in TOPIC_ROW.findall(PAGES['config/topics.md'])}


def test_pages_are_of_the_version_and_date_of_the_recorded_results():
    """And those of studies show these results: make study ARGS='page FOLDER'."""
    record = json.loads(results_page.RECORD.read_text('utf-8'))
    assert record['version'] == __version__
    for name in ('README.md', 'test/README.md', 'test/PAPER.md', EVALUATION):
        assert f'<!-- version -->\n{results_page.dated(record)}<!-- end -->' in PAGES[name], name
    assert set(re.findall(r'20\d\d-\d\d-\d\d', STUDIES)) == {record['date']}
    assert not re.search(r'(January|June|November|December) 20\d\d', STUDIES)
    for name, table in results_page.tables(record['results']).items():
        text = table or results_page.UNMEASURED
        assert f'<!-- {name} -->\n{text}<!-- end -->' in STUDIES, name


def test_the_errors_on_the_first_page_are_those_of_the_other_tables():
    results = json.loads(results_page.RECORD.read_text('utf-8'))['results']
    half_real = re.findall(r'^\| half-real.* ([\d.]+) \| \d+% \|$', PAGES[EVALUATION], re.MULTILINE)
    pairs = re.findall(
        r'/ (\.\d+) \| \.\d+ / (\.\d+) \|$', PAGES['config/cameras.md'], re.MULTILINE
    )
    known, learned = (
        sorted(f'0{error}' for error in column) for column in zip(*pairs, strict=True)
    )
    assert len(half_real) == len(known) == 4
    shown = re.findall(
        r'^\| (?:half-real|rendered).* \| ([^|]+) \|$', PAGES['README.md'], re.MULTILINE
    )
    assert shown == [
        f'{results["demo"][0]["ekf"]["mean"]:.3f}',
        re.search(r'sample_test \| [\d.]+ \| ([\d.]+)', PAGES[EVALUATION])[1],
        f'{learned[0]}-{learned[-1]} / {known[0]}-{known[-1]}',
        f'{min(half_real)}-{max(half_real)}',
    ]


def test_the_page_names_the_speeds_above_their_goals():
    """And none that are not: the goal is a time, or so many times the last release."""
    block = PAGES['test/README.md'].split('<!-- bench -->')[1].split('<!-- end -->')[0]
    rows = [[cell.strip() for cell in line.split('|')[1:-1]] for line in block.splitlines()[3:]]
    above = []
    for what, now, _, ratio, goal in (row for row in rows if row):
        number, _, times = goal.partition(' ')
        value = ratio if times else now
        above += [what] if value and float(value) > float(number) else []
    assert f'\nAbove the goal: {"; ".join(above) or "nothing"}.\n' in block and len(rows) > 5


def test_pages_are_short():
    """1,800 words at most, the first page 1,500, as `wc -w` counts; tables have eight columns."""
    words = {page: len(text.split()) for page, text in PAGES.items()}
    assert {page: count for page, count in words.items() if count > 1800} == {}
    assert words['README.md'] <= 1500
    rulers = re.findall(r'^\|(?:[ :-]+\|)+$', STUDIES, re.MULTILINE)
    assert max(ruler.count('|') - 1 for ruler in rulers) <= 8


def test_lines_of_prose_fit_a_screen():
    """130 columns; rows of tables, what programs wrote, and code are as long as they must be."""
    long = {}
    for page in PAGES.keys() - {'config/python.md'}:
        text = re.sub(r'```.*?```|<!-- \w.*?<!-- end -->', '', PAGES[page], flags=re.DOTALL)
        lines = [line for line in text.splitlines() if len(line) > 130 and line[0] != '|']
        long |= {page: lines} if lines else {}
    assert long == {}


def anchors(text):
    """The anchors that GitHub makes of the headings of a page."""
    return {
        re.sub(r'[^\w -]', '', name.lower()).replace(' ', '-') for name in HEADING.findall(text)
    }


def test_links_and_topics_exist():
    links = [(page, target) for page, text in PAGES.items() for target in LINK.findall(text)]
    broken = []
    for page, target in links:
        path, _, anchor = target.partition('#')
        file = (ROOT / page).parent.joinpath(path) if path else ROOT / page
        if not target.startswith('https://') and not (
            file.exists() and (not anchor or anchor in anchors(file.read_text('utf-8')))
        ):
            broken.append((page, target))
    assert len(links) > 50 and broken == []
    texts = [*PAGES.values(), (ROOT / 'config/localization.rviz').read_text('utf-8')]
    assert set(TOPIC.findall(''.join(texts))) <= topics()


@pytest.mark.ros
def test_the_table_of_topics_is_that_of_the_nodes(bench, monkeypatch, tmp_path):
    from ros_bench import until

    from sfa_localization.nodes import ekf_node, omnicam_node, sfa_node, teach_node

    load_pictures(monkeypatch)
    nodes = [
        bench.run(omnicam_node.OmnicamNode, level_by_imu=True),
        bench.run(omnicam_node.OmnicamNode, cameras=['NAME', 'NAME2']),
        bench.run(sfa_node.SfaNode, model='model.npz'),
        bench.run(ekf_node.EkfNode),
        bench.run(teach_node.TeachNode, output=str(tmp_path / 'garden.npz')),
    ]

    def topics_of(entities):
        return {
            (
                entity.topic_name[1:].replace('NAME2', 'NAME'),
                entity.msg_type.__name__,
                f' `{node.get_name()}` ',
            )
            for node in nodes for entity in getattr(node, entities)
            if not OTHER_TOPICS.fullmatch(entity.topic_name)
        }  # fmt: skip

    rows = TOPIC_ROW.findall(PAGES['config/topics.md'])
    published = {row[:3] for row in rows if '_node' in row[2] and row[0] != 'tf'}
    read = {row[:2] + row[3:] for row in rows if '_node' in row[3] and row[0] != 'tf_static'}
    raw = {row for row in read if not row[0].endswith(('/compressed', '/ffmpeg', '/foxglove'))}
    assert topics_of('publishers') == published
    assert until(lambda: topics_of('subscriptions') == raw)


def test_the_printed_inspection_is_that_of_the_sample(capsys, monkeypatch):
    """But for its figures."""
    monkeypatch.chdir(ROOT)
    assert cli.main(['inspect', 'bags/sample']) == 0
    printed = re.search(r'```text\n(.*?)```', PAGES['bags/README.md'], re.DOTALL)[1]
    texts = printed, capsys.readouterr().out
    page, told = (re.sub(r'-?[\d.]+', '#', text).split() for text in texts)
    assert page == told


def test_foxglove_layout_is_complete_and_its_topics_exist():
    layout = json.loads((ROOT / 'config/foxglove_layout.json').read_text('utf-8'))
    assert set(re.findall(r'"(\w+![a-z]+)"', json.dumps(layout['layout']))) == {
        *layout['configById']
    }
    panels = layout['configById']
    named = {*panels['3D!map']['topics'], panels['Image!panorama']['imageMode']['imageTopic']}
    for panel in panels.values():
        named.update(path['value'].partition('.')[0] for path in panel.get('paths', ()))
    in_bags = {'ground_truth'}  # of a simulated robot, and of evaluate --bag
    assert {name.lstrip('/') for name in named} <= topics() | in_bags


def test_robot_localization_finds_a_robot_that_starts_anywhere(launch):
    """It takes x, y and yaw; a first image hundreds of meters away, or turned, is not rejected."""
    text = (ROOT / 'config/robot_localization.yaml').read_text('utf-8')
    settings = yaml.safe_load(text)['ekf_filter_node_map']['ros__parameters']
    assert settings['pose0'].lstrip('/') in topics()
    assert len(settings['pose0_config']) == len(settings['odom0_config']) == 15
    used = np.flatnonzero(settings['pose0_config'])
    assert used.tolist() == [0, 1, 5], 'x, y and yaw'
    covariance = np.reshape(settings['initial_estimate_covariance'], (15, 15))
    distant = np.array([200.0, -200.0, math.pi])
    d2 = distant @ np.linalg.solve(covariance[np.ix_(used, used)], distant)
    assert d2 <= settings['pose0_rejection_threshold'] ** 2
    before, alone = re.findall('^ros2 launch (.*)$', PAGES['config/robot_localization.md'], re.M)
    assert dict(launch(**given(before))['ekf_node']['remappings'])['odom'] == '/odometry/filtered'
    assert [*launch(**given(alone))] == ['omnicam_node', 'sfa_node'], 'no second filter'


_COSTMAP = ('global_frame', 'robot_base_frame', 'rolling_window', 'width', 'height', 'resolution',
            'track_unknown_space', 'plugins', 'static_layer.plugin', 'static_layer.map_topic',
            'static_layer.map_subscribe_transient_local')  # fmt: skip
NAV2_PARAMETERS = {
    f'{node}.ros__parameters.{name}'
    for node, names in {
        'bt_navigator': ('global_frame', 'robot_base_frame', 'odom_topic'),
        'collision_monitor': ('base_frame_id', 'odom_frame_id'),
        'controller_server': ('odom_topic',),
        'global_costmap.global_costmap': _COSTMAP,
        'local_costmap.local_costmap': _COSTMAP,
        'planner_server': ('planner_plugins', 'GridBased.plugin', 'GridBased.allow_unknown'),
        'lifecycle_manager_localization': ('autostart', 'bond_timeout', 'node_names'),
    }.items()
    for name in names
}
"""Names in the configuration guide of Nav2 for Jazzy, of the parameters that nav2.yaml sets."""


def leaves(settings, path=()):
    """The names of all parameters in a tree, with those of their nodes."""
    for name, value in settings.items():
        here = (*path, name)
        yield from leaves(value, here) if isinstance(value, dict) else ['.'.join(here)]


def test_nav2_uses_our_frames():
    """And plans on the ground that was driven, which it takes from the latched topic."""
    settings = yaml.safe_load((ROOT / 'config/nav2.yaml').read_text('utf-8'))
    navigator, monitor, controller = (
        settings[name]['ros__parameters']
        for name in ('bt_navigator', 'collision_monitor', 'controller_server')
    )
    frames = EkfNodeConfig()
    assert navigator['global_frame'] == frames.map_frame
    assert navigator['robot_base_frame'] == monitor['base_frame_id'] == frames.base_frame
    assert monitor['odom_frame_id'] == frames.odom_frame
    assert navigator['odom_topic'] == controller['odom_topic'] == 'odom', 'not of another robot'
    layer = settings['global_costmap']['global_costmap']['ros__parameters']['static_layer']
    assert layer['map_topic'].lstrip('/') in topics() and layer['map_subscribe_transient_local']
    manager = settings['lifecycle_manager_localization']['ros__parameters']
    assert manager['node_names'] == list(NODES) and manager['bond_timeout'] == 0.0
    assert set(leaves(settings)) <= NAV2_PARAMETERS


def test_an_aggregator_shows_all_nodes():
    settings = yaml.safe_load((ROOT / 'config/analyzers.yaml').read_text('utf-8'))
    assert settings['/**']['ros__parameters']['localization']['contains'] == list(NODES)


class Recorded:
    """In the place of each class of launch: records its arguments."""

    def __init__(self, *given, **named):
        self.given, self.named = given, named


@pytest.fixture
def launch_file(monkeypatch):
    return names_of_launch_file('localization.launch.py', monkeypatch)


def names_of_launch_file(name, monkeypatch):
    """Return the names of a launch file, with launch replaced by stand-ins."""
    path = ROOT / 'config' / name
    imports = re.findall(r'^from (launch[\w.]*) import (.+)$', path.read_text('utf-8'), re.M)
    for module, names in imports:
        classes = dict.fromkeys(names.split(', '), Recorded)
        monkeypatch.setitem(sys.modules, module, types.SimpleNamespace(**classes))
    return runpy.run_path(str(path))


def given(line):
    """The arguments NAME:=VALUE of a command line."""
    return dict(word.split(':=') for word in shlex.split(line, comments=True) if ':=' in word)


@pytest.fixture
def launch(launch_file):
    """Return a function that starts the launch file: the arguments of its nodes, by their names."""

    def start(**arguments):
        (actions,) = launch_file['generate_launch_description']().given
        *declared, nodes = actions
        values = {action.given[0]: action.named.get('default_value') for action in declared}
        assert set(arguments) <= set(values)
        values.update({'config': ROOT / 'config/localization.yaml', **arguments})
        context = types.SimpleNamespace(launch_configurations=values)
        namespace, *nodes = nodes.named['function'](context)
        assert namespace.given == (arguments.get('namespace', ''),)
        return {
            node.named['executable']: node.named
            for node in nodes
            if node.named.get('condition', Recorded('true')).given == ('true',)
        }

    return start


@pytest.mark.parametrize('localize', ['true', 'false'])
def test_teaching_starts_the_chain_that_waits_for_its_model(monkeypatch, localize):
    file = names_of_launch_file('teach.launch.py', monkeypatch)
    (actions,) = file['generate_launch_description']().given
    *declared, nodes = actions
    values = {action.given[0]: action.named.get('default_value') for action in declared}
    values |= {'output': 'garden.npz', 'localize': localize, 'odom': '/wheels'}
    context = types.SimpleNamespace(launch_configurations=values)
    teach, *chain = nodes.named['function'](context, *nodes.named['args'])
    assert teach.named['executable'] in EXECUTABLES
    _, parameters = teach.named['parameters']
    settings = {field.name for kind in SECTIONS['teach_node'] for field in dataclasses.fields(kind)}
    assert {*parameters} <= settings | {'use_sim_time'} and parameters['odometry'] == '/wheels'
    assert len(chain) == parameters['localize'] == (localize == 'true')
    for included in chain:
        arguments = dict(included.named['launch_arguments'])
        assert arguments['model'] == 'garden.npz' and arguments['autostart'] == 'false'
        assert arguments['odom'] == '/wheels' and arguments['image'] == 'image_raw'


def test_launch_file_starts_all_nodes_with_their_parameters_and_topics(launch):
    """The transform stays in the namespace unless asked; nodes can be left out, as in README.md,
    whose bag holds panoramas.
    """
    (block,) = (block for block in BLOCK.findall(PAGES['README.md']) if 'ros2 bag play' in block)
    typed, played = block.splitlines()
    launched, without = launch(model='model.npz'), launch(**given(typed))
    assert [*launched] == list(NODES) and [*without] == ['sfa_node', 'ekf_node']
    for node in [*launched.values(), *without.values()]:
        assert set(node['parameters'][1]) <= parameters()
        assert 'autostart' not in node['parameters'][1]
        sources = {source for source, _ in node['remappings']}
        assert sources <= topics() | {'image_raw', 'odom', '/tf', '/tf_static'}
    assert ('/tf', 'tf') in launched['ekf_node']['remappings']
    assert ('/tf_static', 'tf_static') in launched['sfa_node']['remappings']
    assert ('/tf', '/tf') in launch(tf='/tf')['ekf_node']['remappings']
    assert [*launch(ekf='false')] == ['omnicam_node', 'sfa_node']
    assert [*launch(rviz='true')] == [*NODES, 'rviz2']
    for node in launch(autostart='false', params_file=ROOT / 'config/nav2.yaml').values():
        file, chosen = node['parameters']
        assert file == ROOT / 'config/nav2.yaml' and chosen['autostart'] is False
    assert launch(autostart='True')['ekf_node']['parameters'][1]['autostart'] is True
    with pytest.raises(ValueError, match='autostart:=on: give true or false'):
        launch(autostart='on')
    assert ('imu/data', '/imu') in launch(imu='/imu')['omnicam_node']['remappings']
    assert ('odom', 'wheels') in launch(odom='wheels')['omnicam_node']['remappings']
    assert 'cameras' not in launched['omnicam_node']['parameters'][1]
    several = launch(cameras='front,rear')['omnicam_node']['parameters'][1]
    assert several['cameras'] == ['front', 'rear']
    assert without['sfa_node']['parameters'][1]['image_transport'] == 'compressed'
    panorama = dict(without['sfa_node']['remappings'])['panorama']
    odometry = dict(without['ekf_node']['remappings'])['odom']
    with Bag(ROOT / played.split()[3]) as bag:
        assert {f'{panorama}/compressed', f'/{odometry}'} <= set(bag.topics)
    with pytest.raises(FileNotFoundError, match=r'config:=/nowhere\.yaml'):
        launch(config='/nowhere.yaml')  # launch_ros itself only warns, and starts with defaults
    (composed,) = launch(composed='true', odom='wheels', autostart='false').values()
    assert composed['executable'] == 'localization' and 'name' not in composed
    assert {'image_raw', 'odom', '/tf', '/tf_static', 'imu/data'} <= {
        name for name, _ in composed['remappings']
    }
    with pytest.raises(ValueError, match='leave panorama:= and ekf:= out'):
        launch(composed='true', ekf='false')
    with pytest.raises(FileNotFoundError, match=r'params_file:=/nowhere\.yaml'):
        launch(params_file='/nowhere.yaml')


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


def test_the_reference_for_python_is_that_of_the_docstrings():
    assert PAGES['config/python.md'] == runpy.run_path(str(ROOT / '.ci/reference'))['page']()


def test_pages_name_tests_that_exist():
    """And test/FAULTS.md shows the faults of promises.py."""
    problems, faults = PAGES['config/problems.md'], PAGES['test/FAULTS.md']
    assert promises.table() in faults, 'run: PYTHONPATH=.:test python -m robustness --page'
    names = TEST_NAME.findall(problems + faults)
    missing = [n for n in names if f'def {n[1]}(' not in (ROOT / 'test' / n[0]).read_text('utf-8')]
    assert len(names) > 50 and missing == []


def test_each_reason_on_the_pages_is_in_the_code_with_cause_and_remedy():
    reasons = PAGES['config/diagnostics.md'].partition('## Reasons')[2]
    lines = (PAGES['config/troubleshooting.md'] + reasons).splitlines()
    rows = [row.strip('|').split('|') for row in lines if row.startswith('| `')]
    assert all(len(row) == 3 and all(cell.strip() for cell in row) for row in rows)
    code = ' '.join(path.read_text('utf-8') for path in (ROOT / 'sfa_localization').rglob('*.py'))
    code = re.sub(r"'\s+f?'", '', code)  # texts that go on in the next line
    parts = [part.strip() for row in rows for part in row[0].strip()[1:-1].split('…')]
    assert len(rows) > 20 and [part for part in parts if part not in code] == []
