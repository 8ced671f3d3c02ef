"""Ghost trails of moving objects, distinguished by their shape in clouds without counts of beams.

A vehicle hides the road for a moment, and a standing object for the whole survey: of a trail the ground
beneath was seen, and few points of the sides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.dynamic_objects import OwnEpochEvidence, fits_a_vehicle
from subiaco_change.decisions.rules import Decision
from subiaco_change.geometry import in_box_around
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import never, no_decision, switchable
from subiaco_change.objects.voxel_objects import ObjectInstance, join_voxels
from subiaco_change.segmentation.config import VehicleConfig
from subiaco_change.segmentation.vehicles import has_cabin
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats

_TRAIL_WIDTH = NUMBERS.trail_shapes.trail_width
_ALONE = NUMBERS.trail_shapes.strip_length
_NARROW = NUMBERS.trail_shapes.strip_width
_ROAD = NUMBERS.trail_shapes.road_beneath
_PERSON_WIDTH = NUMBERS.trail_shapes.person_width
_PERSON_TOP = NUMBERS.trail_shapes.person_top
_PERSON_GROUND = NUMBERS.trail_shapes.person_ground
_PERSON_FOOT = NUMBERS.trail_shapes.person_foot
_SEEN_BENEATH = NUMBERS.trail_shapes.ground_beneath
_FILLED = NUMBERS.trail_shapes.opaque_points
_HIDES_NOTHING = NUMBERS.trail_shapes.ground_unhidden
_SIDE = NUMBERS.trail_shapes.side_points
_SHOWN_BENEATH = NUMBERS.trail_shapes.ground_shown
_CELL = NUMBERS.trail_shapes.footprint_cell
_RING = NUMBERS.trail_shapes.ring_cells
_WALKED = NUMBERS.trail_shapes.walked_length
_PIECE = NUMBERS.trail_shapes.piece_reach
_PIECES = 40  # of a strip of which the width is measured


@switchable("strip_on_road", no_decision)
def decide_strip_on_road(
    objects: Sequence[ObjectInstance], own: OwnEpochEvidence | None, rules: DecisionConfig
) -> Decision | None:
    """Tell a strip as wide as a vehicle, and longer, from a hedge or a wall by the road seen beneath it.

    A vehicle hides the road for a moment, a standing object for the whole survey.
    """
    if own is None or own.ground is None or own.ground.n == 0 or not fits_a_vehicle(objects, rules):
        return None
    places = np.concatenate([t.xyz for t in objects])[:, :2]
    length, width = strip_of(places)
    if length < _ALONE or not _NARROW <= width <= _TRAIL_WIDTH:
        return None
    beneath = _road_beneath(places, own.ground.data)
    if beneath < _ROAD:
        return None
    reason = (
        f"The object is a strip {length:.1f} m long and {width:.1f} m wide (limits {_ALONE:g} m and"
        f" {_NARROW:g} to {_TRAIL_WIDTH:g} m), and its own survey saw the ground beneath with"
        f" {beneath:.0%} of the points beside it (limit {_ROAD:.0%}): the ghost trail of a moving vehicle."
    )
    return Decision(Change.NOT_REPORTED, reason, beneath / _ROAD)


@switchable("person_on_the_way", no_decision)
def decide_person_on_the_way(
    objects: Sequence[ObjectInstance], semantic: Semantic, own: OwnEpochEvidence | None
) -> Decision | None:
    """Tell a strip as thin and as tall as a person, in a cloud without counts of beams.

    People walk and cycle, often behind parked cars, which hide their legs. A fence is thinner, most hedges
    are wider and hide the ground; between these, shape does not tell.
    """
    if own is None or own.ground is None or semantic not in (Semantic.VEGETATION, Semantic.OTHER):
        return None
    xyz = np.concatenate([t.xyz for t in objects])
    xy = xyz[:, :2]
    length, width = strip_of(xy)[0], _local_width(xy)
    if not (_PERSON_WIDTH[0] <= width <= _PERSON_WIDTH[1] and length >= _WALKED):
        return None
    foot, top = np.quantile(_heights(xyz, objects), [0.05, 0.95])
    if foot > _PERSON_FOOT or not _PERSON_TOP[0] <= top <= _PERSON_TOP[1]:
        return None
    if _road_beneath(xy, own.ground.data) < _PERSON_GROUND:
        return None
    reason = (
        f"The object is a strip {length:.1f} m long, {width:.1f} m wide and {top:.1f} m high, and the cloud"
        " has no counts of beams: it may be the ghost trail of a pedestrian or cyclist, and nothing is"
        " claimed."
    )
    return Decision(Change.UNOBSERVED, reason, 0.0)


@switchable("cabins_stand", never)
def is_standing_car(objects: Sequence[ObjectInstance], semantic: Semantic, config: VehicleConfig) -> bool:
    """Tell a standing car by its cabin: a moving car leaves its roof along the whole ghost trail."""
    if semantic is not Semantic.MOBILE:
        return False
    xyz = np.concatenate([t.xyz for t in objects])
    return has_cabin(xyz, _heights(xyz, objects), config)


def _heights(xyz: Floats, objects: Sequence[ObjectInstance]) -> Floats:
    """Heights (N,) of points (N, 3) of objects above the ground beneath their voxels [m]."""
    return np.asarray(xyz[:, 2] - join_voxels(objects).ground_near(xyz[:, :2]))


@dataclass(frozen=True)
class Contrast:
    """How an object stands out from the ground beside it; NaN where that is not known.

    ``filled`` and ``beneath``: points of the object, and ground points beneath it, over the ground points on
    an area as large as its footprint. ``side``: points of the object over those on an area as large as its
    longer side.
    """

    filled: float = math.nan
    beneath: float = math.nan
    side: float = math.nan


def contrast_with_ground(
    objects: Sequence[ObjectInstance],
    semantic: Semantic,
    own: OwnEpochEvidence | None,
    rules: DecisionConfig,
) -> Contrast:
    """Compare what may be a vehicle with the ground beside it; not known where beams were counted."""
    if semantic is Semantic.BUILDING or own is None or own.ground is None:
        return Contrast()
    if not fits_a_vehicle(objects, rules):
        return Contrast()
    return _beside_ground(np.concatenate([t.xyz for t in objects]), own.ground.data)


@switchable("hides_no_ground", no_decision)
def decide_by_ground_beneath(found: Contrast) -> Decision | None:
    """Tell what its own survey saw the ground through as if nothing stood there, without counts of beams.

    Whatever stands hides some of the ground beneath it, even a car with clearance that was seen from afar.
    """
    if not (found.filled < _FILLED and found.beneath >= _HIDES_NOTHING):
        return None
    reason = (
        f"The object has {found.filled:.1f} times as many points as the ground beside it on the same area"
        f" (limit {_FILLED:g}), its own survey saw {found.beneath:.0%} of the ground beneath (limit"
        f" {_HIDES_NOTHING:.0%}), and the cloud has no counts of beams: it may be a ghost trail, and nothing"
        " is claimed."
    )
    return Decision(Change.UNOBSERVED, reason, 0.0)


@switchable("shows_no_side", no_decision)
def decide_by_side(found: Contrast) -> Decision | None:
    """Tell what has fewer points than one of its sides would have, on ground that was seen.

    A standing object shows at least the side that faces the sensor, and beams meet an upright surface more
    closely than the ground beside it. Of what passed, a few sweeps met a part here and a part there.
    """
    if not (found.side < _SIDE and found.beneath >= _SHOWN_BENEATH):
        return None
    reason = (
        f"The object has {found.side:.1f} times as many points as the ground beside it has on an area as"
        f" large as a side of the object (limit {_SIDE:g}), its own survey saw {found.beneath:.0%} of the"
        f" ground beneath (limit {_SHOWN_BENEATH:.0%}), and the cloud has no counts of beams: it may be a"
        " ghost trail, and nothing is claimed."
    )
    return Decision(Change.UNOBSERVED, reason, 0.0)


def _no_doubt(*_: object) -> str:
    """Return nothing."""
    return ""


@switchable("ground_shines_through", _no_doubt)
def doubt_of_porous(found: Contrast, semantic: Semantic) -> str:
    """Say why what neither fills nor hides its place may be a trail, in a cloud without counts of beams.

    A standing object hides the ground beneath, and most show a surface that a survey samples as densely as
    the ground beside. Traffic was elsewhere while most beams came: they met the ground in its place. A car of
    which one side was seen from afar looks alike, so the object is claimed with a low confidence.
    """
    if semantic not in (Semantic.VEGETATION, Semantic.OTHER):
        return ""
    if not (found.filled < _FILLED and found.beneath >= _SEEN_BENEATH):
        return ""
    return (
        f"The object has {found.filled:.1f} times as many points as the ground beside it on the same area"
        f" (limit {_FILLED:g}), {found.beneath:.0%} of the ground beneath was seen (limit"
        f" {_SEEN_BENEATH:.0%}), and the cloud has no counts of beams: it may be the ghost trail of a"
        " vehicle, and the confidence is lowered."
    )


def _beside_ground(xyz: Floats, ground: Floats) -> Contrast:
    """Compare points (N, 3) of an object with the ground points (G, 2) in the cells around."""
    xy = xyz[:, :2]
    low = np.floor(xy.min(axis=0) / _CELL).astype(np.int64) - 2 * _RING
    shape = np.floor(xy.max(axis=0) / _CELL).astype(np.int64) - low + 2 * _RING + 1
    near = ground[in_box_around(ground, xy, 2 * _RING * _CELL)]
    counts = []
    for places in (xy, near):
        cell = np.floor(places / _CELL).astype(np.int64) - low
        inside = ((cell >= 0) & (cell < shape)).all(axis=1)
        number = np.zeros(shape, dtype=np.int64)
        np.add.at(number, tuple(cell[inside].T), 1)
        counts.append(number)
    block = np.ones((3, 3))
    footprint = ndimage.binary_closing(counts[0] > 0, block)
    beside = ndimage.binary_dilation(footprint, block, iterations=_RING)
    beside &= ~ndimage.binary_dilation(footprint, block)
    known = counts[1][beside & (counts[1] > 0)]
    if len(known) < _RING:
        return Contrast()
    usual = float(np.median(known))
    expected = usual * np.count_nonzero(footprint)
    bottom, top = np.quantile(xyz[:, 2], [0.025, 0.975])
    side = usual / _CELL**2 * max(strip_of(xy)[0], _CELL) * max(top - bottom, _CELL)
    return Contrast(len(xy) / expected, float(counts[1][footprint].sum()) / expected, len(xy) / side)


def _road_beneath(xy: Floats, ground: Floats) -> float:
    """Density of ground points (G, 2) between the sides of a strip (N, 2) over that beside it, 1 at most."""
    middle = xy.mean(axis=0)
    axes = np.linalg.eigh((xy - middle).T @ (xy - middle))[1]
    across, along = ((xy - middle) @ axes).T
    reach = float(np.quantile(np.abs(along), 0.975))
    low, high = np.quantile(across, [0.025, 0.975])
    place = (ground - middle) @ axes
    place = place[np.abs(place[:, 1]) <= reach]
    inside = np.count_nonzero((place[:, 0] > low) & (place[:, 0] < high))
    around = np.count_nonzero((place[:, 0] > 2 * low - high) & (place[:, 0] < 2 * high - low)) - inside
    return min(1.0, inside / max(0.5 * around, 1.0))


def strip_of(xy: Floats) -> tuple[float, float]:
    """Length and width of points (N, 2) along and across their main direction, less one in twenty [m]."""
    step = xy - xy.mean(axis=0)
    low, high = np.quantile(step @ np.linalg.eigh(step.T @ step)[1], [0.025, 0.975], axis=0)
    width, length = (high - low).tolist()
    return length, width


def _local_width(xy: Floats) -> float:
    """Width of the pieces that points (N, 2) consist of, median of a sample [m]: a way may bend."""
    some = xy[:: -(-len(xy) // _PIECES)]
    return float(np.median([strip_of(xy[near])[1] for near in cKDTree(xy).query_ball_point(some, _PIECE)]))
