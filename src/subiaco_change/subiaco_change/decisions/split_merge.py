"""Splitting and merging of instances after all objects of a place are known."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import shapely
from scipy.spatial import cKDTree

from subiaco_change.association.config import AssociationConfig
from subiaco_change.association.costs import overlap_counts
from subiaco_change.association.matching import match_kind
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.object_decision import (
    ObjectChange,
    ObjectRules,
    decide_object,
    is_fixed,
    is_roof_on_posts,
)
from subiaco_change.decisions.plant_decisions import decide_plant
from subiaco_change.decisions.rules import Decision
from subiaco_change.decisions.vegetation_null import no_null
from subiaco_change.geometry import in_outline_of
from subiaco_change.instance_splitting.building_extensions import (
    find_building_extensions,
    gaps_to_host,
    is_smooth_surface,
    remoteness,
    stands_apart,
)
from subiaco_change.instance_splitting.hedge_sections import HedgeSection, changed_sections, section_labels
from subiaco_change.instance_splitting.merged_instances import (
    Piece,
    group_row_houses,
    split_at_walls,
    split_by_bodies,
)
from subiaco_change.instance_splitting.one_epoch_parts import split_by_labels
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import applies, first_argument, switchable
from subiaco_change.objects.voxel_objects import ObjectInstance, Voxels, height_of, join_voxels
from subiaco_geo.codes import CHANGED, ONE_EPOCH, Change, Semantic

_WHOLE = NUMBERS.split_merge.whole_share
_WALL = NUMBERS.split_merge.wall_reach
_WITHIN = NUMBERS.split_merge.inside_share
_HARDLY = NUMBERS.split_merge.least_observed
_REMAINS = NUMBERS.split_merge.remains


@switchable("building_extensions", first_argument)
def join_building_extensions(changes: list[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Make extensions built onto a building, or taken from it, one object with it, and decide it again.

    An extension seen from few sides may have passed for a vehicle or a plant: what is built tells.
    """
    numbers = [
        i
        for i, change in enumerate(changes)
        if change.semantic is Semantic.BUILDING
        or (
            change.semantic in (Semantic.MOBILE, Semantic.VEGETATION, Semantic.OTHER)
            and change.decision.change in ONE_EPOCH
            and is_smooth_surface(join_voxels((*change.before, *change.after)))
        )
    ]
    if rules.association.parts.points == 0:
        return changes
    pairs = [_bodies(changes[i], rules.measures.carving.room) for i in numbers]
    found = find_building_extensions(pairs, rules.association.parts, rules.ground)
    extensions = {numbers[w]: numbers[h] for w, h in found.items()}
    following = _first_free(changes)
    joined: list[ObjectChange] = []
    for number, change in enumerate(changes):
        parts = [changes[w] for w, h in extensions.items() if h == number]
        if number not in extensions:
            told = _with_extensions(change, parts, rules, following)
            following = max(following, _first_free(told))
            joined.extend(told)
    return joined


def _bodies(change: ObjectChange, room: float) -> tuple[Voxels, Voxels]:
    """Return what both epochs have of a building; none of one that has only what is lower than a room [m].

    A fence that ran along an extension is left of it.
    """
    sides = change.before, change.after
    tall = [height_of(objects) >= room for objects in sides]
    before, after = (
        join_voxels(objects if one or not any(tall) else ()) for objects, one in zip(sides, tall, strict=True)
    )
    return before, after


def _with_extensions(
    host: ObjectChange, parts: Sequence[ObjectChange], rules: ObjectRules, following: int
) -> list[ObjectChange]:
    """Decide a building with the parts that touch it: those of places that both surveys observed.

    The other parts keep rows of their own.
    """
    seen = [p for p in parts if p.decision.change is not Change.UNOBSERVED or _is_seen_alone(p, rules)]
    hidden = [p for p in parts if not any(p is other for other in seen)]
    told = _extended(host, seen, rules, following) if seen else [host]
    return [*told, *hidden]


def _is_seen_alone(change: ObjectChange, rules: ObjectRules) -> bool:
    """Tell whether one epoch alone has an object, although its volume is too uncertain for a claim.

    The end wall of a house that was shortened encloses nothing by itself.
    """
    found, limits = change.measures, rules.decisions
    if (change.before and change.after) or abs(found.delta_v) < limits.least_volume:
        return False
    empty = found.gone_share if change.before else found.new_share
    seen = found.observed_fraction >= limits.min_observed
    return seen and empty >= limits.min_empty and found.free >= limits.min_free


def _extended(
    host: ObjectChange, extensions: Sequence[ObjectChange], rules: ObjectRules, following: int
) -> list[ObjectChange]:
    """Decide a building with its extensions.

    An extension that closes the gap to the next house makes one instance of both. Where the other epoch holds
    the houses apart, the extension belongs to the one that it adjoins the most.
    """
    pieces = [(extension.before, extension.after) for extension in extensions]
    bodies = split_by_bodies(host.before, host.after, rules.association, following)
    if len(bodies) > 1 and all(b and a for b, a in bodies):
        touch = rules.association.parts.touch
        owner = [_owner(piece, bodies, touch) for piece in pieces]
        parts = [
            _decide_together([body, *(e for e, k in zip(pieces, owner, strict=True) if k == number)], rules)
            for number, body in enumerate(bodies)
        ]
        claimed = any(part.decision.change in CHANGED for part in parts)
        if claimed and not any(_is_apart(part, rules) for part in parts):
            return parts
    return [_decide_together([(host.before, host.after), *pieces], rules)]


def _is_apart(change: ObjectChange, rules: ObjectRules) -> bool:
    """Tell whether both epochs have an object, and too little of it in common to be compared."""
    decisions, sides = rules.decisions, (change.before, change.after)
    least = {
        Semantic.BUILDING: decisions.building.min_iou,
        Semantic.VEGETATION: decisions.vegetation.min_iou,
        Semantic.OTHER: decisions.mobile.same_iou,
    }
    overlaps = change.measures.iou > least.get(change.semantic, -1.0)
    if not all(sides) or (overlaps and not _remains_little(change, rules)):
        return False
    return change.semantic is not Semantic.OTHER or all(is_fixed(parts, rules.decisions) for parts in sides)


def _remains_little(change: ObjectChange, rules: ObjectRules) -> bool:
    """Tell whether a building stands in one epoch, and a fence or a container in its place in the other."""
    if change.semantic is not Semantic.BUILDING or not (change.before and change.after):
        return False
    tops = [height_of(objects) for objects in (change.before, change.after)]
    low = min(tops) < rules.measures.carving.room <= max(tops)
    return low or min(tops) < _REMAINS * max(tops)


def _owner(piece: Piece, bodies: Sequence[Piece], touch: float) -> int:
    """Return the position of the body to which a piece of one epoch belongs, within a distance [m].

    The epoch without the piece shows where the bodies end; in the other one all may be one body.
    """
    without = 0 if piece[1] else 1
    xyz = join_voxels(piece[1 - without]).xyz
    gaps = [gaps_to_host(xyz, join_voxels(body[without]).xyz, touch) for body in bodies]
    return min(range(len(bodies)), key=lambda i: remoteness(gaps[i]))


def _decide_together(pieces: Sequence[Piece], rules: ObjectRules) -> ObjectChange:
    """Decide pieces of both epochs as one building."""
    before, after = ([t for piece in pieces for t in piece[epoch]] for epoch in (0, 1))
    return decide_object(before, after, Semantic.BUILDING, rules)


@switchable("hidden_walls", first_argument)
def join_hidden_walls(changes: list[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Join a wall that the other epoch hardly observed to the changed building it belongs to.

    A wall within the outline of a house is a wall of it: pieces of one body are one row. Where absence is
    assumed and not observed, what was built may hide any wall, also of a house without a change of its own.
    """
    hosts = {
        i: shapely.MultiPoint(join_voxels((*c.before, *c.after)).xyz[:, :2]).convex_hull.buffer(_WALL)
        for i, c in enumerate(changes)
        if c.semantic is Semantic.BUILDING and (_is_reshaped(c) or _is_assumed(c, rules))
    }
    joined: dict[int, list[int]] = {}
    for number, change in enumerate(changes):
        alone = (*change.before, *change.after)
        low_part = change.semantic is Semantic.OTHER and all(t.is_part for t in alone)
        if (
            not (change.semantic is Semantic.BUILDING or low_part)
            or (change.before and change.after)
            or not _is_hardly_observed(change, rules)
        ):
            continue
        xyz = join_voxels(alone).xyz
        shares = {i: shapely.contains_xy(o, xyz[:, 0], xyz[:, 1]).mean() for i, o in hosts.items()}
        best = max(shares, key=lambda i: shares[i], default=number)
        if shares.get(best, 0.0) >= _WITHIN:
            joined.setdefault(best, []).append(number)
    return join_rows(changes, joined)


def _is_reshaped(change: ObjectChange) -> bool:
    return change.decision.change in (Change.INCREASED, Change.DECREASED)


def _is_assumed(change: ObjectChange, rules: ObjectRules) -> bool:
    """Tell whether both epochs have an object, and nothing tells what they saw of the space around."""
    return bool(change.before and change.after) and None in rules.ground.empty


def _is_hardly_observed(change: ObjectChange, rules: ObjectRules) -> bool:
    """Tell whether the epoch that lacks an object hardly saw its place, or nothing tells what it saw."""
    other = 1 if change.before else 0
    return rules.ground.empty[other] is None or change.measures.observed_fraction < _HARDLY


@switchable("hardly_overlapping", first_argument)
def part_hardly_overlapping(changes: Sequence[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Decide the objects of a match apart where they overlap too little to be compared (paper: limit of IoU).

    A house that was built over the remains of a wall is a new house, and so is a wall beside a former fence.
    """
    told: list[ObjectChange] = []
    for change in changes:
        parts = [change]
        if _is_apart(change, rules):
            apart = (
                decide_object(change.before, (), change.semantic, rules),
                decide_object((), change.after, change.semantic, rules),
            )
            replaced = _is_reshaped(change) and not _remains_little(change, rules) and _encloses(apart, rules)
            changed = any(p.decision.change in CHANGED for p in apart)
            parts = list(apart) if changed and not replaced else parts
        told.extend(parts)
    return told


def _encloses(apart: Sequence[ObjectChange], rules: ObjectRules) -> bool:
    """Tell whether a house stands around the place of a smaller one, which no beam of its survey reached.

    ``apart``: the two, as objects of one epoch each. The walls of a house that was replaced by a larger one
    lie inside the new house.
    """
    hidden = next((p for p in apart if p.decision.change is Change.UNOBSERVED), None)
    if hidden is None or hidden.semantic is not Semantic.BUILDING or not _is_hardly_observed(hidden, rules):
        return False
    other = next(p for p in apart if p is not hidden)
    one, around = (join_voxels((*p.before, *p.after)) for p in (hidden, other))
    return bool(in_outline_of(around.xyz[:, :2], one.xyz[:, :2]).mean() >= _WITHIN)


@switchable("multi_body_matches", first_argument)
def split_multi_body_matches(changes: Sequence[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Decide the bodies of a split or merge one by one where they did not fare alike."""
    following = _first_free(changes)
    told: list[ObjectChange] = []
    for change in changes:
        pieces = split_by_bodies(change.before, change.after, rules.association, following)
        if len(pieces) == 1:
            told.append(change)
            continue
        parts = [decide_object(b, a, change.semantic, rules) for b, a in pieces]
        labels = {part.decision.change for part in parts if not _is_apart(part, rules)}
        told.extend(parts if len(labels) > 1 and not labels.isdisjoint(CHANGED) else [change])
        following += sum(len(p.before) + len(p.after) for p in parts)
    return told


def _first_free(changes: Sequence[ObjectChange]) -> int:
    """Return the first instance number that no part has."""
    return 1 + max((t.instance for c in changes for t in (*c.before, *c.after)), default=0)


@switchable("row_houses_at_walls", first_argument)
def split_row_houses(changes: Sequence[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Decide the houses of a row one by one where they fared differently, parted as either epoch shows.

    The roof of a carport between two houses makes no row of them.
    """
    if rules.association.parts.points == 0:
        return list(changes)
    numbers = [
        i
        for i, change in enumerate(changes)
        if change.semantic is Semantic.BUILDING and not is_roof_on_posts(change.before, change.after, rules)
    ]
    pieces = [(changes[i].before, changes[i].after) for i in numbers]
    claimed = [changes[i].decision.change in ONE_EPOCH for i in numbers]
    pairs = [_bodies(changes[i], rules.measures.carving.room) for i in numbers]
    apart = partial(stands_apart, pairs=pairs, taken={}, config=rules.association.parts, ground=rules.ground)
    following = _first_free(changes)
    told: dict[int, list[ObjectChange]] = {i: [change] for i, change in enumerate(changes)}
    for row in group_row_houses(pieces, claimed, rules.association, apart):
        members = [numbers[k] for k in row]
        before, after = ([t for i in members for t in getattr(changes[i], e)] for e in ("before", "after"))
        if not before or not after:
            continue
        parts = _fared(split_at_walls(before, after, rules.association, following), rules)
        if parts and _labels(parts) != _labels([changes[i] for i in members]):
            following += sum(len(p.before) + len(p.after) for p in parts)
            told |= {i: [] for i in members} | {members[0]: parts}
    return [change for some in told.values() for change in some]


def _labels(changes: Sequence[ObjectChange]) -> Counter[Change]:
    """Count the labels of rows."""
    return Counter(change.decision.change for change in changes)


def _fared(pieces: Sequence[Piece], rules: ObjectRules) -> list[ObjectChange]:
    """Decide the houses of a row one by one; none where they fared alike.

    A piece that has no partner, and is not seen to be new or gone, is no house: it joins the piece nearest to
    it. So does one that hardly overlaps its partner; a fence on its plot is no partner.
    """
    if len(pieces) == 1 or not any(b and a for b, a in pieces):
        return []
    houses = [(piece, _as_house(piece, rules)) for piece in pieces]
    while len(houses) > 1:
        lone = next((k for k, (_, parts) in enumerate(houses) if not _are_houses(parts, rules)), None)
        if lone is None:
            parts = [part for _, some in houses for part in some]
            labels = {part.decision.change for part in parts}
            return parts if len(labels) > 1 and not labels.isdisjoint(CHANGED) else []
        piece, _ = houses.pop(lone)
        hosts = [k for k, ((b, a), _) in enumerate(houses) if b and a]
        if not hosts:
            return []
        host = min(hosts, key=lambda k: _gap(piece, houses[k][0]))
        together = houses[host][0][0] + piece[0], houses[host][0][1] + piece[1]
        houses[host] = together, _as_house(together, rules)
    return []


def _as_house(piece: Piece, rules: ObjectRules) -> list[ObjectChange]:
    """Decide a house of a row; apart in both epochs where next to nothing of it stands in one of them.

    A few points, as of a party wall, are too small to be a part of anything.
    """
    both = decide_object(*piece, Semantic.BUILDING, rules)
    points = [sum(len(t.xyz) for t in side) for side in piece]
    little = 0 < min(points) < rules.association.parts.points or _remains_little(both, rules)
    return part_hardly_overlapping([both], rules) if little else [both]


def _are_houses(parts: Sequence[ObjectChange], rules: ObjectRules) -> bool:
    """Tell whether what became of a piece of a row is known, as that of a house of its own.

    ``parts``: the piece, or what either epoch has of it.
    """
    first = parts[0]
    known = len(parts) > 1 or (first.before and first.after) or first.decision.change in ONE_EPOCH
    return bool(known) and not any(_is_apart(p, rules) for p in parts)


def _gap(one: Piece, other: Piece) -> float:
    """Smallest distance of two pieces seen from above, whatever the epoch [m]."""
    places = [join_voxels((*b, *a)).xyz[:, :2] for b, a in (one, other)]
    return float(cKDTree(places[0]).query(places[1])[0].min())


@switchable("hedge_sections", first_argument)
def split_hedge_segments(changes: Sequence[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Give sections of hedges and fences whose tops moved rows of their own, or nearly all one row."""
    if rules.association.parts.points == 0:
        return list(changes)
    following = _first_free(changes)
    parted: list[ObjectChange] = []
    for change in changes:
        pieces = _sections(change, following, rules)
        parted.extend(pieces)
        following += sum(len(p.before) + len(p.after) for p in pieces)
    return parted


def _sections(change: ObjectChange, following: int, rules: ObjectRules) -> list[ObjectChange]:
    least = _least_rise(change, rules.decisions)
    if not math.isfinite(least):
        return [change]
    limit = max(least, rules.decisions.lod_factor * change.lod)
    fence = change.semantic is Semantic.OTHER  # a wall with plants on it may show its top in one epoch alone
    sections, columns = changed_sections(
        change.before, change.after, limit, rules.spaces, rules.plants.tops, alone=fence
    )
    if not sections:
        return [change]
    alike = len({s.rise > 0 for s in sections}) == 1
    whole = alike and sum(len(s.xy) for s in sections) >= _WHOLE * len(columns)
    if applies("whole_hedges", whole):
        largest = max(sections, key=lambda s: len(s.xy))
        return [_of_section(change, largest, rules, only=False)]
    sides: list[list[list[ObjectInstance]]] = []
    for objects in (change.before, change.after):
        side: list[list[ObjectInstance]] = [[] for _ in range(len(sections) + 1)]
        for obj in objects:
            numbers, labels = np.unique(section_labels(obj, sections, columns), return_inverse=True)
            for number, piece in zip(numbers.tolist(), split_by_labels(obj, labels, following), strict=True):
                side[number].append(piece)
            following += len(numbers)
        sides.append(side)
    rest, *moved = zip(*sides, strict=True)
    if not all(b and a for b, a in moved) or bool(rest[0]) != bool(rest[1]):
        return [change]
    left = [decide_object(rest[0], rest[1], change.semantic, rules)] if rest[0] else []
    pieces = [decide_object(b, a, change.semantic, rules) for b, a in moved]
    return [*left, *(_of_section(p, s, rules, only=True) for p, s in zip(pieces, sections, strict=True))]


def _least_rise(change: ObjectChange, config: DecisionConfig) -> float:
    """Return the least change of tops that makes a section [m] of a hedge or fence of both epochs."""
    if not (change.before and change.after):
        return math.inf
    if change.semantic is Semantic.VEGETATION:
        return config.vegetation.height
    stayed = change.semantic is Semantic.OTHER and change.decision.change is Change.UNCHANGED
    return config.mobile.height if applies("fences_by_tops", stayed) else math.inf


def _of_section(
    change: ObjectChange, section: HedgeSection, rules: ObjectRules, *, only: bool
) -> ObjectChange:
    """Decide a hedge or fence, or the piece of one that is a section, by the section whose tops moved."""
    if change.semantic is Semantic.OTHER:
        return replace(
            change,
            measures=replace(change.measures, delta_h=section.rise),
            decision=_decide_fence(section),
        )
    if change.plant is None:
        return change
    plant = replace(change.plant, section=section.rise, section_gate=section.gate, section_only=only)
    decision = decide_plant(plant, change.lod, rules.decisions, no_null(rules.plants.null_model))
    return replace(change, plant=plant, decision=decision)


def _decide_fence(section: HedgeSection) -> Decision:
    """Decide a fence, a wall or what else is fixed by its section whose tops moved."""
    rose = section.rise > 0
    reason = f"The top changed by {section.rise:+.2f} m (limit {section.gate:.2f} m): the object is"
    reason += f" {'higher' if rose else 'lower'} than before."
    change = Change.INCREASED if rose else Change.DECREASED
    return Decision(change, reason, abs(section.rise) / section.gate)


def join_rows(changes: Sequence[ObjectChange], joined: Mapping[int, Sequence[int]]) -> list[ObjectChange]:
    """Let rows join others by position; every row that is left keeps its own decision and measures."""
    gone = {number for numbers in joined.values() for number in numbers}
    return [
        _with_fragments(change, [changes[k] for k in joined.get(number, [])])
        for number, change in enumerate(changes)
        if number not in gone
    ]


def _with_fragments(change: ObjectChange, fragments: Sequence[ObjectChange]) -> ObjectChange:
    """Return a row with the points of other rows."""
    before = (*change.before, *(t for f in fragments for t in f.before))
    after = (*change.after, *(t for f in fragments for t in f.after))
    kind = match_kind(len(before), len(after))
    return replace(change, before=before, after=after, match_kind=kind)


def _classes_as_they_are(
    before: list[ObjectInstance], after: list[ObjectInstance], *_: object
) -> tuple[list[ObjectInstance], list[ObjectInstance]]:
    """Return the objects with their own classes."""
    return before, after


@switchable("one_class_one_place", _classes_as_they_are)
def unify_classes(
    before: list[ObjectInstance], after: list[ObjectInstance], config: AssociationConfig, tolerance: float
) -> tuple[list[ObjectInstance], list[ObjectInstance]]:
    """Give one object one class (C6): where two objects mostly coincide, the better score wins."""
    if not before or not after:
        return before, after
    forward, backward = overlap_counts(before, after, tolerance)
    before, after = list(before), list(after)
    common = forward.multiply(backward.T).tocoo()
    for i, j in zip(common.row.tolist(), common.col.tolist(), strict=True):
        b, a = before[i], after[j]
        if b.semantic is a.semantic:
            continue
        shares = (forward[i, j] / len(b.voxels), backward[j, i] / len(a.voxels))
        if min(shares) < config.same_place:
            continue
        winner = b.semantic if b.score >= a.score else a.semantic
        before[i], after[j] = replace(b, semantic=winner), replace(a, semantic=winner)
    return before, after
