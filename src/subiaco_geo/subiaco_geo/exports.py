"""A map in the forms that other programs ask for."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from subiaco_geo.atomic import whole_directory
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.frames import invert_pose
from subiaco_geo.maps import read_map
from subiaco_geo.trajectories import Trajectory, write_kitti

#: Ending of each kind of cloud.
CLOUD_ENDINGS = {"laz": ".laz", "copc": ".copc.laz", "ply": ".ply"}


def for_cloudcompare(cloud: PointCloud) -> PointCloud:
    """Prefix the fields of a PLY as CloudCompare asks: it loads no others by itself."""
    plain = ("normals", "red", "green", "blue")
    fields = {n if n in plain else f"scalar_{n}": values for n, values in cloud.fields.items()}
    return PointCloud(cloud.xyz, cloud.origin, cloud.crs, fields)


def export_map(directory: Path, output: Path, kind: str, *, cloudcompare: bool = False) -> list[Path]:
    """Write a map as a cloud, or its trajectory as KITTI poses.

    Parameters
    ----------
    directory : Path
        Map directory.
    output : Path
        New directory.
    kind : str
        ``laz``, ``copc``, ``ply`` or ``kitti`` (``poses.txt`` with the optimised
        ``lidar_link`` in the first one, and its times).
    cloudcompare : bool
        See :func:`for_cloudcompare`.

    Returns
    -------
    list of Path
        The files, with their final names.

    Raises
    ------
    InputError
        Not a map, a kind that a map does not have, or an output that exists.
    """
    if kind not in (*CLOUD_ENDINGS, "kitti"):
        raise InputError(f"{directory}: a map has no {kind}; give --to laz, copc, ply or kitti")
    survey = read_map(directory, with_last=False)
    if kind == "kitti" and survey.trajectory is None:
        raise InputError(f"{directory}: trajectory.tum is missing; rebuild the map")
    with whole_directory(output) as target:
        if survey.trajectory is not None and kind == "kitti":
            poses = survey.trajectory.poses
            relative = invert_pose(poses[0]) @ poses
            write_kitti(target / "poses.txt", Trajectory(survey.trajectory.times_ns, np.asarray(relative)))
        else:
            cloud = for_cloudcompare(survey.cloud) if cloudcompare else survey.cloud
            write_cloud(target / f"map{CLOUD_ENDINGS[kind]}", cloud)
    return sorted(output.iterdir())
