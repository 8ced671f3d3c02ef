"""The edited map as a second drive would have made it: other points, other noise, other shadows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.injection.config import RepeatConfig
from subiaco_change.injection.edits import Edited
from subiaco_change.observation.evidence import EvidenceConfig, make_observer
from subiaco_geo.clouds import PointCloud, unpack_voxel_keys, voxel_indices, voxel_keys
from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.maps import SurveyMap
from subiaco_geo.visibility import VisibilityGrid


def with_truth(cloud: PointCloud, edited: Edited) -> PointCloud:
    """Truth of the map's own points; what the copy cannot see is 255."""
    change = edited.change.copy()
    change[edited.hidden & ~edited.gone] = Change.UNOBSERVED
    return cloud.with_fields(object=edited.object_id, semantic=edited.semantic, change=change)


def second_pass(survey: SurveyMap, cloud: PointCloud, edited: Edited) -> SurveyMap:
    """Return the copy as a second drive would map it: other points, other noise, other shadows."""
    kept = np.flatnonzero(~edited.gone & ~edited.hidden)
    kept = kept[edited.random.random(len(kept)) < edited.config.repeat.keep]
    lifted = cloud.xyz[kept] + np.column_stack([np.zeros((len(kept), 2)), edited.rise[kept]])
    xyz = np.concatenate([lifted, *(p.xyz for p in edited.put)])
    source = np.concatenate([kept, *(p.source for p in edited.put)])
    observer = make_observer(survey, EvidenceConfig())
    truths = [np.full(len(p.xyz), p.change, dtype=np.uint8) for p in edited.put]
    for put, truth in zip(edited.put, truths, strict=True):
        truth[~observer.observed(put.xyz + cloud.origin)] = Change.UNOBSERVED
    fields = {name: _from(values, source) for name, values in cloud.fields.items()}
    fields |= {
        "object": np.concatenate(
            [edited.object_id[kept], *(np.full(len(p.xyz), p.object_id) for p in edited.put)]
        ),
        "semantic": np.concatenate(
            [edited.semantic[kept], *(np.full(len(p.xyz), p.semantic, np.uint8) for p in edited.put)]
        ),
        "change": np.concatenate([edited.change[kept], *truths]),
    }
    noise = _noise(cloud, source, edited.config.repeat)
    xyz = xyz + noise[:, None] * edited.random.normal(size=(len(xyz), 3))
    visibility = (
        None if survey.visibility is None else edit_visibility(survey.visibility, cloud.origin, edited)
    )
    return replace(
        survey, cloud=PointCloud(xyz, cloud.origin, cloud.crs, fields), visibility=visibility, last=None
    )


def _from(values: NDArray[Any], source: Ints) -> NDArray[Any]:
    """Take field values of the points that new ones come from, the median where there is none."""
    taken = values[np.maximum(source, 0)].copy()
    if (source < 0).any():
        taken[source < 0] = np.median(values, axis=0).astype(values.dtype)
    return taken


def _noise(cloud: PointCloud, source: Ints, repeat: RepeatConfig) -> Floats:
    """Return the standard error of every point [m], from the spread of its voxel where the map has it."""
    if "spread" not in cloud.fields or "n" not in cloud.fields:
        return np.full(len(source), repeat.sigma)
    spread = np.asarray(cloud.fields["spread"], dtype=np.float64)
    count = np.maximum(np.asarray(cloud.fields["n"], dtype=np.float64), 1.0)
    return np.where(source >= 0, np.maximum(spread / np.sqrt(count), repeat.sigma)[source], repeat.sigma)


def edit_visibility(grid: VisibilityGrid, origin: Floats, edited: Edited) -> VisibilityGrid:
    """Return the visibility layer of the copy.

    Where something was taken away beams pass now; where something stands they
    end; what stands behind it is not seen. What a removed thing hid stays unseen.
    """

    def keys_of(local: Floats) -> Ints:
        return np.unique(voxel_keys(voxel_indices(local + origin - grid.origin, grid.voxel)))

    hits, passes = grid.hits.copy(), grid.passes.copy()
    stays = np.concatenate([edited.xyz[~edited.gone], *(p.xyz for p in edited.put)])
    empty = np.isin(grid.keys, np.setdiff1d(keys_of(edited.xyz[edited.gone]), keys_of(stays)))
    passes[empty] += hits[empty]
    hits[empty] = 0
    centres = (voxel_centres(grid) - origin) if edited.put else np.empty((0, 3))
    shadow = np.zeros(len(grid.keys), dtype=bool)
    for put in edited.put:
        shadow |= edited.sight.hidden(centres, put.xyz)
    full = np.isin(grid.keys, keys_of(np.concatenate([p.xyz for p in edited.put]))) if edited.put else shadow
    hits[full] = np.maximum(hits[full], np.maximum(passes[full], 1))
    passes[full] = 0
    kept = ~shadow | full
    return VisibilityGrid(grid.origin, grid.voxel, grid.keys[kept], hits[kept], passes[kept])


def voxel_centres(grid: VisibilityGrid) -> Floats:
    """World coordinates (M, 3) of the middles of the voxels [m]."""
    return np.asarray(grid.origin + (unpack_voxel_keys(grid.keys) + 0.5) * grid.voxel)
