"""Inputs and outputs of the pose graph as frozen records."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats, Ints


@dataclass(frozen=True)
class GnssPriors:
    """Antenna positions acting on scans.

    Parameters
    ----------
    index : (N,) int64
        Scan.
    times_ns : (N,) int64
        In time order.
    enu, levers : (N, 3) float64
        Fix, and antenna in the scan's ``lidar_link`` [m].
    covariance : (N, 3, 3) float64
        Of one fix [m2].
    status : (N,) int64
    """

    index: Ints
    times_ns: Ints
    enu: Floats
    levers: Floats
    covariance: Floats
    status: Ints


@dataclass(frozen=True)
class HeadingPriors:
    """Yaw of ``base_link`` from east, counter-clockwise.

    Parameters
    ----------
    index : (N,) int64
        Scan.
    yaw, sigma : (N,) float64
        [rad].
    R_lidar_base : (N, 3, 3) float64
        From ``base_link`` at the time of the heading to ``lidar_link`` of the scan.
    """

    index: Ints
    yaw: Floats
    sigma: Floats
    R_lidar_base: Floats


@dataclass(frozen=True)
class GravityPriors:
    """Directions of *up* (N, 3), in ``lidar_link`` of scans ``index`` (N,)."""

    index: Ints
    up: Floats


@dataclass(frozen=True)
class WallPriors:
    """Walls near scans are vertical: ``root @ up`` is zero with unit variance.

    Parameters
    ----------
    index : (N,) int64
        Scan.
    root : (N, 3, 3) float64
        Square root of the information on *up* in ``lidar_link`` of the scan [1/rad]; zero without walls.
    """

    index: Ints
    root: Floats


#: Of a recording whose vertical is that of its first scan, which no wall has to agree with.
NO_WALLS = WallPriors(np.zeros(0, dtype=np.int64), np.zeros((0, 3, 3)))


@dataclass(frozen=True)
class Chain:
    """One sequence of scans for the graph.

    Parameters
    ----------
    stamps_ns : (S,) int64
    T_odom_lidar : (S, 4, 4) float64
    covariance : (S, 6, 6) float64
        Of the motion from the scan before; the first is not used.
    held : (S,) bool
        Registered, and no direction is free.
    segment : (S,) int64
    T_world_odom : (4, 4) float64
        First guess of the placement.
    gravity : GravityPriors
    gnss : GnssPriors or None
    heading : HeadingPriors or None
    anchored : bool
        Nothing but this chain's own start says where it is.
    walls : WallPriors
    """

    stamps_ns: Ints
    T_odom_lidar: Floats
    covariance: Floats
    held: NDArray[np.bool_]
    segment: Ints
    T_world_odom: Floats
    gravity: GravityPriors
    gnss: GnssPriors | None = None
    heading: HeadingPriors | None = None
    anchored: bool = False
    walls: WallPriors = NO_WALLS

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def shifted(self, offset: Floats) -> Chain:
        """Return the chain with an offset (3,) [m] added to its fixes."""
        if self.gnss is None:
            return self
        return replace(self, gnss=replace(self.gnss, enu=self.gnss.enu + offset))


@dataclass(frozen=True)
class LoopEdge:
    """A place seen twice, by scans of one or of two chains.

    Parameters
    ----------
    first, second : tuple of int
        Chain and scan.
    T_first_second : (4, 4) float64
    covariance : (6, 6) float64
        Rotation [rad], then translation [m], axes of the second scan's ``lidar_link``.
    """

    first: tuple[int, int]
    second: tuple[int, int]
    T_first_second: Floats
    covariance: Floats


@dataclass(frozen=True)
class ChainSolution:
    """Poses of one sequence: ``T_world_lidar`` (S, 4, 4), covariance (S, 6, 6) and GNSS residuals.

    Covariances are of rotation [rad], then translation [m], world axes. ``residuals`` (N, 3) are
    antenna minus fix [m], ``slow`` (N, 3) the part of them that the graph takes for the receiver's slow
    error, ``weights`` (N,) what the robust kernel left of each fix.
    """

    T_world_lidar: Floats
    covariance: Floats
    residuals: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    slow: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    weights: Floats = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Solved:
    """All chains by number; of every loop (L,) what the robust kernel left, and how far it is off [m].

    ``gnss_offset`` (3,) is what was added to every fix, where control points tell it [m].
    """

    chains: dict[int, ChainSolution]
    loop_weights: Floats
    seams: Floats
    gnss_offset: Floats = field(default_factory=lambda: np.zeros(3))
