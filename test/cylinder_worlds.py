# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A world of soft coloured spheres about a lawn, drawn as small panoramas, and drives in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import Odometry, PanoramaArray, Run, integrate
from sfa_localization.keyframes.light import Conditions
from sfa_localization.keyframes.location import hypotheses, located
from sfa_localization.keyframes.upright import upright
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.sfa.network import Architecture, Layer
from sfa_localization.sfa.network_training import ImageSequence, train_network
from sfa_localization.sfa.settings import NetworkConfig
from sfa_localization.training import Recipe, learn_place

SIZE = (12, 48)
LAYERS = (
    Layer(field=(4, 8), stride=(4, 4), linear=6, outputs=5),
    Layer(field=(2, 3), stride=(1, 1), linear=6, outputs=5),
    Layer(field=(2, 6), stride=(1, 2), linear=6, outputs=4),
)
ARCHITECTURE = Architecture(SIZE, SIZE, 'none', LAYERS)


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spheres at `places` (N, 2) m, of `heights` (N,) and `radii` (N,) m, `colors` (N, 3)."""

    places: np.ndarray
    heights: np.ndarray
    radii: np.ndarray
    colors: np.ndarray

    @classmethod
    @cache
    def about(cls, seed, count=40):
        rng = np.random.default_rng(seed)
        bearing, reach = rng.uniform(-np.pi, np.pi, count), rng.uniform(3.0, 10.0, count)
        places = reach[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
        heights, radii = rng.uniform(-2.0, 3.0, count), rng.uniform(0.4, 1.6, count)
        return cls(places, heights, radii, rng.uniform(-90, 90, (count, 3)))

    def symmetric(self):
        """The same world four times over, a quarter turn apart."""
        x, y = self.places.T
        places = [np.column_stack(turned) for turned in ((x, y), (-y, x), (-x, -y), (y, -x))]
        again = (np.concatenate([part] * 4) for part in (self.heights, self.radii, self.colors))
        return Spheres(np.concatenate(places), *again)

    def panoramas(self, poses, config):
        """Panoramas (T, H, W, 3) uint8 from poses (T, 3)."""
        return np.stack([self._panorama(pose, config) for pose in poses])

    def _panorama(self, pose, config):
        h, w = config.height, config.width
        azimuth = (np.arange(w) + 0.5 - w / 2) * 2 * np.pi / w * (-1 if config.clockwise else 1)
        x, y = (self.places - pose[:2]).T
        reach, bearing = np.hypot(x, y), np.arctan2(y, x) - pose[2]
        sideways = wrap_angle(azimuth - bearing[:, None])
        upward = np.linspace(0.6, -0.6, h) - np.arctan2(self.heights, reach)[:, None]
        size = (np.arctan2(self.radii, reach) ** 2 * 2)[:, None]
        rows, columns = np.exp(-(upward**2) / size), np.exp(-(sideways**2) / size)
        blobs = np.einsum('nh,nw,nc->hwc', rows, columns, self.colors)
        return np.clip(128 + blobs, 0, 255).round().astype(np.uint8)


def panorama_config(size=SIZE, clockwise=True):
    return replace(PanoramaConfig(), height=size[0], width=size[1], clockwise=clockwise)


def lanes(step=0.25):
    """Poses (N, 3) of a square of 4 m, each lane headed another way."""
    along = np.arange(-2.0, 2.01, step)
    rows = enumerate(along.tolist())
    return np.array([(x * (-1) ** n, y, np.pi * (n % 2)) for n, y in rows for x in along])


def wander(count, seed, hz=10.0):
    """A wandering drive of exact odometry that stays near the origin."""
    rng = np.random.default_rng(seed)
    stamps = 10**9 + np.arange(count) * int(1e9 / hz)
    twists = np.stack([np.full(count, 0.8), np.zeros(count)], 1)
    pose, poses = np.zeros(3), []
    omega = 0.0
    for at in range(count):
        poses.append(pose)
        home = np.angle(np.exp(1j * (np.arctan2(-pose[1], -pose[0]) - pose[2])))
        pull = home if np.hypot(*pose[:2]) > 1.4 else 0.0
        omega += 0.1 * (rng.normal(0, 3) + 2.0 * pull - omega)
        twists[at, 1] = np.clip(omega, -2.0, 2.0)
        pose = integrate(np.array([0, int(1e9 / hz)]), twists[[at, at]], pose)[1]
    held_since = np.vstack([twists[:1], twists[:-1]])
    return Odometry(stamps, np.array(poses), held_since, np.tile([1e-4, 1e-4], (count, 1)))


def run_in(world, odometry, config, name='run'):
    """A run whose pictures show the world from the odometry's poses."""
    images = world.panoramas(odometry.poses, config)
    return Run(name, PanoramaArray(odometry.stamps_ns, images), odometry)


def alone(keyframes, image, conditions=None):
    """The `Location` of an image (H, W, 3) by keyframes, without slow features."""
    conditions = conditions or Conditions()
    fits, tilt = hypotheses(keyframes, upright(keyframes, image), conditions.pattern)
    unknown = np.array([fit.place for fit in fits]), np.full(len(fits), 1e6)
    return located(fits, unknown, conditions.scales, keyframes.errors, tilt)


PLACE_SIZE = (12, 72)
LARGE_LAYERS = (
    Layer(field=(4, 8), stride=(4, 4), linear=10, outputs=8),
    Layer(field=(2, 4), stride=(1, 1), linear=10, outputs=8),
    Layer(field=(2, 6), stride=(1, 1), linear=12, outputs=8),
)
PLACE_ARCHITECTURE = Architecture(PLACE_SIZE, PLACE_SIZE, 'none', LARGE_LAYERS)


def recipe(clockwise=True):
    """A small network for pictures of PLACE_SIZE."""
    return Recipe(
        panorama=panorama_config(PLACE_SIZE, clockwise),
        network=NetworkConfig(normalization='none'),
        metric=MetricConfig(slow_features=6),
        architecture=PLACE_ARCHITECTURE,
    )


@cache
def place(clockwise=True):
    """A place learnt from a wandering drive of 400 pictures."""
    config = recipe(clockwise)
    run = run_in(Spheres.about(1), wander(400, 2, hz=4.0), config.panorama)
    network = train_network(PLACE_ARCHITECTURE, [ImageSequence.of(run)])
    return learn_place(network, [run], config)


@cache
def visit(clockwise=True):
    """Another drive in the place, with truth for odometry."""
    true = wander(400, 2, hz=4.0)
    rows = [getattr(true, name)[20::9] for name in ('stamps_ns', 'poses', 'twists', 'variances')]
    rows[1] = rows[1] + np.array([0.05, -0.05, 0.4])
    return run_in(Spheres.about(1), Odometry(*rows), recipe(clockwise).panorama, 'visit')


def drive(count=12, seed=0, size=SIZE):
    """Panoramas of a short drive, all neighbors."""
    run = run_in(Spheres.about(seed), wander(count, seed), panorama_config(size))
    return ImageSequence(run.panoramas, np.ones(count - 1, bool))


PICTURES = 160
SMALL_LAYERS = (
    replace(layer, linear=linear, outputs=6)
    for layer, linear in zip(LARGE_LAYERS, (6, 6, 8), strict=True)
)
SMALL_ARCHITECTURE = replace(PLACE_ARCHITECTURE, layers=tuple(SMALL_LAYERS))
SMALL_RECIPE = replace(
    recipe(), architecture=SMALL_ARCHITECTURE, metric=replace(recipe().metric, slow_features=4)
)
"""Learns the drive of `write_bag` in seconds."""


def write_bag(path, seed=2, size=PLACE_SIZE):
    """Record a wandering drive of PICTURES pictures."""
    run = run_in(Spheres.about(1), wander(PICTURES, seed, hz=4.0), panorama_config(size))
    odometry, images = run.odometry, run.panoramas.read(0, PICTURES)
    with BagWriter(path) as bag:
        for k, stamp in enumerate(odometry.stamps_ns.tolist()):
            bag.odometry('/odom', stamp, odometry.poses[k], odometry.twists[k], (1e-4, 1e-4))
            bag.image('/panorama', stamp, images[k], 'base_link')
    return path
