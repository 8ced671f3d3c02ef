"""Epochs cut into tiles, points and beams alike, and assembled again around a place."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.point_spacing import STREET_SPACING, joint_spacing, neighbour_spacings
from subiaco_change.registration.pair import check_finite
from subiaco_change.visibility_evidence import EvidenceKind
from subiaco_geo.clouds import PointCloud, extent_of, unpack_voxel_columns, voxel_average
from subiaco_geo.crs import Transform
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.free_space.sensor_view import SensorView
from subiaco_geo.sources import Epoch
from subiaco_geo.tiles import split_by_tile
from subiaco_geo.visibility import VisibilityGrid
from subiaco_geo.work.store import Arrays, Store
from subiaco_geo.work.task_runner import TaskRunner
from subiaco_geo.work.tasks import Inputs

EPOCHS = ("before", "after")
#: Fields of points that a run reads, where they are there.
FIELDS = ("intensity", "semantic", "instance", "moving")


@dataclass(frozen=True)
class EpochContext:
    """What every task must know of one epoch.

    Parameters
    ----------
    epoch : str
        ``before`` or ``after``.
    origin : (3,) float64
        Of its points, in world coordinates [m].
    crs : str or None
        Of the pair.
    kind : str
        Of its evidence (see :class:`~subiaco_change.visibility_evidence.Observer`).
    beams_crs : str or None
        CRS in which its beams are counted, where it is not that of the pair.
    corner : (3,) float64
        Origin of its voxels of beams [m].
    voxel : float
        Their edge [m].
    spacing : float
        Median distance between neighbouring points on surfaces of the epoch [m], at the working leaf.
    view : SensorView, optional
        Of its sensor, where what its poses saw is expected.
    from_above : bool
        Its cloud, without visibility layer and trajectory, was measured from above.
    """

    epoch: str
    origin: Floats
    crs: str | None
    kind: EvidenceKind
    beams_crs: str | None
    corner: Floats
    voxel: float
    spacing: float = STREET_SPACING
    view: SensorView | None = None
    from_above: bool = False


@dataclass(frozen=True)
class TilePoints:
    """Points of a tile of one epoch, thinned to the leaf: ``xyz`` (N, 3) about the origin of the epoch [m].

    ``intensity``, ``semantic``, ``instance`` and ``moving``, the probability of having moved, (N,) where the
    cloud has them. ``count`` (N,): points of the cloud that each stands for.
    """

    xyz: Floats
    intensity: NDArray[Any] | None = None
    semantic: NDArray[Any] | None = None
    instance: NDArray[Any] | None = None
    moving: NDArray[Any] | None = None
    count: NDArray[np.uint32] | None = None


@dataclass(frozen=True)
class InputPoints:
    """All points of a tile of one epoch: ``xyz`` (N, 3) about the origin of the epoch [m].

    ``voxel`` (N,): the thinned point that each went into; ``intensity`` (N,) where the cloud has it.
    """

    xyz: Floats
    voxel: NDArray[np.int32]
    intensity: NDArray[Any] | None = None


@dataclass(frozen=True)
class Coordinates:
    """What all stored points have: ``xyz`` (N, 3) [m]."""

    xyz: Floats


@dataclass(frozen=True)
class TileBeams:
    """Voxels of beams in a tile: ``keys``, ``hits`` and ``passes`` (M,), ``moving`` (M,) where known."""

    keys: Ints
    hits: NDArray[np.uint32]
    passes: NDArray[np.uint32]
    moving: NDArray[Any] | None


class Spill:
    """Arrays of tiles as they come, on disk beyond a number of rows, until every tile is asked for once.

    Parameters
    ----------
    folder : Path
        Removed by the caller that created it.
    rows : int
        In memory at a time.
    """

    def __init__(self, folder: Path, rows: int = 1 << 22) -> None:
        self._folder, self._limit = folder, rows
        self._held: dict[str, list[Arrays]] = {}
        self._rows, self._count = 0, 0
        self._files: dict[str, list[Path]] = {}

    def add(self, tile: str, arrays: Arrays) -> None:
        """Take rows of a tile."""
        self._held.setdefault(tile, []).append(arrays)
        self._rows += len(next(iter(arrays.values())))
        if self._rows > self._limit:
            self._flush()

    def _flush(self) -> None:
        for tile, parts in self._held.items():
            path = self._folder / f"{tile}-{self._count}.npz"
            plain: dict[str, Any] = join(parts, parts[0])
            np.savez(path, **plain)
            self._files.setdefault(tile, []).append(path)
            self._count += 1
        self._held, self._rows = {}, 0

    def tiles(self) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
        """Yield every tile, in order, with all its rows in the order in which they came."""
        for tile in sorted({*self._held, *self._files}):
            parts: list[Arrays] = [dict(np.load(path)) for path in self._files.get(tile, [])]
            parts += self._held.get(tile, [])
            yield tile, join(parts, parts[0])


@dataclass(frozen=True)
class CutCloud:
    """Keys of the tiles of a cloud and points of each; its least and largest coordinates (3,) [m].

    ``keys`` of the thinned points, ``inputs`` of all of them, where these are kept.
    """

    keys: dict[str, str]
    inputs: dict[str, str]
    sizes: dict[str, int]
    low: Floats
    high: Floats
    points: int
    kept: int  # of these, at the leaf
    spacing: float  # of the thinned points [m]


def cut_cloud(
    store: Store,
    epoch: Epoch,
    origin: Floats,
    tile: float,
    leaf: float,
    whole: bool,
    folder: Path,
    operation: Transform | None = None,
) -> CutCloud:
    """Keep the points of every tile of the world, downsampled to a leaf.

    Parameters
    ----------
    store : Store
        Where the tiles are kept.
    epoch : Epoch
    origin : (3,) float64
        About which the points are kept.
    tile, leaf : float
        Edges of tiles and of voxels [m].
    whole : bool
        Keeps all points as well, as :class:`InputPoints`.
    folder : Path
        For what memory does not hold; the caller removes it.
    operation : Transform, optional
        Brings the points to the CRS of the pair.

    Raises
    ------
    InputError
        No points, or coordinates that are not finite.
    """
    low, high, points = np.full(3, np.inf), np.full(3, -np.inf), 0
    keys, inputs, sizes, spacings = {}, {}, {}, []
    runner, spill = TaskRunner(store), Spill(Path(mkdtemp(dir=folder)))
    for part in epoch.clouds(FIELDS):
        check_finite(part)
        world = part.world() if operation is None else operation.apply(part.world())
        lowest, highest = extent_of(world)
        low, high = np.minimum(low, lowest), np.maximum(high, highest)
        points += len(part)
        for name, members in split_by_tile(world, tile).items():
            fields = {field: part.fields[field][members] for field in FIELDS if field in part.fields}
            spill.add(name, {"xyz": world[members] - origin, **fields})
    for name, arrays in spill.tiles():
        xyz = arrays.pop("xyz")
        thin, voxel = voxel_average(PointCloud(xyz, origin, None, arrays), leaf)
        if whole:
            every = InputPoints(xyz, voxel.astype(np.int32), arrays.get("intensity"))
            inputs[name] = runner.put("input", name, every)
        sizes[name] = len(thin)
        count = np.bincount(voxel, minlength=len(thin)).astype(np.uint32)
        keys[name] = runner.put("cut", name, TilePoints(thin.xyz, **thin.fields, count=count))
        spacings.append(neighbour_spacings(thin.xyz))
    return CutCloud(keys, inputs, sizes, low, high, points, sum(sizes.values()), joint_spacing(spacings))


@dataclass(frozen=True)
class CutBeams:
    """Keys of the tiles of beams, and the origin (3,) and the edge of their voxels [m]."""

    keys: dict[str, str]
    corner: Floats
    voxel: float


def cut_beams(store: Store, epoch: Epoch, size: float, folder: Path) -> CutBeams | None:
    """Keep the voxels of beams of every tile; None where an epoch has none. See :func:`cut_cloud`."""
    keys, first = {}, None
    runner, spill = TaskRunner(store), Spill(Path(mkdtemp(dir=folder)))
    for part in epoch.beams():
        first = part if first is None else first
        for name, m in _split_columns(part, size):
            columns: dict[str, NDArray[Any]] = {
                "keys": part.keys[m],
                "hits": part.hits[m],
                "passes": part.passes[m],
            }
            if part.moving is not None:
                columns["moving"] = part.moving[m]
            spill.add(name, columns)
    for name, arrays in spill.tiles():
        own = TileBeams(arrays["keys"], arrays["hits"], arrays["passes"], arrays.get("moving"))
        keys[name] = runner.put("beams", name, own)
    return None if first is None else CutBeams(keys, first.origin, first.voxel)


def _split_columns(part: VisibilityGrid, size: float) -> Iterator[tuple[str, Ints]]:
    """Yield the voxels (M,) of every tile, in order; those of a column follow each other in the grid."""
    first = np.flatnonzero(np.diff(part.keys >> 21, prepend=-1))
    count = np.diff(first, append=len(part.keys))
    centres = (unpack_voxel_columns(part.keys[first]) + 0.5) * part.voxel + part.origin[:2]
    for name, columns in split_by_tile(centres, size).items():
        own = count[columns]
        start = np.repeat(first[columns] - np.cumsum(own) + own, own)
        yield name, start + np.arange(len(start))


def join(parts: Iterable[Arrays], names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Concatenate arrays of pieces, field by field; a field counts where all have it."""
    opened = list(parts)
    return {
        name: np.concatenate([part[name] for part in opened])
        for name in names
        if opened and all(name in part for part in opened)
    }


def no_beams(corner: Floats, voxel: float) -> VisibilityGrid:
    """Return the grid of an epoch that saw nothing."""
    none = np.zeros(0, dtype=np.uint32)
    return VisibilityGrid(corner, voxel, np.zeros(0, dtype=np.int64), none, none)


def load_beams(inputs: Inputs, alias: str, corner: Floats, voxel: float) -> VisibilityGrid:
    """Put the tiles of beams under ``alias/`` together."""
    parts = [inputs.of(TileBeams, f"{alias}/{name}") for name in inputs.under(alias)]
    if not parts:
        return no_beams(corner, voxel)
    keys = np.concatenate([part.keys for part in parts])
    order = np.argsort(keys, kind="stable")  # a voxel is in one tile; stable: it merges the sorted tiles
    hits, passes = np.concatenate([p.hits for p in parts]), np.concatenate([p.passes for p in parts])
    known = [part.moving for part in parts if part.moving is not None]
    moving = np.concatenate(known)[order] if len(known) == len(parts) else None
    return VisibilityGrid(corner, voxel, keys[order], hits[order], passes[order], moving)


def tiles_between(low: Floats, high: Floats, size: float) -> list[str]:
    """Return the tiles that a box (2,), (2,) [m, world] touches."""
    first, last = np.floor(low / size).astype(int), np.floor(high / size).astype(int)
    return [
        f"{column}_{row}" for column in range(first[0], last[0] + 1) for row in range(first[1], last[1] + 1)
    ]


def corners(low: Floats, high: Floats, bottom: float = -50.0, top: float = 50.0) -> Floats:
    """Return the corners (8, 3) of a box from its plan (2,), (2,) and heights [m]."""
    return np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (bottom, top)])
