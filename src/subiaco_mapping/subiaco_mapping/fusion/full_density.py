"""Every return of a survey as classified LAZ tiles, written in the pass that fuses the map.

Returns wait on disk by tile of the fusion. When a tile of the map is finished, its returns take the classes
of their voxels and are compressed, so that memory holds one tile of the map and a million returns.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import PointCloud, unpack_voxel_keys, voxel_indices, voxel_keys
from subiaco_geo.codes import ASPRS_CODES, Semantic
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints, transform_points
from subiaco_geo.las_writing import las_stream
from subiaco_mapping.fusion.voxel_tiles import tile_corner, tile_numbers
from subiaco_mapping.preprocessing.scan_spool import SpooledScan

#: Folder of the tiles in a map directory, and its index.
FOLDER, INDEX = "full_density", "tiles.gpkg"
#: ASPRS codes beside those of the classes: never classified, and removed as an outlier.
UNCLASSIFIED, NOISE = 1, 7
#: GPS time in LAS files is less by this [s] (LAS 1.4: adjusted standard GPS time).
_ADJUSTMENT_S = 1_000_000_000
#: TAI - GPS [s], for ever.
GPS_BEHIND_TAI_S = 19
_GPS_EPOCH_S = 315_964_800  # 1980-01-06 in seconds since 1970
_STEP = 1e-4  # of stored coordinates [m]
_PART = 1 << 20  # returns compressed at a time
_RECORD = np.dtype(
    [
        ("xyz", "<i4", 3),
        ("intensity", "<u2"),
        ("gps_time", "<f8"),
        ("number", "u1"),
        ("of", "u1"),
        ("source", "<u2"),
    ]
)

#: Gives the class (:class:`~subiaco_geo.codes.Semantic`) of every point of a part of the map.
Classifier = Callable[[PointCloud, Floats], NDArray[np.uint8]]


@dataclass(frozen=True)
class FullDensity:
    """Where the tiles go, and what classifies the map.

    ``folder`` is new; ``classify`` takes points of the map and the probability (N,) that each moved; None
    leaves all that stands still unclassified. ``gps_minus_utc_s``: leap seconds.
    """

    folder: Path
    classify: Classifier | None = None
    gps_minus_utc_s: int = 18


@dataclass(frozen=True)
class VoxelClasses:
    """ASPRS code of every voxel of a tile: keys (V,), sorted, and codes (V,)."""

    keys: Ints
    codes: NDArray[np.uint8]
    leaf: float

    def of(self, xyz: Floats) -> NDArray[np.uint8]:
        """Return the code of points (N, 3) [m]; one in no voxel takes that of a voxel nearby, else none."""
        if len(self.keys) == 0:
            return np.full(len(xyz), UNCLASSIFIED, dtype=np.uint8)
        index = voxel_indices(xyz, self.leaf)
        codes, known = _looked_up(self.keys, self.codes, voxel_keys(index))
        if not known.all():
            wide, first = np.unique(voxel_keys(unpack_voxel_keys(self.keys) // 2), return_index=True)
            lost = np.flatnonzero(~known)
            found, near = _looked_up(wide, self.codes[first], voxel_keys(index[lost] // 2))
            codes[lost] = np.where(near, found, UNCLASSIFIED)
        return codes


def _looked_up(
    keys: Ints, codes: NDArray[np.uint8], wanted: Ints
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return codes[place].copy(), np.asarray(keys[place] == wanted)


class DensityTiles:
    """Takes the returns of scans, and writes a tile when its voxels are known.

    Parameters
    ----------
    output : FullDensity
    scratch : Path
        Folder for returns that wait.
    leaf : float
        Edge of a voxel [m].
    edge : int
        Edge of a tile [voxels].
    crs : str or None
        Of the map.
    origin : (3,) float64
        World coordinates of the zero of the map [m].
    """

    def __init__(
        self,
        output: FullDensity,
        scratch: Path,
        leaf: float,
        edge: int,
        crs: str | None,
        origin: Floats,
    ) -> None:
        self._output, self._scratch, self._leaf, self._edge = output, scratch, leaf, edge
        self._crs, self._origin = crs, origin
        self._waiting: set[int] = set()
        self._rows: list[dict[str, Any]] = []
        scratch.mkdir(parents=True)
        output.folder.mkdir(parents=True)

    def add(self, scan: SpooledScan, T_map_lidar: Floats, stamp_ns: int, source: int) -> None:
        """Take both returns of a scan, placed about the origin; ``source`` numbers its recording from 1."""
        both = (
            (scan.xyz, scan.intensity, scan.pulses),
            (scan.last_xyz, scan.last_intensity, scan.last_pulses),
        )
        whole_s = self._output.gps_minus_utc_s - _GPS_EPOCH_S - _ADJUSTMENT_S
        gps_s = (stamp_ns + whole_s * 1_000_000_000) * 1e-9
        for xyz, intensity, pulses in both:
            placed = transform_points(T_map_lidar, xyz)
            records = np.zeros(len(xyz), dtype=_RECORD)
            records["xyz"] = np.round(placed / _STEP)
            records["intensity"] = np.clip(intensity, 0, 65535)
            records["gps_time"], records["source"] = gps_s, source
            records["number"] = records["of"] = 1
            if pulses is not None:
                records["gps_time"] -= pulses["before_ns"] * 1e-9
                records["number"], records["of"] = pulses["number"], pulses["of"]
            if len(records):
                self._store(placed, records)

    def _store(self, placed: Floats, records: NDArray[np.void]) -> None:
        tiles = tile_numbers(voxel_indices(placed, self._leaf), self._edge)
        order = np.argsort(tiles, kind="stable")
        found, starts = np.unique(tiles[order], return_index=True)
        for tile, part in zip(found.tolist(), np.split(records[order], starts[1:]), strict=True):
            with self._path(tile).open("ab") as stream:
                stream.write(part.tobytes())
            self._waiting.add(tile)

    def _path(self, tile: int) -> Path:
        return self._scratch / f"{tile}.bin"

    def classes(
        self,
        keys: Ints,
        removed: NDArray[np.bool_],
        moved: NDArray[np.bool_],
        semantic: NDArray[np.uint8] | None,
    ) -> VoxelClasses:
        """Return the codes of voxels.

        Parameters
        ----------
        keys : (V,) int64
            Sorted.
        removed, moved : (V,) bool
            Removed as an outlier, and as a part of a moving object.
        semantic : (K,) uint8 or None
            Class of those that are neither, in their order.
        """
        codes = np.full(len(keys), UNCLASSIFIED, dtype=np.uint8)
        if semantic is not None:
            lookup = np.full(256, UNCLASSIFIED, dtype=np.uint8)
            for kind, code in ASPRS_CODES.items():
                lookup[int(kind)] = code
            codes[~(removed | moved)] = lookup[semantic]
        codes[removed] = NOISE
        codes[moved] = ASPRS_CODES[Semantic.MOBILE]
        return VoxelClasses(keys, codes, self._leaf)

    def finish_tile(self, tile: int, classes: VoxelClasses) -> None:
        """Write the LAZ of a tile, if it has returns."""
        if tile not in self._waiting:
            return
        self._waiting.discard(tile)
        low = tile_corner(tile, self._edge) * self._leaf
        size = self._edge * self._leaf
        path = self._path(tile)
        waiting = np.memmap(path, dtype=_RECORD, mode="r")
        outline = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size + low + self._origin[:2]
        west, south = np.floor(outline[0]).astype(int)
        name = f"{west}_{south}.laz"
        facts = _Facts()
        with las_stream(self._output.folder / name, unit_intensity=False, standard_gps_time=True) as stream:
            for cloud in self._parts(waiting, classes):
                stream.append(cloud)
                facts.add(cloud)
        self._rows.append({"location": name, **facts.row(), "outline": outline})
        del waiting
        path.unlink()

    def _parts(self, waiting: NDArray[np.void], classes: VoxelClasses) -> Iterator[PointCloud]:
        for start in range(0, len(waiting), _PART):
            records = np.asarray(waiting[start : start + _PART])
            placed = records["xyz"] * _STEP
            fields: dict[str, NDArray[Any]] = {
                "intensity": records["intensity"].astype(np.uint16),
                "classification": classes.of(placed),
                "gps_time": records["gps_time"].copy(),
                "return_number": records["number"].copy(),
                "number_of_returns": records["of"].copy(),
                "point_source_id": records["source"].astype(np.uint16),
            }
            yield PointCloud(placed, self._origin, self._crs, fields)

    def finish(self, recordings: dict[int, str]) -> None:
        """Write tiles that the map has no voxel of, the index, and the recordings by their source id.

        Raises
        ------
        InputError
            There was no return.
        """
        import geopandas as gpd
        import shapely

        nothing = VoxelClasses(np.zeros(0, np.int64), np.zeros(0, np.uint8), self._leaf)
        for tile in sorted(self._waiting):
            self.finish_tile(tile, nothing)
        if not self._rows:
            raise InputError(f"{self._output.folder}: no return is left; check range limits")
        shapes = [shapely.Polygon(row.pop("outline")) for row in self._rows]
        index = gpd.GeoDataFrame(self._rows, geometry=shapes, crs=self._crs)
        index.to_file(self._output.folder / INDEX, layer="tiles", driver="GPKG", engine="pyogrio")
        with (self._output.folder / "recordings.csv").open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(("point_source_id", "recording"))
            writer.writerows(sorted(recordings.items()))


class _Facts:
    """What the index says of a tile."""

    def __init__(self) -> None:
        self._points = 0
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)  # of height and GPS time
        self._classes = np.zeros(256, dtype=np.int64)

    def add(self, cloud: PointCloud) -> None:
        self._points += len(cloud)
        values = np.stack([cloud.xyz[:, 2] + cloud.origin[2], np.asarray(cloud.fields["gps_time"])], axis=1)
        self._low = np.minimum(self._low, values.min(axis=0))
        self._high = np.maximum(self._high, values.max(axis=0))
        self._classes += np.bincount(np.asarray(cloud.fields["classification"]), minlength=256)

    def row(self) -> dict[str, Any]:
        (low, first), (high, last) = self._low.tolist(), self._high.tolist()
        counts = {f"class_{code}": int(self._classes[code]) for code in (1, 2, 5, 6, 7, 64)}
        times = {"gps_time_first": first, "gps_time_last": last}
        return {"points": self._points, "low": low, "high": high, **times, **counts}
