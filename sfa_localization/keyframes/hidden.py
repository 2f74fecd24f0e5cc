# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Textures of a camera whose view the robot hides in part.

What was not seen is missing, not different. An image is compared with keyframes only where it was
seen. In a keyframe, the missing part is filled in from neighbors that saw it, because they faced
another way: at each pixel, by the plane that fits their values over their places.
"""

from __future__ import annotations

import cv2
import numpy as np

from sfa_localization.data.geometry import Array, Mask
from sfa_localization.keyframes.texture import Spectra, Texture, channels, columns_of, spectrum

# Ridge of the slopes of a plane. From 0.02 to 0.2 images err alike; with less, planes extrapolate,
# and without slopes an image errs by a tenth more.
_RIDGE = 0.1
# A plane is fitted to the nearest that saw the missing part, of many: on a dense drive most face
# the same way. With 20 or 32 of them images err alike, with 64 by a twentieth more.
_NEIGHBORS = 32
_CANDIDATES = 512
_TINY = 1e-6


def seen_in(panorama: Mask, rows: int, columns: int) -> Mask:
    """Which pixels of textures (rows, columns) show only pixels (H, W) seen in the panorama."""
    hidden = (~panorama).astype(np.float32)
    sizes = [(columns, part.stop - part.start) for part in channels(rows)]
    parts = [cv2.resize(hidden, size, interpolation=cv2.INTER_AREA) for size in sizes]
    return np.asarray(np.concatenate(parts) == 0)


def turned_mask(seen: Mask, angle: float) -> Mask:
    """The mask (rows, columns) of a texture that is `turned` by an angle, rad."""
    columns = int(np.floor(-angle / (2 * np.pi) * seen.shape[1]))
    return np.asarray(np.roll(seen, columns, axis=1) & np.roll(seen, columns + 1, axis=1))


def masked(spectra: Spectra, seen: Mask) -> Spectra:
    """Spectra (..., rows, F) of the part of textures in a mask (rows, columns)."""
    return spectrum(columns_of(spectra, seen.shape[1]) * seen)


def correlated_part(texture: Texture, seen: Mask) -> Spectra:
    """The spectrum (rows, F) of the part of a texture in a mask (rows, columns), scaled so that its
    correlations are those of the whole: what was not seen would count as different.
    """
    part = texture * seen
    part /= max(float(np.linalg.norm(part)), _TINY) * np.sqrt(seen.mean())
    return spectrum(part)


def completed(spectra: Spectra, seen: Mask, places: Array) -> Spectra:
    """Spectra (K, rows, F) of textures at one heading with their missing parts filled in, by masks
    (K, rows, columns) and places (K, 2) m. What no neighbor saw is 0.
    """
    from scipy.spatial import cKDTree  # for training alone

    textures = columns_of(spectra, seen.shape[2]) * seen
    whole = textures.copy()
    tree = cKDTree(places)
    for row in np.flatnonzero(~seen.all(axis=(1, 2))).tolist():
        missing = ~seen[row]
        _, near = tree.query(places[row], min(_CANDIDATES, len(places)))
        others = np.atleast_1d(near)
        others = others[seen[others][:, missing].mean(1) > 0.5][:_NEIGHBORS]
        offset = places[others] - places[row]
        offset /= max(np.hypot(*offset.T).mean(), _TINY) if len(others) else 1
        plane = np.column_stack([np.ones(len(others)), offset])
        weight = np.exp(-(offset**2).sum(1) / 2)[:, None] * seen[others][:, missing]
        squares = np.einsum('np,ni,nj->pij', weight, plane, plane)
        ridge = np.outer(weight.sum(0), [0.0, _RIDGE, _RIDGE]) + _TINY
        squares[:, range(3), range(3)] += ridge
        values = np.einsum('np,ni->pi', weight * textures[others][:, missing], plane)
        whole[row, missing] = np.linalg.solve(squares, values[..., None])[:, 0, 0]
    return spectrum(whole)
