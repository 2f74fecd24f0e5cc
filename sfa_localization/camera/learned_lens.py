# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The lens of an omnidirectional camera, learned from a drive by bundle adjustment.

Points of the surroundings are seen from many places of the drive, which the wheels know. For given
values of the unknowns (lens, mounting, delay of the images, factor of the turns) the points follow
in closed form; the unknowns minimize the distances, in pixels, of the points from where they were
seen, together with the priors of `lens_models`.

Driving on level ground does not show which of two stretches tan e -> c tan e of the elevations is
right, nor which side of the horizon is above it. The priors tell the first, and the brightness of
the sky or ceiling the second; level driving needs neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from sfa_localization.camera.lens_guess import LensGuess
from sfa_localization.camera.lens_models import LEAN_STD, LensModel, Values
from sfa_localization.camera.lenses import CameraModel, DualFisheyeLens, Lens, make_camera
from sfa_localization.camera.point_tracks import Tracks, scale_of
from sfa_localization.camera.settings import LensCalibration
from sfa_localization.data.errors import CameraError, LocalizationError
from sfa_localization.data.geometry import Array, Indices, relative, wrap_angle
from sfa_localization.data.rig import CAMERA_STD_M, Quantity
from sfa_localization.data.run import Image, Trajectory, chained
from sfa_localization.data.sphere import directions

MOTION = {
    'roll': Quantity(0.0, LEAN_STD),
    'pitch': Quantity(0.0, LEAN_STD),
    'yaw': Quantity(0.0, 10.0),
    'ahead': Quantity(0.0, CAMERA_STD_M),
    'left': Quantity(0.0, CAMERA_STD_M),
    'delay': Quantity(0.0, 0.1),
    'turns': Quantity(1.0, 0.05),
}
"""Prior of the mounting (rad, m), of the delay of images (s), and of true over counted turns."""
PLACE_STD_M = 0.03
"""Standard deviation of each coordinate of the place: four rendered robots erred by 0.01 to 0.04
m."""
_YAWS = np.radians(np.arange(0.0, 360.0, 22.5))  # from which the search starts
# spread over cells along the longer side of images
_SEARCH_POINTS = 150
_POINTS = 450
_CELLS = 16
_TRACKER_PX = 16.0  # of a sighting, as those of many tracks err alike: the claimed errors are right
_SMALL_PX = 1.0  # residuals beyond count linearly
_SHARP = 2.5  # times the median residual, beyond which a point is left out
_PASSES = 2  # of leaving out points
# of least squares
_STARTS = 2
_SEARCH_STEPS = 15
_STEPS = 40
_UNSEEN_PX = 50.0  # residual of a sighting that the camera cannot have
_BLOCK = 10  # images whose errors of odometry are alike
_LARGEST_ERROR_PX = 3.0  # median of a lens that fits: 0.5 to 1.2 in rendered gardens
_LEAST_M = 5.0
_LEAST_RAD = 2 * np.pi
_LEAST_POINTS = 100
_NEARLY_ALL = 0.95  # of the directions


@dataclass(frozen=True, slots=True)
class LearnedLens:
    """A lens as a drive shows it: its `calibration`, with the mounting; radius of the `horizon`,
    px, None without a single center; the standard deviations of the center, px, and of roll and
    pitch, deg; the lowest and highest elevation, deg, that it `sees` in nearly all directions; the
    `place` of the camera, ahead + i left of base_link, m; and the median error of points, px of the
    tracker.
    """

    name: str
    calibration: LensCalibration
    horizon: Quantity | None
    center_std: float
    lean_std: float
    sees: tuple[float, float]
    place: complex
    error_px: float


def learn_lens(
    tracks: Tracks, odometry: Trajectory, guess: LensGuess, samples: Sequence[Image]
) -> LearnedLens:
    """The lens that explains the tracks best, of those that the guess from `samples` allows.

    Raises CameraError for a drive that does not show the lens, and says what is missing.
    """
    _require_enough(tracks, odometry)
    models = guess.models(int(np.argmax(tracks.votes)))
    few = tracks.chosen(_spread(tracks, _SEARCH_POINTS))
    searched = list[_Fit]()
    for model in models:
        problem = _Problem(few, odometry, model)
        twins = [fit for fit in searched if fit.problem.model.name == model.name]
        searched.append(_turned_over(twins[0], problem) if twins else _searched(problem))
    likeliest = min(searched, key=lambda fit: fit.cost)
    sides = guess.sides(likeliest.values.get('horizon', 0.0), samples)
    best = min((fit for fit in searched if fit.problem.model.axis in sides), key=lambda f: f.cost)
    problem = _Problem(tracks.chosen(_spread(tracks, _POINTS)), odometry, best.problem.model)
    return _learned(_sharpened(problem, best.x), guess)


def _require_enough(tracks: Tracks, odometry: Trajectory) -> None:
    """Raise CameraError where too little was seen, driven or turned."""
    steps = np.diff(odometry.at(tracks.stamps_ns), axis=0)
    way = np.hypot(*steps[:, :2].T).sum()
    turn = np.abs(wrap_angle(steps[:, 2])).sum()
    lacks = []
    if way < _LEAST_M:
        lacks.append(f'drive {_LEAST_M:.0f} m, not {way:.1f}')
    if turn < _LEAST_RAD:
        needed, turned = np.degrees([_LEAST_RAD, turn])
        lacks.append(f'turn by {needed:.0f} degrees in all, not {turned:.0f}')
    if len(tracks) < _LEAST_POINTS:
        lacks.append(
            f'images show {len(tracks)} points that can be followed, {_LEAST_POINTS} are needed: '
            'record closer images, in better light, where there is more to see'
        )
    if lacks:
        raise CameraError(f'the drive does not show the lens: {"; ".join(lacks)}')


def _spread(tracks: Tracks, most: int) -> Indices:
    """At most so many points (P,), spread over the image, the same each time."""
    counts = np.bincount(tracks.point)
    place = np.column_stack([np.bincount(tracks.point, axis) / counts for axis in tracks.pixels.T])
    cell = (place // (max(tracks.size) / _CELLS)).astype(int) @ [1, _CELLS]
    order = np.lexsort((-counts, cell))
    rank = np.arange(len(order)) - np.searchsorted(cell[order], cell[order])
    return np.sort(order[np.argsort(rank, kind='stable')[:most]])


@dataclass(frozen=True, slots=True)
class _Fit:
    """A problem, and where its search has ended."""

    problem: _Problem
    x: Array
    cost: float
    jacobian: Array

    @property
    def values(self) -> Values:
        return self.problem.values(self.x)


def _searched(problem: _Problem) -> _Fit:
    """The best fit from several headings of the camera and horizons."""
    horizons = [{'horizon': value} for value in problem.model.horizons] or [{}]
    starts = [problem.at(yaw=yaw, **values) for values in horizons for yaw in _YAWS.tolist()]
    starts = sorted(starts, key=problem.cost)[:_STARTS]
    return min((problem.solved(x, _SEARCH_STEPS) for x in starts), key=lambda fit: fit.cost)


def _turned_over(fit: _Fit, problem: _Problem) -> _Fit:
    """The fit of the same lens looking down instead of up: level driving shows no difference."""
    x = fit.x.copy()
    for name in ('roll', 'pitch'):
        x[problem.names.index(name)] *= -1
    return replace(fit, problem=problem, x=x)


def _sharpened(problem: _Problem, x: Array) -> _Fit:
    """The fit without points that disagree, as things that move, and edges that slide."""
    fit = problem.solved(x, _STEPS)
    for _ in range(_PASSES):
        tracks = fit.problem.tracks
        off = np.hypot(*fit.problem.errors(fit.x).T)
        parts = np.split(off, np.flatnonzero(np.diff(tracks.point)) + 1)
        median = np.array([np.median(part) for part in parts])
        kept = np.flatnonzero(median <= _SHARP * np.median(median))
        fit = _Problem(tracks.chosen(kept), problem.odometry, problem.model).solved(fit.x, _STEPS)
    return fit


def _learned(fit: _Fit, guess: LensGuess) -> LearnedLens:
    """Raises CameraError where no lens explains what was seen."""
    problem = fit.problem
    values = fit.values
    error_px = float(np.median(np.hypot(*problem.errors(fit.x).T)))
    std = dict(zip(problem.names, np.sqrt(np.diag(problem.covariance(fit))).tolist(), strict=True))
    if error_px > _LARGEST_ERROR_PX or len(problem.tracks) < _LEAST_POINTS // 2:
        raise CameraError(
            'the images do not move as those of any lens that is known: does the camera see all '
            'around, is it on the robot of this odometry, and do both share a clock?'
        )
    lens = problem.calibration(fit.x)
    has_one_center = len(guess.circles) == 1
    horizon = Quantity(values['horizon'], std['horizon']) if has_one_center else None
    return LearnedLens(
        _name(lens),
        lens,
        horizon,
        max(std.get('cx', 0.0), std.get('cy', 0.0)),
        float(np.degrees(max(std['roll'], std['pitch']))),
        visible_elevations(lens),
        complex(values['ahead'], values['left']),
        error_px,
    )


def _name(lens: LensCalibration) -> str:
    """The camera in words."""
    if lens.camera_model == 'dual_fisheye':
        return 'two fisheyes'
    if lens.camera_model == 'equirectangular':
        return 'panorama'
    if lens.axis == 'up':
        return 'fisheye'
    return 'mirror' if lens.is_mirrored else 'fisheye that looks down'


def visible_elevations(lens: LensCalibration) -> tuple[float, float]:
    """The lowest and highest elevation, deg, that a lens sees in nearly all directions."""
    size = lens.image_height, lens.image_width
    camera = make_camera(lens, size, mount_rpy=lens.mount_rpy)
    rows = np.arange(-80.0, 81.0)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0.0, 360.0, 5.0)), np.radians(rows))
    rays = directions(azimuth, elevation).reshape(-1, 3)
    seen = np.isfinite(camera.project(rays)[:, 0]).reshape(azimuth.shape)
    inside = rows[seen.mean(axis=1) >= _NEARLY_ALL]
    return (float(inside[0]), float(inside[-1])) if inside.size else (0.0, 0.0)


class _Problem:
    """The unknowns of one model, and the residuals of sightings."""

    def __init__(self, tracks: Tracks, odometry: Trajectory, model: LensModel) -> None:
        self.tracks = tracks
        self.model = model
        self.odometry = odometry
        prior = MOTION | model.prior
        self.names = tuple(prior)
        self.mean, self.std = (np.array(part) for part in zip(*prior.values(), strict=True))
        self.size = tracks.size

    def values(self, x: Array) -> Values:
        return dict(zip(self.names, x.tolist(), strict=True))

    def at(self, **values: float) -> Array:
        """The prior's mean with some other values."""
        x = self.mean.copy()
        for name, value in values.items():
            x[self.names.index(name)] = value
        return x

    def calibration(self, x: Array) -> LensCalibration:
        """Raises ConfigError for impossible values."""
        values = self.values(x)
        angles = np.array([values[name] for name in ('roll', 'pitch', 'yaw')])
        mount = np.degrees(wrap_angle(angles))
        return replace(self.model.calibration(values), mount_rpy=tuple(mount.tolist()))

    def camera(self, x: Array) -> CameraModel:
        """Raises CameraError or ConfigError for impossible values."""
        lens = self.calibration(x)
        return make_camera(lens, self.size, mount_rpy=lens.mount_rpy)

    def poses(self, x: Array) -> tuple[Array, Array]:
        """Places (N, 2) m of the camera at the images, and headings (N,) rad of the robot."""
        values = self.values(x)
        poses = self.odometry.at(self.tracks.stamps_ns - round(values['delay'] * 1e9))
        steps = relative(poses[:-1], poses[1:])
        steps[:, 2] *= values['turns']
        poses = chained(poses[0], steps)
        lever = complex(values['ahead'], values['left']) * np.exp(1j * poses[:, 2])
        return poses[:, :2] + np.column_stack([lever.real, lever.imag]), poses[:, 2]

    def errors(self, x: Array) -> Array:
        """Where points should be seen, minus where they were (M, 2), px of the tracker."""
        camera = self.camera(x)
        tracks = self.tracks
        places, yaw = self.poses(x)
        turn = np.exp(1j * yaw[tracks.image])
        seen = _unproject(camera.lens, tracks.pixels) @ camera.rotation.T
        valid = np.where(np.isfinite(seen[:, :1]), seen, [1.0, 0.0, 0.0])
        directions = triangulated(tracks.point, places[tracks.image], _turned(valid, turn))
        expected = _turned(directions, turn.conj()) @ camera.rotation
        errors = _project(camera.lens, expected, tracks.pixels) - tracks.pixels
        errors *= scale_of(self.size)
        errors = np.where(np.isfinite(seen[:, :1]), errors, _UNSEEN_PX)
        return np.nan_to_num(errors, nan=_UNSEEN_PX)

    def residuals(self, x: Array) -> Array:
        """Normalized errors (2 M,), large ones down-weighted, and those of the prior (K,)."""
        try:
            errors = self.errors(x)
        except LocalizationError:
            errors = np.full(self.tracks.pixels.shape, _UNSEEN_PX)
        square = np.sum(errors**2, axis=1) / _SMALL_PX**2 + 1e-12
        factor = np.sqrt(2 * (np.sqrt(1 + square) - 1) / square) / _TRACKER_PX
        return np.concatenate([(errors * factor[:, None]).ravel(), (x - self.mean) / self.std])

    def cost(self, x: Array) -> float:
        return float(np.sum(self.residuals(x) ** 2) / 2)

    def solved(self, x: Array, steps: int) -> _Fit:
        result = least_squares(self.residuals, x, x_scale=self.std, max_nfev=steps)
        return _Fit(self, result.x, float(result.cost), result.jac)

    def covariance(self, fit: _Fit) -> Array:
        """Covariance (K, K); errors of images in one stretch of the drive are alike."""
        jacobian = fit.jacobian
        rows = 2 * len(self.tracks.point)
        block = np.repeat(self.tracks.image // _BLOCK, 2)
        slopes = jacobian[:rows] * self.residuals(fit.x)[:rows, None]
        sums = np.stack([np.bincount(block, slope) for slope in slopes.T])
        priors = jacobian[rows:].T @ jacobian[rows:]
        inverse = np.linalg.inv(jacobian.T @ jacobian)
        return np.asarray(inverse @ (sums @ sums.T + priors) @ inverse)


def _unproject(lens: Lens, pixels: Array) -> Array:
    """Rays (M, 3), also beyond the seam of two lenses."""
    if isinstance(lens, DualFisheyeLens):
        return lens.unproject_by(lens.by_second(pixels), pixels)
    return lens.unproject(pixels)


def _project(lens: Lens, rays: Array, pixels: Array) -> Array:
    """Pixels (M, 2) of rays (M, 3); of two lenses, in the one that shows the given pixels."""
    if isinstance(lens, DualFisheyeLens):
        return lens.project_by(lens.by_second(pixels), rays)
    return lens.project(rays)


def _turned(rays: Array, turn: Array) -> Array:
    """Rays (M, 3), turned about the vertical by the unit complex numbers (M,)."""
    level = (rays[:, 0] + 1j * rays[:, 1]) * turn
    return np.column_stack([level.real, level.imag, rays[:, 2]])


_REFERENCE_M = 5.0  # distance of a usual point
_RAY_RAD = 0.01  # error of a ray beyond which it counts less
_NEAREST = 0.05  # of the reference distance: the camera is not inside of things


def triangulated(point: Indices, places: Array, rays: Array, passes: int = 3) -> Array:
    """Unit directions (M, 3) in which the points should be seen that M rays show best.

    `point` (M,) numbers the points; rays (M, 3) start at `places` (M, 2) m. A point is
    homogeneous, (X, w) with w >= 0, as it may be infinitely far: it minimizes the weighted sum of
    |(I - r r^T) (X - w c)|^2 over its rays r from c, of unit length.
    """
    starts = np.flatnonzero(np.diff(point, prepend=-1))

    def sums(values: Array) -> Array:
        return np.add.reduceat(values, starts, axis=0)

    centers = np.column_stack([places, np.zeros(len(places))])
    counts = sums(np.ones((len(point), 1)))
    centers = (centers - (sums(centers) / counts)[point]) / _REFERENCE_M
    squares = _squares(centers, rays)
    ahead = sums(rays)
    weight = np.ones((len(point), 1))
    for _ in range(passes):
        best = _homogeneous(sums(weight[..., None] * squares), ahead)
        toward = best[point, :3] - centers * best[point, 3:]
        along = np.sum(toward * rays, axis=1, keepdims=True)
        distance = np.linalg.norm(toward, axis=1, keepdims=True) + 1e-9
        off = np.linalg.norm(toward - rays * along, axis=1, keepdims=True) / distance
        off += along < 0
        weight = 1 / np.maximum(distance, _NEAREST) ** 2 / (1 + (off / _RAY_RAD) ** 2)
    return np.asarray(toward / distance)


def _squares(centers: Array, rays: Array) -> Array:
    """The form (M, 4, 4) of |(I - r r^T) (X - w c)|^2 in (X, w), of rays r from c, both (M, 3)."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    column = across @ centers[..., None]
    corner = np.sum(column * centers[..., None], axis=1, keepdims=True)
    return np.block([[across, -column], [-column.transpose(0, 2, 1), corner]])


def _homogeneous(form: Array, ahead: Array) -> Array:
    """The points (P, 4), with w >= 0 and on the side of `ahead` (P, 3), that minimize forms
    (P, 4, 4).
    """
    points = _least(form, ahead)
    behind = points[:, 3] <= 0
    points[behind, :3] = _least(form[behind, :3, :3], ahead[behind])
    points[behind, 3] = 0.0
    return points


def _least(form: Array, ahead: Array) -> Array:
    """The unit vectors (P, K) of the least of forms (P, K, K), on the side of `ahead` (P, 3)."""
    least = np.linalg.eigh(form)[1][:, :, 0]
    side = np.sign(np.sum(least[:, :3] * ahead, axis=1, keepdims=True))
    return np.asarray(least * side)
