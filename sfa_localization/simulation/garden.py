# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated garden, drawn from a world seed.

The robot drives in a rectangle of lawn about the origin of the frame `world`; a strip of plants
surrounds it, then hedges, fences and walls, then the neighbors' trees and houses.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from sfa_localization.data.errors import ConfigError
from sfa_localization.data.geometry import Array, Indices
from sfa_localization.data.run import Image
from sfa_localization.simulation.daylight import LIGHTS
from sfa_localization.simulation.rendering import Light, Scene, Shape, View
from sfa_localization.simulation.seasons import in_season
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.simulation.textures import Floats

Tint = tuple[float, float, float]

STRIP_M = 0.9
"""Distance from the driven area, which the robot's center may reach, to the nearest plant."""
FENCE_M = 2.3
"""Distance from the driven area to the hedges and fences around it."""
CAMERA_HEIGHT_M = 0.45
"""Height of the mirror's focus above the lawn."""

GRASS: Tint = (0.07, 0.24, 0.13)
BARK: Tint = (0.17, 0.25, 0.34)
GLASS: Tint = (0.16, 0.13, 0.10)
WHITE: Tint = (0.72, 0.76, 0.78)
WOODS: tuple[Tint, ...] = ((0.10, 0.20, 0.34), (0.20, 0.33, 0.45), (0.13, 0.16, 0.20))
STONES: tuple[Tint, ...] = ((0.36, 0.38, 0.40), (0.28, 0.36, 0.44))
BRICKS: tuple[Tint, ...] = ((0.13, 0.19, 0.42), (0.22, 0.32, 0.50))
PLASTERS: tuple[Tint, ...] = (WHITE, (0.36, 0.62, 0.74), (0.55, 0.66, 0.76), (0.66, 0.60, 0.50))
ROOFS: tuple[Tint, ...] = ((0.12, 0.17, 0.40), (0.19, 0.18, 0.18), (0.14, 0.20, 0.30))
GREENS: tuple[Tint, ...] = (
    (0.05, 0.19, 0.09), (0.06, 0.26, 0.16), (0.05, 0.14, 0.08),
    (0.11, 0.24, 0.19), (0.08, 0.30, 0.28),
)  # fmt: skip
BLOOMS: tuple[Tint, ...] = (
    (0.15, 0.15, 0.65), (0.50, 0.20, 0.55), (0.08, 0.62, 0.75),
    (0.70, 0.68, 0.72), (0.60, 0.28, 0.25),
)  # fmt: skip


def choose(rng: np.random.Generator, tints: tuple[Tint, ...]) -> Tint:
    """One of the tints, a little lighter or darker."""
    b, g, r = np.array(tints[rng.integers(len(tints))]) * rng.uniform(0.85, 1.15)
    return float(b), float(g), float(r)


def panel(
    corner: ArrayLike, across: ArrayLike, up: ArrayLike, step: float, surface: str, tint: Tint
) -> Shape:
    """A parallelogram whose normal is across x up, in a mesh of about `step` meters."""
    origin, right, rise = (np.asarray(axis, float) for axis in (corner, across, up))
    n, m = (max(1, int(np.ceil(np.linalg.norm(axis) / step))) for axis in (right, rise))
    i, j = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1))
    vertices = origin + i.ravel()[:, None] * right + j.ravel()[:, None] * rise
    a = (np.arange(m)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]], 1).T
    return _flat(vertices, faces, np.cross(right, rise), surface, tint)


def _flat(vertices: Array, faces: Indices, normal: Array, surface: str, tint: Tint) -> Shape:
    """A shape in one plane."""
    normals = np.tile(normal / np.linalg.norm(normal), (len(vertices), 1))
    return Shape(vertices, normals, faces, surface, tint, np.ones(len(vertices)))


def box(
    center: Array, size: Array, surface: str, tint: Tint, low: float = 0.0, step: float = 0.5
) -> list[Shape]:
    """An upright box without a bottom: `center` (x, y), `size` (x, y, height) in meters."""
    x, y = center
    w, d, h = size
    west = x - w / 2
    east = x + w / 2
    south = y - d / 2
    north = y + d / 2
    up = [0, 0, h]
    walls: list[tuple[ArrayLike, ArrayLike, ArrayLike]] = [
        ([west, south, low], [w, 0, 0], up),
        ([east, south, low], [0, d, 0], up),
        ([east, north, low], [-w, 0, 0], up),
        ([west, north, low], [0, -d, 0], up),
        ([west, south, low + h], [w, 0, 0], [0, d, 0]),
    ]
    return [panel(a, b, c, step, surface, tint) for a, b, c in walls]


def solid(mesh: trimesh.Trimesh, surface: str, tint: Tint) -> Shape:
    """A closed mesh with smooth normals."""
    vertices = np.array(mesh.vertices)
    faces = np.array(mesh.faces)
    normals = np.array(mesh.vertex_normals)
    return Shape(vertices, normals, faces, surface, tint, np.ones(len(vertices)))


def bumpy(shape: Shape, rng: np.random.Generator, height: float, wavelength: float) -> Shape:
    """The shape with smooth bumps of about `height` meters.

    The displacement depends on the place alone, so neighboring panels stay joined.
    """
    waves = rng.standard_normal((8, 3)) * 2 * np.pi / wavelength / np.sqrt(3)
    pushes = rng.standard_normal((8, 3)) * height / np.sqrt(8)
    field_ = np.sin(shape.vertices @ waves.T + rng.uniform(0, 2 * np.pi, 8)) @ pushes
    vertices = shape.vertices + field_ * (shape.vertices[:, 2:] > 0.02)
    mesh = trimesh.Trimesh(vertices, shape.faces, process=False)
    shade = shape.shade * np.clip(1 + 0.5 * (field_ * shape.normals).sum(1) / height, 0.5, 1.4)
    return replace(shape, vertices=vertices, normals=np.array(mesh.vertex_normals), shade=shade)


def blob(center: Array, radii: Array, tint: Tint, rng: np.random.Generator, plant: str) -> Shape:
    """A leafy ellipsoid about `center` (3,) with half-axes `radii` (3,) in meters."""
    mesh = trimesh.creation.icosphere(subdivisions=3)
    mesh.apply_scale(np.asarray(radii, float))
    mesh.apply_translation(center)
    size = float(np.mean(radii))
    shape = bumpy(solid(mesh, 'leaves', tint), rng, 0.13 * size, 1.1 * size)
    return replace(shape, plant=plant)


def pole(foot: Array, radius: float, height: float, surface: str, tint: Tint) -> Shape:
    """An upright cylinder on the ground at `foot` (x, y)."""
    mesh = trimesh.creation.cylinder(radius, height, sections=14)
    mesh.apply_translation([foot[0], foot[1], height / 2])
    return solid(mesh, surface, tint)


def tree(foot: Array, height: float, rng: np.random.Generator) -> list[Shape]:
    """A trunk with a crown of three blobs, clear of the robot's head."""
    radius = height * rng.uniform(0.022, 0.034)
    crown = height * rng.uniform(0.20, 0.30)
    shapes = [pole(foot, radius, height * 0.75, 'bark', BARK)]
    tint = choose(rng, GREENS)
    for _ in range(3):
        shift = rng.uniform(-0.5, 0.5, 3) * crown * [1, 1, 0.8]
        top = np.array([foot[0], foot[1], height - crown]) + shift
        radii = crown * rng.uniform([0.7] * 3, [1, 1, 0.9])
        shapes.append(blob(top, radii, tint, rng, 'crown'))
    return shapes


def conifer(foot: Array, height: float, rng: np.random.Generator) -> list[Shape]:
    """A fir: cones one above the other."""
    tint = choose(rng, GREENS[2:3])
    shapes = [pole(foot, 0.04 * height, 0.2 * height, 'bark', BARK)]
    for level in (0.10, 0.35, 0.58):
        mesh = trimesh.creation.cone(0.30 * height * (1 - level), 0.42 * height, sections=20)
        mesh = mesh.subdivide().subdivide()
        mesh.apply_translation([foot[0], foot[1], level * height])
        needles = bumpy(solid(mesh, 'leaves', tint), rng, 0.03 * height, 0.15 * height)
        shapes.append(replace(needles, plant='conifer'))
    return shapes


def house(center: Array, size: Array, rng: np.random.Generator) -> list[Shape]:
    """Walls with windows on all sides and a gabled roof; `size` (x, y, height of the walls)."""
    brick = rng.random() < 0.4
    surface, tint = ('bricks', choose(rng, BRICKS)) if brick else ('plaster', choose(rng, PLASTERS))
    shapes = box(center, size, surface, tint)
    for side in range(4):
        shapes += _windows(center, size, side, rng)
    return shapes + _gable(center, size, (surface, tint), rng)


def _windows(center: Array, size: Array, side: int, rng: np.random.Generator) -> list[Shape]:
    """Framed panes on one wall, storey above storey; one of them is a door."""
    along = side % 2
    length = size[along]
    out = 1 if side > 1 else -1
    count = max(1, int(length / 2.2))
    pane = rng.uniform(0.8, 1.3)
    door = rng.integers(count)
    shapes = []
    for storey in range(int(size[2] // 2.4)):
        for place in range(count):
            is_door = storey == 0 and place == door
            middle = np.array(center, float)
            middle[along] += ((place + 0.5) / count - 0.5) * length
            middle[1 - along] += out * size[1 - along] / 2
            low, high = (0.05, 2.0) if is_door else (0.9 + 2.5 * storey, 1.2)
            shapes += _pane(middle, along, pane, low, high, is_door, rng)
    return shapes


def _pane(
    middle: Array, along: int, wide: float, low: float, high: float, door: bool,
    rng: np.random.Generator,
) -> list[Shape]:  # fmt: skip
    depths = ((0.08, 0.06, WHITE), (-0.06, 0.10, choose(rng, WOODS) if door else GLASS))
    shapes = []
    for margin, depth, tint in depths:
        size = np.array([depth, depth, high + 2 * margin])
        size[along] = wide + 2 * margin
        shapes += box(middle, size, 'plain', tint, low - margin, step=1.0)
    return shapes


def _gable(
    center: Array, size: Array, wall: tuple[str, Tint], rng: np.random.Generator
) -> list[Shape]:
    """A roof with its ridge along the longer side, and the two gables under it."""
    long = 0 if size[0] >= size[1] else 1
    ahead = np.eye(3)[long] * size[long]
    aside = np.eye(3)[1 - long] * size[1 - long]
    rise = np.array([0, 0, rng.uniform(0.3, 0.5) * size[1 - long]])
    base = np.array([center[0], center[1], size[2]])
    tint = choose(rng, ROOFS)
    shapes = []
    for sign in (1.0, -1.0) if long == 0 else (-1.0, 1.0):
        eaves = base - sign * 0.53 * ahead - sign * 0.56 * aside - 0.12 * rise
        slope = sign * 0.56 * aside + 1.12 * rise
        shapes.append(panel(eaves, sign * 1.06 * ahead, slope, 0.6, 'roof', tint))
    for sign in (1.0, -1.0):
        corners = base + sign * ahead / 2 + [-aside / 2, aside / 2, rise]
        shapes.append(_flat(corners, np.array([[0, 1, 2]]), sign * ahead, *wall))
    return shapes


@dataclass(slots=True)
class Plot:
    """The garden while it is laid out: shapes and obstacles.

    `half` (2,) is half the driven area in meters; `obstacles` are discs (x, y, radius) inside it.
    """

    half: Array
    rng: np.random.Generator
    shapes: list[Shape] = field(default_factory=list)
    obstacles: list[tuple[float, float, float]] = field(default_factory=list)

    def beside(self, side: int, along: float, out: float) -> Array:
        """The point (2,) `out` meters outside the area on a side, `along` (-1..1) it."""
        reach = self.half[side % 2]
        width = self.half[1 - side % 2]
        x = reach + out
        y = along * (width + max(out, 0))
        return np.array([[x, y], [-y, x], [-x, -y], [y, -x]][side])

    def extent(self, side: int, deep: float, wide: float) -> Array:
        """Box size (x, y) of something `deep` across and `wide` along a side."""
        return np.array([deep, wide] if side % 2 == 0 else [wide, deep])


def lawn(plot: Plot) -> None:
    """The mown lawn with patches and stripes, and the fields beyond."""
    reach = plot.half + FENCE_M + 0.5
    ground = panel([*-reach, 0], [2 * reach[0], 0, 0], [0, 2 * reach[1], 0], 0.2, 'grass', GRASS)
    x = ground.vertices[:, 0]
    y = ground.vertices[:, 1]
    heading = plot.rng.uniform(0, np.pi)
    stripes = np.sin((x * np.cos(heading) + y * np.sin(heading)) * 2 * np.pi / 1.6)
    patches = sum(
        np.sin(x * a + y * b + c) for a, b, c in plot.rng.uniform(-1.8, 1.8, (7, 3)) * [1, 1, 3]
    )
    ground.shade[:] = 1 + 0.10 * np.tanh(3 * stripes) + 0.07 * np.asarray(patches)
    plot.shapes.append(replace(ground, plant='grass'))
    far = panel([-90, -90, -0.05], [180, 0, 0], [0, 180, 0], 6.0, 'grass', (0.08, 0.22, 0.16))
    plot.shapes.append(replace(far, plant='grass'))


def border(plot: Plot) -> None:
    """Hedges, fences and walls all around, in sections of different kinds."""
    kinds = ['hedge', 'boards', 'stones', 'bricks', 'hedge', 'boards', 'hedge', 'plaster']
    order = plot.rng.permutation(kinds)
    for side in range(4):
        edges = np.array([-1, plot.rng.uniform(-0.4, 0.4), 1])
        for section in range(2):
            kind = order[(2 * side + section) % len(kinds)]
            _section(plot, str(kind), side, edges[section : section + 2])


def _section(plot: Plot, kind: str, side: int, edges: Array) -> None:
    width = np.diff(edges)[0] * (plot.half[1 - side % 2] + FENCE_M) + 0.3
    deep, high = (
        (0.9, plot.rng.uniform(1.2, 2.3)) if kind == 'hedge' else (0.15, plot.rng.uniform(0.8, 1.8))
    )
    center = plot.beside(side, float(edges.mean()), FENCE_M + deep / 2)
    size = [*plot.extent(side, deep, width), high]
    if kind == 'hedge':
        parts = box(center, np.array(size), 'leaves', choose(plot.rng, GREENS), step=0.22)
        seed = plot.rng.integers(2**32)
        bumps = [bumpy(part, np.random.default_rng(seed), 0.10, 0.9) for part in parts]
        plot.shapes += [replace(part, plant='hedge') for part in bumps]
        return
    tints = {'boards': WOODS, 'stones': STONES, 'bricks': BRICKS, 'plaster': PLASTERS}[kind]
    plot.shapes += box(center, np.array(size), kind, choose(plot.rng, tints))


def bed(plot: Plot) -> None:
    """Bushes, flowers and garden things in the strip between lawn and fence."""
    spaces = 2 * plot.half.sum() * 2
    for _ in range(int(0.45 * spaces)):
        side = int(plot.rng.integers(4))
        along = plot.rng.uniform(-0.97, 0.97)
        radius = plot.rng.uniform(0.18, 0.5)
        out = plot.rng.uniform(STRIP_M + 1.2 * radius, FENCE_M)
        center = np.array([*plot.beside(side, along, out), radius * 0.8])
        tints, plant = (BLOOMS, 'bloom') if plot.rng.random() < 0.35 else (GREENS, 'bush')
        tint = choose(plot.rng, tints)
        plot.shapes.append(blob(center, radius * np.array([1, 1, 0.9]), tint, plot.rng, plant))
    for tint in ((0.55, 0.25, 0.08), (0.06, 0.25, 0.70), (0.10, 0.50, 0.62), (0.45, 0.45, 0.45)):
        side = int(plot.rng.integers(4))
        along = plot.rng.uniform(-0.9, 0.9)
        foot = plot.beside(side, along, STRIP_M + 0.6)
        plot.shapes.append(pole(foot, 0.3, plot.rng.uniform(0.5, 1.0), 'plain', tint))


def buildings(plot: Plot) -> None:
    """The shed in the garden, the house behind one side, neighbors behind the others."""
    sides = plot.rng.permutation(4)
    shed = plot.beside(int(sides[0]), plot.rng.choice([-0.75, 0.75]), STRIP_M + 1.1)
    size = np.array([2.0, 2.0, 2.1])
    plot.shapes += box(shed, size, 'boards', choose(plot.rng, WOODS))
    plot.shapes += _gable(shed, size, ('boards', WOODS[0]), plot.rng)
    for number, side in enumerate(sides[1:]):
        out = 6.5 if number == 0 else plot.rng.uniform(10, 18)
        wide = plot.rng.uniform(8, 12)
        deep = plot.rng.uniform(6, 8)
        center = plot.beside(int(side), plot.rng.uniform(-0.6, 0.6), out)
        height = plot.rng.choice([3.0, 5.2])
        plot.shapes += house(center, np.array([*plot.extent(side, deep, wide), height]), plot.rng)


def trees(plot: Plot, dock: Array, on_lawn: int) -> None:
    """Trees behind the fence all around, and some on the lawn."""
    for number in range(14):
        side = number % 4
        along = plot.rng.uniform(-1.1, 1.1)
        foot = plot.beside(side, along, plot.rng.uniform(FENCE_M + 1.5, 9.0))
        kind = conifer if plot.rng.random() < 0.3 else tree
        plot.shapes += kind(foot, plot.rng.uniform(3.5, 7.5), plot.rng)
    for _ in range(on_lawn):
        # Away from the edge of the lawn, the dock and other trees, if there is room.
        spots = plot.rng.uniform(-1, 1, (200, 2)) * np.maximum(plot.half - 2.2, 0.5)
        taken = np.array([dock[:2], *[obstacle[:2] for obstacle in plot.obstacles]])
        gaps = np.linalg.norm(spots[:, None] - taken, axis=2).min(1)
        good = np.flatnonzero(gaps > 3.0)
        foot = spots[good[0] if len(good) else gaps.argmax()]
        plot.shapes += tree(foot, plot.rng.uniform(3.2, 4.8), plot.rng)
        plot.obstacles.append((float(foot[0]), float(foot[1]), 0.17))


class Garden:
    """A garden of a world seed, which can be rendered from any pose of the frame `world`.

    `half` (2,) is half the driven area in meters, `obstacles` (N, 3) discs inside it as x, y,
    radius, `dock` (3,) the start pose of every drive; `shapes` are those of the season. Places of
    things, and so all drives, are the same in any light and season.
    """

    def __init__(
        self, seed: int, config: SimulationConfig | None = None, open_lawn: bool = False
    ) -> None:
        """Lay out and light the garden; an `open_lawn` has no trees.

        Raises ConfigError when the area is too small.
        """
        config = config or SimulationConfig()
        if len(config.area) != 2 or min(config.area) < 6.0:
            raise ConfigError(f'area: {config.area} needs two sides of at least 6 m')
        half = np.array(config.area) / 2
        daylight = LIGHTS[config.light]
        plot = Plot(half, np.random.default_rng([seed, 0]))
        self.dock = np.array([plot.rng.uniform(-0.5, 0.5) * half[0], 0.3 - half[1], np.pi / 2])
        for part in (lawn, border, bed, buildings):
            part(plot)
        trees(plot, self.dock, 0 if open_lawn else round(half.prod() * 4 / 100))
        self.half = half
        self.obstacles = np.array(plot.obstacles).reshape(-1, 3)
        self.shapes = in_season(plot.shapes, config.season, np.random.default_rng([seed, 2]))
        sun = daylight.toward_sun(plot.rng)
        self.scene = Scene(self.shapes, sun, np.random.default_rng([seed, 1]), daylight)

    def image(self, pose: Array, view: View, light: Light | None = None) -> Floats:
        """Brightness (H, W, 3) BGR, 0..255 and beyond, of a view from a pose x m, y m, yaw rad,
        optionally with roll and pitch rad.
        """
        light = light or Light()
        position = np.array([pose[0], pose[1], CAMERA_HEIGHT_M])
        return view.image(self.scene.look(position, pose[2:], view.dome, light), light.gain)


def rounded(image: Floats) -> Image:
    """Brightness as an image of 8 bits."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
