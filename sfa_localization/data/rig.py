# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The robot: place and delay of its camera, scale of its wheels.

Training learns these with the map; a model holds them, and they are the filter's prior. Frames
are those of REP 103: base_link between the wheels, x ahead, y to the left.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.messages import LARGEST_SCALE

CAMERA_STD_M = 0.5
"""Prior of each coordinate of a camera on a robot of unknown size."""
GIVEN_STD_M = 0.005
"""Of a lever arm that was measured on the robot."""
CONTRADICTS = 4.0
"""Standard deviations: two measurements of a place never differ by so many by chance."""
TURN_FACTOR_STD = 0.04
"""Of true over counted turns, also of a known robot on other ground: wheels of eleven real drives
differed by so much; tracks that skid by half are known by the turns of images."""
UNKNOWN_YAW_STD = math.pi / math.sqrt(3)
"""Standard deviation, rad, of an angle that is uniform on the circle."""
_LARGEST_LEVER_M = 5.0  # a camera of a ground robot sits nearer to the middle of its axle
LONGEST_DELAY_S = 10.0
"""Of a camera; training finds delays of up to half a second."""


class Quantity(NamedTuple):
    """A value with its standard deviation, in one unit."""

    value: float
    std: float


@dataclass(frozen=True, slots=True)
class Rig:
    """What training learned of a robot; the defaults are the prior of an unknown robot.

    The camera sits `camera_ahead` and `camera_left` m of base_link, turned left by `camera_yaw` rad
    since the first drive; its images are stamped `camera_delay` s late. The robot drives
    `wheel_scale` times the distance of its odometry, minus `turn_loss` m per radian of its turns,
    plus `speed_offset` m/s, and turns `turn_factor` times as far as the odometry.
    Raises DataError for impossible values.
    """

    camera_ahead: Quantity = Quantity(0.0, 0.0)
    camera_left: Quantity = Quantity(0.0, 0.0)
    camera_yaw: Quantity = Quantity(0.0, 0.0)
    camera_delay: Quantity = Quantity(0.0, 0.2)
    wheel_scale: Quantity = Quantity(1.0, 0.03)
    turn_loss: Quantity = Quantity(0.0, 0.05)
    turn_factor: Quantity = Quantity(1.0, TURN_FACTOR_STD)
    speed_offset: Quantity = Quantity(0.0, 0.005)

    def __post_init__(self) -> None:
        for name, (value, std) in self.items():
            if not (math.isfinite(value) and 0.0 <= std < math.inf):
                raise DataError(f'{name} is {value} +- {std}, which is no estimate')
        if abs(self.lever) > _LARGEST_LEVER_M:
            raise DataError(f'a camera {abs(self.lever):.3g} m beside base_link is impossible')
        if not 1 / LARGEST_SCALE <= self.wheel_scale.value <= LARGEST_SCALE:
            raise DataError(f'a scale of wheels of {self.wheel_scale.value:.3g} is impossible')
        if abs(self.camera_delay.value) > LONGEST_DELAY_S:
            raise DataError(f'a camera delay of {self.camera_delay.value:.3g} s is impossible')

    @classmethod
    def from_mapping(cls, values: Mapping[str, Sequence[float]]) -> Rig:
        """From pairs of value and standard deviation by name. Raises DataError."""
        try:
            return cls(**{name: Quantity(*map(float, pair)) for name, pair in values.items()})
        except (TypeError, ValueError) as error:
            raise DataError(f'no record of a robot: {error}') from None

    def to_mapping(self) -> dict[str, list[float]]:
        """The pairs of `from_mapping`."""
        return {name: [*pair] for name, pair in self.items()}

    def items(self) -> list[tuple[str, Quantity]]:
        """Names and quantities."""
        return [*asdict(self).items()]

    @property
    def lever(self) -> complex:
        """Lever arm of the camera, ahead + i left, m."""
        return complex(self.camera_ahead.value, self.camera_left.value)

    def displaced(self, lever: complex) -> str:
        """A sentence if a camera at a measured lever arm, ahead + i left, m, sits elsewhere than in
        training; '' if not.
        """
        std = (self.camera_ahead.std + self.camera_left.std) / 2
        if abs(lever - self.lever) < CONTRADICTS * math.hypot(std, GIVEN_STD_M):
            return ''
        return (
            f'/tf_static has the camera {lever.real:.2f} m ahead and {lever.imag:.2f} m left of '
            f'base_link, in training it was at {self.lever.real:.2f} and {self.lever.imag:.2f} m '
            f'(+- {std:.2f}): was it moved? Train anew, or correct /tf_static'
        )

    def base(self, pose: Array, covariance: Array, facing: complex) -> tuple[Array, Array]:
        """Pose (3,) and covariance (3, 3) of base_link from those of the camera.

            base = camera - exp(i yaw) lever

        as the mean over the wrapped normal distribution of the yaw. An error of the lever arm
        also displaced the labels of training, by the mean `facing` of exp(i yaw) of the matched
        keyframes: at the heading of training it cancels.
        """
        lever = self.lever
        turn = float(pose[2] - self.camera_yaw.value)
        variance = float(covariance[2, 2]) + self.camera_yaw.std**2
        mean_turn = np.exp(1j * turn - variance / 2)
        across = -1j * lever * mean_turn
        jacobian = np.eye(3)
        jacobian[:2, 2] = across.real, across.imag
        base = np.asarray(covariance, float).copy()
        base[2, 2] = variance
        base = jacobian @ base @ jacobian.T
        # Second order: with a large yaw variance the lever arm is uncertain along itself, too.
        along = (abs(lever) * -math.expm1(-variance)) ** 2 / 2
        labels = facing * np.exp(-1j * self.camera_yaw.value)
        lever_variance = (self.camera_ahead.std**2 + self.camera_left.std**2) / 2
        base[:2, :2] += (along + lever_variance * abs(labels - mean_turn) ** 2) * np.eye(2)
        x = pose[0] - (lever * mean_turn).real
        y = pose[1] - (lever * mean_turn).imag
        return np.array([x, y, wrap_angle(turn)]), base

    def centers(self, poses: Array) -> Array:
        """Places (N, 2) m of base_link from poses (N, 3) of the camera."""
        lever = self.lever * np.exp(1j * (poses[:, 2] - self.camera_yaw.value))
        return np.column_stack([poses[:, 0] - lever.real, poses[:, 1] - lever.imag])

    def camera(self, poses: Array) -> Array:
        """Poses (N, 3) of the camera from those (N, 3) of base_link."""
        moved = self.lever * np.exp(1j * poses[:, 2])
        yaw = wrap_angle(poses[:, 2] + self.camera_yaw.value)
        return np.column_stack([poses[:, 0] + moved.real, poses[:, 1] + moved.imag, yaw])

    def as_text(self) -> list[str]:
        """Lines for a terminal."""
        turned = self.camera_yaw
        delay = self.camera_delay
        scale = self.wheel_scale
        loss = self.turn_loss
        turn = self.turn_factor
        ahead = _offset(self.camera_ahead, 'ahead of', 'behind')
        aside = _offset(self.camera_left, 'left of', 'right of')
        lines = [f'camera: {ahead} and {aside} base_link']
        if turned.std >= UNKNOWN_YAW_STD:
            lines.append('camera turned between the drives: headings of images are not used')
        elif turned.value or turned.std:
            degrees = math.degrees(turned.value), math.degrees(turned.std)
            lines.append('camera turned by {:.1f} deg (+- {:.1f})'.format(*degrees))
        lines.append(f'images stamped {delay.value:.3f} s late (+- {delay.std:.3f})')
        lines.append(f'wheels: {scale.value:.4f} times the way counted (+- {scale.std:.4f})')
        if loss.value or loss.std:
            lines[-1] += f', less {loss.value:.3f} m per radian (+- {loss.std:.3f})'
        offset = 1e3 * self.speed_offset.value, 1e3 * self.speed_offset.std
        if offset[0]:
            lines[-1] += ', plus {:.0f} mm/s (+- {:.0f})'.format(*offset)
        lines.append(f'wheels: {turn.value:.3f} times the turns counted (+- {turn.std:.3f})')
        return lines


def _offset(quantity: Quantity, positive: str, negative: str) -> str:
    side = positive if quantity.value >= 0 else negative
    return f'{abs(quantity.value):.2f} m (+- {quantity.std:.2f}) {side}'
