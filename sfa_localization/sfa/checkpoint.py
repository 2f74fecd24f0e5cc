# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Finished stages of a network's training, so that an interrupted training can be resumed."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.array_files import read_arrays, write_arrays
from sfa_localization.data.errors import ModelError
from sfa_localization.data.run import Run
from sfa_localization.sfa.network import Architecture, Node
from sfa_localization.sfa.network_training import Partial
from sfa_localization.sfa.slowness import LinearSfa

logger = logging.getLogger(__name__)
FORMAT = 'sfa_localization training checkpoint'
VERSION = 1
# So many images of each run enter its fingerprint: enough to notice other recordings.
_FINGERPRINT_IMAGES = 16


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A file beside the output that holds the finished stages until the model is written."""

    path: Path
    fingerprint: str

    @classmethod
    def beside(cls, output: Path, settings: Sequence[object], runs: Sequence[Run]) -> Checkpoint:
        """The checkpoint of training with `settings` on `runs`: its fingerprint depends on both."""
        digest = hashlib.sha256('\n'.join(map(repr, settings)).encode())
        for run in runs:
            digest.update(run.panoramas.stamps_ns.tobytes())
            digest.update(run.odometry.poses.tobytes())
            step = max(1, len(run.panoramas) // _FINGERPRINT_IMAGES)
            for index in range(0, len(run.panoramas), step):
                digest.update(run.panoramas.read(index, index + 1).tobytes())
        return cls(output.with_name(f'.{output.name}.checkpoint.npz'), digest.hexdigest())

    def write(self, partial: Partial) -> None:
        """Save the stages finished so far. Raises ModelError."""
        arrays: dict[str, NDArray[Any]] = {}
        for depth, node in enumerate(partial.nodes):
            for item in fields(Node):
                arrays[f'{depth}/{item.name}'] = getattr(node, item.name)
            arrays[f'{depth}/delta'] = partial.deltas[depth]
        if partial.linear is not None:
            for name in ('mean', 'weights', 'delta'):
                arrays[f'linear/{name}'] = getattr(partial.linear, name)
        header = {
            'format': FORMAT,
            'version': VERSION,
            'fingerprint': self.fingerprint,
            'ranks': partial.ranks,
            'linear_rank': None if partial.linear is None else partial.linear.rank,
        }
        write_arrays(self.path, {**arrays, 'header': np.array(json.dumps(header))})

    def read(self, architecture: Architecture) -> Partial | None:
        """The stages finished so far; None, with a warning, where they cannot be used."""
        if not self.path.is_file():
            return None
        try:
            arrays = read_arrays(self.path, FORMAT, VERSION, 'train')
            header = json.loads(str(arrays['header']))
            if header['fingerprint'] != self.fingerprint:
                raise ModelError(f'{self.path}: made from other bags or parameters')
        except ModelError as error:
            logger.warning('%s: the training starts anew', error)
            return None
        ranks = tuple((a, b) for a, b in header['ranks'])
        nodes = tuple(
            Node(*(arrays[f'{depth}/{item.name}'] for item in fields(Node)))
            for depth in range(len(ranks))
        )
        deltas = tuple(arrays[f'{depth}/delta'] for depth in range(len(ranks)))
        linear = None
        if header['linear_rank'] is not None:
            mean, weights, delta = (arrays[f'linear/{n}'] for n in ('mean', 'weights', 'delta'))
            linear = LinearSfa(mean, weights, delta, header['linear_rank'])
        return Partial(architecture, nodes, linear, deltas, ranks)

    def remove(self) -> None:
        """Delete the file, if there is one."""
        self.path.unlink(missing_ok=True)
