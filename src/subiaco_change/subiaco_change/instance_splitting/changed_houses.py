"""Houses of a row that changed, where neither epoch shows the walls between the houses.

Of joined houses of one height a street shows one long front and one roof. What one epoch alone has tells
where a changed house begins and ends: along the row it is next to nothing where the houses did not change,
and much where one did.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import switchable
from subiaco_change.objects.column_volumes import tops_of_columns
from subiaco_change.objects.layers import before_walls
from subiaco_change.objects.voxel_objects import Voxels
from subiaco_change.segmentation.bounding_rectangles import longer_axis_first
from subiaco_change.segmentation.clustering import group_reduce
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.frames import Floats, Ints

_COLUMN = NUMBERS.rows_of_houses.cell
_FRONT = NUMBERS.rows_of_houses.house_front
_WIDTH = round(_FRONT / _COLUMN)
_SMOOTHED = 2 * (_WIDTH // 2) - 1  # slots of a median filter: half of a house stays
_WALLS = round(NUMBERS.changed_houses.wall_reach / _COLUMN)
_ROOM = NUMBERS.changed_houses.room_height
_FOOT = NUMBERS.changed_houses.foot_height
_CHANGED = NUMBERS.changed_houses.changed_share
_CLEAR = NUMBERS.changed_houses.clear_share
_GONE = NUMBERS.changed_houses.gone_share
_LEFT = NUMBERS.changed_houses.left_columns
_END = round(NUMBERS.changed_houses.end_front / _COLUMN)
_SAME = NUMBERS.changed_houses.same_top
_TALL = NUMBERS.changed_houses.tall_top
_TALL_HALF = NUMBERS.changed_houses.tall_half
_ALIKE = NUMBERS.changed_houses.neighbour_share
_ROW = NUMBERS.changed_houses.houses_of_row
_HALF = NUMBERS.changed_houses.half_of_pair
_PAIR = round(NUMBERS.changed_houses.pair_front / _COLUMN)
_NARROW = round(NUMBERS.changed_houses.narrow_front / _COLUMN)
_GARAGE = NUMBERS.changed_houses.garage_height
_LEAST = NUMBERS.changed_houses.least_top
_PART = NUMBERS.changed_houses.part_of_usual
_SUDDEN = NUMBERS.changed_houses.sudden_step
_QUIET = NUMBERS.changed_houses.quiet_quantile
_SEEN = NUMBERS.changed_houses.confirmed_voxels
_GAP = round(NUMBERS.changed_houses.confirmed_gap / _COLUMN)
_REST = NUMBERS.changed_houses.rest_share
_DEEP = NUMBERS.changed_houses.part_depth / _COLUMN
_ACROSS = NUMBERS.changed_houses.across_row
_LONG = round(NUMBERS.changed_houses.rest_length / _COLUMN)

#: Kinds of the slots of a row: unchanged, only in one epoch (in the order of the epochs), reshaped on the
#: front that both have, with something else in the place of a front, or only in one epoch but for its foot.
_UNCHANGED, _ONLY, _LOST, _GAINED, _PARTLY, _BUT_FOOT = 0, (1, 2), 3, 4, 5, (6, 7)


@dataclass(frozen=True)
class _Stretch:
    """Slots of a row from ``begin`` up to ``end``, the kind of most of them, and how much they changed.

    ``share``: mean fraction of their voxels that one epoch alone has.
    """

    begin: int
    end: int
    kind: int
    share: float

    @property
    def only(self) -> int | None:
        """The epoch, 0 or 1, that alone has a house there; None if both have one."""
        return _ONLY.index(self.kind) if self.kind in _ONLY else None

    @property
    def taller(self) -> int | None:
        """The epoch that alone has a house there, or all of it but its foot; None if both have one."""
        return _BUT_FOOT.index(self.kind) if self.kind in _BUT_FOOT else self.only


@dataclass(frozen=True)
class _Profile:
    """What one epoch has in every slot along a row, of what is as tall as a house.

    ``front`` (S,): whether a wall that faces across the row stands there; ``alone`` (S,): share of its voxels
    whose place the other epoch observed and found empty, and ``above`` (S,) of those in whose column the
    other epoch has something, both less what the quiet slots of the row show; ``known`` (S,): whether the
    other epoch observed any of them; ``foot`` (S,): the share of what is lower than a room, NaN where nothing
    is known; ``tops`` (S, T) of its columns [m], 0 for none; ``step`` (S,), how far it rises over what the
    other epoch has in a column [m]; ``confirmed`` (S,): number of its voxels whose place the other epoch saw
    free on both sides.
    """

    front: Mask
    alone: Floats
    above: Floats
    known: Mask
    foot: Floats
    tops: Floats
    step: Floats
    confirmed: Ints

    @property
    def columns(self) -> Mask:
        """Columns (S, T) that it stands in."""
        return np.asarray(self.tops > 0)

    @property
    def top(self) -> Floats:
        """Height (S,) of the highest column of every slot [m], 0 for none."""
        return np.asarray(self.tops.max(axis=1))

    def hardly_in(self, other: _Profile) -> Mask:
        """Tell in which slots (S,) the other epoch has few of its columns, also where it has none."""
        shared = np.count_nonzero(self.columns & other.columns, axis=1)
        return np.asarray(shared <= _LEFT * np.count_nonzero(self.columns, axis=1))

    def set_back(self, other: _Profile) -> Mask:
        """Tell in which slots (S,) it has a storey that stands back behind a front of both epochs."""
        higher = (other.top > 0) & (self.top > other.top + _SAME)
        return np.asarray((self.alone >= _GONE) & (self.foot < _GONE) & higher)


@dataclass(frozen=True)
class _Row:
    """A row in both epochs, and what they show together in every slot (S,).

    ``kind``; ``built``: whether both epochs have a house there; ``share``: the fraction of it that changed;
    ``step``: how far its top rose or fell [m], infinite where one epoch alone has a house.
    """

    sides: Sequence[_Profile]
    kind: Ints
    built: Mask
    share: Floats
    step: Floats


def changed_houses(before: Voxels, after: Voxels) -> tuple[Ints, Ints]:
    """Return which stretch of a row its voxels (N,) lie in, and which changed house they are of, 0 for none.

    A house was removed, is new, or was reshaped, beside houses of the row that did not change. Of the party
    walls beside it, what only one epoch has is of that house.

    Parameters
    ----------
    before, after : Voxels
        Of the row in both epochs; the results are of those of *before* and then of those of *after*.
    """
    sides = before, after
    xyz = np.concatenate([v.xyz for v in sides])
    epoch = np.repeat([0, 1], [len(v) for v in sides])
    alone = ~np.concatenate([v.occupied_in_other for v in sides])
    axes = longer_axis_first(xyz[:, :2])
    turned = xyz[:, :2] @ axes
    slots = np.floor((turned - turned.min(axis=0)) / _COLUMN).astype(np.int64)
    house = np.zeros(len(xyz), dtype=np.int64)
    own = [slots[epoch == e] for e in (0, 1)]
    built = [[_sharing_layers(v, along) for v in sides] for along in axes.T]
    profiles = [
        _profiles(built[0], own, axes[:, 0]),
        _profiles(built[1], [side[:, ::-1] for side in own], axes[:, 1]),
    ]
    axis, found = _along_row(profiles)
    if not found:
        axis = int(np.argmax(slots.max(axis=0)))
        found = _confirmed_stretches(profiles[axis])
    place = slots[:, axis]
    for stretch in found:
        inside = _within(place, stretch.begin, stretch.end)
        of_house = alone if stretch.taller is None else alone & (epoch == stretch.taller)
        of_house = of_house | inside if stretch.only is None else of_house
        walls = _within(place, stretch.begin - _WALLS, stretch.end + _WALLS)
        house[of_house & walls & (house == 0)] = house.max() + 1
    cuts = np.unique([cut for stretch in found for cut in (stretch.begin, stretch.end)])
    stretches = np.searchsorted(cuts, place, side="right")
    return stretches, house


def _along_row(profiles: Sequence[Sequence[_Profile]]) -> tuple[int, list[_Stretch]]:
    """Return the axis along which a row runs, and its changed houses.

    Seen along the row, a change is confined to few slots; seen across it, houses that did not change lie in
    the same slots. Where one axis alone shows changed houses, it must not be much the shorter one.
    """
    found = [_changed_stretches(sides) for sides in profiles]
    if all(found):
        axis = int(np.argmax([np.mean([stretch.share for stretch in some]) for some in found]))
    else:
        axis = int(not found[0])
        extent = [len(sides[0].tops) - 1 for sides in profiles]
        if extent[axis] < _ALIKE * max(extent):
            return axis, []
    return axis, found[axis]


def _no_stretches(*_: object) -> list[_Stretch]:
    """Return none."""
    return []


@switchable("parts_of_long_buildings", _no_stretches)
def _confirmed_stretches(sides: Sequence[_Profile]) -> list[_Stretch]:
    """Find where along a long building surfaces lie that the other epoch saw free on both sides.

    A house of a row was reshaped there, or has a wing. The stretch is as wide as a house, both epochs saw the
    building behind it to the depth of a room, and most of the building shows nothing of the kind. Of a facade
    alone nobody knows the volume that a bay is a share of.
    """
    first, second = sides
    seen = first.confirmed + second.confirmed
    shared = np.count_nonzero(first.columns & second.columns, axis=1)
    built = ~(first.hardly_in(second) & second.hardly_in(first))
    joined = ndimage.binary_closing(np.pad(seen > 1, _GAP), np.ones(_GAP + 1))[_GAP:-_GAP]
    return [
        _Stretch(begin, end, _PARTLY, float(seen[begin:end].mean()))
        for begin, end in _runs(joined)
        if seen[begin:end].sum() >= _SEEN
        and np.median(shared[begin:end]) >= _DEEP
        and np.count_nonzero(built[begin:end]) >= _ALIKE * (end - begin)
        and np.count_nonzero(built & ~joined) >= max(_REST * (end - begin), _LONG)
    ]


def _within(slot: Ints, begin: int, end: int) -> Mask:
    return (slot >= begin) & (slot < end)


def _profiles(sides: Sequence[Voxels], slots: Sequence[Ints], along: Floats) -> list[_Profile]:
    """Measure both epochs in slots (N, 2) along and across a row of a direction (2,)."""
    shape = tuple((np.concatenate(slots).max(axis=0) + 1).tolist())
    talls = [voxels.height >= _ROOM for voxels in sides]
    tops = [
        tops_of_columns(own[tall], voxels.height[tall], shape)
        for voxels, own, tall in zip(sides, slots, talls, strict=True)
    ]
    return [_profile(*side, along) for side in zip(sides, slots, talls, tops, tops[::-1], strict=True)]


def _profile(
    voxels: Voxels, slots: Ints, tall: Mask, tops: Floats, others: Floats, along: Floats
) -> _Profile:
    """Measure one epoch, with its tops and those of the other (S, T); single slots are smoothed away."""
    count, place = len(tops), slots[:, 0]
    low, alone = ~tall & (voxels.height >= _FOOT), voxels.observed_unoccupied
    in_column = tall & (others[tuple(slots.T)] > 0)
    known, known_above, known_low = (
        np.bincount(place[part & voxels.observed], minlength=count) for part in (tall, in_column, low)
    )
    alone_share, above_share = (
        _less_quiet(_smoothed(np.bincount(place[part & alone], minlength=count) / np.maximum(of, 1)))
        for part, of in ((tall, known), (in_column, known_above))
    )
    foot = np.bincount(place[low & alone], minlength=count) / np.where(known_low > 0, known_low, np.nan)
    new = tall & alone
    rises = tops_of_columns(slots[new], voxels.height[new], tops.shape) - others
    step = np.where(others > 0, rises, 0.0).max(axis=1)
    confirmed = np.bincount(place[new & voxels.free_space_confirmed], minlength=count)
    front = _faces_row(voxels, place, along, count)
    return _Profile(
        _smoothed(front), alone_share, above_share, known > 0, foot, tops, np.maximum(step, 0.0), confirmed
    )


def _faces_row(voxels: Voxels, slots: Ints, along: Floats, count: int) -> Mask:
    """Tell in which slots (S,) of a row of a direction (2,) a wall stands that faces across the row.

    Fewer of its voxels face along the row, as the front of a house does that is seen from its side. The
    edge of a roof on posts is no wall.
    """
    wall = (voxels.height >= _FOOT) & (np.abs(voxels.normal[:, 2]) < _ACROSS)
    turned = np.abs(voxels.normal[:, :2] @ along) >= _ACROSS
    front, height = slots[wall & ~turned], voxels.height[wall & ~turned]
    high, low = (group_reduce(front, height, count, how) for how in ("maximum", "minimum"))
    sides = np.bincount(slots[wall & turned], minlength=count)
    return np.asarray((np.bincount(front, minlength=count) >= sides) & (high - low >= _ROOM / 2))


def _sharing_layers(voxels: Voxels, along: Floats) -> Voxels:
    """Let things close before walls that both epochs have, and that face across a row, count as in both.

    Scaffolding before one house of a row changes no house. ``along`` (2,) is the direction of the row.
    """
    facing = np.abs(voxels.normal[:, :2] @ along) < _ACROSS
    walls = replace(voxels, occupied_in_other=voxels.occupied_in_other & facing)
    alone = np.flatnonzero(voxels.observed_unoccupied)
    shared = voxels.xyz[voxels.occupied_in_other & (voxels.height >= _ROOM), :2]
    if len(alone) == 0 or len(shared) == 0:
        return voxels
    houses = cKDTree(shared)

    def outside(fronts: Floats) -> Mask:
        return ~np.isfinite(houses.query(fronts[:, :2], distance_upper_bound=_COLUMN)[0])

    both = voxels.occupied_in_other.copy()
    both[alone[before_walls(voxels.xyz[alone], walls, outside)]] = True
    return replace(voxels, occupied_in_other=both)


def _smoothed(values: NDArray[Any]) -> NDArray[Any]:
    """Values (S,) of slots without single ones that differ from those beside them."""
    return np.asarray(ndimage.median_filter(values, _SMOOTHED, mode="nearest"))


def _less_quiet(share: Floats) -> Floats:
    """Shares (S,) less what the quiet slots of the row show."""
    return np.maximum(share - np.quantile(share, _QUIET), 0.0)


def _changed_stretches(sides: Sequence[_Profile]) -> list[_Stretch]:
    """Find the changed houses of a row: each begins or ends beside one that did not change.

    Where a part of a stretch is no house of the row, none of it is. Where walls were seen, a house that did
    not change has one that faces across the row: the facade of a house that was built upon behind it is no
    house beside it, nor is its veranda. A house was reshaped where it rose or fell: anything beside it in one
    epoch alone is a wing. Where a stretch has no such house, its neighbours in the row may have changed too:
    then a tall building of one epoch alone may begin or end beside a house that was reshaped.
    """
    kind = _kinds(sides)
    rise = np.maximum(sides[0].step, sides[1].step)
    same = (kind == _UNCHANGED) & (sides[0].known | sides[1].known) & (_smoothed(rise) <= _SAME)
    front = sides[0].front | sides[1].front
    same &= front | ~front.any()
    gone = np.isin(kind, _ONLY + _BUT_FOOT)
    step = np.where(gone, np.inf, rise)
    built = (sides[0].top > 0) & (sides[1].top > 0) & ~gone & (kind != _PARTLY)
    first, second = (
        np.where(gone | side.set_back(other), side.alone, side.above)
        for side, other in zip(sides, sides[::-1], strict=True)
    )
    most = np.maximum(first, second)
    tall = np.maximum(sides[0].top, sides[1].top) >= _TALL
    row = _Row(sides, kind, built, most, step)
    houses: list[_Stretch] = []
    for begin, end in _runs(kind != _UNCHANGED):
        region = np.zeros(len(kind), dtype=bool)
        region[begin:end] = True
        houses.extend(_houses_of(row, region, same) or _houses_of(row, region & gone & tall, same | built))
    return houses


def _houses_of(row: _Row, changed: Mask, beside: Mask) -> list[_Stretch]:
    """Find the houses in changed slots (S,) of a row, next to slots that they may lie ``beside``.

    What is much lower than a house that both epochs have is its carport, and no house beside it.
    """
    houses: list[_Stretch] = []
    before, after = (side.top for side in row.sides)
    lower, higher = np.minimum(before, after), np.maximum(before, after)
    for begin, end in _runs(_clearly(row.share, changed)):
        alike = beside & (higher >= _LEAST * np.median(lower[begin:end]))
        walls = (
            _is_wall(alike[max(begin - _WIDTH, 0) : begin][::-1], row.step[begin:end]),
            _is_wall(alike[end : end + _WIDTH], row.step[begin:end][::-1]),
        )
        apart = _stands_apart(row, begin, end)
        if row.share[begin:end].mean() < _CLEAR or not (apart or any(walls)):
            continue
        parts = [
            _Stretch(
                first,
                last,
                int(np.bincount(row.kind[first:last]).argmax()),
                float(row.share[first:last].mean()),
            )
            for first, last in _by_kind(row.kind, begin, end)
        ]
        if all(_is_house(row, part, apart) for part in parts):
            houses.extend(parts)
    return houses


def _kinds(sides: Sequence[_Profile]) -> Ints:
    """Return the kind (S,) of every slot.

    One epoch alone has what the other holds in few of its columns. Where the front stands in both up to the
    height of a room, a storey was taken off or built, and of its roof nothing may be seen, or nothing above a
    room. Where the foot of the front is gone too, a part of a house was taken down, and the row says nothing
    of houses.
    """
    changed = [side.above >= _CHANGED for side in sides]
    foot = np.logical_or(*(side.foot >= _GONE for side in sides))
    kind = np.select([changed[1], changed[0]], [_GAINED, _LOST], _UNCHANGED)
    kind[_smoothed(foot) & (kind != _UNCHANGED)] = _PARTLY
    for epoch, side in enumerate(sides):
        other = sides[1 - epoch]
        kind[_smoothed(side.set_back(other))] = (_LOST, _GAINED)[epoch]
        missing = side.hardly_in(other)
        kind[_smoothed((side.alone >= _GONE) & missing)] = _BUT_FOOT[epoch]
        kind[_smoothed((side.alone >= _CHANGED) & missing & ~(side.foot < _GONE))] = _ONLY[epoch]
    return kind


def _by_kind(kind: Ints, begin: int, end: int) -> list[tuple[int, int]]:
    """Divide a stretch where its kind changes, into stretches that are as long as a house is wide."""
    edges = [begin, *(begin + 1 + np.flatnonzero(np.diff(kind[begin:end]))).tolist(), end]
    while len(edges) > 2:
        lengths = np.diff(edges)
        shortest = int(lengths.argmin())
        if lengths[shortest] >= _WIDTH:
            break
        sides = [k for k in (shortest - 1, shortest + 1) if 0 <= k < len(lengths)]
        edges.pop(max(shortest, max(sides, key=lambda k: lengths[k])))
    return list(pairwise(edges))


def _stands_apart(row: _Row, begin: int, end: int) -> bool:
    """Tell whether both epochs have nothing as high as a room beside some slots of a row, but not all."""
    none = np.maximum(*(side.top for side in row.sides)) == 0
    beside = np.concatenate([none[max(begin - _WALLS, 0) : begin], none[end : end + _WALLS]])
    return bool(len(beside) > 0 and beside.all())


def _is_house(row: _Row, stretch: _Stretch, apart: bool) -> bool:
    """Tell whether a changed stretch of a row is a house of the row, and no wing of its last house.

    What one epoch alone has between houses is one if it and they are higher than garages, and it is about as
    high as the lower of them: an extension is lower. At the end of a long row, or as half of a pair, it must
    be as high and as deep as the house beside it, and wider than most extensions: as high where the house
    beside it was seen, which may be its front alone. No extension is as high as a tall building, of which a
    street hardly shows a roof. A house that stands ``apart`` is no extension.
    """
    if stretch.taller is None:
        return stretch.kind != _PARTLY
    begin, end = stretch.begin, stretch.end
    own, other, built = row.sides[stretch.taller], row.sides[1 - stretch.taller], row.built
    top = float(np.median(own.top[begin:end]))
    if apart:
        return end - begin >= _END and top >= _GARAGE
    around = (
        [slice(max(begin - gap - _WIDTH, 0), max(begin - gap, 0)) for gap in range(_WALLS + 1)],
        [slice(end + gap, end + gap + _WIDTH) for gap in range(_WALLS + 1)],
    )
    wide = [[slots for slots in side if _is_house_wide(built[slots])] for side in around]
    beside = [side[0] for side in wide if side]
    tops = [float(np.median(own.top[slots])) for slots in beside]
    long = np.count_nonzero(built) >= _ROW * (end - begin)
    if len(beside) != 1 or not (long or _is_half(own, other, built, stretch, top)):
        return len(beside) == 2 and min(*tops, top) >= _GARAGE and top >= _LEAST * min(tops)
    if end - begin < _END:
        return False
    depths = [np.count_nonzero(own.columns[slots], axis=1).mean() for slots in (slice(begin, end), beside[0])]
    if top >= _TALL:
        return bool(top >= _LEAST * tops[0] and depths[0] >= _DEEP)
    seen = np.median(own.columns[beside[0]], axis=0) > 0
    front, of_row = (
        float(np.median(own.tops[slots][:, seen].max(axis=1, initial=0.0)))
        for slots in (slice(begin, end), beside[0])
    )
    high = front >= of_row - _SAME if front > 0 else top >= tops[0] - _SAME
    return bool(high and depths[0] >= _ALIKE * depths[1])


def _is_half(own: _Profile, other: _Profile, built: Mask, stretch: _Stretch, top: float) -> bool:
    """Tell whether what one epoch alone has, with its walls, is as long as the house that both have.

    A narrower half is of one house that was shortened. Narrow houses are higher than wide, and tall ones need
    not be alike; ``top`` is the height of the stretch [m].
    """
    alone = own.columns.any(axis=1) & own.hardly_in(other)
    walls = slice(max(stretch.begin - _WALLS, 0), stretch.end + _WALLS)
    halves = np.count_nonzero(built & ~alone), np.count_nonzero(alone[walls])
    least = _NARROW if top > _COLUMN * max(halves) else _PAIR
    ratio = _TALL_HALF if top >= _TALL else _HALF
    return bool(min(halves) >= max(ratio * max(halves), least))


def _is_house_wide(slots: Mask) -> bool:
    return bool(np.count_nonzero(slots) >= _ALIKE * _WIDTH)


def _is_wall(same: Mask, step: Floats) -> bool:
    """Tell whether a changed stretch begins at the party wall of a house that did not change.

    Of one house of which a part was built upon the tops may rise slowly; a party wall is a sudden step.
    ``same``: which slots beside it, the nearest first, did not change; ``step``: of the stretch, from that
    side on [m].
    """
    rose = step[np.isfinite(step)]
    usual = float(np.median(rose)) if len(rose) else math.inf
    sudden = step[:2].max() >= _SUDDEN * usual
    return bool(sudden and same[:2].any() and _is_house_wide(same))


def _clearly(share: Floats, changed: Mask) -> Mask:
    """Leave out of every run of changed slots (S,) those of which much less changed than of the others."""
    kept = changed.copy()
    for begin, end in _runs(changed):
        kept[begin:end] = share[begin:end] >= _PART * np.median(share[begin:end])
    return kept


def _runs(slots: Mask) -> list[tuple[int, int]]:
    """First slot and end of every run of slots (S,) that is as long as a house is wide."""
    edges = np.flatnonzero(np.diff(np.pad(slots, 1).astype(np.int8)))
    return [(b, e) for b, e in edges.reshape(-1, 2).tolist() if e - b >= _WIDTH]
