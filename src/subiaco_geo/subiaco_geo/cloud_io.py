"""Read and write point clouds by the ending of the file's name."""

from __future__ import annotations

from pathlib import Path

from subiaco_geo.clouds import PointCloud
from subiaco_geo.copc_io import write_copc
from subiaco_geo.errors import InputError
from subiaco_geo.las_io import read_las
from subiaco_geo.las_writing import write_las
from subiaco_geo.ply_io import read_ply, write_ply

READABLE = (".ply", ".las", ".laz", ".pcd")


def read_cloud(path: Path) -> PointCloud:
    """Read a ``.ply``, ``.las``, ``.laz``, ``.copc.laz`` or ``.pcd`` file.

    Returns
    -------
    PointCloud
        About an origin of its own (:func:`subiaco_geo.clouds.from_world`),
        with the CRS that the file names and one field an attribute.

    Raises
    ------
    InputError
        Missing, unknown ending, cut or damaged, empty, NaN coordinates,
        float32 projected coordinates, or an unknown CRS.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such cloud file; give a {', '.join(READABLE)} file")
    suffix = path.suffix.lower()
    if suffix not in READABLE:
        raise InputError(
            f"{path}: cannot read clouds of type {suffix or 'none'!r}; give {', '.join(READABLE)}"
        )
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file has no bytes; copy or export it again")
    if suffix == ".ply":
        return read_ply(path)
    if suffix == ".pcd":
        from subiaco_geo.pcd_io import read_pcd  # brings numba

        return read_pcd(path)
    return read_las(path)


def write_cloud(path: Path, cloud: PointCloud, *, ellipsoidal: bool = True) -> None:
    """Write a ``.ply``, ``.laz``, ``.las`` or ``.copc.laz`` file, whole or not at all.

    Parameters
    ----------
    path : Path
    cloud : PointCloud
        Not empty, coordinates finite.
    ellipsoidal : bool
        For LAS: state in the CRS that heights are ellipsoidal.

    Raises
    ------
    InputError
        Unknown ending, or a cloud that cannot be written without loss of meaning.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.name.lower().endswith(".copc.laz"):
        write_copc(path, cloud, ellipsoidal=ellipsoidal)
    elif suffix == ".ply":
        write_ply(path, cloud)
    elif suffix in (".laz", ".las"):
        write_las(path, cloud, ellipsoidal=ellipsoidal)
    else:
        raise InputError(f"{path}: cannot write clouds of type {suffix or 'none'!r}; use .ply, .laz or .las")
