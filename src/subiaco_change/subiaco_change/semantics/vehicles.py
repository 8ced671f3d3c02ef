"""Cars among the rest, trucks among the buildings, and the sheds that are neither (method, part C3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from subiaco_change.semantics.boxes import box_sides
from subiaco_change.semantics.clustering import cell_clusters, group_indices, voxel_clusters
from subiaco_change.semantics.ground import Mask
from subiaco_change.semantics.rows import RowConfig, split_rows
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats


class VehicleConfig(StrictModel):
    """Boxes of vehicles; heights are above the local ground model."""

    truck_length: float = Field(13.0, gt=0, description="longest truck or bus [m]")
    truck_width: float = Field(3.3, gt=0, description="widest truck or bus [m]")
    truck_min_width: float = Field(
        0.8, gt=0, description="least width seen of a truck [m]; a lone wall has less"
    )
    truck_top: float = Field(3.8, gt=0, description="highest truck or bus [m]")
    truck_gap: float = Field(0.4, gt=0, description="cell in which parts of a truck touch [m]")
    truck_planes: float = Field(
        0.25, ge=0, le=1, description="share of a truck that lies in planes of a facade's size"
    )
    truck_edge: float = Field(0.7, ge=0, description="reach of a truck over its small parts [m]")
    mobile_length: float = Field(5.5, gt=0, description="longest side of a vehicle [m] (paper: 5)")
    mobile_height: float = Field(3.0, gt=0, description="top of a vehicle [m], paper")
    mobile_top: float = Field(
        2.6, gt=0, description="height below which vehicles are looked for, under crowns [m]"
    )
    mobile_hard: float = Field(
        0.4, ge=0, le=1, description="share of a vehicle that does not look like foliage"
    )
    split_band: float = Field(0.3, ge=0, description="band above ground that joins vehicle and hedge [m]")
    split_gap: float = Field(0.3, gt=0, description="cell in which parts of one vehicle touch [m]")
    rows: RowConfig = RowConfig()
    shed_top: float = Field(2.1, gt=0, description="height from which a short box is a shed [m]")
    shed_length: float = Field(4.4, gt=0, description="length below which a high box is a shed [m]")
    mobile_volume: float = Field(60.0, gt=0, description="box of a vehicle [m3], paper")
    mobile_min_width: float = Field(0.8, gt=0, description="narrower things are posts and fences [m]")


def large_vehicles(xyz: Floats, height: Floats, core: Mask, hard: Mask, config: VehicleConfig) -> Mask:
    """Tell which points are trucks and buses: boxes on the ground, alone, with sides like facades.

    They exceed the box of the paper's vehicles; two sides must be seen, else a lone wall would pass.

    Parameters
    ----------
    xyz, height : (N, 3), (N,) float64 [m]
    core : (N,) bool
        Planes that are facades or roofs.
    hard : (N,) bool
        Points that may belong to such a box: neither ground nor foliage.
    config : VehicleConfig
    """
    low = (height > config.split_band) & (height < config.truck_top + config.truck_gap)
    members = np.flatnonzero((core | hard) & low)
    large = np.zeros(len(xyz), dtype=bool)
    for group in group_indices(cell_clusters(xyz[members, :2], config.truck_gap)):
        mine = members[group]
        if core[mine].mean() > config.truck_planes and _is_truck(xyz[mine], height[mine], config):
            large[mine] = True
    return _reach_out(xyz, large, height < config.truck_top, config.truck_edge)


def _reach_out(xyz: Floats, found: Mask, open_: Mask, reach: float) -> Mask:
    """Add the open points within reach [m] of the found ones."""
    loose = np.flatnonzero(open_ & ~found)
    grown = found.copy()
    if found.any() and len(loose):
        near = cKDTree(xyz[found]).query(xyz[loose], distance_upper_bound=reach)[0]
        grown[loose[np.isfinite(near)]] = True
    return grown


def _is_truck(xyz: Floats, height: Floats, config: VehicleConfig) -> bool:
    if len(xyz) < 40 or np.quantile(height, 0.99) > config.truck_top or np.quantile(height, 0.02) > 0.8:
        return False
    length, width = box_sides(xyz[:, :2])
    return bool(2.8 < length < config.truck_length and config.truck_min_width < width < config.truck_width)


def vehicle_parts(
    xyz: Floats, height: Floats, foliage: Mask, members: NDArray[np.int64], config: VehicleConfig
) -> list[NDArray[np.int64]]:
    """Vehicles in a low cluster: all of it, or what is left apart once leaves and the lowest band are out."""
    hard = 1.0 - float(foliage[members].mean())
    if _is_vehicle(xyz[members], height[members], hard, config):
        return [members]
    core = members[~foliage[members] & (height[members] > config.split_band)]
    if len(core) == 0:
        return []
    labels = cell_clusters(xyz[core, :2], config.split_gap)
    labels = split_rows(xyz[core, :2], height[core], labels, config.rows)
    groups = [core[g] for g in group_indices(labels)]
    return [g for g in groups if _is_vehicle(xyz[g], height[g], 1.0, config)]


def _is_vehicle(xyz: Floats, height: Floats, hard: float, config: VehicleConfig) -> bool:
    """Tell a compact thing that stands on the ground and fits the box of a vehicle; cars may look softer."""
    if len(xyz) < 15:
        return False
    length, width = box_sides(xyz[:, :2])
    top = float(np.quantile(height, 0.98))
    low = float(np.quantile(height, 0.02))
    row_of_cars = 1.4 < width < 3.2 and top < 2.4
    car = 3.2 < length < config.mobile_length and 1.4 < width < 2.4 and 1.2 < top < 2.2
    return bool(
        hard > (0.5 * config.mobile_hard if car else config.mobile_hard)
        and width > config.mobile_min_width
        and length > 1.4
        and (length < config.mobile_length or row_of_cars)
        and 0.8 < top < config.mobile_height
        and low < 0.8
        and length * width * top < config.mobile_volume
    )


def sheds(
    xyz: Floats, height: Floats, upright: Mask, mobile: Mask, voxel: float, config: VehicleConfig
) -> Mask:
    """Tell which points of vehicles are sheds: short, high, with walls to the top (planarity goes back)."""
    members = np.flatnonzero(mobile)
    shed = np.zeros(len(xyz), dtype=bool)
    for group in group_indices(voxel_clusters(xyz[members], voxel)):
        mine = members[group]
        upper = mine[height[mine] > 0.5 * config.shed_top]
        high = np.quantile(height[mine], 0.95) > config.shed_top
        if high and upright[upper].mean() > 0.5 and box_sides(xyz[mine, :2])[0] < config.shed_length:
            shed[mine] = True
    return shed
