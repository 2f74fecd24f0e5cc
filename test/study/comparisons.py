# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The studies `baselines` and `ablations`: other features, and fewer parts.

Baselines replace the features, and go through the same metric learning and evaluation; ablations
leave out a part of this package, and are evaluated as the nodes would work.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from unittest.mock import patch

import numpy as np

from sfa_localization.data.errors import LocalizationError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Odometry, Run, differences
from sfa_localization.evaluation import evaluate
from sfa_localization.keyframes.light import Conditions
from sfa_localization.keyframes.location import Location
from sfa_localization.keyframes.observation import UNKNOWN_YAW_VARIANCE
from sfa_localization.keyframes.regression import Fit
from sfa_localization.mapping.learning import MetricResult, learn_metric
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.observer import UNKNOWN_VARIANCE
from sfa_localization.place_model import PlaceModel, View
from sfa_localization.sfa.network import standard_architecture
from sfa_localization.sfa.network_training import ImageSequence, train_network
from sfa_localization.sfa.settings import NetworkConfig
from study.results import Cell, Results
from study.signatures import FourierSignature
from study.sites import Site, learned
from study.trials import Features, Study, Trial, scores_of, slow_of, turned_of

BASELINES: dict[str, Callable[[Study, PlaceModel], Features]] = {
    'Fourier signatures of rows': lambda study, _model: (
        FourierSignature.fit(study.batches).features
    ),
    'slow features, first pass': lambda _study, model: slow_of(model.network),
}
"""Features that metric learning is given, of the images alone."""
SECOND, WHOLE = 'turned maps, second pass', 'this package, one image'
FEATURES = (*BASELINES, SECOND, WHOLE)


def baselines(site: Site, results: Results, world: str) -> None:
    """Add the cells of a world: errors in m, as `Trial.errors` names them, by `features`."""
    missing = [n for n in FEATURES if results.find(world=world, features=n) is None]
    if not missing:
        return
    study = site.study()
    model = site.model(study)
    for name in missing:
        site.progress.say(f'{world}: {name}')
        results.keep({'world': world, 'features': name, **_judged(site, study, model, name)})


def _judged(site: Site, study: Study, model: PlaceModel, name: str) -> Cell:
    """Errors of a kind of features, or the `problem` if they give no map."""
    rows = study.laid_on(SegmentConfig())
    if name == WHOLE:
        judged = evaluate(model, site.test, align_bags=site.training, recipe=site.recipe)
        return {'test': judged.scores['sfa']['mean'], 'ekf': judged.scores['ekf']['mean']}
    segments = study.segments(SegmentConfig())
    fitted = np.concatenate([segment.images for segment in segments])
    if name == SECOND:
        features = study.features(turned_of(model))
        return Trial.of(study, model.metric, features, rows, fitted).errors()
    features = study.features(BASELINES[name](study, model))
    try:
        metric = learn_metric(features[0], segments, MetricConfig()).map
    except LocalizationError as error:
        return {'problem': str(error)}
    return Trial.of(study, metric, features, rows, fitted).errors()


class SlowFeaturesAlone(PlaceModel):
    """A model with positions from slow features, turned by the headings of the keyframes."""

    def located(self, view: View, conditions: Conditions) -> Location:
        location = PlaceModel.located(self, view, conditions)
        places, claimed = self._slow_places(view, [location.fit])
        unlike = np.array([location.fit.unlike])
        (variance,) = self.keyframes.errors.slow_variance(claimed, unlike)
        covariance = np.diag([variance, variance, UNKNOWN_YAW_VARIANCE])
        return replace(location, pose=np.append(places[0], 0.0), covariance=covariance)


class KeyframesAlone(PlaceModel):
    """A model whose slow features say nothing of the place: the likelihood of the image alone."""

    def _slow_places(self, view: View, fits: Sequence[Fit]) -> tuple[Array, Array]:
        places, variances = PlaceModel._slow_places(self, view, fits)
        return places, np.full_like(variances, UNKNOWN_VARIANCE)


@dataclass(frozen=True, slots=True)
class Variant:
    """This package with a change; `images` are located by a class of models."""

    images: type[PlaceModel] = PlaceModel
    second_pass: bool = True
    network: NetworkConfig = field(default_factory=NetworkConfig)
    rotate: bool = True
    exact_odometry: bool = False
    """In the training, not in the test: what the errors of odometry cost the map."""


VARIANTS = {
    'everything: likelihood and slow features': Variant(),
    'one image by its likelihood alone': Variant(images=KeyframesAlone),
    'one image by slow features alone': Variant(images=SlowFeaturesAlone),
    'no second pass': Variant(second_pass=False),
    'exact odometry in the training': Variant(exact_odometry=True),
    'no simulated rotation': Variant(rotate=False),
    'gray': Variant(network=NetworkConfig(normalization='grey')),
}
"""The rows of the table of ablations."""


def ablations(site: Site, results: Results, world: str) -> None:
    """Add the cells of a world by `variant`: `heading`, the mean error of the filter in degrees,
    and what `scores_of` names.
    """
    missing = [n for n in VARIANTS if results.find(world=world, variant=n) is None]
    if not missing:
        return
    study = site.study()
    whole = site.model(study)
    for name in missing:
        site.progress.say(f'{world}: {name}')
        try:
            cell = _ablated(site, study, whole, VARIANTS[name])
        except LocalizationError as error:
            cell = {'problem': str(error)}
        results.keep({'world': world, 'variant': name, **cell})


def _exact(run: Run) -> Run:
    """A drive with exact odometry."""
    assert run.ground_truth is not None
    stamps_ns, poses = run.ground_truth.stamps_ns, run.ground_truth.poses
    twists = differences(stamps_ns, poses)
    odometry = Odometry(stamps_ns, poses, twists, np.zeros_like(twists))
    return replace(run, odometry=odometry, yaw_rate=None)


def _first_pass(
    _spectra: object, _segments: object, first: MetricResult, *_rest: object
) -> tuple[None, MetricResult]:
    """The map of slow features, where else that of turned maps is learned."""
    return None, first


def _ablated(site: Site, study: Study, whole: PlaceModel, variant: Variant) -> Cell:
    """Scores of a variant, aligned on the training drives."""
    network, runs, model = whole.network, study.training, whole
    recipe = replace(site.recipe, network=variant.network)
    if (variant.network, variant.rotate) != (NetworkConfig(), True):
        size, normalization = runs[0].panoramas.shape[:2], variant.network.normalization
        architecture = standard_architecture(size, normalization)
        images, seed = [ImageSequence.of(runs[0])], variant.network.seed
        network = train_network(architecture, images, seed, rotate=variant.rotate)
    if variant.exact_odometry:
        runs = tuple(map(_exact, runs))
    if not variant.second_pass:
        with patch('sfa_localization.training.with_turned', _first_pass):
            model = learned(network, runs, recipe)
    elif network is not whole.network or variant.exact_odometry:
        model = learned(network, runs, recipe)
    model = variant.images(**{part.name: getattr(model, part.name) for part in fields(model)})
    judged = evaluate(model, site.test, align_bags=site.training, recipe=site.recipe)
    heading = judged.scores['ekf']['yaw_deg']
    return {'heading': heading['mean'] if heading else None, **scores_of(judged)}
