"""Rows of parked cars, split at the gaps between bumpers or doors (method, part C4)."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from subiaco_change.segmentation.bounding_rectangles import box_coordinates, box_sides
from subiaco_change.segmentation.clustering import group_indices
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints


class RowConfig(StrictModel):
    """What a row of cars is, and what the cars in it are."""

    length: float = Field(
        5.2, gt=0, description="Length above which a cluster of vehicles may be a row of cars [m]"
    )
    width: float = Field(
        2.3, gt=0, description="Width above which a cluster of vehicles may be a row of cars [m]"
    )
    top: float = Field(
        2.4,
        gt=0,
        description="Height above ground above which a cluster is a truck and is not divided into cars [m]",
    )
    gap: float = Field(
        0.2,
        gt=0,
        description="Smallest gap at which a row of cars is divided [m]; 0.3 m less the noise of the map",
    )
    car_length: float = Field(
        2.8, gt=0, description="Shortest observed length of a car that results from dividing a row [m]"
    )
    car_width: float = Field(
        1.0, gt=0, description="Smallest observed width of a car that results from dividing a row [m]"
    )


def split_rows(xy: Floats, height: Floats, labels: Ints, config: RowConfig) -> Ints:
    """Part clusters (N,) too large for a car at gaps that run right through them.

    Parameters
    ----------
    xy : (N, 2) float64 [m]
    height : (N,) float64
        Above ground [m].
    labels : (N,) int
        Clusters from 0.
    config : RowConfig
    """
    parted = np.empty_like(labels)
    following = 0
    for members in group_indices(labels):
        for part in _parts(xy, height, members, config):
            parted[part] = following
            following += 1
    return parted


def _parts(xy: Floats, height: Floats, members: Ints, config: RowConfig) -> list[Ints]:
    """Cut at the widest gap that leaves a car on both sides, and go on with these."""
    if len(members) < 2 or np.quantile(height[members], 0.98) > config.top:
        return [members]
    sides = box_coordinates(xy[members])
    if (np.ptp(sides, axis=0) <= (config.length, config.width)).all():
        return [members]
    for axis in (0, 1):
        order = np.argsort(sides[:, axis], kind="stable")
        gaps = np.diff(sides[order, axis])
        for cut in np.argsort(-gaps, kind="stable")[: (gaps > config.gap).sum()].tolist():
            first, second = members[order[: cut + 1]], members[order[cut + 1 :]]
            if _is_car(xy[first], config) and _is_car(xy[second], config):
                return [*_parts(xy, height, first, config), *_parts(xy, height, second, config)]
    return [members]


def _is_car(xy: Floats, config: RowConfig) -> bool:
    long, short = box_sides(xy)
    return bool(long > config.car_length and short > config.car_width)
