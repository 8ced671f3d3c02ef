"""Parts of a vehicle instance that exist in one epoch only and are no vehicles.

Where another vehicle stands in the place of the first, it is longer or higher by something; and of what
stood still, one epoch may have seen an end that the other only grazed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.decisions.measures import Measures, oriented_rectangle
from subiaco_change.decisions.rules import Decision
from subiaco_change.decisions.voxel_objects import ObjectInstance, join_voxels
from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats

_ACROSS = NUMBERS.vehicle_parts.crossed_share
_VEHICLE = NUMBERS.vehicle_parts.vehicle_width
_NEXT = NUMBERS.vehicle_parts.adjacent
_HELD = NUMBERS.vehicle_parts.adjacent_share


def decide_vehicle_part(
    objects: Sequence[ObjectInstance], semantic: Semantic, measures: Measures, standing: Floats
) -> Decision | None:
    """Decide what was parted from a vehicle and stands in one epoch alone; None where it may be one.

    ``standing`` (N, 3) are the points of the other epoch that stand, of any class.
    """
    if semantic is not Semantic.MOBILE or any(t.whole < 0 for t in objects):
        return None
    across = 0.5 * abs(measures.net_changed_fraction) / max(measures.gone_share, measures.new_share)
    if across < _ACROSS:
        reason = (
            f"The other survey observed {across:.0%} of this part of a vehicle, less than the limit of"
            f" {_ACROSS:.0%}: nothing is claimed."
        )
        return Decision(Change.UNOBSERVED, reason, 1.0 - across)
    xyz = join_voxels(objects).xyz
    held = _held(xyz, standing)
    if held < _HELD or _width(xyz) >= _VEHICLE:
        return None
    reason = (
        f"{held:.0%} of this part of a vehicle lies beside points of the other survey (limit"
        f" {_HELD:.0%}): the part belongs to an object that both surveys have."
    )
    return Decision(Change.UNCHANGED, reason, held)


def _held(xyz: Floats, standing: Floats) -> float:
    """Share of places (M, 3) beside points (N, 3)."""
    near = ((standing >= xyz.min(axis=0) - _NEXT) & (standing <= xyz.max(axis=0) + _NEXT)).all(axis=1)
    if not near.any():
        return 0.0
    return float(np.mean(cKDTree(standing[near]).query(xyz)[0] <= _NEXT))


def _width(xyz: Floats) -> float:
    """Shorter side of the footprint of places (M, 3) [m]."""
    corners = np.array(oriented_rectangle(xyz[:, :2]).exterior.coords)
    return float(np.linalg.norm(np.diff(corners[:3], axis=0), axis=1).min())
