# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Light and season of the simulated garden: sun and shadow, sky, exposure, plants, same drives."""

import dataclasses
import itertools
from functools import cache

import numpy as np
import pytest

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.simulation.daylight import LIGHTS
from sfa_localization.simulation.drive import drive
from sfa_localization.simulation.garden import GRASS, WHITE, Garden, box, panel
from sfa_localization.simulation.rendering import Dome, Light, Scene
from sfa_localization.simulation.seasons import SEASONS
from sfa_localization.simulation.settings import SimulationConfig

pytestmark = pytest.mark.slow  # trains, or replays many drives

SMALL = PanoramaConfig(width=300, height=30)
TINY = SimulationConfig(area=(6.0, 6.0), length=20.0, images='panorama')
SUNNY = [name for name, light in LIGHTS.items() if any(light.sun)]
EYE = np.array([0.0, 0.0, 30.0])


@cache
def garden_in(light='day', season='summer'):
    return Garden(1, dataclasses.replace(TINY, light=light, season=season))


def block(name, seed=0):
    """A block 1 m wide and 2 m high on a lawn, and the direction (3,) of the sun; the exposure is
    fixed, so that brightness is light.
    """
    light, rng = dataclasses.replace(LIGHTS[name], brightness=None), np.random.default_rng(seed)
    sun = light.toward_sun(rng)
    lawn = panel([-3, -3, 0], [6, 0, 0], [0, 6, 0], 0.1, 'grass', GRASS)
    block = box(np.zeros(2), np.array([1.0, 1.0, 2.0]), 'plain', WHITE, step=0.1)
    return Scene([lawn, *block], sun, rng, light), sun


def sunshine(scene, points, eye=EYE):
    """What the sun adds to the brightness of points (N, 3), seen from an eye, as a share (N,)."""
    rays = (points - eye) / np.linalg.norm(points - eye, axis=1, keepdims=True)
    dome = Dome(np.zeros(1), len(points), rays[None].astype(np.float32))
    lit, unlit = (scene.look(eye, 0.0, dome, Light(sun=sun))[0] for sun in (1.0, 0.0))
    return (lit / unlit).mean(1) - 1


def test_shadows_fall_away_from_the_sun_and_walls_toward_it_are_lit():
    """And an overcast sky casts none."""
    for name, seed in itertools.product(SUNNY, range(2)):
        scene, sun = block(name, seed)
        level = np.append(sun[:2] / np.hypot(*sun[:2]), 0)
        shade, lit = sunshine(scene, 1.05 * np.array([-level, level]))
        assert shade < 0.02 < 0.05 < lit
        axis = int(np.abs(sun[:2]).argmax())
        toward, up = np.sign(sun[axis]) * np.eye(3)[axis], np.array([0, 0, 1.2])
        (lit,) = sunshine(scene, (0.5 * toward + up)[None], 5 * toward + up)
        (shade,) = sunshine(scene, (-0.5 * toward + up)[None], -5 * toward + up)
        assert shade < 1e-6 and lit > 0.3
    scene, _ = block('overcast')
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = 1.2 * np.stack([np.cos(around), np.sin(around), 0 * around], -1)
    assert sunshine(scene, ring) == pytest.approx(np.zeros(24), abs=1e-6)


def test_the_same_poses_in_any_light_and_season():
    for trajectory in ('coverage', 'curves'):
        plain = dataclasses.replace(TINY, trajectory=trajectory)
        first = drive(garden_in(), plain)
        for light, season in [('evening', 'summer'), ('overcast', 'winter'), ('day', 'autumn')]:
            config = dataclasses.replace(plain, light=light, season=season)
            other = drive(garden_in(light, season), config)
            assert np.array_equal(other.truth.poses, first.truth.poses)
            assert np.array_equal(other.image_poses, first.image_poses)
            assert np.array_equal(other.odometry.twists, first.odometry.twists)


def test_seasons_change_plants_only_and_take_the_leaves():
    summer, left = garden_in().shapes, []
    for season in SEASONS:
        later, changed = garden_in('day', season).shapes, set()
        for one, other in zip(summer, later, strict=True):
            assert one.plant == other.plant and one.surface == other.surface
            assert np.array_equal(one.vertices, other.vertices)
            if one.tint != other.tint or len(one.faces) != len(other.faces):
                changed.add(one.plant)
        assert changed == (
            set() if season == 'summer' else {'grass', 'crown', 'bush', 'bloom', 'hedge'}
        )
        left.append(sum(len(shape.faces) for shape in later if shape.plant == 'crown'))
    assert left[0] > left[1] > 2 * left[2] > 0
    again = Garden(1, dataclasses.replace(TINY, season='winter'))
    pictures = [g.render_panorama(np.zeros(3), SMALL) for g in (again, garden_in('day', 'winter'))]
    assert np.array_equal(*pictures)
