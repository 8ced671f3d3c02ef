"""Houses wall to wall: parted where their roofs step across the whole depth (method, part C4)."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from subiaco_change.semantics.boxes import box_coordinates
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints


class TerraceConfig(StrictModel):
    """Steps that part a row of houses."""

    step: float = Field(1.3, gt=0, description="median step of the roofs across a party wall [m]")
    width: float = Field(3.5, gt=0, description="narrowest house of a row [m]")
    window: float = Field(1.5, gt=0, description="stretch compared on either side of the wall [m]")
    cell: float = Field(0.5, gt=0, description="cell of the surface seen from above [m]")
    lowest: float = Field(1.5, gt=0, description="surface that counts as roof [m]")
    depth: float = Field(2.5, gt=0, description="depth over which both sides must be seen [m]")


def split_row(xy: Floats, height: Floats, config: TerraceConfig) -> Ints:
    """Part one building (N,) across its long side, labels from 0.

    Parameters
    ----------
    xy : (N, 2) float64 [m]
    height : (N,) float64
        Above ground [m].
    config : TerraceConfig
    """
    along, across = box_coordinates(xy).T
    if np.ptp(along) < 2 * config.width:
        return np.zeros(len(xy), dtype=np.int64)
    slot = np.floor((along - along.min()) / config.cell).astype(np.int64)
    row = np.floor((across - across.min()) / config.cell).astype(np.int64)
    top = np.full((slot.max() + 1, row.max() + 1), -np.inf)
    np.maximum.at(top, (slot, row), height)
    top[top < config.lowest] = np.nan
    return np.searchsorted(_party_walls(top, config), slot, side="right")


def _party_walls(top: Floats, config: TerraceConfig) -> Ints:
    """Slots at which the surface (slots, rows) steps, the greatest steps first, a house's width apart."""
    side, reach = round(config.width / config.cell), round(config.window / config.cell)
    places = np.arange(side, len(top) - side + 1)
    steps = np.array([_step(top[p - reach : p], top[p : p + reach], config) for p in places])
    walls: list[int] = []
    for p in places[np.argsort(-steps, kind="stable")][: (steps > config.step).sum()].tolist():
        if all(abs(p - wall) >= side for wall in walls):
            walls.append(p)
    return np.sort(np.array(walls, dtype=np.int64))


def _step(left: Floats, right: Floats, config: TerraceConfig) -> float:
    """Median over the rows that both sides show of how far their heights differ [m]."""
    shown = np.isfinite(left).any(axis=0) & np.isfinite(right).any(axis=0)
    if shown.sum() * config.cell < config.depth:
        return 0.0
    low, high = (np.nanmean(part[:, shown], axis=0) for part in (left, right))
    return float(np.median(np.abs(low - high)))
