# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Turns by the shifts of images, and the clock of the camera, in worlds of spheres."""

from dataclasses import replace

import numpy as np
import pytest
from cylinder_worlds import Spheres, panorama_config, wander

from sfa_localization.camera.leveling import tilted
from sfa_localization.camera.turns import headings
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import PanoramaArray, Run, integrate
from sfa_localization.data.sphere import Sphere
from sfa_localization.fusion.camera_clock import camera_clock

SIZE = (20, 120)


def clock_of(run):
    return camera_clock(run.odometry, run.panoramas.stamps_ns, headings(run.panoramas))


def run_of(odometry, seed=0, every=3, clockwise=True):
    """A run whose images, one of every few odometry messages, show spheres."""
    world = Spheres.about(seed)
    images = world.panoramas(odometry.poses[::every], panorama_config(SIZE, clockwise))
    return Run('run', PanoramaArray(odometry.stamps_ns[::every], images), odometry)


def late(run, seconds):
    """The same run of a camera that stamps its images so late."""
    shifted = run.panoramas.stamps_ns + round(seconds * 1e9)
    return replace(run, panoramas=PanoramaArray(shifted, run.panoramas.images))


@pytest.mark.parametrize('seed', range(2))
def test_a_delay_errs_as_it_says(seed):
    punctual = run_of(wander(400, seed, hz=20.0), seed, clockwise=seed % 2 == 0)
    for delay in (-2.0, -0.05, 0.15, 1.7):
        clock = clock_of(late(punctual, delay))
        assert clock.is_estimated and clock.std_s < 0.02
        assert abs(clock.delay_s - delay) < 3 * clock.std_s + 1e-3


def test_what_the_robot_carries_in_every_image_does_not_matter():
    run = late(run_of(wander(400, 2, hz=20.0), 2), 0.2)
    run.panoramas.images[:, :, 20:35], run.panoramas.images[:, -6:, 60:100] = 0, 255
    assert clock_of(run).delay_s == pytest.approx(0.2, abs=0.02)


def driven(speed, omega, seed, hz):
    """Exact odometry of 400 messages at given speed and yaw rate."""
    odometry = wander(400, seed, hz=hz)
    twists = np.stack(np.broadcast_arrays(speed, omega, np.zeros(400))[:2], axis=1)
    return replace(odometry, poses=integrate(odometry.stamps_ns, twists), twists=twists)


def test_a_robot_that_shuttles_over_rough_ground_does_not_turn():
    """Each image is rolled and pitched by some 3 degrees."""
    run = run_of(driven(0.6 * np.sign(np.sin(np.arange(400) / 20)), 0.0, 0, 10.0))
    sphere, rng = Sphere(-0.6, 0.6), np.random.default_rng(0)
    tilts = np.radians(3.0) * rng.normal(size=(len(run.panoramas.images), 2))
    pairs = zip(run.panoramas.images, tilts, strict=True)
    tilted_images = [tilted(image, tilt, sphere) for image, tilt in pairs]
    panoramas = PanoramaArray(run.panoramas.stamps_ns, np.stack(tilted_images))
    assert np.abs(wrap_angle(np.diff(list(headings(panoramas))))).max() < 0.1


def test_where_nothing_shows_the_delay_none_is_claimed():
    run = run_of(wander(300, 5, hz=20.0), 5)
    stamps_ns, images = run.panoramas.stamps_ns, run.panoramas.images
    noise = np.random.default_rng(0).integers(0, 255, images.shape, np.uint8)
    panoramas = [PanoramaArray(stamps_ns, noise), PanoramaArray(stamps_ns, 0 * images)]
    few = replace(run, panoramas=PanoramaArray(stamps_ns[:5], images[:5]))
    straight, even = (run_of(driven(0.2, omega, 5, 20.0), 5) for omega in (0.0, 0.5))
    for each in (*(replace(run, panoramas=p) for p in panoramas), few, straight, even):
        clock = clock_of(each)
        assert not clock.is_estimated and clock.delay_ns == 0
