"""Survey maps on disk: one directory an epoch, written whole, read back the same."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from subiaco_geo import __version__
from subiaco_geo.atomic import whole_directory
from subiaco_geo.cloud_io import read_cloud, write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.config import load_yaml, read_parameters
from subiaco_geo.errors import InputError
from subiaco_geo.free_space.sensor_view import SENSOR
from subiaco_geo.map_tables import (
    read_heights,
    read_uncertainty,
    write_heights,
    write_tile_uncertainty,
    write_uncertainty,
)
from subiaco_geo.simulated import mark_simulated
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import (
    Trajectory,
    read_kitti,
    read_tum,
    write_kitti,
    write_tum,
)
from subiaco_geo.trajectory_files.formats import TrajectoryFormat
from subiaco_geo.trajectory_files.reading import read_trajectory
from subiaco_geo.visibility import VisibilityGrid, load_visibility, save_visibility

#: Coordinates beyond are none of the Earth [m].
_FARTHEST = 1e9


def write_map(
    directory: Path, survey: SurveyMap, overwrite: bool = False, folders: Mapping[str, Path] | None = None
) -> None:
    """Write a map directory; it appears whole or not at all.

    ``map.laz map.ply map.yaml manifest.yaml config.yaml`` always;
    ``trajectory.tum visibility.npz uncertainty.csv heights.csv last.laz moving.laz
    tile_uncertainty.csv odometry/<sequence>.txt (.times.txt)`` and reports where the survey has them.
    ``folders`` are moved into it under their names.

    Raises
    ------
    InputError
        The directory exists and ``overwrite`` is False, or it is not a map; an empty cloud.
    """
    with whole_directory(Path(directory), overwrite=overwrite, marker="map.yaml") as out:
        write_cloud(out / "map.ply", survey.cloud)
        write_cloud(out / "map.laz", survey.cloud)
        for name, side in (("last.laz", survey.last), ("moving.laz", survey.moving)):
            if side is not None and len(side):
                write_cloud(out / name, side)
        _write_trajectories(out, survey)
        if survey.visibility is not None:
            save_visibility(out / "visibility.npz", survey.visibility)
        if survey.heights is not None:
            write_heights(out / "heights.csv", survey.heights)
            write_tile_uncertainty(out / "tile_uncertainty.csv", survey, survey.heights)
        _write_yaml(out / "map.yaml", _map_info(survey))
        _write_yaml(out / "manifest.yaml", survey.manifest)
        _write_yaml(out / "config.yaml", {"/**": {"ros__parameters": survey.config}})
        for name, text in survey.pages.items():
            (out / name).write_text(text, encoding="utf-8")
        for name, folder in (folders or {}).items():
            shutil.move(folder, out / name)


def read_map(directory: Path, *, with_last: bool = True) -> SurveyMap:
    """Read a map directory; parts that are absent are None or empty.

    Parameters
    ----------
    directory : Path
    with_last : bool
        Read the side clouds too: last returns, and points of moving objects.

    Raises
    ------
    InputError
        Not a map directory, or a part that is damaged.
    """
    directory = Path(directory)
    if not (directory / "map.yaml").is_file():
        raise InputError(f"{directory}: not a map directory (no map.yaml); make one with 'subiaco map'")
    info = _read_yaml(directory / "map.yaml")
    uncertainty = directory / "uncertainty.csv"
    heights = directory / "heights.csv"
    last, moving = directory / "last.laz", directory / "moving.laz"
    return SurveyMap(
        cloud=_read_map_cloud(directory, info),
        trajectory=_optional_trajectory(directory / "trajectory.tum"),
        visibility=_optional_visibility(directory / "visibility.npz"),
        uncertainty=read_uncertainty(uncertainty) if uncertainty.is_file() else None,
        info=info,
        last=read_cloud(last) if with_last and last.is_file() else None,
        moving=read_cloud(moving) if with_last and moving.is_file() else None,
        odometry={p.stem: read_kitti(p) for p in _odometry_files(directory)},
        manifest=_read_yaml(directory / "manifest.yaml"),
        heights=read_heights(heights) if heights.is_file() else None,
        config=_read_config(directory / "config.yaml"),
    )


def load_epoch(
    path: Path,
    trajectory: Path | None = None,
    form: TrajectoryFormat | None = None,
    group: str = "trajectories",
) -> SurveyMap:
    """Load one epoch: a map directory, or a bare cloud file.

    Parameters
    ----------
    path : Path
        A map directory, a cloud file, or a folder whose ``map.ply`` (or
        ``map.laz``) is the cloud, as a simulation without bags leaves it;
        ``visibility.npz`` and ``trajectory.tum`` beside it are taken up.
    trajectory : Path, optional
        File that says where the sensor went (TUM, SBET, RTKLIB, named columns); replaces the map's own.
    form : TrajectoryFormat, optional
        What the trajectory file does not say itself.
    group : str
        Settings that errors about it name.
    """
    path = existing_epoch(path)
    survey = read_map(path, with_last=False) if (path / "map.yaml").is_file() else _read_bare(path)
    if trajectory is None:
        return survey
    found = read_trajectory(Path(trajectory), cloud_of(path), survey.cloud.crs, form, group)
    view = {} if found.view is None else {SENSOR: found.view.description()}
    return replace(survey, trajectory=found.trajectory, info={**view, **survey.info})


def existing_epoch(path: Path) -> Path:
    """Refuse a map or cloud that is not there."""
    path = Path(path)
    if not path.exists():
        raise InputError(
            f"{path}: no such map or cloud; give a map directory or a .ply, .las, .laz or .pcd file"
        )
    return path


def _read_bare(path: Path) -> SurveyMap:
    cloud = cloud_of(path)
    survey = SurveyMap(
        read_cloud(cloud),
        _optional_trajectory(path / "trajectory.tum"),
        _optional_visibility(path / "visibility.npz"),
        info={"source": path.name},
    )
    return mark_simulated(survey, [cloud])


def read_map_head(path: Path) -> SurveyMap:
    """Read what is small of a map directory, or beside a bare cloud: ``info``, trajectory and covariances.

    The cloud of what is returned is empty.
    """
    nothing = PointCloud(np.zeros((0, 3)))
    if not (path / "map.yaml").is_file():
        return SurveyMap(nothing, _optional_trajectory(path / "trajectory.tum"), info={"source": path.name})
    info = _read_yaml(path / "map.yaml")
    _origin_of(path, info)
    uncertainty = path / "uncertainty.csv"
    return SurveyMap(
        nothing,
        _optional_trajectory(path / "trajectory.tum"),
        uncertainty=read_uncertainty(uncertainty) if uncertainty.is_file() else None,
        info={"crs": None, **info},
    )


def cloud_of(path: Path) -> Path:
    """Return the cloud file of a map directory, or the file itself.

    Raises
    ------
    InputError
        A folder without one.
    """
    if path.is_file():
        return path
    for name in ("map.ply", "map.laz"):
        if (path / name).is_file():
            return path / name
    raise InputError(f"{path}: holds no map (no map.yaml, map.ply or map.laz); make one with 'subiaco map'")


def _read_map_cloud(directory: Path, info: Mapping[str, Any]) -> PointCloud:
    cloud = read_cloud(cloud_of(directory))
    check_map_crs(directory, info, cloud.crs)
    origin = _origin_of(directory, info)
    return cloud if origin is None else cloud.rebased(origin)


def check_map_crs(directory: Path, info: Mapping[str, Any], crs: str | None) -> None:
    """Refuse a map whose cloud is in another CRS than ``map.yaml`` says."""
    if crs != info.get("crs"):
        raise InputError(
            f"{directory}: map.yaml says CRS {info.get('crs')}, the cloud says {crs}; rebuild the map"
        )


def _origin_of(directory: Path, info: Mapping[str, Any]) -> list[float] | None:
    """Return the origin that ``map.yaml`` names, if it does."""
    origin = info.get("origin")
    if origin is None:
        return None
    if not (isinstance(origin, list) and len(origin) == 3 and all(_is_number(value) for value in origin)):
        raise InputError(
            f"{directory / 'map.yaml'}: origin is {origin!r:.80}, not three numbers; rebuild the map"
        )
    return [float(value) for value in origin]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and abs(value) < _FARTHEST


def _map_info(survey: SurveyMap) -> dict[str, Any]:
    computed = {
        "crs": survey.cloud.crs,
        "heights": None if survey.cloud.crs is None else "ellipsoidal",
        "points": len(survey.cloud),
        "origin": survey.cloud.origin,
        "version": __version__,
    }
    if survey.trajectory is not None and len(survey.trajectory):
        times_ns = survey.trajectory.times_ns
        computed |= {"start_ns": int(times_ns[0]), "end_ns": int(times_ns[-1])}
    return {**survey.info, **computed}


def _odometry_files(directory: Path) -> list[Path]:
    return sorted(p for p in (directory / "odometry").glob("*.txt") if not p.name.endswith(".times.txt"))


def _optional_trajectory(path: Path) -> Trajectory | None:
    return read_tum(path) if path.is_file() else None


def _optional_visibility(path: Path) -> VisibilityGrid | None:
    return load_visibility(path) if path.is_file() else None


def _write_trajectories(out: Path, survey: SurveyMap) -> None:
    if survey.trajectory is not None:
        write_tum(out / "trajectory.tum", survey.trajectory)
    if survey.uncertainty is not None:
        write_uncertainty(out / "uncertainty.csv", survey.uncertainty)
    (out / "odometry").mkdir()
    for name, odometry in survey.odometry.items():
        if not name or "/" in name or name.startswith(".") or name.endswith(".times"):
            raise InputError(f"sequence {name!r}: cannot be a file name; rename the bag")
        write_kitti(out / "odometry" / f"{name}.txt", odometry)


def _read_config(path: Path) -> dict[str, Any]:
    return read_parameters(path) if path.is_file() else {}


def _write_yaml(path: Path, values: Mapping[str, Any]) -> None:
    path.write_text(yaml.safe_dump(plain(values), sort_keys=False, allow_unicode=True), encoding="utf-8")


def _read_yaml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        document = load_yaml(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid YAML ({str(error).splitlines()[0]}); rebuild the map") from error
    if not isinstance(document or {}, dict):
        raise InputError(f"{path}: expected names and values; rebuild the map")
    return dict(document or {})


def plain(value: Any) -> Any:
    """Return a value as the plain lists, dicts, numbers and texts that YAML and JSON hold."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
