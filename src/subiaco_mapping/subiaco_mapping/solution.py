"""What the pose graph answers: every sequence in the local frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from subiaco_geo.crs import EnuFrame
from subiaco_geo.frames import Floats, Ints


@dataclass(frozen=True)
class SequenceSolution:
    """One sequence in the local frame of the graph.

    Parameters
    ----------
    name : str
    stamps_ns : (S,) int64
    T_local_lidar : (S, 4, 4) float64
    covariance : (S, 6, 6) float64
        Rotation [rad], translation [m], local axes.
    T_local_odom : (4, 4) float64
        At the newest scan: what carries fresh odometry over.
    fixes_used, fixes_refused, fixes_unattached, fixes_downweighted : int
    gnss_states : dict
        Counts and residuals by RTK state, see :func:`subiaco_mapping.manifest.describe_fixes`.
    headings_used : int
    """

    name: str
    stamps_ns: Ints
    T_local_lidar: Floats
    covariance: Floats
    T_local_odom: Floats
    fixes_used: int
    fixes_refused: int
    fixes_unattached: int
    fixes_downweighted: int
    gnss_states: dict[str, Any] = field(default_factory=dict)
    headings_used: int = 0


@dataclass(frozen=True)
class GraphSolution:
    """All sequences; ``frame`` is None for a local map, ``reason`` then says why."""

    sequences: tuple[SequenceSolution, ...]
    frame: EnuFrame | None
    reason: str | None
