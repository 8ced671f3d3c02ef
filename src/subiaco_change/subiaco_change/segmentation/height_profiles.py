"""Steps in height along a row of objects (method, part C4)."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import Field

from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints


class ProfileConfig(StrictModel):
    """Steps that part a row; the defaults are those of houses."""

    step: float = Field(
        0.85, gt=0, description="Smallest step of the top height between two objects of a row [m]"
    )
    width: float = Field(3.5, gt=0, description="Shortest length of one object in a row [m]")
    level: float = Field(
        2.0, gt=0, description="Length of the stretch on either side of a step that must be level [m]"
    )
    slack: float = Field(
        0.3,
        gt=0,
        description="Largest variation of the heights on a level stretch, as a fraction of the step",
    )
    sudden: float = Field(
        0.8,
        gt=0,
        le=1,
        description="Fraction of the step that must occur between two adjacent cells of the profile",
    )
    cell: float = Field(
        0.5, gt=0, description="Length of the cells of the profile in which the top height is taken [m]"
    )
    lowest: float = Field(
        2.8,
        gt=0,
        description="Smallest top height above ground on both sides of a step [m]; lower tops are garages "
        "and carports",
    )


def level_steps(top: Floats, config: ProfileConfig) -> Ints:
    """Slots at which tops (slots,) step suddenly between level stretches, the most sudden first."""
    side, reach = round(config.width / config.cell), round(config.level / config.cell)
    reach = min(reach, side - 1)
    places = np.arange(side, len(top) - side + 1)
    if len(places) == 0:
        return places
    windows = sliding_window_view(top, reach)
    level, vary = np.median(windows, axis=1), np.ptp(windows, axis=1)
    found = np.zeros(len(places), dtype=bool)
    # The slot that the step is in has some of either side, and is left out of one.
    for skip_before, skip_after in ((0, 0), (1, 0), (0, 1)):
        before, after = places - reach - skip_before, np.minimum(places + skip_after, len(level) - 1)
        step = np.abs(level[before] - level[after])
        flat = np.maximum(vary[before], vary[after]) < config.slack * step
        sudden = np.abs(top[before + reach - 1] - top[after]) > config.sudden * step
        tall = np.minimum(level[before], level[after]) > config.lowest
        found |= (step > config.step) & flat & sudden & tall
    places = places[found]
    return places[np.argsort(-np.abs(top[places] - top[places - 1]), kind="stable")]


def part_slots(slot: Ints, places: Ints, config: ProfileConfig) -> Ints:
    """Parts (N,) from 0 of points in slots (N,), cut at the places in their order, a thing's width apart."""
    cuts: list[int] = []
    for place in places.tolist():
        if all(abs(place - cut) >= round(config.width / config.cell) for cut in cuts):
            cuts.append(place)
    return np.searchsorted(np.sort(cuts), slot, side="right")
