"""Raster in which the ghost trails of moving objects are told from standing ones, and its configuration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy import ndimage

from subiaco_change.semantics.ground import Mask
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

AROUND = np.ones((3, 3), dtype=np.bool_)  # a cell and the eight around it


class TrailShapeConfig(StrictModel):
    """Shape of the ghost trails of moving vehicles, for clouds without counts and times of beams."""

    cell: float = Field(
        0.3,
        gt=0,
        description="edge of the raster cells in which the shape of trails is measured [m]; coarser clouds"
        " need larger cells",
    )
    bottom: float = Field(
        0.3, gt=0, description="height above ground from which points belong to the body of a vehicle [m]"
    )
    body_top: float = Field(
        2.0, gt=0, description="height above ground up to which the width of a trail is measured [m]"
    )
    top: float = Field(3.8, gt=0, description="greatest height above ground of a vehicle [m]")
    ground_band: float = Field(
        0.15, gt=0, description="distance from the ground model within which a point is ground [m]"
    )
    roof: float = Field(
        0.4,
        ge=0,
        description="distance below the highest point of a vehicle that its roof may take; what lies lower"
        " and away from the sides is inside the vehicle [m]",
    )
    run: float = Field(
        5.0,
        gt=0,
        description="distance for which a trail must go on, forth and back along a straight line; the whole"
        " line is longer than a parked vehicle [m]",
    )
    run_share: float = Field(
        0.75,
        gt=0,
        le=1,
        description="share of such a line that must be occupied, gaps of one cell closed [1]",
    )
    least_area: float = Field(
        4.0, gt=0, description="footprint below which the shape of a trail says nothing [m2]"
    )
    length: float = Field(
        15.0,
        gt=0,
        description="length of a swath, its area over its width, at which a trail is as likely as a row of"
        " standing objects; raise it where long hedges stand between lanes [m]",
    )
    length_scale: float = Field(
        1.2, gt=0, description="difference of length that changes the log odds of a trail by 1 [m]"
    )
    width: float = Field(
        1.5, gt=0, description="width of a swath from which a vehicle is likelier than a hedge [m]"
    )
    widest: float = Field(
        3.6, gt=0, description="width of a swath above which it is no trail of one vehicle [m]"
    )
    width_scale: float = Field(
        0.15, gt=0, description="difference of width that changes the log odds of a trail by 1 [m]"
    )
    fill: float = Field(
        0.38,
        gt=0,
        lt=1,
        description="share of the cells inside a swath that hold points below its roof, at which a trail is"
        " as likely as a standing vehicle [1]",
    )
    fill_scale: float = Field(
        0.06, gt=0, description="difference of that share that changes the log odds of a trail by 1 [1]"
    )
    ground: float = Field(
        0.9,
        gt=0,
        lt=1,
        description="share of the cells beneath a swath where ground was seen, relative to the cells beside"
        " it, at which a trail is as likely as a standing object [1]",
    )
    ground_scale: float = Field(
        0.04, gt=0, description="difference of that share that changes the log odds of a trail by 1 [1]"
    )
    prior: float = Field(
        -1.0, description="log odds that a swath is a trail before its shape is considered [1]"
    )
    beside_axis: float = Field(
        -2.0,
        le=0,
        description="log odds that a part of a swath beside its axis belongs to the trail, before its"
        " shape is considered; lower it where standing vehicles that touch a trail are left out [1]",
    )
    edge: float = Field(
        0.9,
        ge=0,
        description="distance from a trail up to which the ragged edge of the trail reaches; small objects"
        " wholly within it count as trail, raise it where edges of trails are reported as objects [m]",
    )
    edge_share: float = Field(
        0.95, gt=0, le=1, description="share of the footprint of such an object that must lie within it [1]"
    )
    beside: float = Field(
        1.8, gt=0, description="distance from a swath within which the ground beside it is asked [m]"
    )
    piece: float = Field(
        2.0,
        ge=0,
        description="footprint from which a short body that continues a trail is a standing vehicle [m2]",
    )
    piece_length: float = Field(
        7.0, ge=0, description="length of a body above which the body is longer than a standing vehicle [m]"
    )
    piece_gap: float = Field(
        2.5, ge=0, description="greatest distance from a trail, or from a piece of it, to its next piece [m]"
    )
    piece_aside: float = Field(
        1.4, ge=0, description="greatest distance of a piece from the axis of its trail [m]"
    )
    thin_length: float = Field(
        11.5,
        gt=0,
        description="length of a thin swath at which the trail of a cyclist or a person on foot is as likely"
        " as a standing object [m]",
    )
    thin_length_scale: float = Field(
        0.5, gt=0, description="difference of that length that changes the log odds by 1 [m]"
    )
    thickness: float = Field(
        0.07,
        gt=0,
        description="standard deviation across a thin swath at which a person is as likely as a fence or a"
        " wall [m]",
    )
    thickest: float = Field(
        0.25, gt=0, description="standard deviation across a swath above which the swath is not thin [m]"
    )
    thickness_scale: float = Field(
        0.01, gt=0, description="difference of that standard deviation that changes the log odds by 1 [m]"
    )
    lit: float = Field(
        0.85,
        gt=0,
        lt=1,
        description="share of the cells beside a thin swath where ground was seen, relative to open ground,"
        " at which a trail is as likely as a wall that hides the ground behind it [1]",
    )
    overhead: float = Field(
        0.1,
        ge=0,
        lt=1,
        description="share of the footprint of a thin swath with points higher than a person above which the"
        " swath is no trail [1]",
    )


@dataclass(frozen=True)
class Raster:
    """Cells of a cloud: ground seen, body of something, highest point [m], and points inside, below roofs."""

    index: Ints  # (N, 2) cell of every point
    ground: Mask
    body: Mask
    inside: Mask
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
    return Raster(
        index, held(np.abs(height) < config.ground_band), held(body), held(body & (height < roof)), top
    )


def limited(log_odds: float) -> float:
    """Limit what one measure of the shape may say."""
    return float(np.clip(log_odds, -6.0, 2.0))
