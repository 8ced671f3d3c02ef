"""Which true changes lie within the uncertainty of their own measurement of a gate.

The truth of an object is measured too: on columns of 0.5 m, from the surface of its form. Its uncertainty is
what other columns, other places on the surface and other leaves of the same form would have made of it, and
at least what the best survey could know of such a surface. An object is *near a gate* when, anywhere within
twice that uncertainty of its measured values, the published thresholds would give it another label.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from subiaco_sim.ground import Patch, Strip
from subiaco_sim.labels import (
    COLUMN,
    GROUND_AREA,
    GROUND_RISE,
    Body,
    Labels,
    TrueChange,
    column_iou,
    columns_of,
    decide,
    skin_of,
)
from subiaco_sim.scene import EPOCHS, VEGETATION, GroundItem, Item, Scene

#: Repeated measurements: by how much the grid of columns is moved in x and y [columns].
_GRIDS = ((0.5, 0.0), (0.0, 0.5), (0.5, 0.5))
_COVERAGE = 2.0  # standard uncertainties within which a value lies with 95 %
_EDGE = 0.05  # uncertainty of the outline of a ground work, all around [m]
_GROUND = 0.02  # uncertainty of its rise [m]


@dataclass(frozen=True)
class Uncertainty:
    """Standard uncertainties of height [m], share of volume, centroid [m] and IoU."""

    height: float
    share: float
    centroid: float
    iou: float


#: What the best survey leaves uncertain of a solid surface, and of a crown.
_SOLID = Uncertainty(0.03, 0.01, 0.05, 0.02)
_CROWN = Uncertainty(0.05, 0.02, 0.10, 0.03)

#: More than any object's own: what is not near a gate with it is not measured again.
_WIDEST = Uncertainty(0.15, 0.05, 0.25, 0.10)


def near_gates(scene: Scene, labels: Labels) -> set[int]:
    """Return the ids of all objects and ground works whose true change lies near a gate."""
    near = {
        item.object_id
        for item in scene.items
        if not np.isnan((true := labels.measured[item.object_id]).delta_h)
        and true.before is not true.after
        and near_gate(item.semantic, true, _WIDEST)
        and near_gate(item.semantic, true, uncertainty_of(item, scene, true))
    }
    return near | {item.object_id for item in scene.ground_items if ground_near_gate(item)}


def uncertainty_of(item: Item, scene: Scene, true: TrueChange) -> Uncertainty:
    """Measure an object of both epochs again on other grids and with other leaves; return the scatter."""
    least = _CROWN if item.semantic == VEGETATION else _SOLID
    found = [_values(true.before, true.after)] + [
        _values(*_again(item, scene, number, grid)) for number, grid in enumerate(_GRIDS, 1)
    ]
    scatter = np.std(found, axis=0, ddof=1)
    floor = (least.height, least.share, least.centroid, least.iou)
    return Uncertainty(*(float(np.hypot(a, b)) for a, b in zip(scatter, floor, strict=True)))


def _again(item: Item, scene: Scene, number: int, grid: tuple[float, float]) -> tuple[Body, Body]:
    """Measure both epochs of an object once more."""
    bodies = []
    for k, epoch in enumerate(EPOCHS):
        placed = item.at(epoch)
        assert placed is not None
        points, foot = skin_of(placed, item.semantic, scene, epoch, 2 * number + k, number)
        bodies.append(columns_of(points, foot, (COLUMN * grid[0], COLUMN * grid[1])))
    return bodies[0], bodies[1]


def _values(before: Body | None, after: Body | None) -> tuple[float, float, float, float]:
    assert before is not None
    assert after is not None
    moved = float(np.linalg.norm(after.centroid - before.centroid))
    share = (after.volume - before.volume) / before.volume
    return after.h95 - before.h95, share, moved, column_iou(before, after)


def near_gate(semantic: int, true: TrueChange, uncertainty: Uncertainty) -> bool:
    """Tell whether another label lies within twice the uncertainty of the measured values."""
    assert true.before is not None
    steps = (-_COVERAGE, 0.0, _COVERAGE)
    labels = set()
    for h, v, c, overlap in product(steps, steps, steps, steps):
        share = true.delta_v / true.before.volume + v * uncertainty.share
        labels.add(
            decide(
                semantic,
                true.delta_h + h * uncertainty.height,
                share * true.before.volume,
                share,
                max(0.0, true.delta_c + c * uncertainty.centroid),
                min(1.0, true.iou + overlap * uncertainty.iou),
            )
        )
    return len(labels) > 1


def ground_near_gate(item: GroundItem) -> bool:
    """Tell whether the rise or the area of a ground work lies within its uncertainty of the gates."""
    area = item.patch.area
    rise, slack = abs(item.patch.rise), _COVERAGE * _EDGE * _perimeter(item.patch)
    low = rise - _COVERAGE * _GROUND > GROUND_RISE and area - slack > GROUND_AREA
    high = rise + _COVERAGE * _GROUND > GROUND_RISE and area + slack > GROUND_AREA
    return low != high


def _perimeter(patch: Patch | Strip) -> float:
    return float(patch.outline().length)
