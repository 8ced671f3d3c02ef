"""Labels on a grid: the cells of the published protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from subiaco_geo.codes import Change
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_HALF = 1 << 30


class GridConfig(StrictModel):
    """Grid and cell rule; written into every result."""

    cell: float = Field(0.5, gt=0.0, description="Edge of an evaluation cell [m] (published protocol)")
    origin_x: float = Field(0.0, description="World x coordinate of a cell corner [m]")
    origin_y: float = Field(0.0, description="World y coordinate of a cell corner [m]")
    share: float = Field(
        0.3,
        gt=0.0,
        le=1.0,
        description="Smallest fraction of the points of a cell that gives a changed label to the cell",
    )
    unobserved_share: float = Field(
        0.5,
        ge=0.0,
        le=1.0,
        description="Fraction of points with label 255 above which a cell without a changed label is 255",
    )
    leaf: float = Field(
        0.25,
        ge=0.0,
        description="Edge of the voxels in which points of one label, object and epoch count once [m], for "
        "cells and objects; 0 counts every point",
    )


@dataclass(frozen=True)
class LabelledCells:
    """Labelled cells: sorted keys (M,), codes (M,) uint8, confidence (M,) of the winning label."""

    keys: Ints
    codes: NDArray[np.uint8]
    confidence: Floats


def cell_keys(xy: Floats, config: GridConfig) -> Ints:
    """Return one int64 key a point (N, 2) [m, world]."""
    index = np.floor((xy - [config.origin_x, config.origin_y]) / config.cell).astype(np.int64) + _HALF
    return np.asarray((index[:, 0] << 31) | index[:, 1])


def cell_centres(keys: Ints, config: GridConfig) -> Floats:
    """Return the middles (M, 2) [m, world] of cells by their keys (M,)."""
    index = np.column_stack([keys >> 31, keys & ((1 << 31) - 1)]) - _HALF
    return (index + 0.5) * config.cell + [config.origin_x, config.origin_y]


def cell_rule(counts: Ints, config: GridConfig) -> NDArray[np.uint8]:
    """Decide cells from point counts.

    Parameters
    ----------
    counts : (M, 7) int64
        Points labelled Added, Removed, Increased, Decreased, Unchanged, 255, 254.
    config : GridConfig

    Returns
    -------
    (M,) uint8
        The changed label with most points if it holds at least ``share`` of
        the scored points (the lower code on a tie), else 255 if more than
        ``unobserved_share`` of them are 255, else Unchanged; 254 if only 254 is there.
    """
    scored = counts[:, :6].sum(axis=1)
    leader = counts[:, :4].argmax(axis=1)
    votes = counts[np.arange(len(counts)), leader]
    changed = (votes > 0) & (votes >= config.share * scored - 1e-9)
    unseen = counts[:, 5] > config.unobserved_share * scored + 1e-9
    codes = np.where(changed, leader, np.where(unseen, int(Change.UNOBSERVED), int(Change.UNCHANGED)))
    return np.where(scored == 0, int(Change.NOT_REPORTED), codes).astype(np.uint8)


def first_of_each(rows: Ints, least: Floats) -> Ints:
    """Return the index of one of the equal rows (N, K), N at least 1: that with the least value (N,)."""
    order = np.lexsort((least, *rows.T[::-1]))
    return np.asarray(order[np.r_[True, np.any(np.diff(rows[order], axis=0) != 0, axis=1)]])


def rasterise(
    xyz: Floats,
    change: NDArray[Any],
    epoch: NDArray[Any],
    config: GridConfig,
    confidence: Floats | None = None,
) -> LabelledCells:
    """Label the cells that points of both epochs fall in.

    Parameters
    ----------
    xyz : (N, 3) float64
        World coordinates in the frame of *after* [m].
    change : (N,) integer
        Codes of :class:`Change`; -1 means 255.
    epoch : (N,) integer
        0 before, 1 after.
    config : GridConfig
    confidence : (N,) float, optional

    Returns
    -------
    Cells
        The same for every order of the points.
    """
    slot = np.full(256, 5, dtype=np.int64)
    slot[:5], slot[int(Change.NOT_REPORTED)] = np.arange(5), 6
    column = slot[np.asarray(change).astype(np.int64) & 255]
    trust = np.ones(len(xyz)) if confidence is None else np.asarray(confidence, dtype=np.float64)
    if config.leaf > 0 and len(xyz):
        voxel = np.floor(xyz / config.leaf).astype(np.int64)
        kept = first_of_each(np.column_stack([voxel, epoch, column]), trust)
        xyz, column, trust = xyz[kept], column[kept], trust[kept]
    keys, cell = np.unique(cell_keys(xyz[:, :2], config), return_inverse=True)
    counts = np.bincount(cell * 7 + column, minlength=len(keys) * 7).reshape(-1, 7)
    codes = cell_rule(counts, config)
    total = np.bincount(cell * 7 + column, weights=trust, minlength=len(keys) * 7).reshape(-1, 7)
    won = (np.arange(len(keys)), slot[codes])
    mean = np.divide(total[won], counts[won], out=np.zeros(len(keys)), where=counts[won] > 0)
    return LabelledCells(keys, codes, mean)


def look_up(cells: LabelledCells, keys: Ints) -> tuple[NDArray[np.uint8], Floats]:
    """Return code and confidence at keys (M,); cells that are not there are 255."""
    if len(cells.keys) == 0:
        return np.full(len(keys), int(Change.UNOBSERVED), np.uint8), np.zeros(len(keys))
    place = np.minimum(np.searchsorted(cells.keys, keys), len(cells.keys) - 1)
    found = cells.keys[place] == keys
    codes = np.where(found, cells.codes[place], int(Change.UNOBSERVED)).astype(np.uint8)
    return codes, np.where(found, cells.confidence[place], 0.0)
