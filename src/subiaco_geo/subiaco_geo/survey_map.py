"""The survey map of one epoch: cloud, trajectory, visibility, uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.trajectories import (
    Trajectory,
)
from subiaco_geo.visibility import VisibilityGrid


@dataclass(frozen=True)
class PoseUncertainty:
    """Covariances of map poses.

    Parameters
    ----------
    times_ns : (M,) int64
        UTC times, those of the trajectory.
    sequences : sequence of str
        M names: which recording a pose belongs to.
    covariances : (M, 6, 6) float64
        Rotation first [rad2, rad m, m2], about the axes of the map, of ``lidar_link``.
    """

    times_ns: Ints
    sequences: Sequence[str]
    covariances: Floats

    def __post_init__(self) -> None:
        shape = (len(self.times_ns), 6, 6)
        if self.covariances.shape != shape or len(self.sequences) != shape[0]:
            raise InputError(f"covariances must have shape {shape} and one sequence name each")

    @property
    def sigmas(self) -> Floats:
        """Standard deviations (M, 6), rotation [rad] then translation [m]."""
        return np.asarray(np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2)))


@dataclass(frozen=True)
class SurveyMap:
    """One epoch as the change stage sees it.

    Parameters
    ----------
    cloud : PointCloud
        Static points at the working leaf; a CRS of None is a local map.
    trajectory : Trajectory, optional
        ``T_map_lidar`` at each scan's last column, world coordinates.
    visibility : VisibilityGrid, optional
    uncertainty : PoseUncertainty, optional
    info : mapping
        ``map.yaml``: epoch, time range, leaf, configuration hash, input bags with hashes ...
    last : PointCloud, optional
        Last returns.
    odometry : mapping of str to Trajectory
        Raw odometry a sequence, ``T_lidar0_lidar``.
    manifest : mapping
        Flagged stretches of the survey.
    heights : (K, 5) float64, optional
        See :data:`HEIGHT_COLUMNS`.
    config : mapping
        The configuration as resolved.
    pages : mapping of str to str
        Reports to lay beside the map: file name and text; not read back.
    moving : PointCloud, optional
        Points of objects that moved during the survey; not in ``cloud``.
    """

    cloud: PointCloud
    trajectory: Trajectory | None = None
    visibility: VisibilityGrid | None = None
    uncertainty: PoseUncertainty | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    last: PointCloud | None = None
    odometry: Mapping[str, Trajectory] = field(default_factory=dict)
    manifest: Mapping[str, Any] = field(default_factory=dict)
    heights: Floats | None = None
    config: Mapping[str, Any] = field(default_factory=dict)
    pages: Mapping[str, str] = field(default_factory=dict)
    moving: PointCloud | None = None

    @property
    def crs(self) -> str | None:
        """CRS of the map, None for a local one."""
        return self.cloud.crs
