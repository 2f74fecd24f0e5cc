# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A stand-in for a trained model that reads the pose off the picture; a drive for it."""

import dataclasses
import math

import numpy as np
from filter_drives import FilterDrive

from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera.settings import LensCalibration, PanoramaConfig
from sfa_localization.camera.watch import drowned_columns
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.events import ODOMETRY, merge_by_stamp
from sfa_localization.data.rig import Rig
from sfa_localization.keyframes.location import Location
from sfa_localization.keyframes.observation import UNKNOWN_YAW_VARIANCE, Observation
from sfa_localization.keyframes.regression import Fit
from sfa_localization.mapping.driven_ground import DrivenGround
from sfa_localization.place_model import PlaceModel

SIZE = PanoramaConfig(width=64, height=16)
STEP_M = 0.05
CORNER = np.array([[0.0, 1.0], [0.5, 1.0], [0.5, 1.5]])
DROVE = DrivenGround.of(CORNER, np.zeros(3), np.array([0.0, 0.15, 0.6]))
UNLIKE_DEFAULT = ErrorCorrelation(0.5, 2.0)


def panorama(pose=(0.0, 0.0, 0.0), seed=0, explained=0.9, level=120, spread=40):
    """A picture (H, W, 3) of random dots that says where it was taken, to within STEP_M, and which
    part of it that place explains, to within 0.01.
    """
    noise = np.random.default_rng(seed).normal(level, spread, (SIZE.height, SIZE.width, 3))
    image = np.clip(noise, 0, 255).astype(np.uint8)
    x, y = (round(value / STEP_M) for value in pose[:2])
    yaw = round(pose[2] % (2 * math.pi) / (2 * math.pi) * 65535)
    image[0, 0] = x % 256, x // 256, y % 256
    image[0, 1] = y // 256, yaw % 256, yaw // 256
    image[0, 2] = round(100 * explained)
    return image


def fit_at(place, explained, **more):
    """What keyframes say of an image at a place (2,); by default it is beside all of them, and so
    teaches nothing about the light.
    """
    numbers = {'unlike': 1 / explained - 1, 'variance': 0.0, 'outward': 1.0, **more}
    return Fit(np.asarray(place), np.ones(1), np.zeros(3), residual=np.zeros((1, 1)), **numbers)


@dataclasses.dataclass
class PictureReader:
    """Reads what `panorama` wrote; positions are positive."""

    panorama: PanoramaConfig = SIZE
    heading: bool = True
    origin: tuple[float, float] | None = None
    quality: dict = dataclasses.field(default_factory=dict)
    error_correlation: ErrorCorrelation = UNLIKE_DEFAULT
    rig: Rig = dataclasses.field(default_factory=Rig)
    ground: DrivenGround = dataclasses.field(default_factory=lambda: DROVE)
    lens: LensCalibration | None = None
    surround: tuple = ()

    def prepared(self, images):
        return images

    def views(self, images):
        return images

    def located(self, view, conditions):
        seen = self.locate(view)
        fit = fit_at(seen.position, max(seen.explained, 0.01))
        return Location(seen.pose, seen.covariance, fit, 1 + 0j, conditions.scales, seen.tilt)

    def observed(self, view, location):
        return self.locate(view)

    def locate(self, image):
        a, b, explained = image[0, :3].astype(int)
        position = np.array([a[0] + 256 * a[1], a[2] + 256 * b[0]]) * STEP_M
        yaw = math.remainder((b[1] + 256 * b[2]) / 65535 * 2 * math.pi, 2 * math.pi)
        explained = explained[0] / 100
        # As a model does, it is less sure of pictures that are less familiar.
        spread = np.diag([0.02, 0.03, 0.002]) * max(0.6 / max(explained, 0.01), 1.0) ** 2
        pose = np.append(position, yaw if self.heading else 0.0)
        spread[2, 2] = spread[2, 2] if self.heading else UNKNOWN_YAW_VARIANCE
        drowned = float(drowned_columns(image).mean())
        return Observation(pose, spread, pose, explained, drowned=drowned)


def load_pictures(monkeypatch):
    """Let any model that is loaded read pictures."""
    monkeypatch.setattr(PlaceModel, 'load', staticmethod(lambda path: PictureReader()))


class Recording:
    """A drive with dark, covered, frozen, foreign and misshapen pictures, and an odometry gap."""

    def __init__(self):
        drive = FilterDrive(
            seconds=24, rate_hz=20, every=4, start=(5.0, 60.0, 0.3),
            v_std=0.02, omega_std=0.01, position_std=0.1, yaw_std=0.03,
        )  # fmt: skip
        t = np.arange(len(drive.stamps_ns)) / 20
        self.drive, self.kept = drive, np.flatnonzero((t < 16) | (t > 18.5))
        # Between two odometry messages, as pictures are.
        self.pictures_ns = drive.stamps_ns[drive.pictures] + 7_000_000
        self.pictures = [self._picture(k) for k in range(len(drive.pictures))]

    def _picture(self, k):
        if k < 2 or k in (60, 61):
            return panorama(self.drive.seen[k], k, explained=0.05)
        if k in (20, 21):
            return np.zeros((SIZE.height, SIZE.width, 3), np.uint8)
        if k == 30:
            return np.full((SIZE.height, SIZE.width, 3), 90, np.uint8)
        if 40 <= k < 50:
            return panorama(self.drive.seen[40], 40)
        if k == 55:
            return np.zeros((SIZE.height, SIZE.width + 2, 3), np.uint8)
        return panorama(self.drive.seen[k], k, explained=0.3 if 63 <= k < 66 else 0.9)

    def events(self):
        yield from merge_by_stamp(self.drive.stamps_ns[self.kept], self.pictures_ns)

    def write(self, path):
        drive = self.drive
        with BagWriter(path) as bag:
            for stamp_ns, kind, index in self.events():
                if kind == ODOMETRY:
                    i = self.kept[index]
                    told = drive.reckoned[i], drive.read[i], drive.variances()
                    bag.odometry('/odom', stamp_ns, *told)
                else:
                    bag.image('/panorama', stamp_ns, self.pictures[index], 'omnicam')
            for stamp_ns, pose in zip(drive.stamps_ns.tolist(), drive.poses, strict=True):
                bag.pose('/truth', stamp_ns, pose)
        return path
