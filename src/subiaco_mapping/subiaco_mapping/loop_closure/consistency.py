"""Consistency of a loop with the present estimate and with other loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import Floats, invert_pose
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.pose_graph.records import LoopEdge

if TYPE_CHECKING:
    from subiaco_mapping.loop_closure.places import SubmapPlace

PAIR_SLACK = NUMBERS.loop_closure.pair_distance
PAIR_DRIFT = NUMBERS.loop_closure.pair_drift
PAIR_TURN = np.radians(NUMBERS.loop_closure.pair_turn_deg)


def reach_of(place: SubmapPlace) -> float:
    """Return three sigma of a place's horizontal position [m]."""
    return 3.0 * float(np.sqrt(np.linalg.eigvalsh(place.covariance[3:5, 3:5])[-1]))


def _twist(pose: Floats) -> Floats:
    return np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3]])


def disagreement(edge: LoopEdge, first: SubmapPlace, second: SubmapPlace) -> float:
    """Return the chi-square (6 degrees of freedom) between a loop and the present estimate.

    The covariances of both poses are added as if they were independent, and the first's rotation is
    carried over the distance: an estimate that shares errors is more certain than that, so that true
    loops pass.
    """
    assert first.pose is not None
    assert second.pose is not None
    error = _twist(invert_pose(edge.T_first_second) @ invert_pose(first.pose) @ second.pose)
    turn = np.kron(np.eye(2), second.pose[:3, :3].T)
    arm = float(np.sum((second.pose[:3, 3] - first.pose[:3, 3]) ** 2))
    carried = np.zeros((6, 6))
    carried[3:, 3:] = np.eye(3) * arm * np.linalg.eigvalsh(first.covariance[:3, :3])[-1]
    own = turn @ (first.covariance + second.covariance) @ turn.T
    return float(error @ np.linalg.solve(own + carried + edge.covariance, error))


def consistent_set(placements: Sequence[Floats], anchors: Floats) -> list[int]:
    """Return the largest set of loops found that agree pairwise on where a sequence lies.

    Parameters
    ----------
    placements : sequence of (4, 4) float64
        ``T_world_odom`` of the sequence after each loop.
    anchors : (N, 3) float64
        Where in its odometry frame each loop acts [m].
    """
    count = len(placements)
    agree = np.eye(count, dtype=np.bool_)
    for i in range(count):
        for j in range(i):
            agree[i, j] = agree[j, i] = _agree(placements[i], placements[j], anchors[i], anchors[j])
    best: list[int] = []
    for start in np.argsort(-agree.sum(axis=1), kind="stable"):
        chosen: list[int] = [int(start)]
        for k in np.argsort(-agree.sum(axis=1), kind="stable"):
            if k not in chosen and agree[k, chosen].all():
                chosen.append(int(k))
        if len(chosen) > len(best):
            best = chosen
    return sorted(best)


def _agree(one: Floats, other: Floats, at_one: Floats, at_other: Floats) -> bool:
    between = invert_pose(one) @ other
    apart = float(np.linalg.norm(at_one - at_other))
    middle = 0.5 * (at_one + at_other)
    shift = between[:3, :3] @ middle + between[:3, 3] - middle
    turn = float(np.linalg.norm(Rotation.from_matrix(between[:3, :3]).as_rotvec()))
    return bool(np.linalg.norm(shift) < PAIR_SLACK + PAIR_DRIFT * apart and turn < PAIR_TURN)
