"""Number of voxels that two objects share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from subiaco_change.decisions.voxel_objects import ObjectInstance
from subiaco_geo.frames import Floats, Ints

#: A scipy sparse array; scipy has no types.
Sparse = Any


def overlap_counts(
    before: Sequence[ObjectInstance], after: Sequence[ObjectInstance], tolerance: float
) -> tuple[Sparse, Sparse]:
    """Count voxels of every object whose nearest voxel of the other epoch is in each object there.

    Parameters
    ----------
    before, after : sequence of ObjectInstance
    tolerance : float
        Voxels farther apart do not overlap [m].

    Returns
    -------
    forward, backward : (B, A) and (A, B) sparse arrays
        Of voxels of *before* in *after*, and the other way round.
    """
    first, second = _stack(before), _stack(after)
    shape = (len(before), len(after))
    return (
        _nearest_counts(first, second, shape, tolerance),
        _nearest_counts(second, first, shape[::-1], tolerance),
    )


def _stack(objects: Sequence[ObjectInstance]) -> tuple[Floats, Ints]:
    if not objects:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    owner = np.repeat(np.arange(len(objects)), [len(t.voxels) for t in objects])
    return np.concatenate([t.voxels.xyz for t in objects]), owner


def _nearest_counts(
    source: tuple[Floats, Ints], target: tuple[Floats, Ints], shape: tuple[int, int], tolerance: float
) -> Sparse:
    if len(source[0]) == 0 or len(target[0]) == 0:
        return coo_array(shape).tocsr()
    distance, slot = cKDTree(target[0]).query(source[0], distance_upper_bound=tolerance)
    hit = np.isfinite(distance)
    pairs = (source[1][hit], target[1][slot[hit]])
    return coo_array((np.ones(int(hit.sum())), pairs), shape=shape).tocsr()
