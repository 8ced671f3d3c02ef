"""The point cloud type of all packages."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints

Number = TypeVar("Number", bound=np.generic)
#: Voxel indices from minus this to below it fit into a packed key (:func:`voxel_keys`).
VOXEL_LIMIT = 1 << 20
_CELLS_A_POINT, _FEW_CELLS = 8, 1 << 20  # of a grid that is counted cell by cell, not sorted


@dataclass(frozen=True)
class PointCloud:
    """Points in a local frame, with the origin that places them in the world.

    Parameters
    ----------
    xyz : (N, 3) float64
        Local coordinates [m]; ``world = xyz + origin``. Local values stay
        small, so that float32 copies of them lose nothing that matters.
    origin : (3,) float64
        World coordinates of the local zero [m]; zeros for a local map.
    crs : str or None
        Coordinate reference system of the world frame, e.g. ``"EPSG:7850"``.
    fields : mapping of str to (N, ...) array
        Per-point attributes, e.g. ``intensity``, ``normals`` (N, 3), ``n``,
        ``spread``.
    """

    xyz: Floats
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    crs: str | None = None
    fields: Mapping[str, NDArray[np.generic]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz", np.asarray(self.xyz, dtype=np.float64))
        object.__setattr__(self, "origin", np.asarray(self.origin, dtype=np.float64))
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3:
            raise InputError(f"xyz must have shape (N, 3), got {self.xyz.shape}")
        if self.origin.shape != (3,):
            raise InputError(f"origin must have shape (3,), got {self.origin.shape}")
        for name, values in self.fields.items():
            if len(values) != len(self.xyz):
                raise InputError(f"field {name} has {len(values)} values for {len(self.xyz)} points")

    def __len__(self) -> int:
        return len(self.xyz)

    def world(self) -> Floats:
        """Return world coordinates (N, 3) float64 [m]."""
        return self.xyz + self.origin

    def select(self, index: NDArray[np.generic]) -> PointCloud:
        """Return the points of a boolean mask or an index array."""
        fields = {name: values[index] for name, values in self.fields.items()}
        return replace(self, xyz=self.xyz[index], fields=fields)

    def with_fields(self, **fields: NDArray[np.generic]) -> PointCloud:
        """Return a copy with fields added or replaced."""
        return replace(self, fields={**self.fields, **fields})

    def rebased(self, origin: ArrayLike) -> PointCloud:
        """Return the same world points about another origin (3,) [m]."""
        target = np.asarray(origin, dtype=np.float64)
        return replace(self, xyz=self.xyz + (self.origin - target), origin=target)


def concatenate(clouds: Sequence[PointCloud]) -> PointCloud:
    """Return clouds about one origin as one cloud, with the fields of the first that holds points."""
    held = [cloud for cloud in clouds if len(cloud)] or list(clouds[:1])
    fields = {name: np.concatenate([cloud.fields[name] for cloud in held]) for name in held[0].fields}
    return PointCloud(np.concatenate([cloud.xyz for cloud in held]), held[0].origin, held[0].crs, fields)


def from_world(xyz: ArrayLike, crs: str | None = None, **fields: NDArray[np.generic]) -> PointCloud:
    """Build a cloud from world coordinates, about an origin rounded to 100 m.

    A cloud whose coordinates are all within 10 km of zero keeps a zero origin.
    """
    world = np.asarray(xyz, dtype=np.float64)
    origin = np.zeros(3)
    if len(world) and np.abs(world).max() > 10_000.0:
        origin = np.round(np.median(world, axis=0), -2)
    return PointCloud(world - origin, origin, crs, fields)


def extent_of(xyz: NDArray[Number]) -> tuple[NDArray[Number], NDArray[Number]]:
    """Return the lowest and the highest value (D,) of every column of (N, D) values.

    Column by column: numpy reduces rows of three values ten times as slowly.
    """
    columns = range(xyz.shape[1])
    low = np.array([xyz[:, k].min() for k in columns], dtype=xyz.dtype)
    return low, np.array([xyz[:, k].max() for k in columns], dtype=xyz.dtype)


def distance_to_box(xyz: Floats, low: Floats, high: Floats) -> Floats:
    """Distance (N,) of points (N, D) from a box from ``low`` (D,) to ``high`` (D,), zero inside [m]."""
    return np.linalg.norm(np.maximum(np.maximum(low - xyz, xyz - high), 0.0), axis=1)


def within_box(xyz: NDArray[Any], low: NDArray[Any], high: NDArray[Any]) -> NDArray[np.bool_]:
    """Tell which points (N, D) lie in a box from ``low`` (D,) to ``high`` (D,), its faces included."""
    inside = (xyz[:, 0] >= low[0]) & (xyz[:, 0] <= high[0])
    for k in range(1, xyz.shape[1]):
        inside &= (xyz[:, k] >= low[k]) & (xyz[:, k] <= high[k])
    return np.asarray(inside)


def voxel_indices(xyz: Floats, leaf: float) -> Ints:
    """Return the integer voxel (N, 3) of every point for a leaf [m]."""
    return np.floor(xyz / leaf).astype(np.int64)


def packable(index: Ints) -> NDArray[np.bool_]:
    """Tell which voxel indices (N, 3) lie within +-2**20, the reach of :func:`voxel_keys`."""
    return within_box(index, np.full(3, -VOXEL_LIMIT), np.full(3, VOXEL_LIMIT - 1))


def voxel_keys(index: Ints) -> Ints:
    """Pack voxel indices (N, 3), each within +-2**20, into one int64 key a row.

    Raises
    ------
    InputError
        An index out of reach, as world coordinates give: two voxels would share a key.
    """
    if len(index) and (index.min() < -VOXEL_LIMIT or index.max() >= VOXEL_LIMIT):
        raise InputError("voxel index beyond +-2**20; use local coordinates or a larger leaf")
    shifted = index + VOXEL_LIMIT
    return np.asarray((shifted[:, 0] << 42) | (shifted[:, 1] << 21) | shifted[:, 2])


def unpack_voxel_keys(keys: Ints) -> Ints:
    """Invert :func:`voxel_keys`, giving (N, 3) int64 indices."""
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], axis=1) - VOXEL_LIMIT


def unpack_voxel_columns(keys: Ints) -> Ints:
    """Return the first two of the indices that :func:`unpack_voxel_keys` gives, (N, 2) int64."""
    return np.stack([keys >> 42, (keys >> 21) & ((1 << 21) - 1)], axis=1) - VOXEL_LIMIT


def unique_cells(cells: Ints) -> tuple[Ints, Ints]:
    """Return the distinct rows (M, K) of integer cells (N, K) in order, and which of them each row (N,) is.

    As ``np.unique`` by rows does, without sorting rows: cells of points lie close together.
    """
    if len(cells) == 0:
        return cells, np.zeros(0, dtype=np.int64)
    low, high = extent_of(cells)
    spans = (high - low + 1).tolist()
    if math.prod(spans) > _CELLS_A_POINT * len(cells) + _FEW_CELLS:  # scattered far apart
        found, place = np.unique(cells, axis=0, return_inverse=True)
        return found, np.asarray(place.ravel())
    flat = np.ravel_multi_index(tuple((cells - low).T), spans)
    held = np.flatnonzero(np.bincount(flat))
    number = np.empty(int(held[-1]) + 1, dtype=np.int64)
    number[held] = np.arange(len(held))
    return np.stack(np.unravel_index(held, spans), axis=1) + low, number[flat]


def stable_order(keys: NDArray[Any]) -> Ints:
    """Return the order (N,) that sorts numbers (N,), none of them NaN, equal ones as they stand.

    Integers are sorted by digits. Others by a quick sort of the keys and one of the places of equal ones:
    several times faster than one stable sort.
    """
    if keys.dtype.kind == "i":
        from subiaco_geo.radix_sort import radix_order  # numba is not loaded by those who only read clouds

        by_digits = radix_order(keys.astype(np.int64, copy=False))
        if by_digits is not None:
            return by_digits
    order = np.argsort(keys)
    if len(keys) == 0:
        return order
    ordered = keys[order]
    run = np.cumsum(np.diff(ordered, prepend=ordered[:1]) != 0) * len(keys)
    return np.asarray(np.sort(run + order) - run)


def unique_keys(keys: Ints) -> Ints:
    """Return the distinct keys in order, as ``np.unique`` does; many keys are sorted sooner than hashed."""
    ordered = np.sort(keys)
    fresh = np.ones(len(ordered), dtype=np.bool_)
    fresh[1:] = ordered[1:] != ordered[:-1]
    return np.asarray(ordered[fresh])


def sort_spatially(xyz: Floats, cell: float = 2.0) -> Ints:
    """Return the order (N,) that groups points by cells of a size [m].

    Neighbour searches on points sorted like this are several times faster.
    """
    if len(xyz) == 0:
        return np.zeros(0, dtype=np.int64)
    corner = np.floor(extent_of(xyz)[0] / cell) * cell
    return stable_order(voxel_keys(voxel_indices(xyz - corner, cell)))


def voxel_downsample(cloud: PointCloud, leaf: float) -> PointCloud:
    """Average points and float fields per voxel; other fields take the first value.

    Parameters
    ----------
    cloud : PointCloud
    leaf : float
        Voxel edge [m].

    Returns
    -------
    PointCloud
        One point a voxel in voxel-key order; unit ``normals`` are re-normalised.
    """
    return voxel_average(cloud, leaf)[0]


def voxel_average(cloud: PointCloud, leaf: float) -> tuple[PointCloud, Ints]:
    """Downsample as :func:`voxel_downsample`; return also which of its points (N,) each point went into."""
    if len(cloud) == 0:
        return cloud, np.zeros(0, dtype=np.int64)
    keys = voxel_keys(voxel_indices(cloud.xyz, leaf))
    order = stable_order(keys)
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    counts = np.diff(np.append(starts, len(keys)))
    voxel = np.empty(len(keys), dtype=np.int64)
    voxel[order] = np.repeat(np.arange(len(starts)), counts)

    def reduce(values: NDArray[np.generic]) -> NDArray[np.generic]:
        ordered = values[order]
        if not np.issubdtype(values.dtype, np.floating):
            return ordered[starts]
        total = np.add.reduceat(ordered, starts, axis=0)
        return np.asarray(total / counts.reshape(-1, *[1] * (values.ndim - 1)), dtype=values.dtype)

    fields = {name: reduce(values) for name, values in cloud.fields.items()}
    if "normals" in fields:
        normals = np.asarray(fields["normals"], dtype=np.float64)
        norm = np.linalg.norm(normals, axis=1, keepdims=True)
        fields["normals"] = normals / np.maximum(norm, 1e-12)
    return replace(cloud, xyz=np.asarray(reduce(cloud.xyz), dtype=np.float64), fields=fields), voxel
