"""Parts of vehicles that exist in one epoch only.

Where another vehicle stands in the place of the first, it is longer or higher by a part; and of a parked
vehicle, one epoch may have seen an end that the other only grazed.
"""

from __future__ import annotations

from collections.abc import Sequence

from shapely import Point

from subiaco_change.decisions.rules import Decision
from subiaco_change.geometry import in_box_around, lies_near
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import applies, no_decision, switchable
from subiaco_change.objects.measures import Measures, footprint_sides, oriented_rectangle
from subiaco_change.objects.voxel_objects import ObjectInstance, join_voxels
from subiaco_change.segmentation.bounding_rectangles import in_box_of
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats

_ACROSS = NUMBERS.vehicle_parts.crossed_share
_VEHICLE = NUMBERS.vehicle_parts.vehicle_width
_NEXT = NUMBERS.vehicle_parts.adjacent
_HELD = NUMBERS.vehicle_parts.adjacent_share
_LENGTH = NUMBERS.vehicle_parts.vehicle_length
_HELD_END = NUMBERS.vehicle_parts.adjacent_share_of_end


@switchable("parts_of_vehicles", no_decision)
def decide_vehicle_part(
    objects: Sequence[ObjectInstance], semantic: Semantic, measures: Measures, standing: Floats
) -> Decision | None:
    """Decide what was parted from a vehicle and stands in one epoch alone; None where it may be one.

    A part as wide as a vehicle and shorter is the end of a longer vehicle that stood in the place of another
    one, if only some of the part lies beside what the other epoch has.

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
    narrow, long = footprint_sides(xyz)
    short = applies("ends_of_vehicles", _VEHICLE <= long < _LENGTH)
    if narrow >= _VEHICLE and not short:
        return _decide_shell(xyz, long, standing)
    held = float(lies_near(xyz, standing, _NEXT).mean())
    limit = _HELD_END if short else _HELD
    if held < limit:
        return None
    reason = (
        f"{held:.0%} of this part of a vehicle lies beside points of the other survey (limit"
        f" {limit:.0%}): the part belongs to an object that both surveys have."
    )
    return Decision(Change.UNCHANGED, reason, held)


@switchable("shells_of_vehicles", no_decision)
def _decide_shell(xyz: Floats, long: float, standing: Floats) -> Decision | None:
    """Decide a part (M, 3) as large as a vehicle, whose longer side is ``long`` [m].

    A lorry leaves its sides around the car that stands in its place in the other epoch, whose points
    ``standing`` (N, 3) are; what surrounds nothing is a vehicle of its own.
    """
    if not _surrounds(xyz, standing):
        return None
    reason = (
        f"This part of a vehicle is {long:.1f} m long (limit {_LENGTH:g} m) and lies around an object of the"
        " other survey: another vehicle is in the place of the first, and no change is claimed."
    )
    return Decision(Change.UNCHANGED, reason, long / _LENGTH)


def _surrounds(xyz: Floats, points: Floats) -> bool:
    """Tell whether places (M, 3) lie around points (N, 3) as long as a car: the sides of a larger vehicle."""
    inside = points[in_box_around(points, xyz, 0.0)]
    inside = inside[in_box_of(xyz[:, :2], inside[:, :2], 0.0)]
    if len(inside) == 0 or footprint_sides(inside)[1] < _LENGTH:
        return False
    return bool(oriented_rectangle(inside[:, :2]).contains(Point(xyz[:, :2].mean(axis=0))))
