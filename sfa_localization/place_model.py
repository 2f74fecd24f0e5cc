# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The fitted model: one panorama in, position, heading and their covariance out."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.camera.leveling import leveled
from sfa_localization.camera.panorama import filled, repeated_columns
from sfa_localization.camera.sectors import MountedCamera
from sfa_localization.camera.settings import LensCalibration, PanoramaConfig
from sfa_localization.camera.watch import drowned_columns
from sfa_localization.data.array_files import Arrays, read_arrays, read_header, write_arrays
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import ConfigError, LocalizationError, ModelError
from sfa_localization.data.geometry import Array, Indices, Mask
from sfa_localization.data.rejections import short_line
from sfa_localization.data.rig import Rig
from sfa_localization.data.run import Image, Origin
from sfa_localization.data.threads import one_core
from sfa_localization.keyframes.keyframes import Keyframes
from sfa_localization.keyframes.light import Conditions
from sfa_localization.keyframes.location import Location, hypotheses, located
from sfa_localization.keyframes.observation import UNKNOWN_YAW_VARIANCE, Observation
from sfa_localization.keyframes.regression import Fit
from sfa_localization.keyframes.upright import UprightImage, upright
from sfa_localization.mapping.driven_ground import DrivenGround
from sfa_localization.mapping.saved_map import MetricMap
from sfa_localization.mapping.turned_maps import TurnedMaps
from sfa_localization.sfa.image_features import (
    TURNED_LAYER,
    Spectrum,
    slow_features,
    spectrum,
)
from sfa_localization.sfa.network import (
    Architecture,
    Layer,
    Network,
    Node,
    check_weights,
    require_size,
)

FORMAT = 'sfa_localization place model'
VERSION = 17
_REMEDY = 'train it with the train command'


@dataclass(frozen=True, slots=True)
class View:
    """What an image shows before its heading is known: the `upright` image, its slow features (K,),
    the `spectrum` (H, J) of the layer that is turned, and which columns (W,) light has drowned.
    """

    upright: UprightImage
    slow_features: Array
    spectrum: Spectrum
    drowned: Mask


@dataclass(frozen=True, slots=True)
class PlaceModel:
    """Network, metric map and keyframes, learned from one place.

    `PlaceModel.load(path).locate(panorama)` is all that a robot needs. `quality` holds the figures
    of merit of the training, `error_correlation` that of neighboring images, `rig` the robot, and
    `ground` where it drove. Map and keyframes hold places of the camera. The map reads `turned`
    maps, or slow features where there are none. Where the robot hides its view, pixels (H, W)
    repeat those of `repeated`. `lens` is that of the camera, with its mounting. It is None for
    panoramas that were used as they are; `lean` is then roll and pitch of the camera, rad, if the
    images showed them, else (). `surround` lists the cameras, if several make the panorama.
    """

    network: Network
    metric: MetricMap
    panorama: PanoramaConfig
    keyframes: Keyframes
    ground: DrivenGround
    turned: TurnedMaps | None = None
    quality: dict[str, Any] = field(default_factory=dict)
    error_correlation: ErrorCorrelation = field(default_factory=ErrorCorrelation)
    rig: Rig = field(default_factory=Rig)
    repeated: Indices | None = None
    lens: LensCalibration | None = None
    lean: tuple[float, ...] = ()
    surround: tuple[MountedCamera, ...] = ()

    def locate(self, panorama: Image) -> Observation:
        """Position and heading from a panorama (H, W, 3) uint8 BGR.

        Raises ModelError for anything else, and for another size than that of `self.panorama`.
        """
        require_panorama(panorama)
        return self.locate_all(panorama[None])[0]

    @one_core()
    def locate_all(self, panoramas: Image) -> list[Observation]:
        """What panoramas (T, H, W, 3) show, each by itself."""
        views = self.views(self.prepared(panoramas))
        return [self.observed(view, self.located(view, Conditions())) for view in views]

    def prepared(self, panoramas: Image) -> Image:
        """Panoramas (T, H, W, 3) without what hides the view, as by an upright camera."""
        require_size(panoramas, self.network.architecture)
        if self.repeated is not None:
            panoramas = filled(panoramas, self.repeated)
        if not self.lean:
            return panoramas
        lean = np.array(self.lean)
        sphere = self.panorama.sphere
        return np.stack([leveled(panorama, lean, sphere) for panorama in panoramas])

    def views(self, panoramas: Image) -> list[View]:
        """Textures of panoramas (T, H, W, 3), leveled by keyframes."""
        require_size(panoramas, self.network.architecture)
        drowned = [drowned_columns(image) for image in panoramas]
        level = [
            upright(self._comparable(image, columns), image)
            for image, columns in zip(panoramas, drowned, strict=True)
        ]
        maps = self.network.maps(np.stack([image.panorama for image in level]))
        spectra = spectrum(maps[min(TURNED_LAYER, len(maps) - 1)])
        return list(map(View, level, slow_features(maps), spectra, drowned))

    def located(self, view: View, conditions: Conditions) -> Location:
        """Where the camera was, by keyframes and slow features in the current conditions."""
        keyframes = self._comparable(view.upright.seen, view.drowned)
        fits, tilt = hypotheses(keyframes, view.upright, conditions.pattern)
        slow = self._slow_places(view, fits)
        return located(fits, slow, conditions.scales, self.keyframes.errors, tilt)

    def _comparable(self, panorama: Image, drowned: Mask) -> Keyframes:
        """The keyframes, compared only where the panorama (H, W, 3) is not drowned in light, and
        that of several cameras shows more than repeated columns: where a camera is missing.
        """
        hidden = drowned | repeated_columns(panorama) if self.surround else drowned
        if not hidden.any() or hidden.all():
            return self.keyframes
        return self.keyframes.seeing(np.broadcast_to(~hidden, panorama.shape[:2]))

    def _slow_places(self, view: View, fits: Sequence[Fit]) -> tuple[Array, Array]:
        """Where the map puts an image at the heading of each of H hypotheses, (H, 2) m, and its
        variances (H,) m^2 along each axis, which include that of the heading.
        """
        if self.turned is None:
            place, covariance = self.metric.predict(view.slow_features)
            return place.repeat(len(fits), axis=0), covariance[:, 0, 0].repeat(len(fits))
        yaw, unlike = np.array([(fit.yaw, fit.unlike) for fit in fits]).T
        variance = self.keyframes.errors.yaw_variance(unlike)
        spectra = np.repeat(view.spectrum[None], len(yaw), axis=0)
        places, covariances, by_yaw = self.turned.predict(self.metric, spectra, yaw, variance)
        return places, np.trace(covariances + by_yaw, axis1=1, axis2=2) / 2

    def observed(self, view: View, location: Location) -> Observation:
        """The pose of base_link; its covariance includes the errors that all images share: those of
        the map, and of its scale about its center.
        """
        errors = self.keyframes.errors
        center = self.keyframes.poses[:, :2].mean(0)
        of_map = np.array([errors.map_m, errors.map_m, errors.turn_std])
        covariance = location.covariance + np.diag(of_map**2)
        by_scale = self.rig.wheel_scale.std * (location.pose[:2] - center)
        covariance[:2, :2] += np.outer(by_scale, by_scale)
        pose, covariance = self.rig.base(location.pose, covariance, location.facing)
        covariance[2, 2] = min(covariance[2, 2], UNKNOWN_YAW_VARIANCE)
        return Observation(
            pose,
            covariance,
            view.slow_features,
            location.fit.explained,
            tilt=location.tilt,
            drowned=float(view.drowned.mean()),
        )

    def save(self, path: Path) -> None:
        """Write to `path` completely or not at all; the same model gives the same bytes."""
        arrays = {**self._arrays(), 'header': np.array(json.dumps(self._header(), sort_keys=True))}
        write_arrays(path, arrays)

    @property
    def origin(self) -> Origin | None:
        """Latitude and longitude, degrees, of x = y = 0, if a receiver measured points."""
        origin = self.quality.get('origin')
        return (float(origin[0]), float(origin[1])) if origin else None

    @classmethod
    def load(cls, path: Path | str) -> PlaceModel:
        """Read a model. Raises ModelError when it is missing, damaged or of another version."""
        path = Path(path).expanduser()
        arrays = read_arrays(path, FORMAT, VERSION, _REMEDY)
        try:
            model = cls._from_arrays(arrays, json.loads(str(arrays['header'])))
            model._prove()
        except LocalizationError as error:
            raise _damaged(path, str(error)) from None
        except Exception:  # header and arrays that do not fit each other fail in many ways
            raise _damaged(path, 'its parts do not fit together') from None
        return model

    def _prove(self) -> None:
        """Check the parts, and locate two images, so that the first one of a drive does not wait.

        Raises ModelError where the parts do not fit, or a covariance is not positive definite.
        """
        check_weights(self.network)
        if self.turned is not None and abs(self.turned.sign) != 1.0:
            raise ModelError('the direction of its columns is neither 1 nor -1')
        height, width = self.network.architecture.size
        if (height, width) != (self.panorama.height, self.panorama.width):
            raise ModelError('network and panorama differ in size')
        noise = np.random.default_rng(0).integers(0, 256, (1, height, width, 3), np.uint8)
        with np.errstate(all='ignore'):
            estimates = self.locate_all(np.concatenate([noise, np.zeros_like(noise)]))
        for estimate in estimates:
            if not (estimate.finite and np.isfinite(estimate.explained)):
                raise ModelError('its estimates are not finite')
            if np.linalg.eigvalsh(estimate.covariance)[0] <= 0:
                raise ModelError('its covariances are not positive definite')

    def _header(self) -> dict[str, Any]:
        architecture = dataclasses.asdict(self.network.architecture)
        several = [dataclasses.asdict(camera) for camera in self.surround]
        return {
            'format': FORMAT,
            'version': VERSION,
            'architecture': architecture,
            'ranks': self.network.ranks,
            'panorama': dataclasses.asdict(self.panorama),
            'quality': self.quality,
            'error_correlation': dataclasses.asdict(self.error_correlation),
            'rig': self.rig.to_mapping(),
            'lens': None if self.lens is None else dataclasses.asdict(self.lens),
            'lean': self.lean,
            **({'surround': several} if several else {}),
        }

    def _arrays(self) -> Arrays:
        arrays: Arrays = {}
        for depth, node in enumerate(self.network.nodes):
            parts = {f.name: getattr(node, f.name) for f in dataclasses.fields(node)}
            arrays |= _prefixed(f'network/{depth}/', {**parts, 'delta': self.network.deltas[depth]})
        arrays |= _prefixed('metric/', self.metric.to_arrays())
        arrays |= _prefixed('keyframes/', self.keyframes.to_arrays())
        arrays |= _prefixed('ground/', self.ground.to_arrays())
        if self.turned is not None:
            arrays |= _prefixed('turned/', self.turned.to_arrays())
        if self.repeated is not None:
            arrays['repeated'] = self.repeated
        return arrays

    @classmethod
    def _from_arrays(cls, arrays: Arrays, header: dict[str, Any]) -> PlaceModel:
        turned = _under(arrays, 'turned/')
        panorama = PanoramaConfig.from_mapping(header['panorama'], 'panorama')
        return cls(
            network_from(arrays, header),
            MetricMap.from_arrays(_under(arrays, 'metric/')),
            panorama,
            Keyframes.from_arrays(_under(arrays, 'keyframes/'), panorama.sphere),
            DrivenGround.from_arrays(_under(arrays, 'ground/')),
            TurnedMaps.from_arrays(turned) if turned else None,
            header['quality'],
            ErrorCorrelation(**header['error_correlation']),
            Rig.from_mapping(header['rig']),
            arrays.get('repeated'),
            lens_from(header),
            tuple(header.get('lean', ())),
            surround_from(header),
        )


def camera_of(path: Path | str) -> tuple[PanoramaConfig, LensCalibration | None]:
    """Panorama and lens of a model, without reading the rest. Raises ModelError."""
    panorama, lens, _ = _cameras(Path(path).expanduser())
    return panorama, lens


def surround_of(path: Path | str) -> tuple[MountedCamera, ...]:
    """The cameras whose images make the panorama of a model; () for one. Raises ModelError."""
    return _cameras(Path(path).expanduser())[2]


def _cameras(
    path: Path,
) -> tuple[PanoramaConfig, LensCalibration | None, tuple[MountedCamera, ...]]:
    """Panorama, lens, and several cameras of a model. Raises ModelError."""
    header = read_header(path, FORMAT, VERSION, _REMEDY)
    try:
        panorama = PanoramaConfig.from_mapping(header['panorama'], 'panorama')
        return panorama, lens_from(header), surround_from(header)
    except (ConfigError, KeyError, TypeError, ValueError) as error:
        raise _damaged(path, str(error)) from None


def lens_from(header: Mapping[str, Any]) -> LensCalibration | None:
    """The lens in a model file's header. Raises ConfigError."""
    lens = header['lens']
    return None if lens is None else LensCalibration.from_mapping(lens, 'lens')


def surround_from(header: Mapping[str, Any]) -> tuple[MountedCamera, ...]:
    """The cameras around the robot in a model file's header. Raises ConfigError."""
    return tuple(map(MountedCamera.from_mapping, header.get('surround', ())))


def require_panorama(image: object) -> None:
    """Raise ModelError for anything but an array (H, W, 3) uint8."""
    kind = type(image).__name__
    if isinstance(image, np.ndarray):
        kind = f'{image.shape} {image.dtype}'
        if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
            return
    raise ModelError(f'a panorama is (H, W, 3) uint8, not {kind}')


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
        raise ModelError('it has weights of more or fewer layers than its network')
    nodes = []
    deltas = []
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
