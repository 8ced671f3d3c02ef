"""The solution of the pose graph: every recording in the local frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.crs import EnuFrame
from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.absolute_positions.positioning import AbsoluteFacts
from subiaco_mapping.pose_graph.records import Chain, LoopEdge, Solved


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
    headings_used, headings_refused : int
    fixes_contradicting : int
        Used fixes that the map is farther off than 99.9 % of what was stated.
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
    headings_refused: int = 0
    fixes_contradicting: int = 0


@dataclass(frozen=True)
class LoopFacts:
    """Places seen twice.

    Parameters
    ----------
    counts : dict of str to int
        Proposed, refused by reason, verified.
    between : (L,) bool
        Loops between two sequences; the others are within one.
    weights : (L,) float64
        What the robust kernel left.
    seams : (L,) float64
        How far the solved map is off the registration of both visits [m].
    """

    counts: dict[str, int] = field(default_factory=dict)
    between: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    weights: Floats = field(default_factory=lambda: np.zeros(0))
    seams: Floats = field(default_factory=lambda: np.zeros(0))

    def described(self) -> dict[str, Any]:
        """Return plain values for the manifest."""
        found: dict[str, Any] = dict(self.counts)
        found["downweighted"] = int((self.weights < 0.3).sum())
        for name, chosen in (("within", ~self.between), ("between", self.between)):
            seams = self.seams[chosen]
            found[name] = {"loops": len(seams)}
            if len(seams):
                median, high = np.quantile(seams, [0.5, 0.95])
                found[name] |= {
                    "seam_median_m": round(float(median), 4),
                    "seam_p95_m": round(float(high), 4),
                }
        return found


@dataclass(frozen=True)
class SolvedGraph:
    """What was solved and how it fits: chains by number, loops in the order of ``solved``."""

    chains: dict[int, Chain]
    loops: tuple[LoopEdge, ...]
    solved: Solved


@dataclass(frozen=True)
class GraphSolution:
    """All sequences; ``frame`` is None for a local map, ``reason`` then says why."""

    sequences: tuple[SequenceSolution, ...]
    frame: EnuFrame | None
    reason: str | None
    loops: LoopFacts = field(default_factory=LoopFacts)
    graph: SolvedGraph | None = None
    absolute: AbsoluteFacts | None = None


@dataclass(frozen=True)
class LiveSequence:
    """One sequence while driving; see :class:`SequenceSolution`."""

    name: str
    stamps_ns: Ints
    T_local_lidar: Floats
    T_local_odom: Floats
    fixes_used: int


@dataclass(frozen=True)
class LiveEstimate:
    """What is known while driving: no covariances, and sequences not yet placed are left out."""

    sequences: tuple[LiveSequence, ...]
    frame: EnuFrame | None
    reason: str | None
