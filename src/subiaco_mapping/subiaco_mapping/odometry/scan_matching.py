"""Odometry: plane-to-plane matching from the prediction, with kiss-icp where that does not suffice.

Point to point alone sticks to the rings of a scan: seen from almost the same place they lie where they lay,
so that a car that pulls away lags by centimetres and the map turns by a tenth of a degree. The refinement
plane to plane does not, and gives the covariance of the pose. While the motion is predicted well, it starts
from the prediction; otherwise kiss-icp matches first. Where the refinement is not held in some direction,
kiss-icp's pose stays.
"""

from __future__ import annotations

import logging
from collections import deque
from typing import Any, Protocol

import numpy as np
import small_gicp
from kiss_icp.config import KISSConfig
from kiss_icp.mapping import get_voxel_hash_map
from kiss_icp.registration import get_registration

from subiaco_geo.frames import Floats, invert_pose, rotation_angle
from subiaco_mapping.measurements import DeskewedScan, OdometryPose
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.odometry.config import OdometryConfig
from subiaco_mapping.odometry.voxel_thinning import first_in_voxels
from subiaco_mapping.preprocessing.deskew import body_twist

logger = logging.getLogger(__name__)

PLANE_VARIANCE = NUMBERS.odometry.plane_variance
TYPICAL_RANGE = NUMBERS.odometry.typical_range
_GICP_REACH = NUMBERS.odometry.refinement_reach
_WAITING = 50  # scans that wait for kiss-icp's map: about the radius of the map in a car, 20 MB


class OdometryBackend(Protocol):
    """What the front end needs of an odometry."""

    @property
    def twist(self) -> Floats | None:
        """Last body twist (6,), rotation first [rad/s, m/s]; None where unknown."""

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the last scan."""

    def register(self, scan: DeskewedScan) -> OdometryPose:
        """Register one scan, stamps increasing."""


class GicpRefinement:
    """A Gaussian voxel map of the past scans that tells how well a pose is held."""

    def __init__(self, config: OdometryConfig, threads: int) -> None:
        self._config, self._threads = config, threads
        self._map = small_gicp.GaussianVoxelMap(config.gicp_voxel)
        self._filled = False

    def cloud(self, points: Floats) -> Any:
        """Return points with the covariances that the metric needs, neighbours close together in memory."""
        voxel = np.floor(points / self._config.gicp_voxel).astype(np.int64)
        cloud = small_gicp.PointCloud(
            points[np.argsort((voxel[:, 0] << 42) + (voxel[:, 1] << 21) + voxel[:, 2])]
        )
        small_gicp.estimate_covariances(cloud, num_neighbors=10, num_threads=self._threads)
        return cloud

    def align(self, cloud: Any, pose: Floats, distance: float) -> Any | None:
        """Look at a cloud from a pose, correspondences up to a distance [m]; None before the first scan."""
        if not self._filled:
            return None
        return small_gicp.align(
            self._map,
            cloud,
            pose,
            max_correspondence_distance=distance,
            num_threads=self._threads,
            max_iterations=self._config.gicp_iterations,
        )

    def insert(self, cloud: Any, pose: Floats) -> None:
        """Add a scan to the map."""
        self._map.insert(cloud, pose)
        self._filled = True


def _size(deviation: Floats) -> float:
    """Return how far a pose (4, 4) moves points at the typical range, at most [m]."""
    turned = 2 * TYPICAL_RANGE * np.sin(rotation_angle(deviation) / 2)
    return float(turned + np.linalg.norm(deviation[:3, 3]))


def _kiss_config(config: OdometryConfig, threads: int) -> KISSConfig:
    kiss = KISSConfig()
    kiss.data.max_range = config.max_range
    kiss.data.deskew = False
    kiss.mapping.voxel_size = config.voxel
    kiss.mapping.max_points_per_voxel = config.max_points_per_voxel
    kiss.registration.max_num_iterations = config.max_iterations
    kiss.registration.convergence_criterion = config.convergence
    kiss.registration.max_num_threads = threads
    return kiss


class KissOdometry:
    """kiss-icp's map and registration, driven by a prediction from gyro and true time steps.

    Parameters
    ----------
    config : OdometryConfig
    threads : int
        1 makes it deterministic.
    """

    def __init__(self, config: OdometryConfig, threads: int = 1) -> None:
        self._config, self._threads = config, threads
        self._kiss = _kiss_config(config, threads)
        self._registration = get_registration(self._kiss)
        self._pose = np.eye(4)
        self._stamp_ns: int | None = None
        self._twist: Floats | None = None
        self._segment = -1
        self._failures = 0
        self._start_segment()

    @property
    def twist(self) -> Floats | None:
        """Last body twist (6,), rotation first [rad/s, m/s]."""
        return self._twist

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the last scan."""
        return self._stamp_ns

    def _start_segment(self) -> None:
        self._map = get_voxel_hash_map(self._kiss)
        self._waiting: deque[tuple[Floats, Floats]] = deque(maxlen=_WAITING)
        self._look = GicpRefinement(self._config, self._threads)
        self._threshold = self._config.initial_threshold
        self._segment += 1
        self._failures = 0

    def register(self, scan: DeskewedScan) -> OdometryPose:
        """Register one deskewed scan and add it to the local map.

        Raises
        ------
        ValueError
            The stamp is not newer than the last one.
        """
        gap_s = self._gap_s(scan.stamp_ns)
        if gap_s * 1e9 > self._config.max_gap_ns or self._failures >= self._config.max_failures:
            logger.warning(
                "odometry: the chain broke before %d ns; segment %d", scan.stamp_ns, self._segment + 1
            )
            self._twist = None if gap_s * 1e9 > self._config.max_gap_ns else self._twist
            self._start_segment()
        guess = self._pose @ self._prediction(scan, gap_s)
        dense = first_in_voxels(scan.xyz, self._config.voxel * 0.5)
        result = self._solve(dense, guess, gap_s, scan.stamp_ns)
        self._finish(dense, result, guess, gap_s)
        return result

    def _gap_s(self, stamp_ns: int) -> float:
        if self._stamp_ns is None:
            return 0.0
        if stamp_ns <= self._stamp_ns:
            raise ValueError(f"scan at {stamp_ns} ns is not newer than {self._stamp_ns} ns")
        return (stamp_ns - self._stamp_ns) * 1e-9

    def _prediction(self, scan: DeskewedScan, gap_s: float) -> Floats:
        if gap_s == 0.0 or scan.motion is None:
            return np.eye(4)
        return scan.motion

    def _solve(self, dense: Floats, guess: Floats, gap_s: float, stamp_ns: int) -> OdometryPose:
        looked_at = first_in_voxels(dense, self._config.gicp_leaf)
        cloud = self._look.cloud(looked_at) if len(looked_at) > 10 else None
        pose, predicted, first = guess, False, not self._waiting and self._map.empty()
        look = self._from_prediction(cloud, len(looked_at), guess, gap_s)
        if look is None:
            pose = self._matched(dense, guess)
            look = self._look.align(cloud, pose, self._reach()) if cloud is not None else None
            if look is not None and look.num_inliers < self._config.min_inlier_ratio * len(looked_at):
                pose, predicted = guess, True
        predicted = predicted or (look is None and not first)
        covariance, rmse, degenerate = self._uncertainty(look, predicted, gap_s)
        if look is not None and self._config.refine and not (predicted or degenerate):
            pose = np.asarray(look.T_target_source)
        if cloud is not None and not predicted:
            self._look.insert(cloud, pose)
        inliers = 0 if look is None else int(look.num_inliers)
        return OdometryPose(stamp_ns, pose, covariance, inliers, rmse, degenerate, self._segment, predicted)

    def _reach(self) -> float:
        return min(self._config.gicp_distance, _GICP_REACH * self._threshold)

    def _from_prediction(self, cloud: Any | None, count: int, guess: Floats, gap_s: float) -> Any | None:
        """Refine the prediction itself; None where kiss-icp has to match first.

        That is: the errors of the prediction are unknown or may exceed the reach of the refinement, or the
        refinement does not converge near the prediction, matches too little, or is not held in a direction.
        """
        predictable = self._twist is not None and _GICP_REACH * self._threshold <= self._config.gicp_distance
        if cloud is None or not (self._config.refine and predictable):
            return None
        look = self._look.align(cloud, guess, self._reach())
        if look is None or not look.converged or look.num_inliers < self._config.min_inlier_ratio * count:
            return None
        if _size(invert_pose(guess) @ np.asarray(look.T_target_source)) > self._threshold:
            return None
        return None if self._uncertainty(look, False, gap_s)[2] else look

    def _matched(self, dense: Floats, guess: Floats) -> Floats:
        """Return kiss-icp's pose, the guess where there is nothing to match.

        Scans that were placed without kiss-icp enter its map only here.
        """
        while self._waiting:
            self._map.update(*self._waiting.popleft())
        keypoints = first_in_voxels(dense, self._config.voxel * 1.5)
        if len(keypoints) == 0 or self._map.empty():
            return guess
        matched = self._registration.align_points_to_map(
            points=keypoints,
            voxel_map=self._map,
            initial_guess=guess,
            max_correspondance_distance=3 * self._threshold,
            kernel=self._threshold,
        )
        return np.asarray(matched)

    def _uncertainty(self, look: Any | None, predicted: bool, gap_s: float) -> tuple[Floats, float, bool]:
        """Return covariance (6, 6), residual [m] and whether a direction is free."""
        config = self._config
        floor = np.repeat([config.sigma_rotation**2, config.sigma_translation**2], 3)
        inflation = max(1.0, gap_s / 0.15) ** 2
        if predicted or look is None:
            lost = np.repeat([0.05**2, 1.0], 3) * inflation if predicted else floor
            return np.diag(lost), float("nan"), predicted
        freedom = max(3 * look.num_inliers - 6, 1)
        variance = 2.0 * look.error / freedom
        information = np.asarray(look.H) / max(variance * config.correlation, 1e-12)
        values, vectors = np.linalg.eigh(0.5 * (information + information.T))
        held = np.maximum(values, 1e-6)
        covariance = (vectors / held) @ vectors.T
        degenerate = bool(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) > config.degenerate_sigma)
        rmse = float(np.sqrt(variance * PLANE_VARIANCE))
        return (covariance + np.diag(floor)) * inflation, rmse, degenerate

    def _finish(self, dense: Floats, result: OdometryPose, guess: Floats, gap_s: float) -> None:
        pose = result.T_odom_lidar
        if result.predicted:
            self._failures += 1
        else:
            self._failures = 0
            self._waiting.append((dense, pose))
            if gap_s > 0:
                self._adapt(invert_pose(guess) @ pose, known=self._twist is not None)
                self._twist = body_twist(invert_pose(self._pose) @ pose, gap_s)
        self._pose, self._stamp_ns = pose, result.stamp_ns

    def _adapt(self, deviation: Floats, known: bool) -> None:
        """Follow the size of the prediction's errors, forgetting old ones."""
        if not known:
            return
        error, keep = _size(deviation), self._config.threshold_memory
        wanted = float(np.sqrt(keep * self._threshold**2 + (1 - keep) * (3 * error) ** 2))
        self._threshold = float(np.clip(wanted, self._config.min_threshold, self._config.initial_threshold))
