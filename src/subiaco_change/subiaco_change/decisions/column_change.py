"""By how much the columns of an object rose or fell between two epochs, and where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats, Ints

Cells = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class ColumnChange:
    """What the columns of an object gained, less what they lost: ``change`` (nx, ny) [m].

    ``foot`` (nx, ny) is the height above ground at which that begins [m], inf where nothing changed;
    ``tops`` (2, nx, ny) those of both epochs [m], 0 where none was seen.
    Columns of an edge ``cell`` [m] lie along its walls: ``corner`` (2,) [m], ``turn`` (2, 2).
    """

    corner: Floats
    turn: Floats
    cell: float
    change: Floats
    foot: Floats
    tops: Floats

    @staticmethod
    def of(
        gained: Cells, lost: Cells, tops: Floats, rise: float, grid: tuple[Floats, Floats, float]
    ) -> ColumnChange:
        """Sum up changed cells (nx, ny, nz) of a height ``rise`` [m]; ``grid``: corner, turn and cell."""
        changed = gained | lost
        change = (gained.sum(axis=2) - lost.sum(axis=2, dtype=np.float64)) * rise
        foot = np.where(changed.any(axis=2), changed.argmax(axis=2) * rise, np.inf)
        return ColumnChange(*grid, change, foot, tops)

    def slots(self, xy: Floats) -> Ints:
        """Columns (N, 2) of places (N, 2)."""
        return np.floor((xy @ self.turn.T - self.corner) / self.cell).astype(np.int64)
