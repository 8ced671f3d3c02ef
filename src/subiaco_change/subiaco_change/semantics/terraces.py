"""Houses wall to wall: parted where their tops step from one level to another (method, part C4)."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import Field

from subiaco_change.semantics.boxes import wall_coordinates
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints


class TerraceConfig(StrictModel):
    """Steps that part a row of houses."""

    step: float = Field(0.85, gt=0, description="step of the tops across a party wall [m]")
    width: float = Field(3.5, gt=0, description="narrowest house of a row [m]")
    level: float = Field(2.0, gt=0, description="stretch that is level on either side of the wall [m]")
    slack: float = Field(0.3, gt=0, description="share of the step that heights on a level stretch may vary")
    cell: float = Field(0.5, gt=0, description="length over which the top is taken [m]")
    lowest: float = Field(2.8, gt=0, description="lower tops are garages and carports, no houses [m]")


def split_row(xy: Floats, height: Floats, config: TerraceConfig) -> Ints:
    """Part one building (N,) across its long side, labels from 0.

    Seen from the street only facades may be left of a row, with a veranda in front that they
    share, so that the greatest height across the row tells its houses, not the whole surface.
    Hips and gables rise slowly along it; a party wall is a sudden step between level stretches.
    Neighbours that a carport or gate joins part where that is lowest.

    Parameters
    ----------
    xy : (N, 2) float64 [m]
    height : (N,) float64
        Above ground [m].
    config : TerraceConfig
    """
    along, across = wall_coordinates(xy).T
    if np.ptp(along) < 2 * config.width:
        return np.zeros(len(xy), dtype=np.int64)
    slot = np.floor((along - along.min()) / config.cell).astype(np.int64)
    row = np.floor((across - across.min()) / config.cell).astype(np.int64)
    surface = np.full((slot.max() + 1, row.max() + 1), -np.inf)
    np.maximum.at(surface, (slot, row), height)
    walls: list[int] = []
    for p in np.concatenate([_dips(surface.max(axis=1), config), _steps(surface, config)]).tolist():
        if all(abs(p - wall) >= round(config.width / config.cell) for wall in walls):
            walls.append(p)
    return np.searchsorted(np.sort(walls), slot, side="right")


def _steps(surface: Floats, config: TerraceConfig) -> Ints:
    """Slots at which the tops of a surface (slots, rows) step between two houses, the most sudden first."""
    top = surface.max(axis=1)
    side, reach = round(config.width / config.cell), round(config.level / config.cell)
    places = np.arange(side, len(top) - side + 1)
    if len(places) == 0:
        return places
    windows = sliding_window_view(top, reach)
    level, vary = np.median(windows, axis=1), np.ptp(windows, axis=1)
    found = np.zeros(len(places), dtype=bool)
    for before in (places - reach, places - reach - 1):  # the slot that the wall is in has some of either
        for after in (places, places + 1):
            step = np.abs(level[before] - level[after])
            flat = np.maximum(vary[before], vary[after]) < config.slack * step
            houses = np.minimum(level[before], level[after]) > config.lowest
            found |= (step > config.step) & flat & houses
    places = np.array([p for p in places[found].tolist() if _depth_steps(surface, p, config)], dtype=np.int64)
    return places[np.argsort(-np.abs(top[places] - top[places - 1]), kind="stable")]


def _depth_steps(surface: Floats, place: int, config: TerraceConfig) -> bool:
    """Tell whether the rows that both sides of a place show, verandas left out, step there too.

    They do not where the roof of one house is seen on one side of the place only.
    """
    sides = np.stack([surface[place - 3 : place - 1].max(axis=0), surface[place + 1 : place + 3].max(axis=0)])
    shown = np.isfinite(sides).all(axis=0) & (sides.max(axis=0) > config.lowest)
    gap = np.abs(sides[0, shown] - sides[1, shown])
    return bool(len(gap) == 0 or np.median(gap) > config.step)


def _dips(top: Floats, config: TerraceConfig) -> Ints:
    """Slots at which the tops (slots,) are lowest between two houses."""
    run = np.cumsum(np.append(True, np.diff(top > config.lowest)))
    sizes = np.bincount(run)
    walls = []
    for k in np.unique(run[top <= config.lowest]).tolist():
        beside = (sizes[k - 1], sizes[k + 1] if k + 1 < len(sizes) else 0)
        if min(beside) * config.cell >= config.width and k > 1:
            slots = np.flatnonzero(run == k)
            walls.append(slots[np.argmin(top[slots])])
    return np.array(walls, dtype=np.int64)
