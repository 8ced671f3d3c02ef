"""A map in the forms that other programs ask for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from subiaco_geo.atomic import whole_directory
from subiaco_geo.cloud_fields import brightest
from subiaco_geo.cloud_parts import cloud_parts
from subiaco_geo.cloud_windows import CloudFile
from subiaco_geo.clouds import PointCloud
from subiaco_geo.copc_io import write_copc_parts
from subiaco_geo.errors import InputError
from subiaco_geo.frames import invert_pose
from subiaco_geo.las_writing import las_stream
from subiaco_geo.output_heights import above_geoid, write_heights_note
from subiaco_geo.ply_io import write_ply_parts
from subiaco_geo.sources import open_epoch
from subiaco_geo.tiles import tile_grid
from subiaco_geo.trajectories import Trajectory, write_kitti

#: Ending of each kind of cloud.
CLOUD_ENDINGS = {"laz": ".laz", "copc": ".copc.laz", "ply": ".ply"}


def for_cloudcompare(cloud: PointCloud) -> PointCloud:
    """Prefix the fields of a PLY as CloudCompare asks: it loads no others by itself."""
    plain = ("normals", "red", "green", "blue")
    fields = {n if n in plain else f"scalar_{n}": values for n, values in cloud.fields.items()}
    return PointCloud(cloud.xyz, cloud.origin, cloud.crs, fields)


def copy_cloud(
    source: Path,
    target: Path,
    *,
    ellipsoidal: bool = True,
    cloudcompare: bool = False,
    convert: Callable[[PointCloud], PointCloud] = lambda cloud: cloud,
) -> None:
    """Write a cloud file in another form, by its ending; from a binary PLY part by part.

    Parameters
    ----------
    source, target : Path
    ellipsoidal : bool
        For LAS: state in the CRS that heights are ellipsoidal.
    cloudcompare : bool
        See :func:`for_cloudcompare`.
    convert : callable
        Applied to every part before it is written; must give the same fields for each.
    """

    def parts() -> Iterator[PointCloud]:
        for part in cloud_parts(source, None):
            converted = convert(part)
            yield for_cloudcompare(converted) if cloudcompare else converted

    if target.name.endswith(".copc.laz"):
        write_copc_parts(target, parts, ellipsoidal=ellipsoidal)
    elif target.suffix == ".ply":
        write_ply_parts(target, parts(), sum(len(part) for part in parts()))
    else:
        unit = max(brightest(part) for part in parts()) <= 1.0
        with las_stream(target, ellipsoidal=ellipsoidal, unit_intensity=unit) as stream:
            for part in parts():
                stream.append(part)


def tile_cloud(source: Path, folder: Path) -> None:
    """Write a cloud as LAZ of 80 m tiles, ``<column>_<row>.laz``, and ``tiles.gpkg`` that finds them.

    Columns and rows count from the zero of the CRS, so the tiles of every epoch are the same squares. The
    index has a square a tile with its ``location``, ``points``, ``low`` and ``high`` [m].
    """
    import geopandas as gpd
    import shapely

    cloud = CloudFile(source, None)
    unit = max(brightest(part) for part in cloud.parts()) <= 1.0
    rows = []
    crs = None
    for tile in tile_grid((*cloud.low[:2], *cloud.high[:2]), overlap=0.0):
        part = cloud.inside(*tile.core)
        if len(part) == 0:
            continue
        name, crs, height = f"{tile.id}.laz", part.crs, part.xyz[:, 2] + part.origin[2]
        with las_stream(folder / name, unit_intensity=unit) as stream:
            stream.append(part)
        ends = {"low": float(height.min()), "high": float(height.max())}
        rows.append({"location": name, "points": len(part), **ends, "geometry": shapely.box(*tile.core)})
    index = gpd.GeoDataFrame(rows, crs=crs)
    index.to_file(folder / "tiles.gpkg", layer="tiles", engine="pyogrio")


def export_map(
    directory: Path, output: Path, kind: str, *, cloudcompare: bool = False, geoid: Path | None = None
) -> list[Path]:
    """Write a map as a cloud, or its trajectory as KITTI poses.

    Parameters
    ----------
    directory : Path
        Map directory.
    output : Path
        New directory.
    kind : str
        ``laz``, ``copc``, ``ply``, ``tiles`` (see :func:`tile_cloud`) or ``kitti`` (``poses.txt`` with the
        optimised ``lidar_link`` in the first one, and its times).
    cloudcompare : bool
        See :func:`for_cloudcompare`.
    geoid : Path, optional
        Geoid model: ``laz``, ``copc`` and ``ply`` get heights above it.

    Returns
    -------
    list of Path
        The files, with their final names.

    Raises
    ------
    InputError
        Not a map, a kind that a map does not have, or an output that exists.
    """
    if kind not in (*CLOUD_ENDINGS, "tiles", "kitti"):
        raise InputError(f"{directory}: a map has no {kind}; give --to laz, copc, ply, tiles or kitti")
    if geoid is not None and kind not in CLOUD_ENDINGS:
        raise InputError(f"--geoid: heights of {kind} stay above the ellipsoid; give --to laz, copc or ply")
    survey = open_epoch(directory)
    way = survey.trajectory
    if kind == "kitti" and way is None:
        raise InputError(f"{directory}: trajectory.tum is missing; rebuild the map")
    with whole_directory(output) as target:
        if way is not None and kind == "kitti":
            relative = invert_pose(way.poses[0]) @ way.poses
            write_kitti(target / "poses.txt", Trajectory(way.times_ns, np.asarray(relative)))
        elif kind == "tiles":
            tile_cloud(survey.cloud, target)
        else:
            copy_cloud(
                survey.cloud,
                target / f"map{CLOUD_ENDINGS[kind]}",
                ellipsoidal=geoid is None,
                cloudcompare=cloudcompare,
                convert=(lambda cloud: cloud) if geoid is None else partial(above_geoid, grid=geoid),
            )
            if geoid is not None:
                write_heights_note(target, geoid)
    return sorted(output.iterdir())
