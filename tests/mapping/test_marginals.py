"""Covariances of poses, where a chain hangs together tightly, and where it broke."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from subiaco_geo.errors import SubiacoError
from subiaco_geo.frames import make_pose
from subiaco_mapping.pose_graph.config import GnssConfig, GraphConfig
from subiaco_mapping.pose_graph.marginals import SparseMarginals
from subiaco_mapping.pose_graph.records import Chain, GravityPriors
from subiaco_mapping.pose_graph.solver import solve

STEP = 10**8


def chain(segments: list[int], anchored: bool = True) -> Chain:
    """A straight way, a metre a scan, each registered to a millimetre and 0.2 mrad."""
    count = len(segments)
    poses = np.array([make_pose(np.eye(3), np.array([float(k), 0.0, 0.0])) for k in range(count)])
    return Chain(
        stamps_ns=np.arange(count) * STEP,
        T_odom_lidar=poses,
        covariance=np.tile(np.diag([2e-4**2] * 3 + [1e-3**2] * 3), (count, 1, 1)),
        held=np.ones(count, dtype=np.bool_),
        segment=np.array(segments),
        T_world_odom=np.eye(4),
        gravity=GravityPriors(np.zeros(0, dtype=np.int64), np.zeros((0, 3))),
        anchored=anchored,
    )


def test_a_segment_that_only_the_way_since_the_last_one_places_is_solved_and_its_doubt_stated() -> None:
    solved = solve({0: chain([0] * 10 + [1] * 40)}, GraphConfig(covariance_stride=1), GnssConfig())
    sigma = np.sqrt(np.array([np.diag(c) for c in solved.chains[0].covariance]))
    np.testing.assert_allclose(solved.chains[0].T_world_lidar[:, 0, 3], np.arange(50), atol=1e-6)
    assert sigma[9, 3:].max() < 0.01
    np.testing.assert_allclose(sigma[10:, :3], GraphConfig().segment_sigma_rotation, rtol=1e-3)
    along = sigma[10:, 3]
    np.testing.assert_allclose(along, GraphConfig().segment_sigma_translation, rtol=1e-3)
    across = np.hypot(GraphConfig().segment_sigma_translation, 0.5 * np.arange(40))  # yaw at a distance
    np.testing.assert_allclose(sigma[[10, 49], 4], across[[0, 39]], rtol=0.01)


def test_both_ways_to_the_covariances_agree() -> None:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    rng = np.random.default_rng(4)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]))
    at = gtsam.Pose3()
    graph.add(gtsam.PriorFactorPose3(0, at, noise))
    values.insert(0, at)
    for k in range(1, 30):
        step = gtsam.Pose3.Expmap(rng.normal(0.0, 0.3, 6))
        at = at.compose(step)
        values.insert(k, at)
        graph.add(gtsam.BetweenFactorPose3(k - 1, k, step, noise))
    theirs, ours = gtsam.Marginals(graph, values), SparseMarginals(graph.linearize(values))
    for k in (0, 7, 29):
        np.testing.assert_allclose(
            ours.marginalCovariance(k), theirs.marginalCovariance(k), rtol=1e-6, atol=1e-9
        )


def test_a_chain_that_nothing_places_is_refused() -> None:
    with pytest.raises(SubiacoError, match="not determined"):
        solve({0: chain([0] * 10 + [1] * 10, anchored=False)}, GraphConfig(), GnssConfig())
