"""Epochs opened without being loaded: what is small at once, points and beams part by part."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from subiaco_geo.cloud_fields import refuse_strays
from subiaco_geo.cloud_parts import cloud_parts, with_only
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.free_space.sensor_view import SENSOR
from subiaco_geo.maps import check_map_crs, cloud_of, existing_epoch, read_map_head
from subiaco_geo.simulated import distinct, simulation_of
from subiaco_geo.survey_map import PoseUncertainty, SurveyMap
from subiaco_geo.trajectories import Trajectory
from subiaco_geo.trajectory_files.formats import TrajectoryFormat
from subiaco_geo.trajectory_files.reading import read_trajectory
from subiaco_geo.visibility import VisibilityGrid, visibility_parts


class Epoch(Protocol):
    """One epoch as a run reads it; see :class:`EpochFiles` and :class:`LoadedEpoch`."""

    @property
    def crs(self) -> str | None:
        """CRS, None for a local frame."""
        ...

    @property
    def origin(self) -> Floats:
        """Origin (3,) about which its points are best kept, in its CRS [m]."""
        ...

    @property
    def trajectory(self) -> Trajectory | None:
        """Where the sensor went."""
        ...

    @property
    def uncertainty(self) -> PoseUncertainty | None:
        """How well its poses are known."""
        ...

    @property
    def info(self) -> Mapping[str, Any]:
        """Content of ``map.yaml``."""
        ...

    @property
    def has_beams(self) -> bool:
        """Whether beams were counted."""
        ...

    def clouds(self, fields: tuple[str, ...]) -> Iterator[PointCloud]:
        """Yield the points part by part, with those of ``fields`` that there are."""
        ...

    def beams(self) -> Iterator[VisibilityGrid]:
        """Yield the counts of beams part by part."""
        ...


@dataclass(frozen=True)
class LoadedEpoch:
    """An epoch that is in memory."""

    survey: SurveyMap

    @property
    def crs(self) -> str | None:
        """CRS, None for a local frame."""
        return self.survey.crs

    @property
    def origin(self) -> Floats:
        """Origin (3,) of its points [m]."""
        return np.asarray(self.survey.cloud.origin, dtype=np.float64)

    @property
    def trajectory(self) -> Trajectory | None:
        """Where the sensor went."""
        return self.survey.trajectory

    @property
    def uncertainty(self) -> PoseUncertainty | None:
        """How well its poses are known."""
        return self.survey.uncertainty

    @property
    def info(self) -> Mapping[str, Any]:
        """Content of ``map.yaml``."""
        return self.survey.info

    @property
    def has_beams(self) -> bool:
        """Whether beams were counted."""
        return self.survey.visibility is not None

    def clouds(self, fields: tuple[str, ...]) -> Iterator[PointCloud]:
        """Yield all points."""
        yield with_only(self.survey.cloud, fields)

    def beams(self) -> Iterator[VisibilityGrid]:
        """Yield all counts of beams."""
        if self.survey.visibility is not None:
            yield self.survey.visibility


@dataclass(frozen=True)
class EpochFiles:
    """An epoch that lies in files; build it with :func:`open_epoch`."""

    cloud: Path
    crs: str | None
    origin: Floats
    trajectory: Trajectory | None
    uncertainty: PoseUncertainty | None
    visibility: Path | None
    info: Mapping[str, Any] = field(default_factory=dict)
    trajectory_file: Path | None = None

    @property
    def has_beams(self) -> bool:
        """Whether beams were counted."""
        return self.visibility is not None

    def clouds(self, fields: tuple[str, ...]) -> Iterator[PointCloud]:
        """Yield the points of the file part by part; a part with stray points is refused."""
        for part in cloud_parts(self.cloud, fields):
            refuse_strays(self.cloud, part.xyz)
            yield part

    def beams(self) -> Iterator[VisibilityGrid]:
        """Yield the counts of beams part by part."""
        return iter(()) if self.visibility is None else visibility_parts(self.visibility)


def open_epoch(
    path: Path,
    trajectory: Path | None = None,
    form: TrajectoryFormat | None = None,
    group: str = "trajectories",
) -> EpochFiles:
    """Open one epoch: a map directory, or a bare cloud file; as :func:`subiaco_geo.maps.load_epoch`.

    ``form`` says how the trajectory file is read, ``group`` which settings errors name.

    Raises
    ------
    InputError
        Missing, or damaged as far as it was looked at.
    """
    path = existing_epoch(path)
    head = read_map_head(path)
    cloud = cloud_of(path)
    first = next(cloud_parts(cloud, (), 1000), None)
    if first is None:
        raise InputError(f"{cloud}: the cloud is empty; give a cloud with points")
    if "crs" in head.info:
        check_map_crs(path, head.info, first.crs)
    known = head.info.get("origin")
    origin = np.asarray(first.origin if known is None else known, dtype=np.float64)
    beams = path / "visibility.npz"
    info = head.info if "crs" in head.info else {**head.info, **distinct([simulation_of(cloud)])}
    way = head.trajectory
    if trajectory is not None:
        found = read_trajectory(Path(trajectory), cloud, first.crs, form, group)
        way = found.trajectory
        if found.view is not None:
            info = {SENSOR: found.view.description(), **info}
    return EpochFiles(
        cloud,
        first.crs,
        origin,
        way,
        head.uncertainty,
        beams if path.is_dir() and beams.is_file() else None,
        info,
        path / "trajectory.tum" if trajectory is None else Path(trajectory),
    )
