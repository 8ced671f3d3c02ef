"""Hedges that were shortened or extended: a piece of one survey continues a hedge of both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.decisions.object_decision import ObjectChange, ObjectRules, decide_object
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import first_argument, switchable
from subiaco_change.objects.voxel_objects import Voxels, join_voxels
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.bounding_rectangles import box_sides
from subiaco_geo.codes import ONE_EPOCH, Change, Semantic

_CELL = NUMBERS.hedges_in_line.beneath
_REACH = NUMBERS.hedges_in_line.reach
_ENOUGH = NUMBERS.hedges_in_line.voxels
_HEDGE = NUMBERS.hedges_in_line.largest_height
_SAME_TOP = NUMBERS.hedges_in_line.top
_SLENDER = NUMBERS.hedges_in_line.slender
_LONGER = NUMBERS.hedges_in_line.longer


@switchable("hedges_in_line", first_argument)
def join_hedges_in_line(changes: list[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Decide a hedge together with the piece of one epoch that continues it.

    The piece lies in the line of the hedge, as high and as wide. It is no plant of its own that was felled or
    planted: the hedge is shorter or longer.
    """
    pieces = [i for i, c in enumerate(changes) if _is_plant(c) and _is_piece(c)]
    hosts = [i for i, c in enumerate(changes) if _is_plant(c) and c.before and c.after]
    bodies = {i: join_voxels((*changes[i].before, *changes[i].after)) for i in (*pieces, *hosts)}
    told = list(changes)
    gone: set[int] = set()
    for piece in pieces:
        host = next((i for i in hosts if _continues(bodies[piece], bodies[i])), None)
        if host is None:
            continue
        joined = _joined(told[host], told[piece], bodies[piece], rules)
        if joined is not None:
            told[host] = joined
            gone.add(piece)
    return [change for number, change in enumerate(told) if number not in gone]


def _joined(host: ObjectChange, piece: ObjectChange, body: Voxels, rules: ObjectRules) -> ObjectChange | None:
    """Return the row of a hedge with a piece; None where that is too small, or the rest did the opposite."""
    before, after = (*host.before, *piece.before), (*host.after, *piece.after)
    change, whole, lost, shrank = (
        (Change.DECREASED, before, "lost", "shrank")
        if piece.before
        else (Change.INCREASED, after, "gained", "grew")
    )
    share = len(body) / sum(len(t.voxels) for t in whole)
    limit = rules.decisions.vegetation.surface
    if host.decision.change not in (Change.UNCHANGED, change) or share < limit:
        return None
    found = decide_object(before, after, Semantic.VEGETATION, rules)
    length = box_sides(body.xyz[:, :2])[0]
    reason = (
        f"Hedge: it {lost} {length:.1f} m of its length, {100 * share:.0f} % of its surface (limit "
        f"{100 * limit:.0f} %): the plant {shrank}."
    )
    decision = replace(piece.decision, change=change, reason=reason)
    return replace(found, decision=decision, plant=None)


def _is_piece(change: ObjectChange) -> bool:
    """Tell whether an object of one epoch was a part of a larger plant: what stood apart is its own plant."""
    alone = (*change.before, *change.after)
    return change.decision.change in ONE_EPOCH and all(t.is_part for t in alone)


def _is_plant(change: ObjectChange) -> bool:
    return change.semantic is Semantic.VEGETATION


def _continues(piece: Voxels, host: Voxels) -> bool:
    """Tell whether a piece and what a hedge has beside it are in one line, as high and as wide."""
    low, high = piece.xyz[:, :2].min(axis=0) - _REACH, piece.xyz[:, :2].max(axis=0) + _REACH
    near = np.flatnonzero(((host.xyz[:, :2] > low) & (host.xyz[:, :2] < high)).all(axis=1))
    if len(near) < _ENOUGH:
        return False
    apart = cKDTree(piece.xyz[:, :2]).query(host.xyz[near, :2])[0]
    beside = host.select(near[(apart > _CELL) & (apart < _REACH)])  # beneath the piece grows grass
    if len(beside) < _ENOUGH:
        return False
    tops = [quantile_of(own.height, 0.95) for own in (piece, beside)]
    if max(tops) > _HEDGE or abs(tops[0] - tops[1]) > _SAME_TOP:
        return False
    own, other, joint = (
        box_sides(voxels.xyz[:, :2]) for voxels in (piece, beside, Voxels.joined([piece, beside]))
    )
    narrow = joint[1] <= min(max(own[1], other[1]) + _CELL, _SLENDER * joint[0])
    return narrow and joint[0] >= max(own[0], other[0]) + _LONGER
