"""Recordings without GNSS, placed by streets that they share with placed ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from subiaco_geo.frames import Floats, invert_pose
from subiaco_mapping.loop_closure.consistency import consistent_set
from subiaco_mapping.loop_closure.finder import LoopFinder, edge_of
from subiaco_mapping.loop_closure.places import LoopCandidate, SubmapPlace
from subiaco_mapping.pose_graph.records import LoopEdge


def join(
    finder: LoopFinder, places: Sequence[SubmapPlace], T_odom_lidar: dict[int, Floats]
) -> tuple[int, Floats, list[LoopEdge]] | None:
    """Place one more chain, the one with most consistent loops.

    Parameters
    ----------
    finder : LoopFinder
    places : sequence of SubmapPlace
        Of all chains; those not placed have no pose.
    T_odom_lidar : dict of int to (S, 4, 4) float64
        Odometry of the chains that are not placed.

    Returns
    -------
    tuple or None
        The chain, its ``T_world_odom``, and the loops that say so; None where no chain has
        ``min_joining`` loops that agree.
    """
    across = [c for c in finder.by_descriptor(places) if (c.first.pose is None) != (c.second.pose is None)]
    finder.counts = Counter(proposed_by_descriptor=len(across))
    found = finder.verified(across)
    best: tuple[int, Floats, list[LoopEdge]] | None = None
    for chain, odometry in T_odom_lidar.items():
        own = [(c, r) for c, r in found if chain in (c.first.key[0], c.second.key[0])]
        if not own:
            continue
        placements = [_placement(c, r.T_target_source, odometry) for c, r in own]
        anchors = np.array([odometry[_free(c).submap.anchor, :3, 3] for c, _ in own])
        chosen = consistent_set(placements, anchors)
        if len(chosen) >= finder.config.min_joining and (best is None or len(chosen) > len(best[2])):
            middle = chosen[len(chosen) // 2]
            best = chain, placements[middle], [edge_of(*own[k]) for k in chosen]
    return best


def _free(candidate: LoopCandidate) -> SubmapPlace:
    return candidate.first if candidate.first.pose is None else candidate.second


def _placement(candidate: LoopCandidate, T_first_second: Floats, odometry: Floats) -> Floats:
    first, second = candidate.first, candidate.second
    if second.pose is None:
        assert first.pose is not None
        T_world_lidar = first.pose @ T_first_second
    else:
        T_world_lidar = second.pose @ invert_pose(T_first_second)
    return np.asarray(T_world_lidar @ invert_pose(odometry[_free(candidate).submap.anchor]))
