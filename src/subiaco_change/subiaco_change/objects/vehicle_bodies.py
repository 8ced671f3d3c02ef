"""Bodies of vehicles: a place inside a vehicle of one epoch is occupied in that epoch.

A survey sees one or two sides of a vehicle and often its roof. Beams that cross its windows do not show that
its inside was free, nor do gaps between the points of a sparse cloud.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from subiaco_change.geometry import in_box_around
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import none_of_them, switchable
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.bounding_rectangles import box_sides, in_box_of
from subiaco_change.segmentation.clustering import group_indices
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats

if TYPE_CHECKING:
    from subiaco_change.objects.voxel_objects import EpochView

_NARROWEST, _WIDEST = NUMBERS.vehicle_bodies.width
_SHORTEST, _LONGEST = NUMBERS.vehicle_bodies.length
_TOP = NUMBERS.vehicle_bodies.top_share


@switchable("closed_vehicles", none_of_them)
def inside_vehicles(places: Floats, view: EpochView) -> Mask:
    """Tell which places (M, 3) lie inside the vehicles of an epoch, in its frame [m]."""
    found = np.zeros(len(places), dtype=bool)
    members = np.flatnonzero((view.semantic == Semantic.MOBILE) & (view.instance >= 0))
    for group in group_indices(view.instance[members].astype(np.int64)):
        if len(group) == 0:  # a number that no vehicle has
            continue
        xyz = view.xyz[members[group]]
        near = np.flatnonzero(in_box_around(places, xyz, 0.0))
        long, narrow = box_sides(xyz[:, :2])
        if len(near) and _NARROWEST <= narrow <= _WIDEST and _SHORTEST <= long <= _LONGEST:
            below = places[near, 2] <= quantile_of(xyz[:, 2], _TOP)
            found[near[below & in_box_of(xyz[:, :2], places[near, :2], 0.0)]] = True
    return found
