"""The registration over all tiles: one rigid transform, from clouds thinned until they fit."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from subiaco_change.records import Registration
from subiaco_change.registration.register import given_registration, register
from subiaco_change.semantics.ground import Mask
from subiaco_change.tiled.cutting import Side, corners
from subiaco_change.tiled.framing import registration_arrays, registration_of
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.errors import RegistrationError
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs

_LOG = logging.getLogger(__name__)


def find_registration(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Register two epochs, or take a given transform.

    Parameters
    ----------
    inputs : Inputs
        ``cloud/<epoch>/<tile>``.
    params : mapping
        ``sides config transform``.
    """
    before, after = (_gather(inputs, side, params)[0] for side in params["sides"])
    config, transform = params["config"].registration, params["transform"]
    if transform is None:
        return registration_arrays(register(before, after, config))
    method = "identity" if np.array_equal(transform, np.eye(4)) else "given"
    return registration_arrays(given_registration(transform, before, after, config, method))


def register_again(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Refine a registration without what its pass calls changed.

    Returns
    -------
    arrays
        Of the new registration, with ``shift``, how far it moves *before* at most [m]; or of
        the first one, with ``failed``, why it was kept.
    """
    first = registration_of(inputs["registration"])
    (before, changed_before), (after, changed_after) = (
        _gather(inputs, side, params) for side in params["sides"]
    )
    try:
        again = register(
            before, after, params["config"].registration, changed_before, changed_after, start=first
        )
    except RegistrationError as error:
        note = f"the second estimate, without changed places, failed and the first is kept: {error}"
        _LOG.warning(note)
        return {**registration_arrays(first), "failed": np.array(note), "shift": np.float64(0.0)}
    return {**registration_arrays(again), "shift": np.float64(shift(first, again, before))}


def _gather(inputs: Inputs, side: Side, params: Mapping[str, Any]) -> tuple[PointCloud, Mask]:
    """Points of all tiles of an epoch, and which of them an earlier pass calls changed.

    Where there are more than ``registration.points``, voxels of doubled size thin them, tile by
    tile: the memory that this takes does not grow with the city.
    """
    names = inputs.under(f"cloud/{side.epoch}")
    leaf, limit = params["config"].leaf, params["config"].registration_points
    parts = {name: _load(inputs, side, name) for name in names}
    while sum(map(len, parts.values())) > limit:
        leaf *= 2.0
        parts = {name: voxel_downsample(part, leaf) for name, part in parts.items()}
    xyz = np.concatenate([part.xyz for part in parts.values()])
    changed = np.concatenate([np.asarray(part.fields["changed"]) for part in parts.values()])
    return PointCloud(xyz, side.origin, side.crs), changed > 0.0


def _load(inputs: Inputs, side: Side, name: str) -> PointCloud:
    xyz = inputs[f"cloud/{side.epoch}/{name}"]["xyz"]
    alias = f"changed/{side.epoch}/{name}"
    changed = inputs[alias]["changed"] if alias in inputs else np.zeros(len(xyz), dtype=bool)
    return PointCloud(xyz, side.origin, side.crs, {"changed": changed.astype(np.float32)})


def shift(first: Registration, second: Registration, before: PointCloud) -> float:
    """Largest distance between two registrations at the corners of *before* [m]."""
    low, high = before.world().min(axis=0), before.world().max(axis=0)
    box = corners(low, high, low[2], high[2])
    placed = [(box - r.origin) @ r.T_local[:3, :3].T + r.T_local[:3, 3] + r.origin for r in (first, second)]
    return float(np.linalg.norm(placed[0] - placed[1], axis=1).max())
