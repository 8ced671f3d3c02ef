"""The edited map as a second drive would have made it: other points, other noise, other shadows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_change.geometry import estimate_normals
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.visibility_evidence import EvidenceConfig, make_observer
from subiaco_evaluation.injection.config import InjectionConfig, RepeatConfig
from subiaco_evaluation.injection.edits import Edited
from subiaco_geo.clouds import PointCloud, unpack_voxel_keys, voxel_indices, voxel_keys
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.visibility import NO_VERDICT, VisibilityGrid

_SURFACE = 0.8  # radius in which a surface has its direction [m]
_NEIGHBOURS = 8  # points between which other ones lie


def with_truth(cloud: PointCloud, edited: Edited) -> PointCloud:
    """Truth of the map's own points; what the copy cannot see is 255."""
    change = edited.change.copy()
    change[edited.hidden & ~edited.gone] = Change.UNOBSERVED
    return cloud.with_fields(object=edited.object_id, semantic=edited.semantic, change=change)


def second_pass(survey: SurveyMap, cloud: PointCloud, edited: Edited) -> SurveyMap:
    """Return the copy as a second drive would map it: other points, other noise, other shadows."""
    stays = np.flatnonzero(~edited.gone & ~edited.hidden)
    lifted = cloud.xyz[stays] + np.column_stack([np.zeros((len(stays), 2)), edited.rise[stays]])
    xyz = np.concatenate([lifted, *(p.xyz for p in edited.put)])
    source = np.concatenate([stays, *(p.source for p in edited.put)])
    observer = make_observer(survey, EvidenceConfig())
    truths = [np.full(len(p.xyz), p.change, dtype=np.uint8) for p in edited.put]
    for put, truth in zip(edited.put, truths, strict=True):
        truth[~observer.observed(put.xyz + cloud.origin)] = Change.UNOBSERVED
    fields = {name: _from(values, source) for name, values in cloud.fields.items()}
    fields |= {
        "object": np.concatenate(
            [edited.object_id[stays], *(np.full(len(p.xyz), p.object_id) for p in edited.put)]
        ),
        "semantic": np.concatenate(
            [edited.semantic[stays], *(np.full(len(p.xyz), p.semantic, np.uint8) for p in edited.put)]
        ),
        "change": np.concatenate([edited.change[stays], *truths]),
    }
    chosen, moved = resampled(xyz, fields, edited.config, edited.random)
    fields = {name: values[chosen] for name, values in fields.items()}
    visibility = (
        None if survey.visibility is None else edit_visibility(survey.visibility, cloud.origin, edited)
    )
    return replace(
        survey, cloud=PointCloud(moved, cloud.origin, cloud.crs, fields), visibility=visibility, last=None
    )


def _from(values: NDArray[Any], source: Ints) -> NDArray[Any]:
    """Take field values of the points that new ones come from, the median where there is none."""
    taken = values[np.maximum(source, 0)].copy()
    if (source < 0).any():
        taken[source < 0] = np.median(values, axis=0).astype(values.dtype)
    return taken


def resampled(
    xyz: Floats, fields: Mapping[str, NDArray[Any]], config: InjectionConfig, random: np.random.Generator
) -> tuple[Ints, Floats]:
    """Let beams fall elsewhere, on the same surfaces.

    A voxel that ``n`` beams hit is missed with probability ``(1 - again) ** (n g)``, with ``g`` about one
    and the same for a whole place; as many others are hit instead, between voxels of the same kind. What
    is kept moves by the chance of where in the voxel its beams fall, along its surface, and by its noise
    in all directions. Foliage shows other leaves, between those that were seen: its outline stays.

    Parameters
    ----------
    xyz : (N, 3) float64
        The edited map.
    fields : mapping
        ``semantic``; ``n`` and ``spread`` where the map has them.
    config : InjectionConfig
    random : numpy.random.Generator

    Returns
    -------
    chosen : (M,) int64
        Which points the second pass has, some twice.
    moved : (M, 3) float64
        Where [m].
    """
    repeat = config.repeat
    count = np.maximum(np.asarray(fields.get("n", np.full(len(xyz), repeat.beams)), np.float64), 1.0)
    missed = random.random(len(xyz)) < (1.0 - repeat.again) ** (count * _beams(xyz, repeat, random))
    chance = (1.0 - repeat.again) ** count
    kept = np.flatnonzero(~missed)
    new = random.choice(len(xyz), int(missed.sum()), p=chance / chance.sum()) if missed.any() else kept[:0]
    chosen = np.concatenate([kept, new])
    leafy = np.asarray(fields["semantic"])[chosen] == Semantic.VEGETATION
    between = np.flatnonzero(leafy | (np.arange(len(chosen)) >= len(kept)))
    moved = xyz[chosen]
    moved[between] += _between(xyz, chosen[between], config, random)
    reach = repeat.wander * config.leaf / np.sqrt(12.0 * count[chosen])
    step = random.normal(size=(len(chosen), 3)) * np.where(leafy, 0.0, reach)[:, None]
    normal = estimate_normals(xyz, _SURFACE)[chosen]
    step -= normal * np.einsum("ij,ij->i", step, normal)[:, None]
    noise = _noise(fields, count, repeat)[chosen, None] * random.normal(size=(len(chosen), 3))
    return chosen, moved + step + noise


def _beams(xyz: Floats, repeat: RepeatConfig, random: np.random.Generator) -> Floats:
    """Return how many beams (N,) a second pass sends for each of the first: another lane, other shadows."""
    if not np.isfinite(repeat.uneven):
        return np.ones(len(xyz))
    _, place = np.unique(voxel_keys(voxel_indices(xyz, repeat.place)), return_inverse=True)
    share = random.gamma(repeat.uneven, 1.0 / repeat.uneven, int(place.max()) + 1)
    return np.asarray(share[place.ravel()])


def _between(xyz: Floats, points: Ints, config: InjectionConfig, random: np.random.Generator) -> Floats:
    """Return steps (K, 3) from points towards one of their neighbours each, and as often away from it."""
    reach = config.repeat.foliage
    distance, neighbours = cKDTree(xyz).query(
        xyz[points], k=_NEIGHBOURS + 1, distance_upper_bound=3.0 * config.leaf
    )
    pick = random.integers(1, _NEIGHBOURS + 1, len(points))
    rows = np.arange(len(points))
    alone = ~np.isfinite(distance[rows, pick])
    other = np.where(alone, points, neighbours[rows, pick])
    share = random.uniform(-1.0, 1.0, len(points)) * reach / np.maximum(distance[rows, pick], 1e-6)
    return np.asarray(np.clip(share, -1.0, 1.0)[:, None] * (xyz[other] - xyz[points]))


def _noise(fields: Mapping[str, NDArray[Any]], count: Floats, repeat: RepeatConfig) -> Floats:
    """Return the standard error of every point [m], from the spread of its voxel where the map has it."""
    if "spread" not in fields:
        return np.full(len(count), repeat.sigma)
    return np.maximum(np.asarray(fields["spread"], dtype=np.float64) / np.sqrt(count), repeat.sigma)


def edit_visibility(grid: VisibilityGrid, origin: Floats, edited: Edited) -> VisibilityGrid:
    """Return the visibility layer of the copy.

    Beams pass where an object was removed and end where an object was inserted; places behind an
    inserted object are occluded. Places that a removed object occluded stay unobserved.
    """

    def keys_of(local: Floats) -> Ints:
        return np.unique(voxel_keys(voxel_indices(local + origin - grid.origin, grid.voxel)))

    hits, passes = grid.hits.copy(), grid.passes.copy()
    stays = np.concatenate([edited.xyz[~edited.gone], *(p.xyz for p in edited.put)])
    empty = np.isin(grid.keys, np.setdiff1d(keys_of(edited.xyz[edited.gone]), keys_of(stays)))
    passes[empty] += hits[empty]
    hits[empty] = 0
    shadow = _shadow(voxel_centres(grid) - origin, edited)
    full = np.isin(grid.keys, keys_of(np.concatenate([p.xyz for p in edited.put]))) if edited.put else shadow
    hits[full] = np.maximum(hits[full], np.maximum(passes[full], 1))
    passes[full] = 0
    kept = ~shadow | full
    moving = None if grid.moving is None else grid.moving.copy()
    if moving is not None:
        moving[empty], moving[full] = NO_VERDICT, 0
        moving = moving[kept]
    return VisibilityGrid(grid.origin, grid.voxel, grid.keys[kept], hits[kept], passes[kept], moving)


def _shadow(centres: Floats, edited: Edited) -> Mask:
    """Tell which places (M, 3) are not seen any more past what was put."""
    lines = edited.sight.lines(centres)
    blocked = np.zeros(len(lines.point), dtype=bool)
    for put in edited.put:
        if len(put.fresh):
            blocked |= edited.sight.blocked(lines, centres, put.fresh)
    return lines.hidden(blocked)


def voxel_centres(grid: VisibilityGrid) -> Floats:
    """World coordinates (M, 3) of the middles of the voxels [m]."""
    return np.asarray(grid.origin + (unpack_voxel_keys(grid.keys) + 0.5) * grid.voxel)
