# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The studies `baselines` and `ablations`: other features, and fewer parts.

Baselines replace the features, and go through the same metric learning and evaluation; ablations
leave out a part of this package, and are evaluated as the nodes would work.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from unittest.mock import patch

import numpy as np

from sfa_localization.data.errors import LocalizationError
from sfa_localization.data.run import Odometry, Run, differences
from sfa_localization.evaluation import evaluate
from sfa_localization.keyframes.light import Conditions
from sfa_localization.keyframes.location import Location
from sfa_localization.keyframes.observation import UNKNOWN_YAW_VARIANCE
from sfa_localization.metric.learning import MetricResult, learn_metric
from sfa_localization.metric.settings import MetricConfig, SegmentConfig
from sfa_localization.place_model import PlaceModel, View
from sfa_localization.sfa.network import (
    PAPER_LAYERS,
    Architecture,
    Layer,
    standard_architecture,
)
from sfa_localization.sfa.network_training import LIGHT_STD, ImageSequence, train_network
from sfa_localization.sfa.settings import NetworkConfig
from sfa_localization.training import Recipe
from study.results import BATCH, Cell, Results
from study.retrieval import ImageRetrieval
from study.signatures import FourierSignature, TurnedComponents
from study.sites import Site, learned
from study.trials import MONOMIALS, STRAIGHT, Features, Study, Trial, mean_error, slow_of, turned_of

BASELINES: dict[str, Callable[[Study, PlaceModel], Features]] = {
    'principal components of all rotations': (
        lambda study, _model: TurnedComponents.fit(study.batches).features
    ),
    'Fourier signatures of rows': lambda study, _model: (
        FourierSignature.fit(study.batches).features
    ),
    'slow features, first pass': lambda _study, model: slow_of(model.network),
}
"""Features that metric learning is given, of the images alone."""
SECOND, WHOLE, RETRIEVAL = (
    'turned maps, second pass', 'this package, one image', 'nearest image, at true positions',
)  # fmt: skip
MEASURES = {
    'test': 'test (m)',
    'test_supervised': 'test, supervised (m)',
    'training': 'training (m)',
    'training_supervised': 'training, supervised (m)',
}


def baselines(site: Site, results: Results, world: str) -> None:
    """Add the cells of a world: errors in m, as `MEASURES` names them, by `features`."""
    names = (*BASELINES, SECOND, WHOLE, RETRIEVAL)
    missing = [n for n in names if results.find(world=world, features=n) is None]
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
    if name == RETRIEVAL:
        return _retrieved(study)
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


def _retrieved(study: Study) -> Cell:
    """Errors of the true position of the most similar training image."""
    poses = np.column_stack([study.places, np.zeros(len(study.places))])
    retrieval = ImageRetrieval.of((image for batch in study.batches() for image in batch), poses)
    images = (i for batch in study.test.panoramas.batches(BATCH) for i in batch)
    places = np.array([retrieval.locate(image)[:2] for image in images])
    return {'test_supervised': mean_error(places, study.test_truth.poses[:, :2])}


class SlowFeaturesAlone(PlaceModel):
    """A model with positions from slow features, turned by the headings of the keyframes."""

    @classmethod
    def of(cls, model: PlaceModel) -> SlowFeaturesAlone:
        return cls(**{part.name: getattr(model, part.name) for part in fields(model)})

    def located(self, view: View, conditions: Conditions) -> Location:
        location = PlaceModel.located(self, view, conditions)
        places, claimed = self._slow_places(view, [location.fit])
        unlike = np.array([location.fit.unlike])
        (variance,) = self.keyframes.errors.slow_variance(claimed, unlike)
        covariance = np.diag([variance, variance, UNKNOWN_YAW_VARIANCE])
        return replace(location, pose=np.append(places[0], 0.0), covariance=covariance)


@dataclass(frozen=True, slots=True)
class Variant:
    """This package with a change. Empty `layers` mean the standard network."""

    metric: MetricConfig = field(default_factory=MetricConfig)
    segments: SegmentConfig = field(default_factory=SegmentConfig)
    normalization: str = NetworkConfig().normalization
    layers: tuple[Layer, ...] = ()
    rotate: bool = True
    light_std: float = LIGHT_STD
    second_pass: bool = True
    keyframes: bool = True
    single_drive: bool = False
    """The map is learned from the last training drive: the paper's descent starts from odometry,
    whose frame is another one in each drive."""
    exact_odometry: bool = False
    """In the training, not in the test: what the errors of odometry cost the map."""

    @property
    def same_network(self) -> bool:
        """Whether it uses the network of the whole package."""
        mine = self.normalization, self.layers, self.rotate, self.light_std
        return mine == (NetworkConfig().normalization, (), True, LIGHT_STD)

    @property
    def same_map(self) -> bool:
        """Whether it learns the map of the whole package, from its network."""
        mine = self.metric, self.segments, self.second_pass, self.single_drive, self.exact_odometry
        return mine == (MetricConfig(), SegmentConfig(), True, False, False)

    def recipe(self, base: Recipe) -> Recipe:
        """The recipe of the training."""
        network = replace(base.network, normalization=self.normalization)
        return replace(base, network=network, metric=self.metric, segments=self.segments)

    def drives(self, study: Study) -> tuple[Run, ...]:
        """The drives from which the map is learned."""
        runs = study.training[-1:] if self.single_drive else study.training
        return tuple(map(_exact, runs)) if self.exact_odometry else runs

    def reduced(self, model: PlaceModel) -> PlaceModel:
        """A model without the parts that it does without."""
        return model if self.keyframes else SlowFeaturesAlone.of(model)

    def architecture(self, size: tuple[int, int]) -> Architecture:
        """Its network for panoramas of (rows, columns)."""
        standard = standard_architecture(size, self.normalization)
        return replace(standard, layers=self.layers) if self.layers else standard


FIRST, SECOND_LAYER, TOP = PAPER_LAYERS
TWO_LAYERS = (FIRST, replace(TOP, field=(6, 20)))
FOUR_LAYERS = (FIRST, SECOND_LAYER, Layer((2, 5), (1, 1), 32, 32), replace(TOP, field=(3, 20)))
VARIANTS = {
    'everything': Variant(),
    'no keyframes': Variant(keyframes=False),
    'no second pass': Variant(second_pass=False),
    'neither: slow features alone': Variant(second_pass=False, keyframes=False),
    'straight segments only': Variant(segments=STRAIGHT),
    'monomials, 8 features; no second pass': Variant(metric=MONOMIALS),
    'the same, straight lines of one drive': Variant(
        metric=MONOMIALS, segments=STRAIGHT, single_drive=True
    ),
    "the same, paper's solver": Variant(
        metric=replace(MONOMIALS, solver='paper'), segments=STRAIGHT, single_drive=True
    ),
    'exact odometry in the training': Variant(exact_odometry=True),
    'no simulated rotation': Variant(rotate=False),
    'no random light': Variant(light_std=0.0),
    'two layers; no second pass': Variant(layers=TWO_LAYERS),
    'four layers': Variant(layers=FOUR_LAYERS),
    'gray': Variant(normalization='grey'),
    'color as it is': Variant(normalization='none'),
}
"""The rows of the table of ablations."""
SCORES = {
    'slow': 'slow features alone (m)',
    'sfa': 'one image (m)',
    'ekf': 'EKF (m)',
    'heading': 'EKF heading (°)',
}


def ablations(site: Site, results: Results, world: str) -> None:
    """Add the cells of a world: errors in m and degrees, as `SCORES` names them, by `variant`."""
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
    """Scores of a variant, aligned on the last training drive."""
    recipe, network = variant.recipe(site.recipe), whole.network
    if not variant.same_network:
        drive = study.training[0]
        network = train_network(
            variant.architecture(drive.panoramas.shape[:2]),
            [ImageSequence.of(drive)],
            recipe.network.seed,
            light_std=variant.light_std,
            rotate=variant.rotate,
        )
    same, drives = variant.same_network and variant.same_map, variant.drives(study)
    with patch('sfa_localization.training.with_turned', _first_pass):
        first = learned(network, drives, recipe)
    if variant.second_pass:
        model = whole if same else learned(network, drives, recipe)
    else:
        model = first
    model = variant.reduced(model)
    judged = evaluate(model, site.test, align_bags=site.training, recipe=site.recipe)
    alone = Variant(keyframes=False).reduced(first)
    slow = evaluate(alone, site.test, align_bags=site.training, recipe=site.recipe)
    heading = judged.scores['ekf']['yaw_deg']
    return {
        'slow': slow.scores['sfa']['mean'],
        'sfa': judged.scores['sfa']['mean'],
        'ekf': judged.scores['ekf']['mean'],
        'heading': heading['mean'] if heading else None,
    }
