# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The package as pip and colcon build it; dependency lists live here and nowhere else.

``package.xml`` names the same dependencies by their rosdep keys. `make env` installs the extras.
"""

import sys
from glob import glob

from setuptools import find_packages, setup

NAME = 'sfa_localization'
COMMANDS = (
    'simulate',
    'train',
    'evaluate',
    'fleet',
    'play',
    'inspect',
    'calibrate',
    'filter',
    'map',
    'tune',
    'config',
    'demo',
)
NODES = ('omnicam_node', 'sfa_node', 'ekf_node', 'localization', 'teach_node')
# colcon runs `setup.py install` or `develop`, and setup.cfg puts the executables into
# lib/sfa_localization, for `ros2 run sfa_localization train`. pip builds a wheel instead, whose
# executables are on the PATH: it gets the nodes and one command, no `train`, `filter` or `config`.
IN_WORKSPACE = bool({'install', 'develop'} & set(sys.argv))
BAGS = ('bags', 'bags/sample', 'bags/sample_test')

setup(
    name=NAME,
    version='0.1.0',
    description='Localization from one omnidirectional camera and odometry, learned without '
    'ground truth',
    long_description='See README.md.',
    author='The sfa_localization authors',
    maintainer='The sfa_localization authors',
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', glob('config/*.*')),
        *((f'share/{NAME}/{folder}', glob(f'{folder}/*.*')) for folder in BAGS),
    ],
    zip_safe=False,
    python_requires='>=3.10',
    # The robot (the three nodes), the trainer and the evaluation.
    install_requires=[
        'numpy>=1.26',
        'scipy>=1.11',
        'opencv-python-headless>=4.6',
        'rosbags>=0.11.3',
        # Bags that were cut off; it needs the next two, which bound what compressed bags become.
        'mcap>=1.2',
        'zstandard>=0.22',
        'lz4>=4.0',
        'PyYAML>=5.4',
        'threadpoolctl>=3.1',
        'tqdm>=4.60',
        'matplotlib>=3.6',
        # Arrays in pages are binary from version 6.
        'plotly>=6.0',
    ],
    extras_require={
        # Real ROS 2 Jazzy without a ROS installation (Linux x86-64).
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        # The release after Jazzy, for `make matrix`.
        'kilted': ['ros-kilted-rclpy[fastrtps]', 'ros-kilted-common-interfaces'],
        # The simulated garden of `simulate` and `demo`.
        'simulation': ['trimesh>=4.4', 'embreex>=2.17.7'],
        # Images that are H.264 or H.265 video; older ones do not notice a lost packet of H.265.
        'video': ['av>=16.0'],
        # The reference engine of `train`, made of MDP's nodes.
        'mdp': ['MDP==3.6'],
        # The workers of `fleet` on several machines.
        'fleet': ['dask>=2024.1', 'distributed>=2024.1'],
        # colcon finds the test runner by this name.
        'test': [
            'pytest>=7.4',
            'hypothesis>=6.82',
            'psutil>=5.9',
            'filterpy>=1.4.5',
            'selenium>=4.10',
        ],
        'dev': ['ruff==0.17.5', 'mypy==2.4.1', 'types-PyYAML', 'pytest-xdist>=3.3'],
    },
    entry_points={
        'console_scripts': [
            f'{NAME} = {NAME}.__main__:main',
            *(f'{command} = {NAME}.__main__:main' for command in COMMANDS if IN_WORKSPACE),
            *(f'{node} = {NAME}.__main__:main' for node in NODES),
        ],
    },
)
