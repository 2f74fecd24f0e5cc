# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three nodes in one launch: camera image -> panorama -> pose -> fused pose.

ros2 launch sfa_localization localization.launch.py model:=/path/to/model.npz
"""

from functools import partial
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, PushROSNamespace
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from sfa_localization.nodes.process import CANNOT_START, COMPOSED, is_true

PACKAGE = 'sfa_localization'
RESPAWN_DELAY_S = 2.0


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and start the nodes with them."""
    parameters = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config', 'localization.yaml'])
    arguments = [
        DeclareLaunchArgument('model', description='model file, as `train` writes it'),
        DeclareLaunchArgument('config', default_value=parameters, description='parameter file'),
        DeclareLaunchArgument(
            'params_file', default_value='', description='the same, by the name that Nav2 uses'
        ),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the nodes'),
        DeclareLaunchArgument('image', default_value='image_raw', description="camera's topic"),
        DeclareLaunchArgument(
            'cameras',
            default_value='',
            description='names of several cameras, as front,left,rear,right; a model has its own',
        ),
        DeclareLaunchArgument(
            'panorama', default_value='', description='topic of panoramas, without an omnicam_node'
        ),
        DeclareLaunchArgument(
            'image_transport',
            default_value='raw',
            description='raw, compressed, ffmpeg or foxglove',
        ),
        DeclareLaunchArgument('odom', default_value='odom', description="odometry's topic"),
        DeclareLaunchArgument(
            'imu', default_value='imu/data', description="the IMU's topic, for level_by_imu"
        ),
        DeclareLaunchArgument(
            'ekf', default_value='true', description='false: without ekf_node, poses of images only'
        ),
        DeclareLaunchArgument(
            'tf', default_value='tf', description="the transform's topic, in the namespace; or /tf"
        ),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false', description='time from /clock (bags, simulators)'
        ),
        DeclareLaunchArgument(
            'autostart', default_value='', description='false: a lifecycle manager starts the nodes'
        ),
        DeclareLaunchArgument(
            'composed', default_value='false', description='true: all nodes in one process'
        ),
        DeclareLaunchArgument('log_level', default_value='info', description='of the nodes'),
        DeclareLaunchArgument('rviz', default_value='false', description='start RViz too'),
        DeclareLaunchArgument(
            'respawn', default_value='true', description='start a node again that has died'
        ),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list:
    """The nodes in their namespace. Raises FileNotFoundError for a missing parameter file.

    launch itself would go on with every default.
    """
    given = context.launch_configurations
    argument = 'params_file' if given['params_file'] else 'config'
    file = Path(given[argument]).expanduser()
    if not file.is_file():
        raise FileNotFoundError(f'{argument}:={file}: there is no such parameter file')
    # Without the argument, the parameter file decides.
    start = {'autostart': is_true('autostart', given['autostart'])} if given['autostart'] else {}
    node = partial(_node, file, start)
    transport = {'image_transport': given['image_transport']}
    # Without the argument, the parameter file or the model decides.
    cameras = {'cameras': given['cameras'].split(',')} if given['cameras'] else {}
    model = {'model': given['model']}
    image, panorama = given['image'], given['panorama']
    images = [('image_raw', image), ('image_raw/compressed', f'{image}/compressed')]
    images += [('imu/data', given['imu']), ('odom', given['odom'])]
    # As Nav2 does, so that robots with frames of the same names do not meet on /tf.
    odometry = [('odom', given['odom']), ('/tf', given['tf'])]
    static = [('/tf_static', f'{given["tf"]}_static')]
    if is_true('composed', given['composed']):
        if panorama or given['ekf'] != 'true':
            raise ValueError('composed:=true runs all nodes: leave panorama:= and ekf:= out')
        every = [*images, *odometry[1:], *static]
        chain = node('localization', every, {**model, **transport, **cameras})
        return [PushROSNamespace(given['namespace']), chain, _rviz(given)]
    if panorama:
        seeing = [node('sfa_node', [('panorama', panorama), *static], {**model, **transport})]
    else:
        several = {**model, **transport, **cameras}
        seeing = [node('omnicam_node', images, several), node('sfa_node', static, model)]
    ekf = node('ekf_node', odometry, {}, condition=IfCondition(given['ekf']))
    return [PushROSNamespace(given['namespace']), *seeing, ekf, _rviz(given)]


def _rviz(given: dict) -> Node:
    layout = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config', 'localization.rviz'])
    return Node(
        package='rviz2',
        executable='rviz2',
        arguments=['-d', layout],
        remappings=[('/tf', given['tf'])],
        condition=IfCondition(given['rviz']),
    )


def _node(
    file: Path, start: dict, name: str, remappings: list, parameters: dict, **options: object
) -> Node:
    sim_time = ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
    return Node(
        package=PACKAGE,
        executable=name,
        # All nodes of one process would have one name.
        **({} if name == COMPOSED else {'name': name}),
        output='screen',
        arguments=['--ros-args', '--log-level', LaunchConfiguration('log_level')],
        parameters=[file, {'use_sim_time': sim_time, **start, **parameters}],
        remappings=remappings,
        respawn=LaunchConfiguration('respawn'),
        respawn_delay=RESPAWN_DELAY_S,
        on_exit=_exited,
        **options,
    )


def _exited(event: ProcessExited, context: LaunchContext) -> None:
    """End the launch, with exit code 1, where a node cannot start: it could not the next time."""
    if event.returncode == CANNOT_START and not context.is_shutdown:
        raise RuntimeError(f'{event.process_name} cannot start: see its message above')
