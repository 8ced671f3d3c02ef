"""Cars among the rest, trucks among the buildings, and the sheds that are neither (method, part C3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from subiaco_change.semantics.boxes import box_coordinates, box_sides
from subiaco_change.semantics.clustering import cell_clusters, group_indices, voxel_clusters
from subiaco_change.semantics.ground import Mask
from subiaco_change.semantics.rows import RowConfig, split_rows
from subiaco_geo.codes import Semantic
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
    trunk_linearity: float = Field(
        0.8, gt=0, le=1, description="linearity from which a point is of a trunk or pole beside a truck"
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
    overhang: float = Field(0.15, ge=0, description="how far a top may stand out: shelters have eaves [m]")
    top_band: float = Field(0.35, gt=0, description="height of that top [m]")
    screen_upright: float = Field(
        0.7, gt=0, le=1, description="share of walls in the upper half of fences that meet"
    )
    screen_fill: float = Field(0.38, gt=0, le=1, description="share of their rectangle that such fences fill")


def free_boxes(
    xyz: Floats, height: Floats, core: Mask, part: Mask, hard: Mask, config: VehicleConfig
) -> tuple[Mask, Mask]:
    """Tell which points are trucks and buses, and which shelters: boxes on the ground, alone, like facades.

    They exceed the box of the paper's vehicles; two sides must be seen, else a lone wall would pass.

    Parameters
    ----------
    xyz, height : (N, 3), (N,) float64 [m]
    core : (N,) bool
        Planes that are facades or roofs.
    part : (N,) bool
        Smaller planes, of which a shelter may consist.
    hard : (N,) bool
        Points that may belong to such a box: neither ground nor foliage.
    config : VehicleConfig
    """
    low = (height > config.split_band) & (height < config.truck_top + config.truck_gap)
    members = np.flatnonzero((core | part | hard) & low)
    large, shelter = np.zeros((2, len(xyz)), dtype=bool)
    for group in group_indices(cell_clusters(xyz[members, :2], config.truck_gap)):
        mine = members[group]
        if (core | part)[mine].mean() < config.truck_planes or not _is_free_box(
            xyz[mine], height[mine], config
        ):
            continue
        if has_eaves(xyz[mine], height[mine], config):
            shelter[mine] = True
        elif core[mine].mean() > config.truck_planes:
            large[mine] = True
    low = height < config.truck_top
    return (
        _reach_out(xyz, large, low, config.truck_edge),
        _reach_out(xyz, shelter, low, config.truck_edge),
    )


def _reach_out(xyz: Floats, found: Mask, open_: Mask, reach: float) -> Mask:
    """Add the open points within reach [m] of the found ones."""
    loose = np.flatnonzero(open_ & ~found)
    grown = found.copy()
    if found.any() and len(loose):
        near = cKDTree(xyz[found]).query(xyz[loose], distance_upper_bound=reach)[0]
        grown[loose[np.isfinite(near)]] = True
    return grown


def _is_free_box(xyz: Floats, height: Floats, config: VehicleConfig) -> bool:
    if len(xyz) < 40 or np.quantile(height, 0.99) > config.truck_top or np.quantile(height, 0.02) > 0.8:
        return False
    length, width = box_sides(xyz[:, :2])
    return bool(2.8 < length < config.truck_length and config.truck_min_width < width < config.truck_width)


def has_eaves(xyz: Floats, height: Floats, config: VehicleConfig) -> bool:
    """Tell a shelter: its top stands out over its body; vehicles grow narrower upwards."""
    top = float(np.quantile(height, 0.98)) - config.top_band
    head, body = height > top, (height < top - 0.15) & (height > config.split_band)
    if head.sum() < 4 or body.sum() < 4:
        return False
    sides = box_coordinates(xyz[:, :2])
    return bool((np.ptp(sides[head], axis=0) > np.ptp(sides[body], axis=0) + config.overhang).any())


def ground_boxes(
    xyz: Floats,
    height: Floats,
    foliage: Mask,
    upright: Mask,
    members: NDArray[np.int64],
    config: VehicleConfig,
) -> list[tuple[NDArray[np.int64], Semantic]]:
    """Vehicles, shelters and fences that meet in a low cluster, each with its class.

    It is one such box, or what is left apart once leaves and the lowest band are out.
    """
    hard = 1.0 - float(foliage[members].mean())
    whole = _kind(xyz[members], height[members], upright[members], hard, config)
    if whole is Semantic.MOBILE:
        return [(members, whole)]
    core = members[~foliage[members] & (height[members] > config.split_band)]
    labels = cell_clusters(xyz[core, :2], config.split_gap)
    labels = split_rows(xyz[core, :2], height[core], labels, config.rows)
    groups = [core[g] for g in group_indices(labels)]
    kinds = [_kind(xyz[g], height[g], upright[g], 1.0, config) for g in groups]
    parts = [(g, kind) for g, kind in zip(groups, kinds, strict=True) if kind is not None]
    return parts if parts or whole is None else [(members, whole)]


def _kind(xyz: Floats, height: Floats, upright: Mask, hard: float, config: VehicleConfig) -> Semantic | None:
    """Class of a compact thing that stands on the ground; None for what is no box of a vehicle's size."""
    if len(xyz) < 15 or not _fits(xyz, height, hard, config):
        return None
    upper = upright[height > 0.5 * np.quantile(height, 0.98)].mean()
    screen = upper > config.screen_upright and _fill(xyz) < config.screen_fill
    if (screen or has_eaves(xyz, height, config)) and not _is_shed(xyz, height, upright, config):
        return Semantic.OTHER
    return Semantic.MOBILE


def sheds(
    xyz: Floats, height: Floats, upright: Mask, mobile: Mask, voxel: float, config: VehicleConfig
) -> Mask:
    """Tell which points of vehicles are sheds (planarity goes back); the cab of a truck touches it."""
    members = np.flatnonzero(mobile)
    shed = np.zeros(len(xyz), dtype=bool)
    for group in group_indices(voxel_clusters(xyz[members], voxel)):
        mine = members[group]
        shed[mine] = _is_shed(xyz[mine], height[mine], upright[mine], config)
    return shed


def _is_shed(xyz: Floats, height: Floats, upright: Mask, config: VehicleConfig) -> bool:
    """Tell a short, high box with walls to the top."""
    if np.quantile(height, 0.95) < config.shed_top or box_sides(xyz[:, :2])[0] > config.shed_length:
        return False
    return bool(upright[height > 0.5 * config.shed_top].mean() > 0.5)


def _fill(xyz: Floats, cell: float = 0.25) -> float:
    """Share of its rectangle that a thing fills, seen from above."""
    sides = box_coordinates(xyz[:, :2])
    cells = np.unique(np.floor((sides - sides.min(axis=0)) / cell), axis=0)
    return float(len(cells) * cell**2 / max(float(np.prod(np.ptp(sides, axis=0))), cell**2))


def _fits(xyz: Floats, height: Floats, hard: float, config: VehicleConfig) -> bool:
    """Tell what fits the box of a vehicle or a row of them; cars may look softer."""
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
