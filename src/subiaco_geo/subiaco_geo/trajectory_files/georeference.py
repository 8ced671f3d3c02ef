"""Recorded paths brought into the CRS of a cloud: datum, heights, projection, axes of the grid, lever arm."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo.crs import fixes_to_datum, projection_of, require_crs, transformer
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, make_pose
from subiaco_geo.geoid import geoid_heights
from subiaco_geo.trajectory_files.attitude import level_rotations
from subiaco_geo.trajectory_files.formats import RecordedPath, TrajectoryFormat

_NORTHWARDS = 1e-4  # between the places that tell where true north is [deg]
_GRID_NORTH = np.array([0.0, 10.0, 0.0])  # between the places that tell where another grid's north is [m]


def poses_of_lidar(path: RecordedPath, crs: str | None, form: TrajectoryFormat, group: str) -> Floats:
    """Return the poses (N, 4, 4) of the LiDAR in the CRS of a cloud.

    Axes of the world are grid east, grid north, up; of the LiDAR forward, left, up unless
    ``mounting_deg`` turns them. A path without attitude is taken as level and facing its direction of travel.

    Parameters
    ----------
    path : RecordedPath
    crs : str, optional
        Of the cloud.
    form : TrajectoryFormat
    group : str
        Settings that errors name.

    Raises
    ------
    InputError
        Geographic positions and a cloud without CRS, or a datum or projection that PROJ cannot bring about.
    """
    if path.geographic:
        positions, turn = _projected(path.positions, crs, form, group)
    else:
        positions, turn = _regridded(path.positions, crs, form, group)
    rotations = level_rotations(positions) if path.rotations is None else turn @ path.rotations
    mounted = make_pose(
        Rotation.from_euler("ZYX", form.mounting_deg[::-1], degrees=True).as_matrix(), form.lever_arm
    )
    return np.asarray(make_pose(rotations, positions) @ mounted)


def _projected(places: Floats, crs: str | None, form: TrajectoryFormat, group: str) -> tuple[Floats, Floats]:
    """Return east, north, height (N, 3) of geographic places, and the turn (N, 3, 3) from true north."""
    if crs is None:
        raise InputError(
            "the trajectory has latitude and longitude, the cloud has no CRS; assign the CRS of the cloud in "
            "its file, or give a trajectory in its coordinates"
        )
    found = fixes_to_datum(places, form.declared_frame, crs, form.epoch, group)
    if form.geoid_grid is not None:
        found = geoid_heights(found, form.geoid_grid)
    operation = projection_of(crs)

    def project(latitude: Floats) -> Floats:
        columns = operation.transform(found[:, 1], latitude, found[:, 2])
        return np.column_stack(columns)

    positions = project(found[:, 0])
    if not np.isfinite(positions).all():
        raise InputError(
            f"the trajectory lies outside the range of {require_crs(crs).name}; check the CRS of the cloud"
        )
    poleward = np.where(found[:, 0] > 0, -1.0, 1.0)  # never beyond a pole
    north = poleward[:, None] * (project(found[:, 0] + poleward * _NORTHWARDS) - positions)
    return positions, _turns(north)


def _regridded(places: Floats, crs: str | None, form: TrajectoryFormat, group: str) -> tuple[Floats, Floats]:
    """Return places (N, 3) of another grid in that of the cloud, and the turn (N, 3, 3) of its north."""
    if form.crs is None:
        return places, np.broadcast_to(np.eye(3), (len(places), 3, 3))
    if crs is None:
        raise InputError(f"{group}.crs is {form.crs}, but the cloud has no CRS; assign it in its file")
    operation = transformer(form.crs, crs)
    positions = operation.apply(places)
    return positions, _turns(operation.apply(places + _GRID_NORTH) - positions)


def _turns(north: Floats) -> Floats:
    """Return rotations (N, 3, 3) about the vertical that bring north to where (N, 3) points."""
    angle = np.arctan2(-north[:, 0], north[:, 1])
    return np.asarray(Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0])).as_matrix())
