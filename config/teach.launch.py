# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Teach and go: record a drive, see where to drive still, train, and be localized.

ros2 launch sfa_localization teach.launch.py output:=garden.npz
ros2 service call /teach_node/finish std_srvs/srv/Trigger
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from sfa_localization.nodes.process import is_true

PACKAGE = 'sfa_localization'


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and start the node with them."""
    config = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config'])
    arguments = [
        DeclareLaunchArgument('output', description='model to write; drives are kept beside it'),
        DeclareLaunchArgument(
            'config', default_value=[config, '/localization.yaml'], description='parameter file'
        ),
        DeclareLaunchArgument('image', default_value='', description='topic of images; or found'),
        DeclareLaunchArgument('odom', default_value='', description='topic of odometry; or found'),
        DeclareLaunchArgument('imu', default_value='', description='topic of the IMU; or found'),
        DeclareLaunchArgument(
            'localize',
            default_value='true',
            description='start the three nodes too, which localize when a model is written',
        ),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false', description='time from /clock (bags, simulators)'
        ),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes, args=[config])])


def _nodes(context: LaunchContext, config: PathJoinSubstitution) -> list:
    """The node that teaches, and the chain that waits for its model."""
    given = context.launch_configurations
    output = str(Path(given['output']).expanduser())
    localize = is_true('localize', given['localize'])
    parameters = {
        'output': output,
        'localize': localize,
        'image': given['image'],
        'odometry': given['odom'],
        'imu': given['imu'],
        'use_sim_time': is_true('use_sim_time', given['use_sim_time']),
    }
    teach = Node(
        package=PACKAGE,
        executable='teach_node',
        name='teach_node',
        output='screen',
        parameters=[given['config'], parameters],
    )
    if not localize:
        return [teach]
    # Empty names are those that the nodes find.
    topics = {'image': given['image'] or 'image_raw', 'odom': given['odom'] or 'odom'}
    arguments = {
        **topics, 'model': output, 'autostart': 'false', 'config': given['config'],
        'use_sim_time': given['use_sim_time'],
    }  # fmt: skip
    source = PythonLaunchDescriptionSource([config, '/localization.launch.py'])
    chain = IncludeLaunchDescription(source, launch_arguments=arguments.items())
    return [teach, chain]
