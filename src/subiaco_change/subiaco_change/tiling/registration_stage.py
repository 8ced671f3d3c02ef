"""Stage: one rigid registration over all tiles, from clouds thinned until they fit into memory."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.records import Registration
from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.registration.register import given_registration, register
from subiaco_change.tiling.alignment import ChangedPoints
from subiaco_change.tiling.epoch_tiles import Coordinates, EpochContext, corners
from subiaco_change.tiling.stage_inputs import REGISTRATION, PairRegistration
from subiaco_geo.clouds import PointCloud, unique_cells, voxel_downsample
from subiaco_geo.errors import RegistrationError
from subiaco_geo.frames import Floats
from subiaco_geo.work.tasks import Inputs

_LOG = logging.getLogger(__name__)
_BLOCK = NUMBERS.tiling.sample_block


@dataclass(frozen=True)
class RegistrationSlice:
    """What the registration reads of the configuration."""

    registration: RegistrationConfig
    registration_points: int
    leaf: float
    second_shift: float
    second_points: int


@dataclass(frozen=True)
class RegistrationParams:
    """Parameters of a registration; ``transform`` (4, 4) in the world [m] where it is given."""

    sides: tuple[EpochContext, ...]
    config: RegistrationSlice
    transform: Floats | None


def find_registration(inputs: Inputs, params: RegistrationParams) -> PairRegistration:
    """Register two epochs, or take a given transform; ``inputs`` hold ``cloud/<epoch>/<tile>``."""
    before, after = gather(inputs, params)
    config, transform = params.config.registration, params.transform
    if transform is None:
        return PairRegistration(register(before, after, config), 0.0, None)
    method = "identity" if np.array_equal(transform, np.eye(4)) else "given"
    return PairRegistration(given_registration(transform, before, after, config, method), 0.0, None)


def register_again(inputs: Inputs, params: RegistrationParams) -> PairRegistration:
    """Refine a registration without what its comparison calls changed.

    A sample of blocks tells first whether there is anything to refine: mostly there is not.
    """
    first = inputs.of(PairRegistration, REGISTRATION).registration
    before, after = gather(inputs, params)
    moved = _sampled_shift(first, before, after, params.config)
    if moved is not None and moved < 0.5 * params.config.second_shift:
        return PairRegistration(first, moved, None)
    masks = [np.asarray(cloud.fields["changed"], dtype=bool) for cloud in (before, after)]
    try:
        again = register(before, after, params.config.registration, masks[0], masks[1], start=first)
    except RegistrationError as error:
        note = f"the second estimate, without changed places, failed and the first is kept: {error}"
        _LOG.warning(note)
        return PairRegistration(first, 0.0, note)
    return PairRegistration(again, shift(first, again, before), None)


def _sampled_shift(
    first: Registration, before: PointCloud, after: PointCloud, config: RegistrationSlice
) -> float | None:
    """Shift [m] that blocks with ``second_points`` of each epoch give; None where all points take part."""
    share = config.second_points / max(min(len(before), len(after)), 1)
    if share <= 0.0 or share > 0.5:
        return None
    places = first.placed(before.world()), after.world()
    some = [cloud.select(_in_blocks(p, share)) for cloud, p in zip((before, after), places, strict=True)]
    masks = [np.asarray(cloud.fields["changed"], dtype=bool) for cloud in some]
    try:
        found = register(some[0], some[1], config.registration, masks[0], masks[1], start=first)
    except RegistrationError:
        return None
    return shift(first, found, before)


def _in_blocks(world: Floats, share: float) -> NDArray[np.bool_]:
    """Tell which points (N, 3) lie in blocks drawn with a probability, the same in every run and epoch."""
    blocks, own = unique_cells(np.floor(world[:, :2] / _BLOCK).astype(np.int64))
    drawn = [int.from_bytes(_lot(f"{i}_{j}")[:4], "big") < share * 2**32 for i, j in blocks.tolist()]
    return np.array(drawn, dtype=bool)[own]


EpochClouds = tuple[PointCloud, PointCloud]  # a tile of before and of after


def gather(inputs: Inputs, params: RegistrationParams) -> tuple[PointCloud, PointCloud]:
    """Points of both epochs (*before*, *after*), field ``changed``: 1 where an earlier pass calls them so.

    What a city takes in memory does not grow with it: where an epoch has more than
    ``registration_points``, voxels of doubled size thin both, and where that is not enough, tiles
    of a random sample all over the city represent it. Coarser voxels would lose the walls.
    Epochs without CRS need not have the same tiles at the same places, and are only thinned.
    """
    sides, config = params.sides, params.config
    local = any(side.crs is None for side in sides)
    names = sorted({name for side in sides for name in inputs.under(f"cloud/{side.epoch}")}, key=_lot)
    parts: dict[str, EpochClouds] = {}
    held, thin = np.zeros(2, dtype=np.int64), False
    for name in names:
        part: EpochClouds = tuple(_load(inputs, side, name) for side in sides)  # type: ignore[assignment]
        parts[name] = _thinned(part, 2.0 * config.leaf) if thin else part
        held += [len(cloud) for cloud in parts[name]]
        if held.max() > config.registration_points and not thin:
            parts = {own: _thinned(part, 2.0 * config.leaf) for own, part in parts.items()}
            held = np.sum([[len(cloud) for cloud in part] for part in parts.values()], axis=0)
            thin = True
        if held.max() > config.registration_points and not local:
            _LOG.info("registration: %d of %d tiles", len(parts), len(names))
            break
    return tuple(_joined([parts[n][e] for n in sorted(parts)], side) for e, side in enumerate(sides))  # type: ignore[return-value]


def _lot(name: str) -> bytes:
    """Return a place in an order that has nothing to do with where a tile lies, the same for every run."""
    return hashlib.sha256(name.encode()).digest()


def _thinned(part: EpochClouds, edge: float) -> EpochClouds:
    return voxel_downsample(part[0], edge), voxel_downsample(part[1], edge)


def _joined(clouds: Sequence[PointCloud], side: EpochContext) -> PointCloud:
    changed = np.concatenate([np.asarray(cloud.fields["changed"]) for cloud in clouds]) > 0.0
    return PointCloud(np.concatenate([c.xyz for c in clouds]), side.origin, side.crs, {"changed": changed})


def _load(inputs: Inputs, side: EpochContext, name: str) -> PointCloud:
    own = f"cloud/{side.epoch}/{name}"
    xyz = inputs.once(Coordinates, own).xyz if own in inputs else np.zeros((0, 3))
    alias = f"changed/{side.epoch}/{name}"
    known = alias in inputs
    changed = inputs.once(ChangedPoints, alias).changed if known else np.zeros(len(xyz), dtype=bool)
    return PointCloud(xyz, side.origin, side.crs, {"changed": changed.astype(np.float32)})


def shift(first: Registration, second: Registration, before: PointCloud) -> float:
    """Largest distance between two registrations at the corners of *before* [m]."""
    low, high = before.world().min(axis=0), before.world().max(axis=0)
    box = corners(low, high, low[2], high[2])
    return float(np.linalg.norm(first.placed(box) - second.placed(box), axis=1).max())
