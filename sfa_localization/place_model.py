# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The fitted model: one panorama in, position, heading and their covariance out."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.array_files import Arrays, read_arrays, write_arrays
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import LocalizationError, ModelError
from sfa_localization.data.geometry import Array
from sfa_localization.data.rejections import short_line
from sfa_localization.data.run import Image
from sfa_localization.data.threads import one_core
from sfa_localization.features.image_features import (
    TURNED_LAYER,
    layer_harmonics,
    slow_features,
    spectrum,
)
from sfa_localization.features.keyframes import Keyframes
from sfa_localization.features.network import (
    Architecture,
    Layer,
    Network,
    Node,
    check_weights,
    require_size,
)
from sfa_localization.features.observation import (
    UNKNOWN_YAW_VARIANCE,
    Match,
    Observation,
    Spectra,
    combine,
)
from sfa_localization.features.rotation import Map
from sfa_localization.features.rotation_spread import Agreement, disagreement
from sfa_localization.metric.compass import Compass
from sfa_localization.metric.saved_map import MetricMap
from sfa_localization.metric.turned_maps import TurnedMaps

FORMAT = 'sfa_localization place model'
VERSION = 11
SCALE_STD = 0.01
"""Of the scale of a map: its meters are those of wheels, seldom known better."""
_LONGEST_DELAY_S = 10.0
"""Of a camera: training finds delays of up to half a second."""


@dataclass(frozen=True, slots=True)
class PlaceModel:
    """Network, metric map, compass and keyframes, learned from one place.

    `PlaceModel.load(path).locate(panorama)` is all that a robot needs. `quality` holds the
    figures of merit of the training; `error_correlation` is that of the errors of
    neighboring images. The map reads `turned` maps, or slow features where there are none.
    """

    network: Network
    metric: MetricMap
    panorama: PanoramaConfig
    keyframes: Keyframes
    agreement: Agreement
    turned: TurnedMaps | None = None
    compass: Compass | None = None
    yaw_agreement: Agreement | None = None
    heading_layers: tuple[int, ...] = ()
    quality: dict[str, Any] = field(default_factory=dict)
    error_correlation: ErrorCorrelation = field(default_factory=ErrorCorrelation)

    @property
    def camera_delay_s(self) -> float:
        """Delay of the image stamps in the training drives; 0 where unknown."""
        known = [delay for delay in self.quality.get('camera_delay_s', ()) if delay is not None]
        return float(np.median(known)) if known else 0.0

    def locate(self, panorama: Image) -> Observation:
        """Position and heading from a panorama (H, W, 3) uint8 BGR.

        Raises ModelError when it is none, or its size is not `self.panorama`'s.
        """
        require_panorama(panorama)
        return self.locate_all(panorama[None])[0]

    @one_core()
    def locate_all(self, panoramas: Image) -> list[Observation]:
        """What panoramas (T, H, W, 3) show."""
        slow = self.slow_poses(panoramas)
        return [
            self.combined(one, self.match(panorama, one))
            for one, panorama in zip(slow, panoramas, strict=True)
        ]

    def slow_poses(self, panoramas: Image) -> list[Observation]:
        """What panoramas (T, H, W, 3) show by slow features alone, leveled by keyframes."""
        require_size(panoramas, self.network.architecture)
        level = list(map(self.keyframes.level, panoramas))
        maps = self.network.maps(np.stack([image.panorama for image in level]))
        slow = slow_features(maps)
        spread = disagreement(maps[-1])
        yaw, yaw_variance = self.headings(maps, slow)
        if self.yaw_agreement is not None:
            yaw_variance = yaw_variance * self.yaw_agreement.factor(spread)
        yaw_variance = np.minimum(yaw_variance, UNKNOWN_YAW_VARIANCE)
        by_yaw: Array | float = 0.0
        if self.turned is None:
            positions, own = self.metric.predict(slow)
        else:
            spectra = spectrum(maps[TURNED_LAYER])
            positions, own, by_yaw = self.turned.predict(self.metric, spectra, yaw, yaw_variance)
        own = own * self.agreement.factor(spread)[:, None, None] + by_yaw
        covariances = np.zeros((len(slow), 3, 3))
        covariances[:, :2, :2] = own
        covariances[:, 2, 2] = yaw_variance
        poses = np.column_stack([positions, yaw])
        return [
            Observation(pose, covariance, features, leveled=image)
            for pose, covariance, features, image in zip(
                poses, covariances, slow, level, strict=True
            )
        ]

    def match(self, panorama: Image, slow: Observation, pattern: Spectra | None = None) -> Match:
        """What keyframes show of a panorama (H, W, 3) without the `pattern` that the light adds,
        see `OtherLight`; they are looked for also where its slow features put it.
        """
        guess = slow.position if np.isfinite(slow.position).all() else None
        level = slow.leveled or self.keyframes.level(panorama)
        return self.keyframes.match_level(level, guess, pattern)

    def combined(
        self, slow: Observation, match: Match, light: float = 0.0, doubt: float = 1.0
    ) -> Observation:
        """Both together, see `combine`, with what is uncertain of both alike: the scale of the map
        about its center, how far beyond the keyframes they are, and what no image has shown yet.
        """
        noise, center = self.keyframes.noise, self.keyframes.poses[:, :2].mean(0)
        pose, covariance = combine(slow, match, noise, light, doubt)
        novelty = noise.novelty(match.score)
        by_scale = SCALE_STD * (pose[:2] - center)
        covariance = covariance * max(novelty, 1.0) ** 2
        covariance[:2, :2] += np.outer(by_scale, by_scale)
        covariance[:2, :2] += noise.beyond(match, light) ** 2 * np.eye(2)
        covariance[2, 2] = min(covariance[2, 2], UNKNOWN_YAW_VARIANCE)
        return Observation(pose, covariance, slow.slow_features, novelty, tilt=match.tilt)

    def headings(self, maps: list[Map], slow: Array) -> tuple[Array, Array]:
        """Yaw (T,) rad in the map and its variance (T,), from the maps of all layers and the slow
        features (T, K); without a compass it is 0 and unknown.
        """
        if self.compass is None:
            return np.zeros(len(slow)), np.full(len(slow), UNKNOWN_YAW_VARIANCE)
        return self.compass.predict(slow, layer_harmonics(maps, self.heading_layers))

    def save(self, path: Path) -> None:
        """Write to `path` completely or not at all; the same model gives the same bytes."""
        arrays = {**self._arrays(), 'header': np.array(json.dumps(self._header(), sort_keys=True))}
        write_arrays(path, arrays)

    @classmethod
    def load(cls, path: Path | str) -> PlaceModel:
        """Read a model. Raises ModelError when it is missing, damaged or of another version."""
        path = Path(path)
        arrays = read_arrays(path, FORMAT, VERSION, 'train it with the train command')
        try:
            model = cls._from_arrays(arrays, json.loads(str(arrays['header'])))
            model._prove()
        except LocalizationError as error:
            raise _damaged(path, str(error)) from None
        except Exception:  # header and arrays that do not fit each other fail in many ways
            raise _damaged(path, 'its parts do not fit each other') from None
        return model

    def _prove(self) -> None:
        """Locate two images, so that the first of a drive neither fails nor waits.

        Raises ModelError where the results are not finite, or certain beyond reason.
        """
        check_weights(self.network)
        turned = [part for part in (self.compass, self.turned) if part is not None]
        if any(abs(part.sign) != 1.0 for part in turned):
            raise ModelError('it turns neither way')
        height, width = self.network.architecture.size
        if (height, width) != (self.panorama.height, self.panorama.width):
            raise ModelError('network and panorama are of different sizes')
        noise = np.random.default_rng(0).integers(0, 256, (1, height, width, 3), np.uint8)
        with np.errstate(all='ignore'):
            estimates = self.locate_all(np.concatenate([noise, np.zeros_like(noise)]))
        for estimate in estimates:
            if not (estimate.finite and np.isfinite(estimate.novelty)):
                raise ModelError('its estimates are not finite')
            if np.linalg.eigvalsh(estimate.covariance)[0] <= 0:
                raise ModelError('its covariances are not positive')
        if not abs(self.camera_delay_s) <= _LONGEST_DELAY_S:
            raise ModelError('its camera delay is not that of a camera')

    def _header(self) -> dict[str, Any]:
        architecture = dataclasses.asdict(self.network.architecture)
        return {
            'format': FORMAT,
            'version': VERSION,
            'architecture': architecture,
            'ranks': self.network.ranks,
            'panorama': dataclasses.asdict(self.panorama),
            'heading_layers': self.heading_layers,
            'quality': self.quality,
            'error_correlation': dataclasses.asdict(self.error_correlation),
        }

    def _arrays(self) -> Arrays:
        arrays: Arrays = {}
        for depth, node in enumerate(self.network.nodes):
            parts = {f.name: getattr(node, f.name) for f in dataclasses.fields(node)}
            arrays |= _prefixed(f'network/{depth}/', {**parts, 'delta': self.network.deltas[depth]})
        arrays |= _prefixed('metric/', self.metric.to_arrays())
        arrays |= _prefixed('keyframes/', self.keyframes.to_arrays())
        arrays |= _prefixed('agreement/', self.agreement.to_arrays())
        for name in ('compass', 'yaw_agreement', 'turned'):
            part = getattr(self, name)
            if part is not None:
                arrays |= _prefixed(f'{name}/', part.to_arrays())
        return arrays

    @classmethod
    def _from_arrays(cls, arrays: Arrays, header: dict[str, Any]) -> PlaceModel:
        turned, compass, yaw_agreement = (
            _under(arrays, name) for name in ('turned/', 'compass/', 'yaw_agreement/')
        )
        panorama = PanoramaConfig.from_mapping(header['panorama'], 'panorama')
        return cls(
            network_from(arrays, header),
            MetricMap.from_arrays(_under(arrays, 'metric/')),
            panorama,
            Keyframes.from_arrays(_under(arrays, 'keyframes/'), panorama.sphere),
            Agreement.from_arrays(_under(arrays, 'agreement/')),
            TurnedMaps.from_arrays(turned) if turned else None,
            Compass.from_arrays(compass) if compass else None,
            Agreement.from_arrays(yaw_agreement) if yaw_agreement else None,
            tuple(header['heading_layers']),
            header['quality'],
            ErrorCorrelation(**header['error_correlation']),
        )


def require_panorama(image: object) -> None:
    """Raise ModelError for anything but an array (H, W, 3) uint8."""
    found = type(image).__name__
    if isinstance(image, np.ndarray):
        found = f'{image.shape} {image.dtype}'
        if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
            return
    raise ModelError(f'a panorama is (H, W, 3) uint8, not {found}')


def _damaged(path: Path, reason: str) -> ModelError:
    return ModelError(f'{path}: the model is damaged ({short_line(reason)}): train it again')


def network_from(arrays: Arrays, header: Mapping[str, Any]) -> Network:
    """The network of a model file's arrays and header."""
    spec = dict(header['architecture'])
    spec['size'], spec['grid'] = tuple(spec['size']), tuple(spec['grid'])
    spec['layers'] = tuple(
        Layer(**{**layer, 'field': tuple(layer['field']), 'stride': tuple(layer['stride'])})
        for layer in spec['layers']
    )
    architecture = Architecture(**spec)
    if sum(name.endswith('/linear_offset') for name in arrays) != len(architecture.layers):
        raise ModelError('its layers are not those of its weights')
    nodes, deltas = [], []
    for depth in range(len(architecture.layers)):
        part = _under(arrays, f'network/{depth}/')
        deltas.append(np.asarray(part.pop('delta'), float))
        nodes.append(Node(**part))
    ranks = tuple((int(a), int(b)) for a, b in header['ranks'])
    return Network(architecture, tuple(nodes), tuple(deltas), ranks)


def _prefixed(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    return {prefix + name: np.asarray(array) for name, array in arrays.items()}


def _under(arrays: Arrays, prefix: str) -> Arrays:
    return {name[len(prefix) :]: a for name, a in arrays.items() if name.startswith(prefix)}
