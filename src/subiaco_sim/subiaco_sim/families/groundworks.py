"""What happens to the ground of a street of either family: strips and plots, up or down through the gates."""

from __future__ import annotations

from subiaco_sim.families.events import RISE, signed
from subiaco_sim.families.placing import lot_at
from subiaco_sim.ground import ROAD_HALF, Patch, Strip, strip_along
from subiaco_sim.scene import GroundItem
from subiaco_sim.suburb import Layout, from_lot

STRIP_WIDTH = (0.9, 3.2)  # [m]
AREA = (12.0, 70.0)  # of a strip or plot, through the gate of 25 m2 [m2]
_EVERY = 26.0  # one work each so many metres of street, times the activity [m]


def work_the_street(
    layout: Layout, first_id: int, widen: float, footway: float, activity: float
) -> list[GroundItem]:
    """Resurface, mill, settle and build on strips of the road and plots of the footway; none overlap."""
    rng = layout.rng
    found: list[GroundItem] = []
    length = 0.25 * len(layout.centreline)
    for _ in range(int(activity * length / _EVERY + rng.random())):
        side = int(rng.choice(layout.sides))
        rise, area = signed(RISE, rng), float(rng.uniform(*AREA))
        if rng.random() < 0.6:
            work: Strip | Patch = _strip(layout, side, widen, area, rise)
        else:
            work = _plot(layout, side, widen, footway, area, rise)
        if not any(work.outline().intersects(other.patch.outline()) for other in found):
            event = "ground raised" if rise > 0 else "ground lowered"
            found.append(GroundItem(first_id + len(found), work, event))
    return found


def _strip(layout: Layout, side: int, widen: float, area: float, rise: float) -> Strip:
    """Return a strip of the carriageway that follows the road, anywhere from the crown to the kerb."""
    rng, line = layout.rng, layout.centreline
    width = float(rng.uniform(*STRIP_WIDTH))
    steps = int(min(area / width / 0.25, 0.6 * len(line)))
    start = int(rng.integers(0, max(1, len(line) - steps - 1)))
    offset = side * float(rng.uniform(width / 2, ROAD_HALF + widen - 0.05 - width / 2))
    return strip_along(line, start, start + steps, offset, width, rise)


def _plot(layout: Layout, side: int, widen: float, footway: float, area: float, rise: float) -> Patch:
    """Return a plot of the footway between kerb and building line."""
    rng = layout.rng
    width = min(float(rng.uniform(1.2, 4.0)), footway - 0.3)
    inset = float(rng.uniform(0.1, footway - width))
    length = min(area / width, 30.0)
    station = float(
        rng.uniform(length / 2, max(length / 2 + 1.0, 0.25 * len(layout.centreline) - length / 2))
    )
    lot = lot_at(layout, station, side, ROAD_HALF + widen)
    x, y = from_lot(lot, 0.0, inset + width / 2)
    return Patch(x, y, length, width, lot.yaw, rise)
