"""The pose graph while driving: ISAM2 adds what is new.

Same factors as the batch, but for the receiver's slow errors: instead of states of their own every fix is
given the variance that white errors would need to be as slow (their spectral density at rest).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import gtsam
import numpy as np

from subiaco_geo.errors import SubiacoError
from subiaco_geo.frames import Floats, invert_pose
from subiaco_mapping.pose_graph.config import GnssConfig, GraphConfig
from subiaco_mapping.pose_graph.factors import (
    add_anchor,
    add_gravity,
    add_heading,
    add_loops,
    add_odometry,
    add_walls,
    add_white_fixes,
    as_pose,
    pose_key,
)
from subiaco_mapping.pose_graph.records import Chain, LoopEdge

STACK = 512 * 2**20  # ISAM2 recurses along the chain: 200 000 poses overflow the usual 8 MB

T = TypeVar("T")


def on_large_stack(step: Callable[[], T]) -> T:
    """Run a step in a thread with a large stack; memory is taken only as far as it is used."""
    before = threading.stack_size(STACK)
    try:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(step).result()
    finally:
        threading.stack_size(before)


class LiveGraph:
    """Grow the graph of a survey.

    Parameters
    ----------
    config : GraphConfig
    gnss : GnssConfig
    """

    def __init__(self, config: GraphConfig, gnss: GnssConfig) -> None:
        self._config, self._gnss = config, gnss
        self._isam = gtsam.ISAM2(gtsam.ISAM2Params())
        self._poses: dict[int, Floats] = {}
        self._taken: dict[tuple[str, int], int] = {}  # measurements by kind and chain

    def update(self, chains: Mapping[int, Chain], loops: Sequence[LoopEdge] = ()) -> dict[int, Floats]:
        """Take what chains have got since the last time, and new loops.

        Returns
        -------
        dict of int to (S, 4, 4) float64
            ``T_world_lidar`` of every chain.

        Raises
        ------
        SubiacoError
            A pose is not determined.
        """
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for number, chain in chains.items():
            self._add(graph, values, number, chain)
        add_loops(graph, loops, gtsam.noiseModel.mEstimator.Cauchy.Create(self._config.loop_kernel))

        def step() -> Any:
            self._isam.update(graph, values)
            for _ in range(2):
                self._isam.update()
            return self._isam.calculateEstimate()

        try:
            estimate = on_large_stack(step)
        except RuntimeError as error:
            raise SubiacoError(
                f"live pose graph: {str(error).strip().splitlines()[0]}; check GNSS and extrinsics"
            ) from error
        for number, chain in chains.items():
            keys = range(len(chain))
            self._poses[number] = np.array([estimate.atPose3(pose_key(number, k)).matrix() for k in keys])
        return dict(self._poses)

    def covariance(self, number: int, scan: int) -> Floats:
        """Return the present covariance (6, 6) of a pose: rotation, translation, world axes."""
        block = on_large_stack(lambda: self._isam.marginalCovariance(pose_key(number, scan)))
        turn = np.kron(np.eye(2), self._poses[number][scan, :3, :3])
        return np.asarray(turn @ block @ turn.T)

    def _new(self, kind: str, number: int, count: int) -> int:
        """Return how many of a kind were taken already, and remember the new count."""
        before = self._taken.get((kind, number), 0)
        self._taken[kind, number] = count
        return before

    def _add(self, graph: Any, values: Any, number: int, chain: Chain) -> None:
        start = self._new("scans", number, len(chain))
        poses = self._guess(number, chain, start)
        for k in range(start, len(chain)):
            values.insert(pose_key(number, k), as_pose(poses[k]))
        add_odometry(graph, number, chain, self._config, start)
        gravity = self._new("gravity", number, len(chain.gravity.index))
        add_gravity(graph, values, number, chain, self._config, gravity, weak=start == 0)
        add_walls(graph, number, chain, self._new("walls", number, len(chain.walls.index)))
        if chain.heading is not None:
            add_heading(graph, number, chain, poses, self._new("heading", number, len(chain.heading.index)))
        if chain.gnss is not None:
            fixes = self._new("fixes", number, len(chain.gnss.index))
            add_white_fixes(graph, number, chain, self._gnss, fixes)
        if chain.anchored and start == 0:
            add_anchor(graph, number, chain)

    def _guess(self, number: int, chain: Chain, start: int) -> Floats:
        if start == 0:
            return np.asarray(chain.T_world_odom @ chain.T_odom_lidar)
        known = self._poses[number]
        carried = known[-1] @ invert_pose(chain.T_odom_lidar[start - 1]) @ chain.T_odom_lidar[start:]
        return np.concatenate([known, carried])
