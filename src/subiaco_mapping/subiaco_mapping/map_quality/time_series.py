"""Time series of a solved recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.frames import Floats, Ints, invert_pose
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion.projection import Projection
from subiaco_mapping.pose_graph.records import Chain
from subiaco_mapping.survey_graph.solution import GraphSolution, SequenceSolution

#: Distance from the vehicle at which the uncertainty of heights is told: that of facades and gardens [m].
BESIDE = 20.0
_DIRECTIONS = 16
#: RTK states of a pose: no fix near it, then the states of the fixes.
STATES = {-1: "no fix", 0: "single", 1: "float", 2: "RTK fixed"}


@dataclass(frozen=True)
class Series:
    """One sequence.

    Parameters
    ----------
    name : str
    seconds : (S,) float64
        Since its first scan.
    position : (S, 3) float64
        Of ``lidar_link``, coordinates of the map [m].
    sigma : (S, 3) float64
        East, north, up [m].
    sigma_beside : (S,) float64
        Of the height of a point :data:`BESIDE` away, in the direction in which it is largest [m].
    state : (S,) int64
        See :data:`STATES`.
    speed : (S,) float64
        [m/s].
    correction : (S, 4) float64
        What the graph moved odometry by since the first scan: east, north, up [m], yaw [deg].
    """

    name: str
    seconds: Floats
    position: Floats
    sigma: Floats
    sigma_beside: Floats
    state: Ints
    speed: Floats
    correction: Floats

    @property
    def way(self) -> float:
        """Length driven [m]."""
        return float(np.linalg.norm(np.diff(self.position, axis=0), axis=1).sum())


def series_of(solution: GraphSolution, config: MappingConfig) -> list[Series]:
    """Return the series of all sequences; the solution must hold its graph."""
    assert solution.graph is not None
    projection = Projection.of_place(solution.frame, config.crs)
    return [
        _series(solved, solution.graph.chains[number], projection, config)
        for number, solved in enumerate(solution.sequences)
    ]


def _series(solved: SequenceSolution, chain: Chain, projection: Projection, config: MappingConfig) -> Series:
    local = solved.T_local_lidar[:, :3, 3]
    turn = projection.axes(local)
    covariance = turn @ solved.covariance[:, 3:, 3:] @ np.swapaxes(turn, 1, 2)
    seconds = (solved.stamps_ns - solved.stamps_ns[0]) * 1e-9
    return Series(
        name=solved.name,
        seconds=seconds,
        position=projection.points(local),
        sigma=np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)),
        sigma_beside=_sigma_beside(solved.covariance),
        state=_states(chain, config.manifest.rtk_gap_ns),
        speed=_speed(seconds, local),
        correction=_corrections(solved.T_local_lidar, chain.T_odom_lidar),
    )


def _sigma_beside(covariance: Floats) -> Floats:
    """Return the largest sigma of height (S,) [m] around poses of covariance (S, 6, 6)."""
    azimuth = np.linspace(0.0, 2 * np.pi, _DIRECTIONS, endpoint=False)
    row = np.zeros((_DIRECTIONS, 6))  # of the Jacobian of a point's height
    row[:, 0], row[:, 1], row[:, 5] = BESIDE * np.sin(azimuth), -BESIDE * np.cos(azimuth), 1.0
    return np.asarray(np.sqrt(np.einsum("di,sij,dj->sd", row, covariance, row).max(axis=1)))


def _states(chain: Chain, gap_ns: int) -> Ints:
    """Return the state of the fix nearest to every scan, -1 beyond half a gap."""
    if chain.gnss is None or len(chain.gnss.times_ns) == 0:
        return np.full(len(chain), -1, dtype=np.int64)
    times = chain.gnss.times_ns
    after = np.clip(np.searchsorted(times, chain.stamps_ns), 1, max(len(times) - 1, 1))
    pair = np.stack([after - 1, np.minimum(after, len(times) - 1)])
    apart = np.abs(times[pair] - chain.stamps_ns)
    nearest = np.take_along_axis(pair, apart.argmin(axis=0)[None], axis=0)[0]
    return np.where(apart.min(axis=0) <= gap_ns // 2, np.clip(chain.gnss.status[nearest], 0, 2), -1)


def _speed(seconds: Floats, positions: Floats) -> Floats:
    if len(seconds) < 2:
        return np.zeros(len(seconds))
    return np.asarray(np.linalg.norm(np.gradient(positions, seconds, axis=0), axis=1))


def _corrections(T_local_lidar: Floats, T_odom_lidar: Floats) -> Floats:
    start = T_local_lidar[0] @ invert_pose(T_odom_lidar[0])
    carried = start @ T_odom_lidar
    turned = T_local_lidar[:, :3, :3] @ np.swapaxes(carried[:, :3, :3], 1, 2)
    yaw = np.degrees(np.arctan2(turned[:, 1, 0], turned[:, 0, 0]))
    return np.column_stack([T_local_lidar[:, :3, 3] - carried[:, :3, 3], yaw])
