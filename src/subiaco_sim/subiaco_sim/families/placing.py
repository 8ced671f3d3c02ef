"""Frontages of drawn widths along a street, and placing things where nothing stands yet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from subiaco_sim.scene import Item, Placed, Shape
from subiaco_sim.suburb import Layout, Lot, from_lot, rectangle, walk_lots

_TIGHT = 0.7  # of the curvature times the distance from the crown: no lot inside sharper bends


@dataclass(frozen=True)
class Frontage:
    """A lot at the building line, its place being the middle of its front, and its width [m]."""

    lot: Lot
    width: float


def frontages(layout: Layout, widths: tuple[float, float], line: float) -> Iterator[Frontage]:
    """Yield lots of drawn widths side by side, ``line`` from the crown, on both sides of the street [m]."""
    length = 0.25 * len(layout.centreline)
    for side in layout.sides:
        station = float(layout.rng.uniform(0.0, 3.0))
        while station + widths[1] < length:
            width = float(layout.rng.uniform(*widths))
            lot = lot_at(layout, station + width / 2, side, line)
            shrink = 1.0 - lot.bend * line  # of the building line on the inside of a bend
            station += width / max(shrink, 1.0 - _TIGHT)
            if shrink > 1.0 - _TIGHT:
                yield Frontage(lot, width * min(shrink, 1.0))


def lot_at(layout: Layout, station: float, side: int, line: float) -> Lot:
    """Return a place beside the street: ``station`` along it, ``line`` from its crown, on a side [m]."""
    route = layout.centreline
    k = int(np.clip(station / 0.25, 16, len(route) - 17))
    behind, ahead = route[k - 16], route[k + 16]
    heading = float(np.arctan2(*(ahead - behind)[::-1]))
    headings = [float(np.arctan2(*(b - a)[::-1])) for a, b in ((behind, route[k]), (route[k], ahead))]
    bend = float(np.angle(np.exp(1j * (headings[1] - headings[0])))) / 4.0
    yaw = heading + (0.0 if side > 0 else np.pi)
    x, y = route[k] + line * np.array([-np.sin(yaw), np.cos(yaw)])
    return Lot(k * 0.25, side, float(x), float(y), yaw, side * bend)


def beside(layout: Layout, spacing: float, line: float) -> Iterator[Lot]:
    """Yield places every ``spacing`` along both sides of the street, ``line`` from its crown [m]."""
    yield from walk_lots(layout.centreline, spacing, line, layout.sides)


def put(
    layout: Layout, lot: Lot, kind: str, semantic: int, shape: Shape, place: tuple[float, float, float]
) -> Item:
    """Place a shape ``along`` the street, ``inward`` of the lot's place, turned [m, rad]."""
    x, y = from_lot(lot, place[0], place[1])
    return layout.add(kind, semantic, Placed(shape, x, y, lot.yaw + place[2]))


def put_free(
    layout: Layout,
    lot: Lot,
    kind: str,
    semantic: int,
    shape: Shape,
    place: tuple[float, float, float],
    size: tuple[float, float],
) -> Item | None:
    """Place a shape of a size (along its x, along its y) [m] where nothing stands yet; else return None."""
    x, y = from_lot(lot, place[0], place[1])
    area = rectangle(x, y, lot.yaw + place[2], *size)
    if not layout.free(area):
        return None
    return layout.add(kind, semantic, Placed(shape, x, y, lot.yaw + place[2]), area=area)
