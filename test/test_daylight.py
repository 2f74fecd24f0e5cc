# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Light and season of the simulated garden: sun and shadow, sky, exposure, plants, same drives."""

import dataclasses
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.simulation.daylight import LIGHTS, MEAN_BRIGHTNESS, Daylight
from sfa_localization.simulation.drive import drive
from sfa_localization.simulation.garden import GRASS, WHITE, Garden, box, panel
from sfa_localization.simulation.rendering import Dome, Light, Scene, metered, panorama_view
from sfa_localization.simulation.seasons import SEASONS
from sfa_localization.simulation.settings import SimulationConfig

pytestmark = pytest.mark.slow  # trains, or replays many drives

SMALL = PanoramaConfig(width=300, height=30)
TINY = SimulationConfig(area=(8.0, 8.0), length=20.0, images='panorama')
SUNNY = [name for name, light in LIGHTS.items() if any(light.sun)]
METERED = [name for name in LIGHTS if name != 'day']
EYE = np.array([0.0, 0.0, 30.0])


@cache
def garden_in(light='day', season='summer'):
    return Garden(1, dataclasses.replace(TINY, light=light, season=season))


def fixed(name):
    """A light seen with a fixed exposure, so that brightness is light."""
    return dataclasses.replace(LIGHTS[name], brightness=None)


def block(light, seed=0):
    """A block 1 m wide and 2 m high on a lawn, and the direction (3,) of the sun."""
    rng = np.random.default_rng(seed)
    sun = light.toward_sun(rng)
    lawn = panel([-6, -6, 0], [12, 0, 0], [0, 12, 0], 0.1, 'grass', GRASS)
    block = box(np.zeros(2), np.array([1.0, 1.0, 2.0]), 'plain', WHITE, step=0.1)
    return Scene([lawn, *block], sun, rng, light), sun


def seen(scene, eye, points, light):
    """Brightness (N, 3) of points (N, 3), looked at from an eye (3,)."""
    rays = (points - eye) / np.linalg.norm(points - eye, axis=1, keepdims=True)
    dome = Dome(np.zeros(1), len(points), rays[None].astype(np.float32))
    return scene.look(eye, 0.0, dome, light)[0]


def sunshine(scene, points, eye=EYE):
    """What the sun adds to the brightness of points (N, 3), as a share (N,)."""
    without = seen(scene, eye, points, Light(sun=0.0))
    return (seen(scene, eye, points, Light()) / without).mean(1) - 1


@pytest.mark.parametrize('name', SUNNY)
@pytest.mark.parametrize('seed', range(3))
def test_shadows_fall_away_from_the_sun(name, seed):
    scene, sun = block(fixed(name), seed)
    level = np.append(sun[:2] / np.hypot(*sun[:2]), 0)
    behind, before = -1.05 * level, 1.05 * level
    shade, lit = sunshine(scene, np.array([behind, before]))
    assert shade < 0.02 < 0.05 < lit


@pytest.mark.parametrize('name', SUNNY)
def test_walls_toward_the_sun_are_lit_and_those_behind_are_not(name):
    scene, sun = block(fixed(name))
    axis = int(np.abs(sun[:2]).argmax())
    toward = np.sign(sun[axis]) * np.eye(3)[axis]
    up = np.array([0, 0, 1.2])
    (lit,) = sunshine(scene, (0.5 * toward + up)[None], 5 * toward + up)
    (shade,) = sunshine(scene, (-0.5 * toward + up)[None], -5 * toward + up)
    assert shade < 1e-6 and lit > 0.3


def test_an_overcast_sky_casts_no_shadow():
    scene, _ = block(fixed('overcast'))
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = 1.2 * np.stack([np.cos(around), np.sin(around), 0 * around], -1)
    assert sunshine(scene, ring) == pytest.approx(np.zeros(24), abs=1e-6)


def lawn_in_shadow(name):
    """Share of the lawn of a garden that the sun does not reach."""
    garden = Garden(1, dataclasses.replace(TINY, light=name))
    sides = (np.linspace(-0.95, 0.95, 30) * half for half in garden.half)
    places = np.stack([axis.ravel() for axis in np.meshgrid(*sides)], -1)
    places = np.column_stack([places, np.full(len(places), 0.02)])
    sun = np.broadcast_to(garden.scene.sun, places.shape)
    return 1 - garden.scene._free(places.astype(np.float32), sun).mean()


def test_shadows_are_longer_the_lower_the_sun():
    day, morning, evening = (lawn_in_shadow(name) for name in ('day', 'morning', 'evening'))
    assert day + 0.1 < morning < evening


def test_every_light_has_its_own_sun_and_looks_different():
    suns = {name: garden_in(name).scene.sun for name in SUNNY}
    pictures = {name: garden_in(name).render_panorama(np.zeros(3), SMALL) for name in LIGHTS}
    for one, other in combinations(SUNNY, 2):
        assert np.degrees(np.arccos(suns[one] @ suns[other])) > 40
    for one, other in combinations(LIGHTS, 2):
        assert np.abs(pictures[one].astype(float) - pictures[other]).mean() > 5


@pytest.mark.parametrize('name', METERED)
def test_exposure_keeps_the_mean_brightness(name):
    garden, rng = garden_in(name), np.random.default_rng(0)
    for _ in range(5):
        pose = np.append(rng.uniform(-0.7, 0.7, 2) * garden.half, rng.uniform(0, 6))
        assert garden.render_panorama(pose, SMALL).mean() == pytest.approx(MEAN_BRIGHTNESS, abs=2)


def test_exposure_makes_up_for_any_strength_of_the_light():
    view, rng = panorama_view(SMALL), np.random.default_rng(0)
    image = rng.uniform(5, 250, (*view.dome.rays.shape[:2], 3)).astype(np.float32)
    bright, dim = (metered(gain * image, view.dome, 120.0) for gain in (2.0, 0.2))
    assert bright == pytest.approx(dim, rel=0.01)
    assert np.minimum(bright, 255).mean() == pytest.approx(120, abs=1)


def test_day_has_the_exposure_of_its_weather():
    view, pose = panorama_view(SMALL), np.zeros(3)
    full, half = (garden_in().image(pose, view, Light(sun=sun)) for sun in (1.0, 0.3))
    assert half.mean() < full.mean() - 5


def test_the_camera_takes_a_part_of_the_cast_out():
    warm = Daylight(sun=(0.3, 0.6, 1.2), ambient=(0.2, 0.3, 0.6))
    blue, green, red = warm.balance
    assert blue > green == 1 > red
    cast = np.sqrt(np.array(warm.sun) / 2 + warm.ambient)
    day = np.sqrt(np.array(LIGHTS['day'].sun) / 2 + LIGHTS['day'].ambient)
    before, after = cast / day, warm.balance * cast / day
    assert before[2] / before[0] > after[2] / after[0] > 1


def test_hills_stay_and_clouds_move():
    """Where the sky ends is the same in any light; above, it differs."""
    day, evening = (garden_in(name).scene._sky.astype(float) for name in ('day', 'evening'))
    edge = [np.abs(np.diff(sky[-50:], axis=0)).sum(2).argmax(0) for sky in (day, evening)]
    assert np.mean(np.abs(edge[0] - edge[1]) <= 2) > 0.9
    assert np.abs(day - evening)[:200].mean() > 20


@pytest.mark.parametrize('trajectory', ['coverage', 'test'])
def test_the_same_poses_in_any_light_and_season(trajectory):
    plain = dataclasses.replace(TINY, trajectory=trajectory)
    first = drive(garden_in(), plain)
    for light, season in [('evening', 'summer'), ('overcast', 'winter'), ('day', 'autumn')]:
        config = dataclasses.replace(plain, light=light, season=season)
        other = drive(garden_in(light, season), config)
        assert np.array_equal(other.truth.poses, first.truth.poses)
        assert np.array_equal(other.image_poses, first.image_poses)
        assert np.array_equal(other.odometry.twists, first.odometry.twists)


@pytest.mark.parametrize('season', ['autumn', 'winter'])
def test_seasons_change_plants_only(season):
    summer, later = garden_in().shapes, garden_in('day', season).shapes
    changed = set()
    for one, other in zip(summer, later, strict=True):
        assert one.plant == other.plant and one.surface == other.surface
        assert np.array_equal(one.vertices, other.vertices)
        if one.tint != other.tint or len(one.faces) != len(other.faces):
            changed.add(one.plant)
    assert changed == {'grass', 'crown', 'bush', 'bloom', 'hedge'}
    assert {shape.plant for shape in summer} - changed <= {'', 'conifer'}


def test_trees_lose_their_leaves_toward_winter():
    left = [
        sum(len(s.faces) for s in garden_in('day', season).shapes if s.plant == 'crown')
        for season in ('summer', 'autumn', 'winter')
    ]
    assert left[0] > left[1] > 2 * left[2] > 0


def test_a_season_looks_the_same_each_time():
    again = Garden(1, dataclasses.replace(TINY, season='winter'))
    pictures = [g.render_panorama(np.zeros(3), SMALL) for g in (again, garden_in('day', 'winter'))]
    assert np.array_equal(*pictures)


def test_day_in_summer_is_the_garden_that_it_was():
    """Means of thirds of a panorama from before there were lights and seasons."""
    picture = garden_in().render_panorama(np.zeros(3), SMALL)
    thirds = picture.reshape(3, 10, 300, 3).mean((1, 2))
    assert thirds == pytest.approx(np.array(BEFORE), abs=0.5)


BEFORE = [[150.66, 133.84, 111.13], [90.08, 95.29, 89.49], [53.70, 86.29, 69.35]]


def test_every_light_and_season_is_a_choice():
    choices = {item.name: item.metadata['choices'] for item in dataclasses.fields(TINY)}
    assert choices['light'] == tuple(LIGHTS) and choices['season'] == tuple(SEASONS)
