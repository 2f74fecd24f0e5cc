# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three nodes in one launch: camera image -> panorama -> pose -> fused pose.

ros2 launch sfa_localization localization.launch.py model:=/path/to/model.npz
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, PushROSNamespace
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'sfa_localization'


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and start the nodes with them."""
    parameters = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config', 'localization.yaml'])
    arguments = [
        DeclareLaunchArgument('model', description='model file, as `train` writes it'),
        DeclareLaunchArgument('config', default_value=parameters, description='parameter file'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the nodes'),
        DeclareLaunchArgument('image', default_value='image_raw', description="camera's topic"),
        DeclareLaunchArgument(
            'image_transport', default_value='raw', description='raw, or compressed images'
        ),
        DeclareLaunchArgument('odom', default_value='odom', description="odometry's topic"),
        DeclareLaunchArgument(
            'tf', default_value='tf', description="the transform's topic, in the namespace; or /tf"
        ),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false', description='time from /clock (bags, simulators)'
        ),
    ]
    image = LaunchConfiguration('image')
    transport = {'image_transport': LaunchConfiguration('image_transport')}
    images = [('image_raw', image), ('image_raw/compressed', [image, '/compressed'])]
    odometry = [('odom', LaunchConfiguration('odom'))]
    return LaunchDescription(
        [
            *arguments,
            OpaqueFunction(function=_require_config),
            PushROSNamespace(LaunchConfiguration('namespace')),
            _node('omnicam_node', images, transport),
            _node('sfa_node', [], {'model': LaunchConfiguration('model')}),
            # As Nav2 does, so that robots with frames of the same names do not meet on /tf.
            _node('ekf_node', [*odometry, ('/tf', LaunchConfiguration('tf'))], {}),
        ]
    )


def _require_config(context: LaunchContext) -> None:
    """Raise for a parameter file that is missing: launch would go on with every default."""
    path = LaunchConfiguration('config').perform(context)
    if not Path(path).is_file():
        raise FileNotFoundError(f'config:={path}: there is no such parameter file')


def _node(name: str, remappings: list, parameters: dict) -> Node:
    sim_time = ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
    return Node(
        package=PACKAGE,
        executable=name,
        name=name,
        output='screen',
        parameters=[LaunchConfiguration('config'), {'use_sim_time': sim_time, **parameters}],
        remappings=remappings,
    )
