# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The command line: one thin function per command, over the use cases of the other modules."""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from sfa_localization import __version__
from sfa_localization.bags.settings import TopicNames
from sfa_localization.camera.settings import (
    CalibrationConfig,
    CameraConfig,
    LensCalibration,
    PanoramaConfig,
    WatchConfig,
)
from sfa_localization.commands.settings import DemoConfig, PlayConfig
from sfa_localization.config import (
    SECTIONS,
    load_changes,
    load_settings,
    render,
    write_config,
)
from sfa_localization.data.errors import ConfigError, DataError, LocalizationError
from sfa_localization.data.settings import Settings
from sfa_localization.features.settings import NetworkConfig
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.inspection import InspectionConfig
from sfa_localization.metric.settings import MetricConfig, SegmentConfig
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.tuning import TuneConfig

if TYPE_CHECKING:
    from sfa_localization.training import Recipe

S = TypeVar('S', bound=Settings)
OPTIONAL = {
    'trimesh': 'trimesh embreex',
    'embreex': 'trimesh embreex',
    'mdp': 'MDP==3.6',
    'distributed': 'distributed',
    'lz4': 'lz4',
    'zstandard': 'backports.zstd',
    'rclpy': '"ros-jazzy-rclpy[fastrtps]" ros-jazzy-common-interfaces, or source ROS 2',
}
"""What some commands need beyond the rest, and how it is installed."""


@dataclass(frozen=True)
class Command:
    """A command: its name, one line of help, its arguments, and what runs it."""

    name: str
    summary: str
    example: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def _add_settings(
    parser: argparse.ArgumentParser, group: type[Settings], names: Sequence[str] = ()
) -> None:
    """Add an option --some-name for each named setting of the group (none named: for all)."""
    for item in dataclasses.fields(group):
        if names and item.name not in names:
            continue
        unit = f' ({item.metadata["unit"]})' if item.metadata['unit'] else ''
        parser.add_argument(
            f'--{item.name.replace("_", "-")}',
            dest=_dest(group, item.name),
            metavar=None if item.metadata['choices'] else item.name.upper(),
            type=_by_x if isinstance(item.default, tuple) else type(item.default),
            choices=item.metadata['choices'] or None,
            default=argparse.SUPPRESS,
            help=f'{item.metadata["doc"]}{unit} [{_shown(item.default)}]',
        )


def _by_x(text: str) -> tuple[float, ...]:
    """Numbers joined by x, as in 16x18."""
    try:
        return tuple(float(part) for part in text.split('x'))
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text!r} is not like 16x18') from None


def _shown(default: object) -> str:
    return 'x'.join(f'{part:g}' for part in default) if isinstance(default, tuple) else str(default)


def _dest(group: type[Settings], name: str) -> str:
    """Where the parser keeps a setting: under its group, as two groups may share a name."""
    return f'{group.__name__}.{name}'


def _given(group: type[Settings], arguments: argparse.Namespace) -> dict[str, Any]:
    """The settings of the group that were given on the command line."""
    places = {_dest(group, item.name): item.name for item in dataclasses.fields(group)}
    return {places[at]: value for at, value in vars(arguments).items() if at in places}


def _settings(group: type[S], arguments: argparse.Namespace, path: Path | None = None) -> S:
    """The group as the parameter file at `path`, if any, and then the command line say."""
    section = next((name for name, kinds in SECTIONS.items() if group in kinds), '')
    settings = load_settings(path, section, group) if path else group()
    told = {item.name: getattr(settings, item.name) for item in dataclasses.fields(group)}
    return group.from_mapping({**told, **_given(group, arguments)}, 'command line')


def _configure_simulate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('out', type=Path, metavar='OUT_BAG', help='folder of the bag to write')
    parser.add_argument('--size', type=_by_x, help='columns x rows of --images panorama [600x60]')
    parser.add_argument(
        '--compressed',
        action='store_const',
        dest=_dest(SimulationConfig, 'compression'),
        const='jpeg',
        default=argparse.SUPPRESS,
        help='short for --compression jpeg',
    )
    _add_settings(parser, SimulationConfig)


def _simulate(arguments: argparse.Namespace) -> int:
    from sfa_localization.simulation.drive import simulate

    config = _settings(SimulationConfig, arguments)
    panorama, progress = _panorama_of(arguments.size), sys.stderr.isatty()
    drive = simulate(config, arguments.out, panorama, progress=progress)
    seconds = (drive.truth.stamps_ns[-1] - drive.truth.stamps_ns[0]) * 1e-9
    print(f'{arguments.out}: {len(drive.image_stamps_ns)} pictures in {seconds:.0f} s')
    return 0


def _panorama_of(size: tuple[float, ...] | None) -> PanoramaConfig:
    if size is None:
        return PanoramaConfig()
    if len(size) != 2:
        raise ConfigError('--size: name columns x rows, as in 300x30')
    return PanoramaConfig.from_mapping({'width': int(size[0]), 'height': int(size[1])}, '--size')


SIMULATE = Command(
    'simulate',
    'Record a bag with a simulated robot in a simulated garden.',
    '  simulate bags/coverage --trajectory coverage --seed 1\n'
    '  simulate bags/test --trajectory test --seed 2 --compressed\n'
    '  simulate bags/tiny --area 8x8 --length 30 --images panorama --size 300x30',
    _configure_simulate,
    _simulate,
)


def _configure_play(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bag', type=Path, metavar='BAG', help='bag: a folder or a single file')
    parser.add_argument('--loop', action='store_true', help='start again at the end')
    parser.add_argument(
        '--clock', action='store_true', help='publish the time of the bag on /clock'
    )
    parser.add_argument('--topics', nargs='+', default=(), metavar='T', help='only these topics')
    parser.add_argument(
        '--wait-for',
        nargs='+',
        default=(),
        metavar='T',
        help='topics that need a subscriber first; none: one of images and one of odometry',
    )
    parser.add_argument('--strict', action='store_true', help='refuse a damaged bag')
    _add_settings(parser, PlayConfig)


def _play(arguments: argparse.Namespace) -> int:
    try:
        from sfa_localization.commands.play import play
    except ImportError as error:
        raise LocalizationError(f'play needs ROS 2 ({error}); install ros-jazzy-rclpy') from None

    played = play(
        arguments.bag,
        config=_settings(PlayConfig, arguments),
        loop=arguments.loop,
        clock=arguments.clock,
        topics=arguments.topics,
        wait_for=arguments.wait_for,
        strict=arguments.strict,
    )
    for topic, number in sorted(played.messages.items()):
        print(f'{topic}: {number} messages')
    return 0


PLAY = Command(
    'play',
    'Replay a bag through ROS, with the types, QoS and pace it was recorded with.',
    '  play bags/sample\n'
    '  play bags/sample --rate 2 --loop --clock\n'
    '  play bags/sample --start-offset 10 --topics /panorama/compressed /odom\n\n'
    'keys: space pauses, s or right arrow plays one message, up and down change the rate,\n'
    'Ctrl-C ends it',
    _configure_play,
    _play,
)


def _configure_inspect(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='folders or single files')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write what was found as JSON')
    parser.add_argument(
        '--report', type=Path, metavar='DIR', help='write a contact sheet and the path as PNG'
    )
    parser.add_argument('--strict', action='store_true', help='refuse damaged bags')
    _add_topics(parser)
    _add_settings(parser, InspectionConfig)


_TOPIC_FLAGS = {
    'image': '--image-topic',
    'odometry': '--odom-topic',
    'imu': '--imu-topic',
    'ground_truth': '--ground-truth-topic',
}


def _add_topics(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add the flags that choose topics (none named: for pictures and odometry)."""
    docs = {item.name: item.metadata['doc'] for item in dataclasses.fields(TopicNames)}
    for name in names or ('image', 'odometry'):
        parser.add_argument(
            _TOPIC_FLAGS[name],
            dest=_dest(TopicNames, name),
            metavar='T',
            default=argparse.SUPPRESS,
            help=docs[name],
        )


def _inspect(arguments: argparse.Namespace) -> int:
    from sfa_localization.commands.inspection_files import inspect_bags

    reports = inspect_bags(
        arguments.bags,
        topics=_settings(TopicNames, arguments),
        config=_settings(InspectionConfig, arguments),
        strict=arguments.strict,
        json_file=arguments.json,
        folder=arguments.report,
    )
    for report in reports:
        print(report.as_text(), file=sys.stderr if report.error else sys.stdout)
    return 1 if any(report.error for report in reports) else 0


INSPECT = Command(
    'inspect',
    'Tell what is in bags, what is wrong with them, and whether they are enough to train on.',
    '  inspect bags/coverage bags/test\n'
    '  inspect recording_0.mcap --json bag.json --report report\n\n'
    'JSON: {"bags": [{"path", "topics": {NAME: {"type", "count", "first_stamp_ns",\n'
    '"last_stamp_ns", "rate_hz", "largest_gap_s", "problems"}}, "problems", "lacks", ...}]}',
    _configure_inspect,
    _inspect,
)


def _configure_calibrate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('images', nargs='*', type=Path, metavar='IMAGE', help='raw images')
    parser.add_argument(
        '--calibration',
        type=Path,
        help='camera_info, OpenCV, Kalibr or camodocal YAML, or OCamCalib calib_results.txt',
    )
    parser.add_argument('--center', type=_by_x, help='COLUMNxROW of the mirror (px); else found')
    parser.add_argument('--radii', type=_by_x, help='INNERxOUTER radius (px); else found')
    parser.add_argument('--output', type=Path, help='calibration file to write (YAML)')
    parser.add_argument('--check', type=Path, help='image to write, to see if all is right (PNG)')
    _add_settings(parser, CalibrationConfig)
    _add_settings(parser, LensCalibration, ('angle_min', 'angle_max', 'axis', 'mirrored'))
    _add_settings(parser, CameraConfig, ('mount_rpy',))


def _calibrate(arguments: argparse.Namespace) -> int:
    from sfa_localization.camera import calibration, calibration_files
    from sfa_localization.camera.panorama import Unwrapper

    images = calibration.read_images(arguments.images)
    circles = None
    if arguments.center or arguments.radii:
        circles = calibration.given_circles(arguments.center, arguments.radii, images)
    config, known = _settings(CalibrationConfig, arguments), _given(LensCalibration, arguments)
    lens = calibration.calibrate(images, arguments.calibration, circles, config, known)
    camera = _settings(CameraConfig, arguments)
    text = calibration_files.calibration_text(lens, camera.mount_rpy)
    print(text, end='')
    if arguments.check:
        if not images:
            raise LocalizationError('--check needs an image of the camera to draw in')
        unwrapper = Unwrapper(camera, PanoramaConfig(), lens)
        calibration.write_check(arguments.check, calibration.check_image(images[0], unwrapper))
    if arguments.output:
        calibration.write_calibration(arguments.output, text)
    return 0


CALIBRATE = Command(
    'calibrate',
    'Find the mirror in images, or read a calibration file; write a calibration file.',
    '  calibrate drive/*.png --check check.png --output camera.yaml\n'
    '  calibrate image.png --model fisheye --field-of-view 190 --check check.png\n'
    '  calibrate image.png --calibration calib_results.txt --mirrored yes --axis down \\\n'
    '      --check check.png --output camera.yaml\n'
    '  calibrate --calibration camchain.yaml --output camera.yaml\n\n'
    'The check image shows where FRONT, LEFT, BACK and RIGHT of the robot are taken to be, and\n'
    'the elevations of the panorama. Turn it right with --mount-rpy (ROLLxPITCHxYAW, as 0x0x90),\n'
    '--axis and --mirrored. omnicam_node takes the file as its parameter calibration_file.\n\n'
    'how to get each model:\n'
    '  mirror    (most exact) Kalibr, omni-radtan; OpenCV omnidir; camodocal, MEI; a fisheye\n'
    '            calibrated so needs --mirrored no --axis up\n'
    '  fisheye   Kalibr, pinhole-equi; OpenCV fisheye; ROS camera_calibration with its\n'
    '            fisheye model; or from the rim alone with --model fisheye\n'
    '  ocam      OCamCalib: export calib_results.txt; a mirror needs --mirrored yes --axis down\n'
    '  polar     (no calibration) from images, --angle-min and --angle-max',
    _configure_calibrate,
    _calibrate,
)


def _configure_filter(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('odometry', type=Path, metavar='ODOM.csv')
    parser.add_argument('positions', type=Path, metavar='POSITIONS.csv')
    parser.add_argument('--config', type=Path, help='parameter file; section ekf_node is read')
    parser.add_argument(
        '--initial-pose',
        nargs=3,
        type=float,
        metavar=('X', 'Y', 'YAW'),
        help='start (m, m, rad), where it is known',
    )
    parser.add_argument('--output', type=Path, required=True, help='TUM file to write')


def _filter(arguments: argparse.Namespace) -> int:
    from sfa_localization import filtering

    odometry = filtering.read_odometry_table(arguments.odometry)
    positions = filtering.read_position_table(arguments.positions)
    config = _settings(FilterConfig, arguments, arguments.config)
    config, text = filtering.fitting_config(odometry, positions, config)
    if text:
        print(text)
    done = filtering.run_filter(
        odometry, positions, config, arguments.initial_pose, progress=sys.stderr.isatty()
    )
    for name, table in (('odometry rows', odometry), ('position rows', positions)):
        for reason, count in sorted(table.skipped.items()):
            print(f'{name}: {reason}: {count}')
    for reason, count in sorted(done.counts.items()):
        print(f'{reason}: {count}')
    print(': '.join([done.status.level.name, '; '.join(done.status.reasons)]).rstrip(': '))
    if len(done.poses) == 0:
        raise DataError(
            'the filter never started: positions without heading need some metres of motion; '
            'or give --initial-pose X Y YAW'
        )
    filtering.write_tum(arguments.output, done.stamps_ns, done.poses)
    waited = f', {done.before_start} rows before the start' if done.before_start else ''
    print(f'{arguments.output}: {len(done.poses)} poses{waited}')
    return 0


def _require_same_panorama(path: Path | None, trained: PanoramaConfig) -> None:
    """Refuse a parameter file with which sfa_node would refuse omnicam_node's panoramas."""
    if path is None:
        return
    declared = load_settings(path, 'omnicam_node', PanoramaConfig)
    # The size is the pictures' own where they are panoramas already.
    declared = dataclasses.replace(declared, width=trained.width, height=trained.height)
    differences = trained.differences(declared)
    if differences:
        raise ConfigError(
            f'{path}: omnicam_node: panoramas would be unlike those of training: {differences}'
        )


FILTER = Command(
    'filter',
    'Fuse a log of odometry and positions, without ROS: what the live filter would have told.',
    '  filter odom.csv positions.csv --output poses.tum\n'
    '  filter odom.csv gps.csv --config localization.yaml --initial-pose 0 0 1.57 \\\n'
    '      --output poses.tum\n\n'
    'ODOM.csv: stamp_s,v_mps,omega_radps[,var_v,var_omega]\n'
    'POSITIONS.csv: stamp_s,x_m,y_m[,var_x,var_y][,var_xy][,yaw_rad,var_yaw]\n'
    'Seconds, metres, radians; variances in their squares; empty: unknown.',
    _configure_filter,
    _filter,
)


def _configure_tune(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG')
    parser.add_argument('--model', type=Path, required=True, help='file of the trained model')
    parser.add_argument('--config', type=Path, help='parameter file to start from')
    parser.add_argument('--output', type=Path, required=True, help='parameter file to write')
    _add_settings(parser, TuneConfig)
    _add_topics(parser, *_TOPIC_FLAGS)


def _tune(arguments: argparse.Namespace) -> int:
    from sfa_localization import tuning
    from sfa_localization.place_model import PlaceModel

    how, model = _settings(TuneConfig, arguments), PlaceModel.load(arguments.model)
    _require_same_panorama(arguments.config, model.panorama)
    recipe = dataclasses.replace(_recipe(arguments), panorama=model.panorama)
    config = _settings(FilterConfig, arguments, arguments.config)
    watch = _settings(WatchConfig, arguments, arguments.config)
    progress = sys.stderr.isatty()
    drives = tuning.read_drives(
        arguments.bags, model, recipe, how.method == 'grid', progress, watch
    )
    best = tuning.tune(drives, config, how, progress)
    changes = load_changes(arguments.config) if arguments.config else {}
    found = {
        item.name: getattr(best.config, item.name)
        for item in dataclasses.fields(FilterConfig)
        if getattr(best.config, item.name) != getattr(config, item.name)
    }
    changes['ekf_node'] = {**changes.get('ekf_node', {}), **found}
    write_config(arguments.output, changes)
    unit = 'm mean error' if how.method == 'grid' else 'negative log-likelihood per component'
    for name, value in found.items():
        print(f'{name}: {value:.4g} (was {getattr(config, name):.4g})')
    print(f'{arguments.output}: {best.cost:.4f} {unit}')
    return 0


TUNE = Command(
    'tune',
    "Find the filter's noise parameters from bags; write them into a parameter file.",
    '  tune bags/test --model model.npz --output tuned.yaml\n'
    '  tune bags/a bags/b --model model.npz --method grid --output tuned.yaml\n\n'
    'The default needs no ground truth. Variances count in the squares of m, rad, m/s and rad/s.',
    _configure_tune,
    _tune,
)


def _configure_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--output', type=Path, help='file to write; else it is printed')


def _config(arguments: argparse.Namespace) -> int:
    if arguments.output:
        write_config(arguments.output)
    else:
        print(render(), end='')
    return 0


CONFIG = Command(
    'config',
    'Write the parameter file of nodes and trainer: every parameter, explained, with its unit.',
    '  config\n  config --output localization.yaml',
    _configure_config,
    _config,
)


def _recipe(arguments: argparse.Namespace) -> Recipe:
    """The recipe of --config, with the topics and settings that the command line names."""
    from sfa_localization.training import Recipe

    default = Recipe()
    groups = {item.name: getattr(default, item.name) for item in dataclasses.fields(Recipe)}
    named: dict[str, Any] = {
        name: _settings(type(group), arguments, arguments.config)
        for name, group in groups.items()
        if isinstance(group, Settings)
    }
    return dataclasses.replace(default, **named)


def _configure_train(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG', help='drives to learn from')
    parser.add_argument('--output', type=Path, required=True, metavar='MODEL.npz')
    parser.add_argument('--config', type=Path, help='parameter file')
    parser.add_argument('--report', type=Path, metavar='DIR', help='write pictures of the training')
    parser.add_argument('--resume', action='store_true', help='go on where a training was cut off')
    parser.add_argument('--strict', action='store_true', help='refuse damaged bags')
    parser.add_argument(
        '--dask', metavar='ADDRESS', help='train on a cluster whose workers see the output folder'
    )
    _add_topics(parser, 'image', 'odometry', 'imu')
    _add_settings(parser, SegmentConfig, ('segments',))
    _add_settings(parser, MetricConfig, ('solver', 'metric_map'))
    _add_settings(parser, NetworkConfig, ('engine', 'normalization'))


def _train(arguments: argparse.Namespace) -> int:
    from sfa_localization import training
    from sfa_localization.features.cluster import executor_at
    from sfa_localization.reports.summary import summary

    with executor_at(arguments.dask) as executor:
        trained = training.train(
            arguments.bags,
            arguments.output,
            _recipe(arguments),
            progress=sys.stderr.isatty(),
            resume=arguments.resume,
            strict=arguments.strict,
            executor=executor,
        )
    print(summary(trained))
    if arguments.report:
        from sfa_localization.reports.training import write_training_report

        write_training_report(arguments.report, trained)
    print(f'{arguments.output}: written')
    return 0


TRAIN = Command(
    'train',
    'Learn a place model from bags of pictures and odometry; ground truth is never read.',
    '  train bags/coverage --output garden.npz\n'
    '  train bags/a bags/b --output garden.npz --config localization.yaml --report report\n'
    '  train recording --output garden.npz --image-topic /front/image_raw --odom-topic /odom',
    _configure_train,
    _train,
)


def _configure_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('model', type=Path, metavar='MODEL.npz')
    parser.add_argument('bag', type=Path, metavar='BAG', help='drive with ground truth')
    parser.add_argument(
        '--align', type=Path, metavar='TRAIN_BAG', help='drive that lays the map on the truth'
    )
    parser.add_argument('--config', type=Path, help='parameter file')
    parser.add_argument('--report', type=Path, metavar='DIR', help='write pictures and the table')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the figures')
    _add_topics(parser, *_TOPIC_FLAGS)


def _evaluate(arguments: argparse.Namespace) -> int:
    from sfa_localization import evaluation
    from sfa_localization.place_model import PlaceModel
    from sfa_localization.reports import evaluation as report

    model = PlaceModel.load(arguments.model)
    _require_same_panorama(arguments.config, model.panorama)
    judged = evaluation.evaluate(
        model,
        arguments.bag,
        align_bag=arguments.align,
        recipe=_recipe(arguments),
        config=_settings(FilterConfig, arguments, arguments.config),
        watch=_settings(WatchConfig, arguments, arguments.config),
        progress=sys.stderr.isatty(),
    )
    print(report.table(judged.scores), report.heading_table(judged.scores), sep='\n\n')
    for stream in ('images', 'odometry', 'observations'):
        count = judged.counts[stream]
        reasons = ''.join(f'; {n} skipped: {why}' for why, n in sorted(count['skipped'].items()))
        print(f'{stream}: {count["used"]} used{reasons}')
    for line in _fusion_lines(judged.counts):
        print(line)
    print(f'aligned on {judged.aligned_on}')
    if arguments.report:
        report.write_report(
            arguments.report,
            judged.truth,
            judged.estimates,
            judged.scores,
            judged.estimates['sfa'].poses[:, :2],
            judged.features,
        )
    if arguments.json:
        evaluation.write_json(arguments.json, judged.as_dict())
    return 0


EVALUATE = Command(
    'evaluate',
    'Compare a model, alone and fused with odometry, with the ground truth of a drive (metres).',
    '  evaluate garden.npz bags/test --align bags/coverage\n'
    '  evaluate garden.npz bags/test --align bags/coverage --report report --json results.json',
    _configure_evaluate,
    _evaluate,
)


def _fusion_lines(counts: Mapping[str, Any]) -> list[str]:
    """What the filter rejected, how long it was in each state, and how late images were."""
    usual = {'odometry: used', 'measurement: accepted', 'measurement: started'}
    rejected = {why: n for why, n in counts['fusion'].items() if why not in usual}
    lines = [f'filter: {n} times {why}' for why, n in sorted(rejected.items())]
    states = ', '.join(f'{name} {seconds:.1f} s' for name, seconds in counts['states_s'].items())
    lines.append(f'state: {states}')
    if 'camera_delay_s' in counts:
        delay = counts['camera_delay_s']
        late = 'late' if delay > 0 else 'early'
        lines.append(f'camera: images are stamped {abs(delay):.2f} s {late}')
    return lines


def _configure_demo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--out', type=Path, default=Path('demo'), metavar='DIR', help='folder to write [demo]'
    )
    _add_settings(parser, DemoConfig)


def _demo(arguments: argparse.Namespace) -> int:
    from sfa_localization.commands import demo
    from sfa_localization.commands.processes import terminable
    from sfa_localization.reports import evaluation as report

    with terminable():
        judged = demo.demonstrate(arguments.out, _settings(DemoConfig, arguments), progress=True)
    print(report.table(judged.scores), report.heading_table(judged.scores), sep='\n\n')
    return 0


DEMO = Command(
    'demo',
    'Simulate, train, run the three nodes live, and print how far they are off (about 5 minutes).',
    '  demo\n  demo --world 2 --out demo_of_world_2',
    _configure_demo,
    _demo,
)


COMMANDS: list[Command] = [
    SIMULATE,
    TRAIN,
    EVALUATE,
    PLAY,
    INSPECT,
    CALIBRATE,
    FILTER,
    TUNE,
    CONFIG,
    DEMO,
]


NODES = {
    'omnicam_node': 'ROS 2 node: camera pictures to panoramas (--ros-args -p NAME:=VALUE).',
    'sfa_node': 'ROS 2 node: panoramas to slow features and poses.',
    'ekf_node': 'ROS 2 node: poses and odometry to the pose in the map.',
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command or node named by the first argument; return the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words and words[0] in NODES:
        return _guarded(_run_node, argparse.Namespace(name=words[0], words=words))
    parser = argparse.ArgumentParser(
        prog='sfa_localization',
        description='Localization from one omnidirectional camera, learnt without ground truth.',
    )
    parser.add_argument('--version', action='version', version=__version__)
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    for command in COMMANDS:
        _prepare(
            commands.add_parser(command.name, help=command.summary, **_texts(command)), command
        )
    for name, summary in NODES.items():
        commands.add_parser(name, help=summary)
    arguments = parser.parse_args(words)
    return _guarded(arguments.run_command, arguments)


def _run_node(arguments: argparse.Namespace) -> int:
    """Run a node, which reads its ROS arguments itself."""
    node = importlib.import_module(f'sfa_localization.nodes.{arguments.name}')
    return int(node.main(arguments.words))


def executable() -> int:
    """Run the command that this executable is named after (console_scripts in setup.py)."""
    name = Path(sys.argv[0]).stem
    return _run_alone(next(command for command in COMMANDS if command.name == name))


def _run_alone(command: Command) -> int:
    """Run one command as an executable of its own."""
    parser = argparse.ArgumentParser(prog=command.name, **_texts(command))
    _prepare(parser, command)
    arguments = parser.parse_args()
    return _guarded(arguments.run_command, arguments)


def _texts(command: Command) -> dict[str, Any]:
    return {
        'description': f'{command.summary}\n\nexamples:\n{command.example}',
        'formatter_class': argparse.RawDescriptionHelpFormatter,
    }


def _prepare(parser: argparse.ArgumentParser, command: Command) -> None:
    command.configure(parser)
    parser.set_defaults(run_command=command.run)


def _guarded(run: Callable[[argparse.Namespace], int], arguments: argparse.Namespace) -> int:
    """Turn expected errors into one line and exit code 1, Ctrl-C into 130."""
    try:
        code = run(arguments)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader, such as head, has seen enough; what is still buffered goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except LocalizationError as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        package = (error.name or '').partition('.')[0]
        if package not in OPTIONAL:
            raise
        remedy = f'pip install {OPTIONAL[package]}'
        print(f'error: {package} is not installed; this needs it: {remedy}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130
