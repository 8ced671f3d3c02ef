"""Pieces of ghost trails, distinguished from standing objects by the row of pieces that they lie in.

Where few sweeps met a moving vehicle, its trail is a row of pieces: fronts, sides and corners some metres
apart, along a straight line or a bend. Each piece alone looks like a plant or a vehicle of one epoch. The row
is longer than vehicles are and as wide as one, its own survey saw the ground beneath all of it, and the other
epoch holds none of its pieces.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.dynamic_objects import OwnEpochEvidence, fits_a_vehicle
from subiaco_change.decisions.rules import Decision
from subiaco_change.decisions.trail_shapes import strip_of
from subiaco_change.geometry import in_box_around, lies_near
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import no_decision, switchable
from subiaco_change.objects.voxel_objects import NO_OBJECT, ObjectInstance, Voxels, join_voxels
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.clustering import group_indices
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, Ints

ROW_REACH = NUMBERS.trail_in_pieces.reach
_DIRECTIONS = NUMBERS.trail_in_pieces.directions
_BENDS = np.array(NUMBERS.trail_in_pieces.bends)
_GENTLEST = NUMBERS.trail_in_pieces.gentle_bend
_GENTLE = _BENDS[np.abs(_BENDS) <= _GENTLEST]
_STEP = NUMBERS.trail_in_pieces.step
_GAP = NUMBERS.trail_in_pieces.gap
_HALF = NUMBERS.trail_in_pieces.half_width
_RIM = NUMBERS.trail_in_pieces.rim
_RIM_SHARE = NUMBERS.trail_in_pieces.rim_share
_RIM_WEIGHT = NUMBERS.trail_in_pieces.rim_weight
_SECTION = NUMBERS.trail_in_pieces.section
_ASIDE = NUMBERS.trail_in_pieces.aside
_FEWEST = NUMBERS.trail_in_pieces.fewest_points
_BEYOND = NUMBERS.trail_in_pieces.beyond
_TALLER = NUMBERS.trail_in_pieces.taller
_ROAD = NUMBERS.trail_in_pieces.road
_HELD = NUMBERS.trail_in_pieces.held
_LOW, _TOP = NUMBERS.trail_in_pieces.low, NUMBERS.trail_in_pieces.high
_NARROW = NUMBERS.trail_shapes.strip_width
_WIDEST = NUMBERS.trail_shapes.trail_width
_LENGTH = NUMBERS.trail_shapes.strip_length
_VEHICLE = NUMBERS.trail_in_pieces.trail_length
_PLACES = NUMBERS.trail_in_pieces.places
_PLACE = NUMBERS.trail_in_pieces.place_radius
_TOP_SHARE = NUMBERS.trail_in_pieces.top_share
_SAME = NUMBERS.object_decision.same_point
_BINS = round(ROW_REACH / _STEP)
_GAPS = round(_GAP / _STEP)
_FIRST = round(NUMBERS.trail_in_pieces.ahead / _STEP)


@dataclass(frozen=True)
class Surroundings:
    """What one epoch holds widely around the objects of a tile, in the frame of the objects.

    ``ground`` (G, 2); ``standing`` (S, 3): all that is neither ground nor a ghost trail; ``pieces`` (P, 3)
    and their ``height`` (P,) above ground: what may be left of traffic, neither a building nor of the shape
    of a vehicle [m].
    """

    ground: Floats
    standing: Floats
    pieces: Floats
    height: Floats

    @staticmethod
    def joined(parts: Sequence[Surroundings]) -> Surroundings:
        """Return what several tiles hold."""
        names = Surroundings.__dataclass_fields__
        return Surroundings(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def surroundings(
    xyz: Floats, semantic: NDArray[np.uint8], instance: NDArray[np.int32], height: NDArray[np.float32]
) -> Surroundings:
    """Sort points (N, 3) of an epoch by what they may be.

    Parameters
    ----------
    xyz : (N, 3) float64 [m]
    semantic : (N,) uint8
    instance : (N,) int32
        Object, :data:`NO_OBJECT` or below without one.
    height : (N,) float32
        Above ground [m].
    """
    loose = (semantic == Semantic.MOBILE) & (instance <= NO_OBJECT)
    shapeless = loose | (semantic == Semantic.VEGETATION) | (semantic == Semantic.OTHER)
    piece = shapeless & (height > _LOW) & (height < _TOP)
    ground = semantic == Semantic.GROUND
    return Surroundings(xyz[ground, :2], xyz[~ground & ~loose], xyz[piece], height[piece].astype(np.float64))


@dataclass(frozen=True)
class _Row:
    """Pieces in line with an object.

    ``beyond``: length of the row beyond the object; ``length``: with the object; ``width`` and ``top`` of the
    pieces [m]; ``rim``: points just beside the row for each point of its pieces; ``road``: density of the
    ground beneath the row over that beside it.
    """

    beyond: float
    length: float
    width: float
    top: float
    rim: float
    road: float

    def is_of_traffic(self, top: float) -> bool:
        """Tell whether traffic may have left the row and, in it, an object as high as ``top`` [m]."""
        long = self.beyond >= _BEYOND and self.length >= _LENGTH
        return long and self.rim <= _RIM_SHARE and self.road >= _ROAD and top <= self.top + _TALLER


@switchable("trail_in_pieces", no_decision)
def decide_piece_of_trail(
    objects: Sequence[ObjectInstance],
    semantic: Semantic,
    own: OwnEpochEvidence | None,
    mine: Surroundings | None,
    other: Surroundings | None,
    rules: DecisionConfig,
) -> Decision | None:
    """Tell an object in a row of pieces as long as no vehicle and as wide as one, in a cloud without counts.

    ``mine`` and ``other``: what its own and the other epoch hold around. A plant or a parked car beside a
    trail does not lie in the middle of the row, and a planted row hides the ground. Along a narrow bend a row
    must go on at both sides of an object without a vehicle's shape: otherwise it would lead from a parked car
    into a trail beside it. An object that is both longer and wider than a vehicle may hold pieces of two
    lanes: most of its places must lie in rows.
    """
    if own is None or own.ground is None or mine is None or other is None:
        return None
    if semantic is Semantic.BUILDING or not fits_a_vehicle(objects, rules):
        return None
    bends = _GENTLE if semantic is Semantic.MOBILE else _BENDS
    bodies = _bodies(np.concatenate([t.xyz for t in objects]), join_voxels(objects), bends)
    found = [(_row_of(xyz, arcs, mine, other), top) for xyz, arcs, top in bodies]
    rows = [row for row, top in found if row is not None and row.is_of_traffic(top)]
    if 2 * len(rows) <= len(bodies):
        return None
    row = max(rows, key=lambda r: r.length)
    reason = (
        f"The object lies in a row of pieces {row.length:.0f} m long (limit {_LENGTH:g} m) and"
        f" {row.width:.1f} m wide that the other survey does not hold, and its own survey saw the ground"
        f" beneath the row with {row.road:.0%} of the points beside it (limit {_ROAD:.0%}): it may be a piece"
        " of the ghost trail of a vehicle, and nothing is claimed."
    )
    return Decision(Change.UNOBSERVED, reason, 0.0)


def _bodies(xyz: Floats, voxels: Voxels, bends: Floats) -> list[tuple[Floats, _Arcs, float]]:
    """Points (N, 3) through which rows are followed, arcs through them, and their tops.

    They are those of an object, or of places of a wide one.
    """
    arcs = _arcs_through(xyz[:, :2], bends)
    if len(arcs.bend):
        return [(xyz, arcs, quantile_of(voxels.height, _TOP_SHARE))]
    if strip_of(xyz[:, :2])[0] < _VEHICLE:
        return []
    some = np.linspace(0, len(xyz) - 1, _PLACES).astype(np.int64)
    found = []
    for middle in xyz[np.lexsort(xyz.T[:2])[some], :2]:
        near, high = (np.linalg.norm(p[:, :2] - middle, axis=1) < _PLACE for p in (xyz, voxels.xyz))
        top = quantile_of(voxels.height[high], _TOP_SHARE) if high.any() else 0.0
        found.append((xyz[near], _arcs_through(xyz[near, :2], bends), top))
    return found


def _row_of(xyz: Floats, arcs: _Arcs, own: Surroundings, other: Surroundings) -> _Row | None:
    """Return the row of pieces through the points (N, 3) of an object; None where there is none."""
    place = xyz[:, :2]
    near = in_box_around(own.pieces[:, :2], place, ROW_REACH)
    if np.count_nonzero(near) < _FEWEST:
        return None
    pieces, height = own.pieces[near], own.height[near]
    beyond = ~(lies_near(pieces, xyz, _SAME) | lies_near(pieces, other.standing, _HELD))
    if np.count_nonzero(beyond) < _FEWEST:
        return None
    ground = own.ground[in_box_around(own.ground, place, 2.0 * ROW_REACH)]
    return _best_row(pieces[beyond, :2], height[beyond], arcs, ground)


@dataclass(frozen=True)
class _Arcs:
    """Arcs (A,) through an object: directions (A, 2), bends (A,) [1/m], and the middle of the object.

    ``low`` and ``high`` (A,): where the object begins and ends along them; ``middle`` (A,): aside of the arc
    through ``centre`` (2,) [m].
    """

    centre: Floats
    direction: Floats
    bend: Floats
    low: Floats
    high: Floats
    middle: Floats


@numba.njit(cache=True)
def _aside_of_arc(x: float, y: float, direction: Floats, bend: float) -> float:
    """Distance to the left of a circle through the origin that begins in a direction (2,) [m]."""
    ahead, left = direction[0] * x + direction[1] * y, direction[0] * y - direction[1] * x
    outward = math.sqrt((bend * ahead) ** 2 + (1.0 - bend * left) ** 2)
    return (2.0 * left - bend * (ahead * ahead + left * left)) / (1.0 + outward)


@numba.njit(cache=True)
def _along_arc(x: float, y: float, direction: Floats, bend: float) -> float:
    """Length along that circle [m]."""
    ahead, left = direction[0] * x + direction[1] * y, direction[0] * y - direction[1] * x
    return ahead if bend == 0 else math.atan2(bend * ahead, 1.0 - bend * left) / bend


@numba.njit(cache=True)
def _on_arcs(step: Floats, direction: Floats, bend: Floats, lengthwise: bool) -> Floats:
    """Lengths (A, N) of points (N, 2) along arcs (A,), or their distances to the left of these [m]."""
    found = np.empty((len(bend), len(step)))
    for arc in range(len(bend)):
        for number, (x, y) in enumerate(step):
            if lengthwise:
                found[arc, number] = _along_arc(x, y, direction[arc], bend[arc])
            else:
                found[arc, number] = _aside_of_arc(x, y, direction[arc], bend[arc])
    return found


def _arcs_through(place: Floats, bends: Floats) -> _Arcs:
    """Return the arcs along which an object of points (N, 2) is no wider than a vehicle."""
    angle = np.repeat(np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS, len(bends))
    bend = np.tile(bends, _DIRECTIONS)
    direction, centre = np.stack([np.cos(angle), np.sin(angle)], axis=1), np.median(place, axis=0)
    step, ends = place - centre, [0.025, 0.975]
    left, right = np.quantile(_on_arcs(step, direction, bend, lengthwise=False), ends, axis=1)
    fits = right - left <= _WIDEST
    direction, bend = direction[fits], bend[fits]
    low, high = np.quantile(_on_arcs(step, direction, bend, lengthwise=True), ends, axis=1)
    return _Arcs(centre, direction, bend, low, high, 0.5 * (left + right)[fits])


@dataclass(frozen=True)
class _Pieces:
    """Pieces beside an object, as an arc through the object has them.

    ``along`` and ``aside`` (N,) [m]; ``after`` (N,): beyond the end of the object, else before its
    beginning; ``step`` (N,): steps between the piece and the object, below 0 beside the object.
    """

    along: Floats
    aside: Floats
    after: Mask
    step: Ints


def _pieces_along(arcs: _Arcs, number: int, pieces: Floats) -> _Pieces:
    """Place pieces (N, 2) along one of the arcs."""
    one = pieces - arcs.centre, arcs.direction[number : number + 1], arcs.bend[number : number + 1]
    along, aside = (
        _on_arcs(*one, lengthwise=True)[0],
        _on_arcs(*one, lengthwise=False)[0] - arcs.middle[number],
    )
    low, high = arcs.low[number], arcs.high[number]
    distance = np.maximum(along - high, low - along)
    return _Pieces(along, aside, along > high, np.floor(distance / _STEP).astype(np.int64))


@dataclass(frozen=True)
class _Rows:
    """Rows on both sides of an object along arcs (A, 2): steps that they reach, points in and beside them."""

    ends: Ints
    count: Ints
    rim: Ints

    @property
    def score(self) -> Floats:
        """Points in rows (A, 2) less those just beside them, which weigh more."""
        return np.asarray(self.count - _RIM_WEIGHT * self.rim)


def _rows_along(arcs: _Arcs, pieces: Floats) -> _Rows:
    """Follow the rows of pieces (N, 2) along arcs."""
    step = pieces - arcs.centre
    inside, wide = _count_steps(
        step, arcs.direction, arcs.bend, arcs.middle, arcs.low, arcs.high, (_STEP, _HALF, _RIM), _BINS
    )
    ends = _ends(inside > 0)
    reached = np.arange(_BINS) < ends[..., None]
    return _Rows(ends, (inside * reached).sum(axis=2), ((wide - inside) * reached).sum(axis=2))


@numba.njit(cache=True)
def _count_steps(
    pieces: Floats, direction: Floats, bend: Floats, middle: Floats, low: Floats, high: Floats,
    sizes: tuple[float, float, float], steps: int,
) -> tuple[Ints, Ints]:  # fmt: skip
    """Count places (N, 2) along arcs (A,) by steps from an object: within half a row's width, and with a rim.

    ``sizes``: a step, half of the width and the rim [m]. Both counts (A, 2, ``steps``) are before the object
    and beyond it.
    """
    step, half, rim = sizes
    inside = np.zeros((len(bend), 2, steps), np.int64)
    wide = np.zeros_like(inside)
    for arc in range(len(bend)):
        for x, y in pieces:
            aside = abs(_aside_of_arc(x, y, direction[arc], bend[arc]) - middle[arc])
            if aside >= half + rim:
                continue
            along = _along_arc(x, y, direction[arc], bend[arc])
            number = int(np.floor(max(along - high[arc], low[arc] - along) / step))
            if number < 0 or number >= steps:
                continue
            side = 1 if along > high[arc] else 0
            wide[arc, side, number] += 1
            if aside < half:
                inside[arc, side, number] += 1
    return inside, wide


def _best_row(pieces: Floats, height: Floats, arcs: _Arcs, ground: Floats) -> _Row | None:
    """Return the row with the most points (N, 2) along an arc through an object, and the fewest beside it."""
    if len(arcs.bend) == 0:
        return None
    rows = _rows_along(arcs, pieces)
    score = rows.score
    most = np.maximum(score, 0).sum(axis=1)
    best, found = 0.0, None
    for k in np.argsort(-most, kind="stable").tolist():
        if most[k] <= best:
            break
        if rows.count[k].sum() < _FEWEST:
            continue
        near = _pieces_along(arcs, k, pieces)
        members = [_in_row(near, side, int(rows.ends[k, side])) for side in (0, 1)]
        sides = [side for side in (0, 1) if _goes_on(near, members[side])]
        if len(sides) < 2 and abs(arcs.bend[k]) > _GENTLEST:
            continue
        if float(score[k, sides].sum()) <= best or rows.count[k, sides].sum() < _FEWEST:
            continue
        row = np.logical_or.reduce([members[side] for side in sides])
        along, aside = near.along[row], near.aside[row]
        width = _width(along, aside)
        if width < _NARROW:
            continue
        best = float(score[k, sides].sum())
        beyond = _STEP * float(rows.ends[k, sides].sum())
        found = _Row(
            beyond,
            beyond + float(arcs.high[k] - arcs.low[k]),
            width,
            quantile_of(height[row], _TOP_SHARE),
            float(rows.rim[k, sides].sum() / rows.count[k, sides].sum()),
            _road(arcs, k, ground, np.unique(np.floor(along))),
        )
    return found


def _in_row(near: _Pieces, side: int, end: int) -> Mask:
    """Tell which pieces (N,) are in the row on one side of an object along one arc."""
    on_side = (near.after == bool(side)) & (np.abs(near.aside) < _HALF)
    return np.asarray(on_side & (near.step >= 0) & (near.step < end))


def _goes_on(near: _Pieces, row: Mask) -> bool:
    """Tell whether a row of pieces (N,) goes on before or behind an object, and not beside it."""
    first = near.aside[row & (near.step < _FIRST)]
    return len(first) > 0 and abs(float(np.quantile(first, [0.05, 0.95]).mean())) <= _ASIDE


def _ends(occupied: Mask) -> Ints:
    """Count the steps (A, 2) that rows reach beyond an object, by which steps (A, 2, B) hold pieces."""
    ends = np.zeros(occupied.shape[:2], dtype=np.int64)
    for step in range(occupied.shape[2]):
        ends[occupied[..., step] & (step - ends <= _GAPS)] = step + 1
    return ends


def _width(along: Floats, aside: Floats) -> float:
    """Width of the pieces of a row, median over its sections: a thin row aslant is no wider for that [m]."""
    sections = group_indices(np.unique(np.floor(along / _SECTION), return_inverse=True)[1].astype(np.int64))
    return float(np.median([np.ptp(np.quantile(aside[s], [0.025, 0.975])) for s in sections]))


def _road(arcs: _Arcs, number: int, ground: Floats, metres: Floats) -> float:
    """Density of the ground points (G, 2) beneath the metres of a row along an arc, over that beside it."""
    near = _pieces_along(arcs, number, ground)
    aside = near.aside[np.isin(np.floor(near.along), metres)]
    inner, outer = _HALF - _RIM, _HALF + _RIM
    beneath = np.count_nonzero(np.abs(aside) < inner) / (2.0 * inner)
    beside = [np.count_nonzero((s * aside > outer) & (s * aside < outer + _HALF)) / _HALF for s in (-1, 1)]
    return beneath / max(*beside, 1.0)
