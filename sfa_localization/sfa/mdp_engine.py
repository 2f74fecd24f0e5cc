# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The reference engine: the same hierarchy from MDP's nodes, trained on really rotated images.

It makes the paper's sequence, image after image at all rotations (section 2.2), and learns the
same network as network_training.py, hundreds of times slower.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image
from sfa_localization.sfa.mdp_shim import import_mdp
from sfa_localization.sfa.network import Architecture, Layer, Network, Node, input_map
from sfa_localization.sfa.network_training import (
    LIGHT_STD,
    RELATIVE_CUT,
    ImageSequence,
    Shard,
    require_pairs,
    shards_of,
)
from sfa_localization.sfa.rotation import Field
from sfa_localization.sfa.slowness import LinearSfa, signed, whitening


def train_network(
    architecture: Architecture,
    sequences: Sequence[ImageSequence],
    seed: int = 0,
    *,
    light_std: float = LIGHT_STD,
    relative_cut: float = RELATIVE_CUT,
    on_shard: Callable[[int], object] = lambda images: None,
) -> Network:
    """Train all layers, as network_training.train_network does.

    `on_shard` receives the number of images since its last call.
    Raises ConfigError without MDP, and DataError when the images vary too little.
    """
    require_pairs(sequences)
    shards = shards_of(sequences, seed, light_std)
    return train_flow(architecture, shards, relative_cut, on_shard)[1]


def train_flow(
    architecture: Architecture,
    shards: Sequence[Shard],
    relative_cut: float = RELATIVE_CUT,
    on_shard: Callable[[int], object] = lambda images: None,
) -> tuple[Any, Network]:
    """The trained mdp.Flow, from flat input maps (T, D) to flat top maps, and its network."""
    mdp = import_mdp()
    flow = build_flow(mdp, architecture, relative_cut)
    data = [
        _RotatedSequence(architecture, shards, on_shard) if node.is_trainable() else None
        for node in flow
    ]
    try:
        flow.train(data)
        # Flow.train leaves the last SFANode open: the node behind it is not trained.
        for node in flow:
            if node.is_training():
                node.stop_training()
    except mdp.MDPException as error:
        raise _unwrapped(error) from None
    return flow, network_of(flow, architecture)


def _unwrapped(error: BaseException) -> DataError:
    """The cause of MDP's failure, taken from its long report."""
    inner: BaseException | None = error
    while inner is not None:
        if isinstance(inner, DataError):
            return inner
        inner = inner.__context__
    return DataError(f'MDP cannot learn from these images: {str(error).strip().splitlines()[-1]}')


def build_flow(mdp: Any, architecture: Architecture, relative_cut: float) -> Any:
    """An untrained mdp.Flow: per layer a switchboard, linear SFA, expansion, SFA and limit."""
    nodes: list[Any] = []
    rows = architecture.map_rows
    for depth, layer in enumerate(architecture.layers):
        receptive = architecture.fields[depth]
        channels = architecture.channels[depth]
        shape = (rows[depth], architecture.rotations, channels)
        wires = connections(shape, receptive)
        nodes += _layer(mdp, layer, int(np.prod(shape)), wires, relative_cut)
    return mdp.Flow(nodes)


def connections(shape: tuple[int, int, int], receptive: Field) -> NDArray[np.int64]:
    """Indices (nodes, D) into a flat map (rows, R, channels) that each node sees."""
    rows, columns, _ = shape
    index = np.arange(int(np.prod(shape))).reshape(shape)
    wires = []
    for rows_of in receptive.row_slices(rows):
        for column in range(columns):
            at = (column + np.arange(receptive.columns) * receptive.spacing) % columns
            wires.append(index[rows_of][:, at].transpose(1, 0, 2).ravel())
    return np.array(wires)


def _layer(
    mdp: Any, layer: Layer, inputs: int, wires: NDArray[np.int64], relative_cut: float
) -> list[Any]:
    """The nodes of one layer; all fields of a layer share one SFANode."""
    count, fan_in = wires.shape
    parts = (
        _sfa_node(mdp, fan_in, layer.linear, relative_cut),
        mdp.nodes.QuadraticExpansionNode(input_dim=layer.linear),
        _sfa_node(mdp, layer.expanded, layer.outputs, relative_cut),
    )
    return [
        mdp.hinet.Switchboard(input_dim=inputs, connections=wires.ravel()),
        *(mdp.hinet.CloneLayer(part, n_nodes=count) for part in parts),
        mdp.nodes.CutoffNode(
            lower_bound=-layer.clip, upper_bound=layer.clip, input_dim=count * layer.outputs
        ),
    ]


def _sfa_node(mdp: Any, inputs: int, outputs: int, relative_cut: float) -> Any:
    """An SFANode that drops directions of little variance by the rule of sfa.solve."""
    node = mdp.nodes.SFANode(input_dim=inputs, output_dim=outputs, include_last_sample=False)

    def solve(
        difference: Array, covariance: Array, *_: Any, dfc_out: Any, **__: Any
    ) -> tuple[Array, Array]:
        white = whitening(covariance, relative_cut, outputs)
        dfc_out.rank_deficit = inputs - white.shape[1]
        delta, turn = mdp.utils.symeig(white.T @ difference @ white, range=(1, outputs))
        return delta, signed(white @ turn)

    node._symeig = solve
    return node


@dataclass(frozen=True, slots=True)
class _RotatedSequence:
    """The training sequence, one image at all rotations at a time, as MDP takes it.

    Each part ends with the next one's first sample, which counts for the difference only.
    """

    architecture: Architecture
    shards: Sequence[Shard]
    on_shard: Callable[[int], object]

    def __iter__(self) -> Iterator[tuple[Array, bool]]:
        waiting: Array | None = None
        for image, joined in self._images():
            turned = self._turned(image)
            if waiting is not None:
                yield (np.concatenate([waiting, turned[:1]]), False) if joined else (waiting, True)
                self.on_shard(1)
            waiting = turned
        if waiting is not None:
            yield waiting, True
            self.on_shard(1)

    def _images(self) -> Iterator[tuple[Image, bool]]:
        """Every image (H, W, C), and whether it is a neighbor of the one before it."""
        for shard in self.shards:
            for images, joined in shard.batches():
                yield from zip(images, joined.tolist(), strict=True)

    def _turned(self, image: Image) -> Array:
        """Flat maps (R, D) of an image at all rotations."""
        rotations = self.architecture.rotations
        step = image.shape[1] // rotations
        turned = np.stack([np.roll(image, -turn * step, axis=1) for turn in range(rotations)])
        return input_map(turned, self.architecture).reshape(rotations, -1).astype(np.float64)


def network_of(flow: Any, architecture: Architecture) -> Network:
    """The trained weights of a flow as a network."""
    trained = [layer.node for layer in flow if layer.is_trainable()]
    solutions = [
        LinearSfa(node.avg, node.sf, node.d, node.input_dim - node.rank_deficit) for node in trained
    ]
    pairs = list(zip(solutions[::2], solutions[1::2], strict=True))
    return Network(
        architecture,
        tuple(Node.from_solutions(*pair) for pair in pairs),
        tuple(slow.delta for _, slow in pairs),
        tuple((linear.rank, slow.rank) for linear, slow in pairs),
    )
