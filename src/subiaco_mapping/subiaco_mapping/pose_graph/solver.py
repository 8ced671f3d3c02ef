"""Batch solution of the pose graph: Levenberg-Marquardt with marginals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from subiaco_geo.errors import SubiacoError
from subiaco_geo.frames import Floats
from subiaco_mapping.pose_graph.absolute_factors import NO_TIES, AbsoluteTies, add_ties, offset_of
from subiaco_mapping.pose_graph.config import GnssConfig, GraphConfig
from subiaco_mapping.pose_graph.correlated_gnss_errors import slow_errors
from subiaco_mapping.pose_graph.factors import (
    MakeKernel,
    add_anchor,
    add_fixes,
    add_gravity,
    add_heading,
    add_loops,
    add_odometry,
    add_walls,
    as_pose,
    handed_on,
    pose_key,
    slow_key,
)
from subiaco_mapping.pose_graph.marginals import marginals_of
from subiaco_mapping.pose_graph.records import Chain, ChainSolution, LoopEdge, Solved


def _build(
    chains: Mapping[int, Chain],
    poses: Mapping[int, Floats],
    loops: Sequence[LoopEdge],
    configs: tuple[GraphConfig, GnssConfig],
    make: MakeKernel,
    ties: AbsoluteTies,
) -> tuple[Any, Any]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    config, gnss = configs
    for number, chain in chains.items():
        own = poses[number]
        for k, pose in enumerate(own):
            values.insert(pose_key(number, k), as_pose(pose))
        add_odometry(graph, number, chain, config)
        add_gravity(graph, values, number, chain, config)
        add_walls(graph, number, chain)
        add_heading(graph, number, chain, own)
        add_fixes(graph, values, number, chain, own, gnss, make, offset=ties.offset_sigma is not None)
        if chain.anchored:
            add_anchor(graph, number, chain)
    add_loops(graph, loops, make(config.loop_kernel))
    add_ties(graph, values, ties, make)
    return graph, values


def _optimize(graph: Any, values: Any, config: GraphConfig) -> Any:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(config.max_iterations)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    if not np.isfinite(graph.error(result)):
        raise SubiacoError(
            "pose graph: the solution is not finite; a measurement that is not a number came in"
        )
    return result


def chain_poses(values: Any, number: int, chain: Chain) -> Floats:
    """Return the poses (S, 4, 4) of a chain."""
    return np.array([values.atPose3(pose_key(number, k)).matrix() for k in range(len(chain))])


def _jitter(chain: Chain, config: GraphConfig) -> Floats:
    """Return the covariance (S, 6, 6) of single scans about the chain: half of a motion's."""
    rest = (1.0 - handed_on(chain, config))[:, None, None]
    return np.asarray(0.5 * rest * chain.covariance)


def _in_world(poses: Floats, covariance: Floats) -> Floats:
    turn = np.zeros((len(poses), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = poses[:, :3, :3]
    return np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))


def _world_covariances(marginals: Any, number: int, poses: Floats, stride: int) -> Floats:
    """Return marginals (S, 6, 6) in world axes, every ``stride``-th solved, the rest interpolated."""
    count = len(poses)
    solved = np.unique(np.append(np.arange(0, count, stride), count - 1))
    blocks = np.array([marginals.marginalCovariance(pose_key(number, int(k))) for k in solved])
    world = _in_world(poses[solved], blocks).reshape(len(solved), 36)
    rows = [np.interp(np.arange(count), solved, world[:, i]) for i in range(36)]
    return np.stack(rows, axis=1).reshape(count, 6, 6)


def _gnss_residuals(
    values: Any, number: int, chain: Chain, poses: Floats, config: GnssConfig, offset: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return residuals, slow errors (N, 3) about the common offset (3,), and weights (N,)."""
    if chain.gnss is None:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    gnss, slow = chain.gnss, slow_errors(chain.gnss, config)
    antenna = np.einsum("nij,nj->ni", poses[gnss.index, :3, :3], gnss.levers) + poses[gnss.index, :3, 3]
    residuals, share, states = antenna - gnss.enu, 1.0, np.zeros_like(gnss.enu)
    if slow is not None:
        share = 1.0 - config.correlated_share
        states = np.array([values.atPoint3(slow_key(number, k)) for k in range(len(slow))])[slow.knot]
    white = residuals - states
    whitened = np.einsum("ni,nij,nj->n", white, np.linalg.inv(share * gnss.covariance), white)
    return residuals - offset, states - offset * (slow is not None), 1.0 / (1.0 + whitened / config.kernel**2)


def _loops_in(poses: Mapping[int, Floats], loops: Sequence[LoopEdge], kernel: float) -> tuple[Floats, Floats]:
    """Return what the robust kernel leaves of loops (L,), and how far they are off (L,) [m]."""
    weights, seams = np.zeros(len(loops)), np.zeros(len(loops))
    for k, loop in enumerate(loops):
        first, second = (poses[chain][scan] for chain, scan in (loop.first, loop.second))
        between = as_pose(loop.T_first_second).between(as_pose(np.linalg.solve(first, second)))
        error = gtsam.Pose3.Logmap(between)
        weights[k] = 1.0 / (1.0 + error @ np.linalg.solve(loop.covariance, error) / kernel**2)
        seams[k] = np.linalg.norm(error[3:])
    return weights, seams


def solve(
    chains: Mapping[int, Chain],
    config: GraphConfig,
    gnss: GnssConfig,
    loops: Sequence[LoopEdge] = (),
    ties: AbsoluteTies = NO_TIES,
) -> Solved:
    """Solve all sequences together: first with Huber, from there with Cauchy on fixes, loops and ties.

    Cauchy alone would ignore every fix while odometry drift keeps the first guess far away.

    Raises
    ------
    SubiacoError
        The solution is not finite or a pose is not determined.
    """
    poses = {number: chain.T_world_odom @ chain.T_odom_lidar for number, chain in chains.items()}
    gnss = ties.gnss_config(gnss)
    estimator = gtsam.noiseModel.mEstimator
    for make in (estimator.Huber.Create, estimator.Cauchy.Create):
        graph, values = _build(chains, poses, loops, (config, gnss), make, ties)
        values = _optimize(graph, values, config)
        poses = {number: chain_poses(values, number, chain) for number, chain in chains.items()}
    marginals = marginals_of(graph, values)
    solutions, offset = {}, offset_of(values, ties)
    for number, chain in chains.items():
        own = poses[number]
        covariance = _world_covariances(marginals, number, own, config.covariance_stride)
        covariance += _in_world(own, _jitter(chain, config))
        residuals = _gnss_residuals(values, number, chain, own, gnss, offset)
        solutions[number] = ChainSolution(own, covariance, *residuals)
    return Solved(solutions, *_loops_in(poses, loops, config.loop_kernel), offset)
