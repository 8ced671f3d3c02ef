"""Trees that were cut down to their trunks or grew from them: one plant, and no felled tree beside a post."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from subiaco_change.decisions.object_decision import ObjectChange, ObjectRules, decide_object
from subiaco_change.decisions.rules import Decision
from subiaco_change.geometry import lies_near
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import first_argument, switchable
from subiaco_change.objects.voxel_objects import height_of, join_voxels
from subiaco_geo.codes import ONE_EPOCH, Change, Semantic
from subiaco_geo.frames import Floats

_WIDE = NUMBERS.standing_trunks.width
_FOOT = NUMBERS.standing_trunks.foot
_LEAST = NUMBERS.standing_trunks.least_top
_CROWN = NUMBERS.standing_trunks.crown
_REACH = NUMBERS.standing_trunks.reach


@switchable("standing_trunks", first_argument)
def join_standing_trunks(changes: list[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Decide a tree of one epoch together with the trunk that both epochs have below the middle of its crown.

    A tree that was cut down to its trunk shrank, and one that grew from a trunk grew. Where the crowns of
    both epochs have nothing in common, as those of a palm that grew, their tops decide.
    """
    trunks = [number for number, change in enumerate(changes) if _is_trunk(change)]
    if not trunks:
        return changes
    places = np.array([_circle(changes[number])[0] for number in trunks])
    crowns: dict[int, list[int]] = {}
    for number, change in enumerate(changes):
        if change.semantic is Semantic.VEGETATION and change.decision.change in ONE_EPOCH:
            middle, radius = _circle(change)
            away = np.hypot(*(places - middle).T)
            nearest = int(away.argmin())
            if away[nearest] <= _REACH * radius:
                crowns.setdefault(trunks[nearest], []).append(number)
    told = list(changes)
    gone: set[int] = set()
    for trunk, members in crowns.items():
        one_epoch = len({bool(changes[k].before) for k in members}) == 1
        found = [k for k in members if not one_epoch or _stands_below(changes[trunk], changes[k], rules)]
        joined = _joined(changes[trunk], [changes[k] for k in found], rules)
        if joined is not None:
            told[trunk] = joined
            gone.update(found)
    return [change for number, change in enumerate(told) if number not in gone]


def _is_trunk(change: ObjectChange) -> bool:
    """Tell whether an object stands on the ground in both epochs and is no wider than a trunk."""
    if change.semantic not in (Semantic.VEGETATION, Semantic.OTHER):
        return False
    if change.decision.change is not Change.UNCHANGED:
        return False
    voxels = [join_voxels(side) for side in (change.before, change.after) if side]
    foot = min(float(v.height.min()) for v in voxels)
    return foot <= _FOOT and min(_width(v.xyz) for v in voxels) <= _WIDE


def _stands_below(trunk: ObjectChange, tree: ObjectChange, rules: ObjectRules) -> bool:
    """Tell whether the epoch without a tree has a trunk that ends well below the top of the tree."""
    left, space = (trunk.after, rules.spaces[1]) if tree.before else (trunk.before, rules.spaces[0])
    if not left or not _LEAST <= height_of(left) <= height_of((*tree.before, *tree.after)) - _CROWN:
        return False
    return not _goes_on(np.concatenate([t.xyz for t in left]), space.standing)


def _goes_on(xyz: Floats, standing: Floats) -> bool:
    """Tell whether points of an epoch (M, 3) follow right above places (N, 3): the foot of a pole."""
    above = standing[:, 2] - xyz[:, 2].max()
    next_above = standing[(above > 0.0) & (above <= 0.5 * _CROWN)]
    return bool(lies_near(xyz[:, :2].mean(axis=0)[None], next_above[:, :2], 0.5 * _WIDE)[0])


def _circle(change: ObjectChange) -> tuple[Floats, float]:
    """Return the middle (2,) and the radius of an object, half the mean width of its box from above [m]."""
    xy = join_voxels((*change.before, *change.after)).xyz[:, :2]
    low, high = xy.min(axis=0), xy.max(axis=0)
    return 0.5 * (low + high), float(0.5 * (high - low).mean())


def _width(xyz: Floats) -> float:
    """Return the width of the middle nine tenths of places (N, 3), seen from above [m]."""
    return float(np.ptp(np.quantile(xyz[:, :2], (0.05, 0.95), axis=0), axis=0).max())


def _joined(trunk: ObjectChange, trees: list[ObjectChange], rules: ObjectRules) -> ObjectChange | None:
    """Return the row of a trunk with its trees; None without any, and where the tops are alike."""
    if not trees:
        return None
    before = (*trunk.before, *(t for tree in trees for t in tree.before))
    after = (*trunk.after, *(t for tree in trees for t in tree.after))
    tops = height_of(before), height_of(after)
    rise = tops[1] - tops[0]
    limit = rules.decisions.vegetation.height
    if abs(rise) < limit:
        return None
    change, grew = (Change.INCREASED, "grew") if rise > 0 else (Change.DECREASED, "shrank")
    reason = (
        f"Both surveys have the trunk of the plant. The top changed from {tops[0]:.1f} to {tops[1]:.1f} m"
        f" above the ground, by {rise:+.2f} m (limit {limit:.2f} m): the plant {grew}."
    )
    found = decide_object(before, after, Semantic.VEGETATION, rules)
    decision = Decision(change, reason, abs(rise) / limit)
    return replace(found, decision=decision, plant=None)
