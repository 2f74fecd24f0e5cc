# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Two laps of bags/sample_test as messages, with the truth; a model of bags/sample to locate them.

Model, other lights and foreign pictures are made once, and kept in build/ while the code that makes
them stays.
"""

import functools
import hashlib
import tempfile
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from robustness.messages import Message, Picture, Reading
from sfa_localization.bags.drives import as_live, read_drive
from sfa_localization.data.geometry import compose, relative
from sfa_localization.data.run import Trajectory
from sfa_localization.evaluation import fit_transform
from sfa_localization.observer import Observer
from sfa_localization.place_model import PlaceModel
from sfa_localization.training import Recipe, train

ROOT = Path(__file__).parents[2]
BAGS = ROOT / 'bags'
CACHE = ROOT / 'build/robustness'
LEARNING = (
    'bags', 'camera', 'data', 'keyframes', 'metric', 'sfa', 'place_model.py', 'training.py',
    'training_input.py',
)  # fmt: skip
"""Rooms that decide what a training gives."""
RENDERING = ('bags', 'camera', 'data', 'simulation')
SENSOR_STD = 3.0
"""Gray levels by which two pictures from one place differ: the noise of the simulated camera."""
FOREIGN_WORLD = 5
RECORDED = 'day', 'summer'
"""Light and season of the bags."""
OTHER_LIGHTS = (
    ('morning', 'summer'), ('evening', 'summer'), ('overcast', 'autumn'), ('day', 'winter'),
)  # fmt: skip


@dataclass(frozen=True)
class RecordedDrive:
    """What happens: times (ns) of odometry (N,) and pictures (M,), and what both show.

    `steps` (N, 3) are the motions since the reading before by the wheels, `true` (N, 3) the poses.
    `pictures` (M, H, W, 3) are panoramas.
    """

    times_ns: np.ndarray
    steps: np.ndarray
    twists: np.ndarray
    variances: np.ndarray
    true: np.ndarray
    pictures_ns: np.ndarray
    pictures: np.ndarray

    @property
    def start_ns(self):
        return int(self.times_ns[0])

    @property
    def messages(self):
        """Odometry, then pictures, without any fault."""
        poses = [np.zeros(3)]
        for step in self.steps[1:]:
            poses.append(compose(poses[-1], step))
        said = zip(self.times_ns, poses, self.twists, self.variances, self.true, strict=True)
        readings = [Message(int(t), int(t), Reading(*values), true) for t, *values, true in said]
        seen = zip(self.pictures_ns.tolist(), self.pictures, strict=True)
        return readings + [Message(t, t, Picture(image)) for t, image in seen]

    def seconds(self, times_ns):
        """Seconds since the begin."""
        return (times_ns - self.times_ns[0]) * 1e-9

    def part(self, start_s, stop_s):
        """The messages from one second until another."""
        kept, seen = (
            (start_s <= t) & (t < stop_s)
            for t in (self.seconds(self.times_ns), self.seconds(self.pictures_ns))
        )
        odometry = [getattr(self, f.name)[kept] for f in fields(self)[:5]]
        return RecordedDrive(*odometry, self.pictures_ns[seen], self.pictures[seen])

    def followed_by(self, other, pause_ns=40_000_000):
        """Both, one after the other: the pose may jump between them."""
        later = self.times_ns[-1] + pause_ns - other.times_ns[0]
        joined = [
            np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)
        ]
        joined[0][len(self.times_ns) :] += later
        joined[5][len(self.pictures_ns) :] += later
        return RecordedDrive(*joined)


def sources_key(rooms, *more):
    """Hash of the source files of rooms, and of other files."""
    files = [file for room in rooms for file in sorted((ROOT / 'sfa_localization').glob(room))]
    files = [f for file in files for f in ([file] if file.is_file() else sorted(file.glob('*.py')))]
    content = hashlib.sha256()
    for file in (*files, *more):
        content.update(file.read_bytes())
    return content.hexdigest()[:16]


@functools.cache
def model_file():
    """Where the model of bags/sample is kept, while the code of the training stays."""
    files = sorted((BAGS / 'sample').iterdir())
    return CACHE / f'model-{sources_key(LEARNING, *files)}.npz'


def model_path():
    """A model trained on bags/sample."""
    if not model_file().exists():
        train([BAGS / 'sample'], model_file())
    return model_file()


class Remembering:
    """A model that looks at each picture once: most faults leave most pictures as they are."""

    def __init__(self, model):
        self._model, self._seen = model, {}

    def __getattr__(self, name):
        return getattr(self._model, name)

    def views(self, panoramas):
        return [self._view(panorama) for panorama in panoramas]

    def _view(self, panorama):
        key = hashlib.sha1(panorama.tobytes(), usedforsecurity=False).digest()
        if key not in self._seen:
            (self._seen[key],) = self._model.views(panorama[None])
        return self._seen[key]


@functools.cache
def model():
    return Remembering(PlaceModel.load(model_path()))


def read(bag):
    """Run and panoramas (M, H, W, 3) of a bag, with the truth."""
    recipe = as_live(Recipe(), model().panorama)
    with tempfile.TemporaryDirectory() as folder:
        run = read_drive(bag, Path(folder), recipe, want_truth=True)
        return run, np.array(run.panoramas.read(0, len(run.panoramas)))


@functools.cache
def to_truth():
    """The transform from map to truth, fitted on the training drive."""
    run, pictures = read(BAGS / 'sample')
    observer = Observer(model())
    stamps, poses = [], []
    for stamp_ns, picture in zip(run.panoramas.stamps_ns, pictures, strict=True):
        seen = observer.observe(int(stamp_ns), picture)
        if not seen.problem:
            stamps.append(stamp_ns)
            poses.append(seen.pose)
    return fit_transform((run.ground_truth, Trajectory(np.array(stamps), np.array(poses))))


def simulated(name, **settings):
    """A bag of panoramas in a garden of 8 m; needs what simulates."""
    from sfa_localization.simulation.drive import simulate
    from sfa_localization.simulation.settings import SimulationConfig

    bag = CACHE / f'{name}-{sources_key(RENDERING)}'
    if not bag.exists():
        config = SimulationConfig(
            trajectory='test', area=(8.0, 8.0), images='panorama', compression='jpeg',
            odometry_rate=25.0, **settings,
        )  # fmt: skip
        simulate(config, bag)
    return bag


def drive_in(light, season):
    """bags/sample_test, or the same drive in another light or season."""
    if (light, season) == RECORDED:
        return BAGS / 'sample_test'
    return simulated(f'{light}-{season}', seed=2, length=20.0, light=light, season=season)


@functools.cache
def two_laps(light=RECORDED[0], season=RECORDED[1]):
    """The closed drive, once around and once again."""
    run, pictures = read(drive_in(light, season))
    odometry = run.odometry
    true = run.ground_truth.at(odometry.stamps_ns)
    steps = np.zeros((len(true), 3))
    steps[1:] = relative(odometry.poses[:-1], odometry.poses[1:])
    whole = RecordedDrive(odometry.stamps_ns, steps, odometry.twists, odometry.variances, true,
                  run.panoramas.stamps_ns, pictures)  # fmt: skip
    # It begins with a turn on the spot, into the direction in which it ends.
    off = np.abs(relative(true[-1], true[: len(true) // 2])) @ [1.0, 1.0, 1.0]
    start_s = float(whole.seconds(whole.times_ns)[np.argmin(off)])
    lap = whole.part(start_s, np.inf)
    again = noisy(lap.pictures, np.random.default_rng(1))
    return lap.followed_by(replace(lap, pictures=again))


def noisy(pictures, rng, std=SENSOR_STD):
    """Pictures as another exposure shows them."""
    noise = rng.normal(0.0, std, pictures.shape)
    return np.clip(pictures + noise, 0, 255).astype(np.uint8)


@functools.cache
def foreign_pictures():
    """Panoramas (M, H, W, 3) of another garden; needs what simulates."""
    bag = simulated('foreign', seed=5, world=FOREIGN_WORLD, length=12.0)
    return read(bag)[1]
