"""The lane that a survey vehicle drove through: what one epoch alone holds there is seldom a lasting change.

A vehicle of a queue that stood while a survey passed has the beams of a standing object. Whether it lasts
cannot be seen in one epoch. The survey vehicle itself tells: where it drove, the place is carriageway.
No traffic crosses a standing object there: where mapping recorded moving objects in most columns of an object
in the lane, the object was a vehicle too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from shapely import MultiPoint, contains_xy

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.dynamic_objects import Moved, Observed, fits_a_vehicle
from subiaco_change.decisions.rules import Decision
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import no_decision, switchable
from subiaco_change.objects.voxel_objects import ObjectInstance
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import ONE_EPOCH, Change
from subiaco_geo.frames import Floats

_HALF_WIDTH = NUMBERS.driven_lane.half_width
_BEYOND = NUMBERS.driven_lane.beyond
_GAP = NUMBERS.driven_lane.gap
_BELOW = NUMBERS.driven_lane.sensor_height
_SHARE = NUMBERS.driven_lane.share
_STEP = NUMBERS.driven_lane.step
_HEADING = NUMBERS.driven_lane.heading_length
_CURVE = NUMBERS.driven_lane.curve_length
_RADIUS = NUMBERS.driven_lane.least_radius
_APART = NUMBERS.driven_lane.positions_apart
_GRID = NUMBERS.driven_lane.footprint_step
_CROSSED = NUMBERS.driven_lane.crossed_share
_COLUMN = NUMBERS.driven_lane.crossed_column
_SURE = NUMBERS.driven_lane.crossed_probability


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
    behind, ahead = _prolonged(positions[::-1]), _prolonged(positions)
    nodes = np.concatenate([behind[::-1], positions, ahead])
    length = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
    inside = slice(len(behind), len(nodes) - len(ahead) - 1)
    length[inside] = np.where(length[inside] > _GAP, 0.0, length[inside])  # what lies between is not known
    count = np.maximum(np.ceil(length / _STEP).astype(np.int64), 1)
    first = np.repeat(np.arange(len(count)), count)
    part = (np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)) / count[first]
    along = nodes[first] + part[:, None] * np.diff(nodes, axis=0)[first]
    return np.concatenate([along, nodes[-1:]])


def _prolonged(nodes: Floats) -> Floats:
    """Points (M, 3) ahead of the end of a path, on the arc of its last metres; none without a direction.

    A bend narrower than those of a carriageway is a turn at a junction: the path goes straight on.
    """
    end = _last_metres(nodes)
    last, turned = _heading(end, 0.0), _heading(end, _CURVE)
    if last is None:
        return nodes[:0]
    curve = 0.0
    if turned is not None:
        curve = float(np.arctan2(turned[0] * last[1] - turned[1] * last[0], turned @ last)) / _CURVE
    at_end = 0.5 * _HEADING * curve  # the direction is that of the middle of the last metres
    ahead = np.arange(_STEP, _BEYOND + 0.5 * _STEP, _STEP)
    turn = at_end + (curve * ahead if abs(curve) * _RADIUS <= 1.0 else 0.0 * ahead)
    step = np.column_stack([np.cos(turn), np.sin(turn)])
    xy = _STEP * np.column_stack([step @ [last[0], -last[1]], step @ [last[1], last[0]]]).cumsum(axis=0)
    return np.asarray(nodes[-1] + np.column_stack([xy, np.zeros(len(xy))]))


def _last_metres(nodes: Floats) -> Floats:
    """Positions (M, 2) of the end of a path up to its last gap, the last first, apart.

    A vehicle that waits has no direction, nor is one known across a gap.
    """
    kept = [nodes[-1, :2]]
    for node in nodes[-2::-1, :2]:
        step = np.linalg.norm(node - kept[-1])
        if step > _GAP:
            break
        if step >= _APART:
            kept.append(node)
            if len(kept) * _APART > 2.0 * (_CURVE + _HEADING):
                break
    return np.array(kept)


def _heading(end: Floats, back: float) -> Floats | None:
    """Direction (2,) over a few metres of positions (M, 2), the last first, so far before the last [m]."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(end, axis=0), axis=1))])
    if way[-1] < back + _HEADING:
        return None
    places = np.column_stack([np.interp([back, back + _HEADING], way, end[:, k]) for k in range(2)])
    step = places[0] - places[1]
    length = float(np.linalg.norm(step))
    return step / length if length > 0 else None


def share_in_lane(objects: Sequence[ObjectInstance], lanes: Sequence[Observed]) -> float:
    """Largest fraction of the footprint of objects in one of the lanes, each asked by places (N, 3)."""
    xyz = np.concatenate([np.zeros((0, 3)), *(t.xyz for t in objects)])
    if len(xyz) == 0 or not lanes:
        return 0.0
    places = _footprint(xyz)
    return max(float(lane(places).mean()) for lane in lanes)


def _footprint(xyz: Floats) -> Floats:
    """Places (M, 3) that fill the footprint of points (N, 3) at their middle height.

    A survey sees one or two sides of a vehicle: most of its points lie at the rim of its footprint.
    """
    middle = float(np.median(xyz[:, 2]))
    hull = MultiPoint(xyz[:, :2]).convex_hull
    low, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    x, y = (np.arange(a + 0.5 * _GRID, b, _GRID) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside = grid[contains_xy(hull, grid[:, 0], grid[:, 1])] if len(grid) else grid
    xy = inside if len(inside) else xyz[:, :2]
    return np.column_stack([xy, np.full(len(xy), middle)])


def crossed_share(objects: Sequence[ObjectInstance], moved: Moved) -> float:
    """Fraction of the columns of objects in which mapping recorded a moving object, no higher than they are.

    ``moved``: how probable it is that what their own survey found at places (N, 3) moved.
    """
    xyz = np.concatenate([t.xyz for t in objects])
    columns = np.unique(np.floor(xyz[:, :2] / _COLUMN).astype(np.int64), axis=0)
    heights = np.arange(xyz[:, 2].min(), xyz[:, 2].max() + _COLUMN, _COLUMN)
    xy = np.repeat((columns + 0.5) * _COLUMN, len(heights), axis=0)
    places = np.column_stack([xy, np.tile(heights, len(columns))])
    return float((moved(places) >= _SURE).reshape(len(columns), -1).any(axis=1).mean())


@switchable("lane_crossed_by_traffic", no_decision)
def decide_in_traffic(
    objects: Sequence[ObjectInstance], lanes: Sequence[Observed], moved: Moved | None, rules: DecisionConfig
) -> Decision | None:
    """Decide what one epoch alone holds in a driven lane, in columns that moving objects crossed.

    Nothing that stands in the lane is crossed; the side of a standing object may share its columns with
    traffic beside it.
    """
    if moved is None or not fits_a_vehicle(objects, rules):
        return None
    share = share_in_lane(objects, lanes)
    crossed = crossed_share(objects, moved) if share >= _SHARE else 0.0
    if crossed < _CROSSED:
        return None
    reason = f"{share:.0%} of the object lies in the lane that a survey vehicle drove through, and moving"
    reason += f" objects crossed {crossed:.0%} of its place while it was mapped (limit {_CROSSED:.0%}): a"
    return Decision(Change.NOT_REPORTED, f"{reason} vehicle of the traffic.", crossed / _CROSSED)


def _unlimited(_: object, __: float, confidence: float, reason: str, *___: object) -> tuple[float, str]:
    """Return the confidence and the reason as they are."""
    return confidence, reason


@switchable("claim_in_driven_lane", _unlimited)
def limit_in_lane(
    change: Change, share: float, confidence: float, reason: str, rules: DecisionConfig
) -> tuple[float, str]:
    """Return the confidence in a claim and its reason, limited where ``share`` of its points is in a lane."""
    single = change in ONE_EPOCH
    if not single or share < _SHARE or confidence <= rules.lane_confidence:
        return confidence, reason
    doubt = f"{share:.0%} of the object lies in the lane that a survey vehicle drove through (limit"
    doubt += f" {_SHARE:.0%}): it may be a vehicle of the traffic, and the confidence is lowered."
    return rules.lane_confidence, f"{reason} {doubt}"


def lane_share_of_claim(
    decision: Decision, objects: Sequence[ObjectInstance], lanes: Sequence[Observed], rules: DecisionConfig
) -> float:
    """Fraction of a claim of one epoch that lies in a driven lane; 0 for what is higher than vehicles."""
    if decision.change not in ONE_EPOCH or not lanes:
        return 0.0
    return share_in_lane(objects, lanes) if fits_a_vehicle(objects, rules) else 0.0
