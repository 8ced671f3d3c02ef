"""Instances that are separate in one epoch and merged in the other: split in both."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.association.costs import AssociationConfig
from subiaco_change.decisions.column_volumes import column_keys
from subiaco_change.decisions.voxel_objects import ObjectInstance
from subiaco_change.instance_splitting.one_epoch_parts import PartConfig, split_by_labels
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.segmentation.clustering import connect, group_indices, voxel_clusters
from subiaco_geo.frames import Ints

_CELL = NUMBERS.merged_instances.cell

#: The objects of *before* and of *after* that are one piece.
Piece = tuple[tuple[ObjectInstance, ...], tuple[ObjectInstance, ...]]


def split_by_bodies(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    config: AssociationConfig,
    following: int,
) -> list[Piece]:
    """Divide a match into the bodies that one of the epochs holds apart; one piece where there are none.

    Parameters
    ----------
    before, after : sequence of ObjectInstance
        The parts of one match.
    config : AssociationConfig
    following : int
        First free instance number: pieces of a divided instance need their own.

    Returns
    -------
    list of (before, after)
        Things that are no body of their own (too small, or above or below
        another) join the nearest body.
    """
    sides = (tuple(before), tuple(after))
    bodies = [separate_bodies(side, config) for side in sides]
    leader = int(len(bodies[1]) > len(bodies[0]))
    if len(bodies[leader]) < 2:
        return [sides]
    groups = bodies[leader]
    owner = np.repeat(np.arange(len(groups)), [sum(len(t.voxels) for t in group) for group in groups])
    places = np.concatenate([t.voxels.xyz for group in groups for t in group])
    tree, built = cKDTree(places), np.unique(column_keys(places, _CELL))
    found: list[tuple[list[ObjectInstance], list[ObjectInstance]]] = [([], []) for _ in groups]
    for epoch, side in enumerate(sides):
        for obj in side:
            nearest = owner[tree.query(obj.voxels.xyz)[1]]
            if epoch == leader:
                nearest[:] = np.bincount(nearest).argmax()
            else:
                nearest = _undivided(obj, nearest, built, config.parts)
            for number, piece in _along(obj, nearest, following):
                found[number][epoch].append(piece)
            following += len(groups)
    return [(tuple(b), tuple(a)) for b, a in found]


def _undivided(obj: ObjectInstance, owner: Ints, built: Ints, config: PartConfig) -> Ints:
    """Give every connected part beside the bodies, which the other epoch lacks, to one body (M,).

    A wing that closes the gap between two houses is one wing, of the house that is next to most of it.
    ``built``: columns of all bodies.
    """
    voxels = obj.voxels
    beside = ~np.isin(column_keys(voxels.xyz, _CELL), built)
    alone = np.flatnonzero(voxels.observed & ~voxels.occupied_in_other & beside)
    whole = owner.copy()
    for group in group_indices(voxel_clusters(voxels.xyz[alone], config.gap)) if len(alone) else ():
        whole[alone[group]] = np.bincount(owner[alone[group]]).argmax()
    return whole


def _along(obj: ObjectInstance, owner: Ints, following: int) -> list[tuple[int, ObjectInstance]]:
    """Divide an instance by the body (M,) that its voxels belong to."""
    numbers, labels = np.unique(owner, return_inverse=True)
    return list(zip(numbers.tolist(), split_by_labels(obj, labels, following), strict=True))


def separate_bodies(
    objects: Sequence[ObjectInstance], config: AssociationConfig
) -> list[list[ObjectInstance]]:
    """Group the objects of one epoch that are large enough into bodies that stand side by side."""
    total = sum(len(t.voxels) for t in objects)
    large = [t for t in objects if len(t.voxels) >= config.apart * total]
    if len(large) < 2:
        return [list(large)]
    columns = [np.unique(column_keys(t.voxels.xyz, _CELL)) for t in large]
    links = [
        (i, j)
        for i in range(len(large))
        for j in range(i)
        if len(np.intersect1d(columns[i], columns[j]))
        > config.stacked * min(len(columns[i]), len(columns[j]))
    ]
    joined = connect(len(large), np.array(links, dtype=np.int64).reshape(-1, 2))
    return [[large[k] for k in group] for group in group_indices(joined)]
