"""The pose graph in local ENU: odometry, GNSS with lever arm, gravity (gtsam)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from subiaco_geo.errors import SubiacoError
from subiaco_geo.frames import Floats, Ints, invert_pose
from subiaco_mapping.config import GraphConfig

logger = logging.getLogger(__name__)

GRAVITY_BOUNDS = (9.2, 10.4)

RobustGnss: TypeAlias = tuple[Callable[[float], Any], float]  # makes a kernel, its width [sigma]


@dataclass(frozen=True)
class GnssPriors:
    """Antenna positions acting on scans.

    Parameters
    ----------
    index : (N,) int64
        Scan.
    enu, levers : (N, 3) float64
        Fix, and antenna in the scan's ``lidar_link`` [m].
    covariance : (N, 3, 3) float64
        Of one fix [m2].
    status : (N,) int64
    inflation : float
        Of the variance, since errors of neighbouring fixes are alike. Outliers are still judged
        by ``covariance``.
    """

    index: Ints
    enu: Floats
    levers: Floats
    covariance: Floats
    status: Ints
    inflation: float = 1.0


@dataclass(frozen=True)
class GravityPriors:
    """Directions of *up* (N, 3), in ``lidar_link`` of scans ``index`` (N,)."""

    index: Ints
    up: Floats


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
    gnss : GnssPriors or None
    gravity : GravityPriors
    """

    stamps_ns: Ints
    T_odom_lidar: Floats
    covariance: Floats
    held: NDArray[np.bool_]
    segment: Ints
    T_world_odom: Floats
    gnss: GnssPriors | None
    gravity: GravityPriors

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class ChainSolution:
    """Poses of one sequence: ``T_world_lidar`` (S, 4, 4), covariance (S, 6, 6) and GNSS residuals.

    Covariances are of rotation [rad], then translation [m], world axes. ``residuals`` (N, 3) are
    antenna minus fix [m], ``weights`` (N,) what the robust kernel left of each fix.
    """

    T_world_lidar: Floats
    covariance: Floats
    residuals: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    weights: Floats = field(default_factory=lambda: np.zeros(0))


def gravity_priors(stamps_ns: Ints, T_odom_lidar: Floats, accel: Floats, window_ns: int) -> GravityPriors:
    """Find *up* in windows of accelerometer, the odometry's own acceleration taken off.

    Parameters
    ----------
    stamps_ns : (S,) int64
    T_odom_lidar : (S, 4, 4) float64
    accel : (S, 3) float64
        Mean specific force in ``lidar_link`` of every scan [m/s2], NaN where unknown.
    window_ns : int

    Returns
    -------
    GravityPriors
        One a window that holds at least five scans and a plausible gravity.
    """
    empty = GravityPriors(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    if len(stamps_ns) < 7:
        return empty
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    velocity = np.gradient(T_odom_lidar[:, :3, 3], seconds, axis=0)
    force = np.einsum("nij,nj->ni", T_odom_lidar[:, :3, :3], accel)
    window = ((stamps_ns - stamps_ns[0]) // window_ns).astype(np.int64)
    index, ups = [], []
    for number in np.unique(window[1:-1]):
        scans = np.flatnonzero(window == number)
        scans = scans[(scans > 0) & (scans < len(stamps_ns) - 1)]
        if len(scans) < 5 or not np.isfinite(force[scans]).all():
            continue
        first, final = scans[0], scans[-1]
        moved = (velocity[final] - velocity[first]) / (seconds[final] - seconds[first])
        up = force[scans].mean(axis=0) - moved
        if GRAVITY_BOUNDS[0] < np.linalg.norm(up) < GRAVITY_BOUNDS[1]:
            middle = scans[len(scans) // 2]
            index.append(middle)
            ups.append(T_odom_lidar[middle, :3, :3].T @ (up / np.linalg.norm(up)))
    return GravityPriors(np.array(index, dtype=np.int64), np.array(ups)) if index else empty


def _diagonal(sigmas: Floats) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(sigmas)


def _robust(kernel: Any, covariance: Floats) -> Any:
    return gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Gaussian.Covariance(covariance))


def _add_odometry(graph: Any, chain: Chain, offset: int, config: GraphConfig) -> None:
    broken = _diagonal(np.repeat([config.segment_sigma_rotation, config.segment_sigma_translation], 3))
    covariance = _handed_on(chain, config)[:, None, None] * chain.covariance
    for k in range(1, len(chain)):
        motion = invert_pose(chain.T_odom_lidar[k - 1]) @ chain.T_odom_lidar[k]
        same = chain.segment[k] == chain.segment[k - 1]
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance[k]) if same else broken
        graph.add(gtsam.BetweenFactorPose3(offset + k - 1, offset + k, gtsam.Pose3(motion), noise))


def _add_priors(graph: Any, chain: Chain, offset: int, config: GraphConfig, robust: RobustGnss) -> None:
    up = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
    huber = gtsam.noiseModel.mEstimator.Huber.Create(2.0)
    noise = _robust(huber, np.eye(2) * config.sigma_gravity**2)
    for index, direction in zip(chain.gravity.index, chain.gravity.up, strict=True):
        graph.add(gtsam.AttitudeFactorPose3(offset + int(index), up, noise, gtsam.Unit3(direction)))
    has_gravity = len(chain.gravity.index) > 0
    if chain.gnss is None:
        loose = 0.5 if has_gravity else 1e-4
        sigmas = np.array([loose, loose, 1e-4, 1e-3, 1e-3, 1e-3])
        first = gtsam.Pose3(chain.T_world_odom @ chain.T_odom_lidar[0])
        graph.add(gtsam.PriorFactorPose3(offset, first, _diagonal(sigmas)))
        return
    if not has_gravity:
        level = chain.T_world_odom[:3, :3] @ chain.T_odom_lidar[0, :3, :3]
        direction = gtsam.Unit3(level.T @ np.array([0.0, 0.0, 1.0]))
        graph.add(gtsam.AttitudeFactorPose3(offset, up, _diagonal(np.full(2, 0.05)), direction))
    gnss, (make_kernel, width) = chain.gnss, robust
    kernel = make_kernel(width / np.sqrt(gnss.inflation))
    for i, index in enumerate(gnss.index):
        noise = _robust(kernel, gnss.covariance[i] * gnss.inflation)
        graph.add(gtsam.GPSFactorArm(offset + int(index), gnss.enu[i], gnss.levers[i], noise))


def _build(chains: Sequence[Chain], config: GraphConfig, robust: RobustGnss) -> Any:
    graph, offset = gtsam.NonlinearFactorGraph(), 0
    for chain in chains:
        _add_odometry(graph, chain, offset, config)
        _add_priors(graph, chain, offset, config, robust)
        offset += len(chain)
    return graph


def _optimize(graph: Any, values: Any, config: GraphConfig) -> Any:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(config.max_iterations)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    if not np.isfinite(graph.error(result)):
        raise SubiacoError(
            "pose graph: the solution is not finite; a measurement that is not a number came in"
        )
    return result


def _handed_on(chain: Chain, config: GraphConfig) -> Floats:
    """Return the share (S,) of each registration's variance that later scans inherit.

    Scans are registered to a local map of the last hundred metres, so that the error of one is
    mostly its own: measured over 1, 10 and 100 scans of a simulated street it is 18, 29 and 27 mm
    (x), where independent steps would give 18, 57 and 180 mm. Where the scene does not hold a
    direction, or registration failed, the whole error goes on.
    """
    return np.where(chain.held, config.drift_share, 1.0)


def _jitter(chain: Chain, config: GraphConfig) -> Floats:
    """Return the covariance (S, 6, 6) of single scans about the chain: half of a motion's."""
    rest = (1.0 - _handed_on(chain, config))[:, None, None]
    return np.asarray(0.5 * rest * chain.covariance)


def _in_world(poses: Floats, covariance: Floats) -> Floats:
    turn = np.zeros((len(poses), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = poses[:, :3, :3]
    return np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))


def _world_covariances(graph: Any, values: Any, poses: Floats, offset: int, stride: int) -> Floats:
    """Return marginals (S, 6, 6) in world axes, every ``stride``-th solved, the rest interpolated."""
    count = len(poses)
    solved = np.unique(np.append(np.arange(0, count, stride), count - 1))
    try:
        marginals = gtsam.Marginals(graph, values)
        blocks = np.array([marginals.marginalCovariance(offset + int(k)) for k in solved])
    except RuntimeError as error:
        first = str(error).strip().splitlines()[0]
        raise SubiacoError(
            f"pose graph: a pose is not determined ({first}); check GNSS and extrinsics"
        ) from error
    world = _in_world(poses[solved], blocks).reshape(len(solved), 36)
    rows = [np.interp(np.arange(count), solved, world[:, i]) for i in range(36)]
    return np.stack(rows, axis=1).reshape(count, 6, 6)


def _gnss_residuals(chain: Chain, poses: Floats, kernel: float) -> tuple[Floats, Floats]:
    if chain.gnss is None:
        return np.zeros((0, 3)), np.zeros(0)
    gnss = chain.gnss
    antenna = np.einsum("nij,nj->ni", poses[gnss.index, :3, :3], gnss.levers) + poses[gnss.index, :3, 3]
    residuals = antenna - gnss.enu
    whitened = np.einsum("ni,nij,nj->n", residuals, np.linalg.inv(gnss.covariance), residuals)
    return residuals, 1.0 / (1.0 + whitened / kernel**2)


def solve(chains: Sequence[Chain], config: GraphConfig, gnss_kernel: float) -> list[ChainSolution]:
    """Solve all sequences together: first with Huber, from there with Cauchy on GNSS.

    Cauchy alone would ignore every fix while odometry drift keeps the first guess far away.

    Raises
    ------
    SubiacoError
        The solution is not finite or a pose is not determined.
    """
    values, offset = gtsam.Values(), 0
    for chain in chains:
        guess = chain.T_world_odom @ chain.T_odom_lidar
        for k, pose in enumerate(guess):
            rotation = Rotation.from_matrix(pose[:3, :3]).as_matrix()
            values.insert(offset + k, gtsam.Pose3(gtsam.Rot3(rotation), pose[:3, 3]))
        offset += len(chain)
    estimator = gtsam.noiseModel.mEstimator
    for make_kernel in (estimator.Huber.Create, estimator.Cauchy.Create):
        graph = _build(chains, config, (make_kernel, gnss_kernel))
        values = _optimize(graph, values, config)
    solutions, offset = [], 0
    for chain in chains:
        poses = np.array([values.atPose3(offset + k).matrix() for k in range(len(chain))])
        covariance = _world_covariances(graph, values, poses, offset, config.covariance_stride)
        covariance += _in_world(poses, _jitter(chain, config))
        solutions.append(ChainSolution(poses, covariance, *_gnss_residuals(chain, poses, gnss_kernel)))
        offset += len(chain)
    return solutions
