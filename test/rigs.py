# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Robots with several cameras in a scene at infinity: their images, and bags of them."""

from __future__ import annotations

import numpy as np

from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera.lenses import turned_camera
from sfa_localization.camera.sectors import MountedCamera, optical_pose
from sfa_localization.camera.settings import LensCalibration
from sfa_localization.data.sphere import directions, rotation

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def pinhole(fov=100.0, width=200, height=120):
    """A pinhole camera with this horizontal field of view, degrees."""
    focal = float(width / 2 / np.tan(np.radians(fov / 2)))
    return LensCalibration(
        camera_model='mirror', image_width=width, image_height=height, fx=focal, fy=focal,
        cx=width / 2 - 0.5, cy=height / 2 - 0.5, xi=0.0, radius_min=0.0, radius_max=0.0,
        axis='forward', mirrored='no',
    )  # fmt: skip


def fisheye(fov=190.0, size=200):
    """An equidistant fisheye, whose circle touches the edges of a square image."""
    focal = float(size / 2 / np.radians(fov / 2))
    return LensCalibration(
        camera_model='fisheye', image_width=size, image_height=size, fx=focal, fy=focal,
        cx=size / 2 - 0.5, cy=size / 2 - 0.5, radius_min=0.0, radius_max=size / 2,
    )  # fmt: skip


def camera(name, yaw_deg, lens=None, radius=0.2):
    """A camera at a radius, m, from the center of the robot, which looks away from it."""
    ahead, left, _ = radius * directions(np.radians(yaw_deg), 0.0)
    pose = optical_pose((ahead, left, 0.0), (0.0, 0.0, yaw_deg))
    return MountedCamera.at(name, lens or pinhole(), pose)


def rig(yaws=(0, 90, 180, -90), lens=None, names=('front', 'left', 'rear', 'right')):
    """Cameras that look to these yaws, degrees."""
    return [camera(name, yaw, lens) for name, yaw in zip(names, yaws, strict=False)]


def smooth(rays):
    """A scene that tells every direction apart, all around and up and down."""
    x, y, z = rays.T
    return np.column_stack([127 + 100 * x, 127 + 100 * y, 127 + 100 * np.sin(3 * z)])


def picture(mounted, scene=smooth, heading=0.0, gain=1.0):
    """What a camera sees of a scene, a function of rays (N, 3) to BGR, of a robot at a heading."""
    size = mounted.lens.image_height, mounted.lens.image_width
    rows, columns = np.mgrid[0 : size[0], 0 : size[1]]
    model = turned_camera(mounted.lens, size, np.array(mounted.rotation))
    rays = model.unproject(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    seen = np.isfinite(rays[:, 0])
    image = np.zeros((size[0] * size[1], 3))
    image[seen] = gain * scene(rays[seen] @ rotation(0.0, 0.0, heading).T)
    return np.rint(np.clip(image, 0, 255)).astype(np.uint8).reshape(*size, 3)


def speckled(rays):
    """A scene of blobs, a few degrees wide, all around."""
    azimuth, height = np.arctan2(rays[:, 1], rays[:, 0]), rays[:, 2]
    phases = np.random.default_rng(4).uniform(0, 2 * np.pi, 40)
    waves = [np.sin(k * azimuth + 7 * (k % 3) * height + p) for k, p in enumerate(phases, 1)]
    level = 127 + 18 * np.sum(waves, axis=0) / np.sqrt(8)
    return np.repeat(level[:, None], 3, axis=1)


def write_bag(
    path,
    cameras,
    headings,
    *,
    stated=None,
    scene=smooth,
    period_s=0.1,
    later_s=None,
    skipped=(),
    with_info=True,
    with_tf=True,
):
    """A bag of a robot that turns on the spot: `headings` (N,) rad at the times of its images.

    /tf_static holds the `stated` cameras; stamps of a camera are `later_s` by its name; the images
    in `skipped`, (name, number), were not recorded.
    """
    step = round(period_s * SECOND)
    stamps = START + step * np.arange(len(headings))
    rates = np.gradient(headings, period_s) if len(headings) > 1 else np.zeros(1)
    with BagWriter(path) as bag:
        if with_tf:
            frames = {f'{mounted.name}_optical': mounted for mounted in stated or cameras}
            bag.static_transforms(START, 'base_link', frames)
        for number, stamp in enumerate(stamps.tolist()):
            for part in range(4):
                at = stamp + part * step // 4
                heading = headings[number] + part / 4 * period_s * rates[number]
                pose = np.array([0.0, 0.0, heading])
                bag.odometry('/odom', at, pose, np.array([0.0, rates[number]]), np.zeros(2))
            for mounted in cameras:
                late_s = (later_s or {}).get(mounted.name, 0.0)
                if (mounted.name, number) in skipped:
                    continue
                at = stamp + round(late_s * SECOND)
                heading = headings[number] + late_s * rates[number]
                image = picture(mounted, scene, heading)
                bag.image(f'/{mounted.name}/image_raw', at, image, f'{mounted.name}_optical')
                if with_info:
                    info = f'/{mounted.name}/camera_info'
                    bag.camera_info(info, at, mounted.lens, f'{mounted.name}_optical')
        last = np.array([0.0, 0.0, headings[-1]])
        bag.odometry('/odom', int(stamps[-1]) + step, last, np.zeros(2), np.zeros(2))
    return path
