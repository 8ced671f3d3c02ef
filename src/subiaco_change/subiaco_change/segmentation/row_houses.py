"""Row houses of one epoch, split where their heights step from one level to another (method, part C4)."""

from __future__ import annotations

import numpy as np

from subiaco_change.segmentation.bounding_rectangles import wall_coordinates
from subiaco_change.segmentation.height_profiles import ProfileConfig, level_steps, part_slots
from subiaco_geo.frames import Floats, Ints


def split_row(xy: Floats, height: Floats, config: ProfileConfig) -> Ints:
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
    config : ProfileConfig
    """
    along, across = wall_coordinates(xy).T
    if np.ptp(along) < 2 * config.width:
        return np.zeros(len(xy), dtype=np.int64)
    slot = np.floor((along - along.min()) / config.cell).astype(np.int64)
    row = np.floor((across - across.min()) / config.cell).astype(np.int64)
    surface = np.full((slot.max() + 1, row.max() + 1), -np.inf)
    np.maximum.at(surface, (slot, row), height)
    top = np.maximum(surface.max(axis=1), 0.0)  # nothing seen: no house
    steps = [p for p in level_steps(top, config).tolist() if _depth_steps(surface, p, config)]
    return part_slots(slot, np.array([*_dips(top, config), *steps], dtype=np.int64), config)


def _depth_steps(surface: Floats, place: int, config: ProfileConfig) -> bool:
    """Tell whether the rows that both sides of a place show, verandas left out, step there too.

    They do not where the roof of one house is seen on one side of the place only.
    """
    sides = np.stack([surface[place - 3 : place - 1].max(axis=0), surface[place + 1 : place + 3].max(axis=0)])
    shown = np.isfinite(sides).all(axis=0) & (sides.max(axis=0) > config.lowest)
    gap = np.abs(sides[0, shown] - sides[1, shown])
    return bool(len(gap) == 0 or np.median(gap) > config.step)


def _dips(top: Floats, config: ProfileConfig) -> Ints:
    """Slots at which the tops (slots,) are lowest between two houses."""
    run = np.cumsum(np.append(True, np.diff(top > config.lowest)))
    sizes = np.bincount(run)
    walls = []
    for k in np.unique(run[top <= config.lowest]).tolist():
        beside = (sizes[k - 1], sizes[k + 1] if k + 1 < len(sizes) else 0)
        if min(beside) * config.cell >= config.width:
            slots = np.flatnonzero(run == k)
            walls.append(slots[np.argmin(top[slots])])
    return np.array(walls, dtype=np.int64)
