"""Raster in which ghost trails are distinguished from static objects, and its configuration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy import ndimage

from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

AROUND = np.ones((3, 3), dtype=np.bool_)  # a cell and the eight around it


class TrailShapeConfig(StrictModel):
    """Shape of the ghost trails of moving vehicles, for clouds without counts and times of beams."""

    cell: float = Field(
        0.3,
        gt=0,
        description="Edge of the raster cells in which the shape of ghost trails is measured [m]; coarser "
        "clouds need larger cells",
    )
    bottom: float = Field(
        0.3, gt=0, description="Height above ground from which points belong to the body of a vehicle [m]"
    )
    body_top: float = Field(
        2.0, gt=0, description="Height above ground up to which the width of a ghost trail is measured [m]"
    )
    top: float = Field(3.8, gt=0, description="Greatest height above ground of a vehicle [m]")
    ground_band: float = Field(
        0.15, gt=0, description="Distance from the ground model within which a point is ground [m]"
    )
    roof: float = Field(
        0.4,
        ge=0,
        description="Thickness of the roof of a vehicle below its highest point; lower points away from "
        "the sides are inside the vehicle [m]",
    )
    run: float = Field(
        5.0,
        gt=0,
        description="Distance for which a ghost trail must continue in both directions along a straight "
        "line [m]; above half a parked vehicle",
    )
    run_share: float = Field(
        0.75,
        gt=0,
        le=1,
        description="Fraction of the straight line through a ghost trail that must be occupied, gaps of "
        "one cell closed",
    )
    least_area: float = Field(
        4.0, gt=0, description="Footprint below which the shape of a ghost trail is not evaluated [m2]"
    )
    length: float = Field(
        15.0,
        gt=0,
        description="Length of a swath (area over width, at most its extent) at which a trail is as likely "
        "as a row of static objects [m]; raise it where long hedges line the lanes",
    )
    length_scale: float = Field(
        1.2,
        gt=0,
        description="Difference of swath length that changes the log odds of a ghost trail by 1 [m]",
    )
    width: float = Field(
        1.5, gt=0, description="Width of a swath from which a vehicle is likelier than a hedge [m]"
    )
    widest: float = Field(
        3.6, gt=0, description="Width of a swath above which it cannot be the ghost trail of one vehicle [m]"
    )
    width_scale: float = Field(
        0.15,
        gt=0,
        description="Difference of swath width that changes the log odds of a ghost trail by 1 [m]",
    )
    fill: float = Field(
        0.38,
        gt=0,
        lt=1,
        description="Fraction of the cells inside a swath with points below its roof at which a trail is "
        "as likely as a static vehicle",
    )
    fill_scale: float = Field(
        0.06,
        gt=0,
        description="Difference of the filled fraction of a swath that changes the log odds of a ghost "
        "trail by 1 [1]",
    )
    ground: float = Field(
        0.9,
        gt=0,
        lt=1,
        description="Fraction of ground observed beneath a swath, relative to beside it, at which a trail "
        "is as likely as a static object",
    )
    ground_scale: float = Field(
        0.04,
        gt=0,
        description="Difference of the fraction of observed ground that changes the log odds of a ghost "
        "trail by 1 [1]",
    )
    foot: float = Field(
        0.4,
        gt=0,
        lt=1,
        description="Fraction of the cells of a swath with points between ground and body at which a trail "
        "is as likely as a hedge; vehicles run on wheels",
    )
    foot_scale: float = Field(
        0.04,
        gt=0,
        description="Difference of that fraction that changes the log odds of a ghost trail by 1 [1]",
    )
    prior: float = Field(
        -3.0, description="Log odds that a swath is a ghost trail before its shape is considered [1]"
    )
    beside_axis: float = Field(
        -2.0,
        le=0,
        description="Prior log odds that a part of a swath beside its axis belongs to the trail [1]; "
        "lower it if parked vehicles beside a trail are left out",
    )
    edge: float = Field(
        0.9,
        ge=0,
        description="Distance from a ghost trail within which small objects count as its ragged edge [m]; "
        "raise it if trail edges are reported as objects",
    )
    edge_share: float = Field(
        0.95,
        gt=0,
        le=1,
        description="Fraction of the footprint of a small object that must lie at the edge of a ghost "
        "trail for the object to be dropped",
    )
    beside: float = Field(
        1.8, gt=0, description="Distance from a swath within which the ground beside it is compared [m]"
    )
    piece: float = Field(
        2.0,
        ge=0,
        description="Footprint from which a short body in line with a ghost trail is a static vehicle [m2]",
    )
    piece_length: float = Field(
        7.0, ge=0, description="Length above which a body is too long to be a static vehicle [m]"
    )
    piece_gap: float = Field(
        2.5, ge=0, description="Greatest gap between a ghost trail, or a piece of it, and its next piece [m]"
    )
    piece_aside: float = Field(
        1.4, ge=0, description="Greatest distance of a piece from the axis of its ghost trail [m]"
    )
    thin_top: float = Field(
        1.0,
        gt=0,
        description="median height of a thin swath at which a person is as likely as a low hedge [m]",
    )
    thin_top_scale: float = Field(
        0.1, gt=0, description="difference of that height that changes the log odds by 1 [m]"
    )
    thin_length: float = Field(
        8.0,
        gt=0,
        description="Length of a thin swath at which the trail of a cyclist or pedestrian is as likely as "
        "a static object [m]",
    )
    thin_length_scale: float = Field(
        0.5,
        gt=0,
        description="Difference of the length of a thin swath that changes the log odds of a ghost trail "
        "by 1 [m]",
    )
    thickness: float = Field(
        0.07,
        gt=0,
        description="Standard deviation across a thin swath at which a person is as likely as a fence or "
        "a wall [m]",
    )
    thickest: float = Field(
        0.25, gt=0, description="Standard deviation across a swath above which the swath is not thin [m]"
    )
    thickness_scale: float = Field(
        0.01,
        gt=0,
        description="Difference of the standard deviation across a thin swath that changes the log odds "
        "of a ghost trail by 1 [m]",
    )
    lit: float = Field(
        0.85,
        gt=0,
        lt=1,
        description="Fraction of ground observed beside a thin swath, relative to open ground, at which a "
        "trail is as likely as a wall that occludes the ground behind it",
    )
    overhead: float = Field(
        0.1,
        ge=0,
        lt=1,
        description="Fraction of the footprint of a thin swath with points higher than a person above "
        "which the swath is no ghost trail",
    )


@dataclass(frozen=True)
class Raster:
    """Cells of a cloud: ground, body, points inside below roofs, foot just above ground, top [m]."""

    index: Ints  # (N, 2) cell of every point
    ground: Mask
    body: Mask
    inside: Mask
    foot: Mask
    top: Floats


def rasterise(xyz: Floats, height: Floats, config: TrailShapeConfig) -> Raster:
    """Sort points (N, 3), so high (N,) above ground [m], into cells."""
    place = np.floor(xyz[:, :2] / config.cell).astype(np.int64)  # of one lattice for all tiles of a cloud
    index = place - place.min(axis=0) + 2
    shape = tuple(int(size) for size in index.max(axis=0) + 3)

    def held(points: Mask) -> Mask:
        cells = np.zeros(shape, dtype=np.bool_)
        cells[tuple(index[points].T)] = True
        return cells

    vehicle = (height > config.bottom) & (height < config.top)
    top = np.full(shape, -np.inf)
    np.maximum.at(top, tuple(index[vehicle].T), height[vehicle])
    roof = ndimage.grey_dilation(top, footprint=AROUND)[tuple(index.T)] - config.roof
    body = vehicle & (height < config.body_top)
    foot = (height > config.ground_band) & (height <= config.bottom)
    return Raster(
        index,
        held(np.abs(height) < config.ground_band),
        held(body),
        held(body & (height < roof)),
        held(foot),
        top,
    )


def limited(log_odds: float) -> float:
    """Limit what one measure of the shape may say."""
    return float(np.clip(log_odds, -6.0, 2.0))
