"""The lane that a survey vehicle drove through: what one epoch alone holds there is seldom a lasting change.

A vehicle of a queue that stood while a survey passed has the beams of a standing object. Whether it lasts
cannot be seen in one epoch. The survey vehicle itself tells: where it drove, the place is carriageway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.dynamic_objects import Observed, fits_a_vehicle
from subiaco_change.decisions.rules import Decision
from subiaco_change.decisions.voxel_objects import ObjectInstance
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import switchable
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats

_HALF_WIDTH = NUMBERS.driven_lane.half_width
_BEYOND = NUMBERS.driven_lane.beyond
_GAP = NUMBERS.driven_lane.gap
_BELOW = NUMBERS.driven_lane.sensor_height
_SHARE = NUMBERS.driven_lane.share
_STEP = NUMBERS.driven_lane.step
_HEADING = NUMBERS.driven_lane.heading_length


@dataclass(frozen=True)
class SurveyPath:
    """Positions (K, 3) of the sensor of one epoch in the world, in the order of the drive [m]."""

    positions: Floats


class DrivenLane:
    """Strip of ground that the vehicle of one survey drove over, and a little beyond both ends of the drive.

    Parameters
    ----------
    positions : (K, 3) float64
        Of the sensor, in the order of the drive [m].
    """

    def __init__(self, positions: Floats) -> None:
        self._path = _densified(positions)
        self._tree = cKDTree(self._path[:, :2])

    def covers(self, xyz: Floats) -> Mask:
        """Tell which places (N, 3), in the frame of the positions, lie in the lane and below the sensor."""
        if len(self._path) == 0 or len(xyz) == 0:
            return np.zeros(len(xyz), dtype=bool)
        distance, slot = self._tree.query(xyz[:, :2], distance_upper_bound=_HALF_WIDTH)
        near = np.isfinite(distance)
        near[near] = np.abs(xyz[near, 2] - self._path[slot[near], 2]) <= _BELOW
        return near


def lane_near(path: SurveyPath, world: Floats) -> DrivenLane:
    """Return the lane along that part of a path that lies near points (N, 3) of the world."""
    nodes = path.positions
    if len(world) == 0:
        return DrivenLane(nodes[:0])
    low, high = world[:, :2].min(axis=0) - 2 * _BEYOND, world[:, :2].max(axis=0) + 2 * _BEYOND
    return DrivenLane(nodes[((nodes[:, :2] >= low) & (nodes[:, :2] <= high)).all(axis=1)])


def _densified(positions: Floats) -> Floats:
    """Points (M, 3) along a path a small step apart, its ends prolonged; gaps of the path stay open."""
    if len(positions) < 2:
        return positions
    nodes = np.concatenate([_prolonged(positions[::-1])[None], positions, _prolonged(positions)[None]])
    length = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
    length[1:-1][length[1:-1] > _GAP] = 0.0  # nothing is known of what lies between
    count = np.maximum(np.ceil(length / _STEP).astype(np.int64), 1)
    first = np.repeat(np.arange(len(count)), count)
    part = (np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)) / count[first]
    along = nodes[first] + part[:, None] * np.diff(nodes, axis=0)[first]
    return np.concatenate([along, nodes[-1:]])


def _prolonged(nodes: Floats) -> Floats:
    """Point (3,) ahead of the end of a path, in the direction of its last metres."""
    back = np.linalg.norm(nodes[:, :2] - nodes[-1, :2], axis=1)
    far = np.flatnonzero(back >= _HEADING)
    if len(far) == 0:
        return np.asarray(nodes[-1])
    ahead = nodes[-1] - nodes[far[-1]]
    return np.asarray(nodes[-1] + _BEYOND * ahead / np.linalg.norm(ahead[:2]))


def share_in_lane(objects: Sequence[ObjectInstance], lanes: Sequence[Observed]) -> float:
    """Largest fraction of the points of objects in one of the lanes, each asked by places (N, 3)."""
    places = np.concatenate([np.zeros((0, 3)), *(t.xyz for t in objects)])
    return max((float(lane(places).mean()) for lane in lanes), default=0.0) if len(places) else 0.0


def _unlimited(_: object, __: float, confidence: float, reason: str, *___: object) -> tuple[float, str]:
    """Return the confidence and the reason as they are."""
    return confidence, reason


@switchable("claim_in_driven_lane", _unlimited)
def limit_in_lane(
    change: Change, share: float, confidence: float, reason: str, rules: DecisionConfig
) -> tuple[float, str]:
    """Return the confidence in a claim and its reason, limited where ``share`` of its points is in a lane."""
    single = change in (Change.ADDED, Change.REMOVED)
    if not single or share < _SHARE or confidence <= rules.lane_confidence:
        return confidence, reason
    doubt = f"{share:.0%} of the object lies in the lane that a survey vehicle drove through (limit"
    doubt += f" {_SHARE:.0%}): it may be a vehicle of the traffic, and the confidence is lowered."
    return rules.lane_confidence, f"{reason} {doubt}"


def lane_share_of_claim(
    decision: Decision, objects: Sequence[ObjectInstance], lanes: Sequence[Observed], rules: DecisionConfig
) -> float:
    """Fraction of a claim of one epoch that lies in a driven lane; 0 for what is higher than vehicles."""
    if decision.change not in (Change.ADDED, Change.REMOVED) or not lanes:
        return 0.0
    return share_in_lane(objects, lanes) if fits_a_vehicle(objects, rules) else 0.0
