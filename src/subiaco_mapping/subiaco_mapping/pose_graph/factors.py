"""Measurements as gtsam factors; the batch solver and the incremental one take the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import gtsam
import numpy as np
from scipy import constants
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import Floats, invert_pose
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.pose_graph.config import GnssConfig, GraphConfig
from subiaco_mapping.pose_graph.correlated_gnss_errors import link_precision, own_precision, slow_errors
from subiaco_mapping.pose_graph.records import Chain, GnssPriors, LoopEdge

MakeKernel: TypeAlias = Callable[[float], Any]

_CHAIN = 1 << 40
#: Common offset of all fixes, sign turned, and frame of a reference cloud: one of each in a graph.
OFFSET_KEY, REFERENCE_KEY = 4 << 36, 5 << 36
_LEVER_SIGMA = NUMBERS.pose_graph.lever_sigma
_FREE = NUMBERS.pose_graph.heading_tilt_sigma


def pose_key(chain: int, scan: int) -> int:
    """Return the key of a pose."""
    return chain * _CHAIN + scan


def slow_key(chain: int, knot: int) -> int:
    """Return the key of a receiver's slow error, sign turned."""
    return chain * _CHAIN + (1 << 36) + knot


def _bias_key(chain: int) -> int:
    """Return the key of a recording's accelerometer bias, as a part of gravity."""
    return chain * _CHAIN + (6 << 36)


def _antenna_key(chain: int, fix: int) -> int:
    return chain * _CHAIN + (2 << 36) + fix


def _lever_key(chain: int, fix: int) -> int:
    return chain * _CHAIN + (3 << 36) + fix


def _diagonal(sigmas: Floats) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(sigmas)


def _robust(kernel: Any, covariance: Floats) -> Any:
    return gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Gaussian.Covariance(covariance))


def as_pose(matrix: Floats) -> Any:
    """Return a gtsam pose; the rotation is made exact."""
    return gtsam.Pose3(gtsam.Rot3(Rotation.from_matrix(matrix[:3, :3]).as_matrix()), matrix[:3, 3])


def handed_on(chain: Chain, config: GraphConfig) -> Floats:
    """Return the share (S,) of each registration's variance that later scans inherit.

    Scans are registered to a local map of the last hundred metres, so that the error of one is
    mostly its own: measured over 1, 10 and 100 scans of a simulated street it is 18, 29 and 27 mm
    (x), where independent steps would give 18, 57 and 180 mm. Where the scene does not hold a
    direction, or registration failed, the whole error goes on.
    """
    return np.where(chain.held, config.drift_share, 1.0)


def add_odometry(graph: Any, number: int, chain: Chain, config: GraphConfig, start: int = 1) -> None:
    """Add the motions into scans ``start`` and later."""
    broken = _diagonal(np.repeat([config.segment_sigma_rotation, config.segment_sigma_translation], 3))
    covariance = handed_on(chain, config)[:, None, None] * chain.covariance
    for k in range(max(start, 1), len(chain)):
        motion = invert_pose(chain.T_odom_lidar[k - 1]) @ chain.T_odom_lidar[k]
        same = chain.segment[k] == chain.segment[k - 1]
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance[k]) if same else broken
        before, after = pose_key(number, k - 1), pose_key(number, k)
        graph.add(gtsam.BetweenFactorPose3(before, after, gtsam.Pose3(motion), noise))


def add_gravity(
    graph: Any,
    values: Any,
    number: int,
    chain: Chain,
    config: GraphConfig,
    start: int = 0,
    *,
    weak: bool = True,
) -> None:
    """Add the vertical where the accelerometer gives it, else, if ``weak``, one at the first scan.

    The bias of the accelerometer is one unknown of the recording: without it a hundred windows would claim
    a tenth of the error of one, while all of them are tilted alike.
    """
    bias, sigma = _bias_key(number), config.sigma_accelerometer_bias / constants.g
    if start == 0 and len(chain.gravity.index):
        values.insert(bias, np.zeros(3))
        graph.add(gtsam.PriorFactorPoint3(bias, np.zeros(3), _diagonal(np.full(3, sigma))))
    huber = gtsam.noiseModel.mEstimator.Huber.Create(2.0)
    noise = _robust(huber, np.eye(3) * config.sigma_gravity**2)
    for index, direction in zip(chain.gravity.index[start:], chain.gravity.up[start:], strict=True):
        graph.add(_gravity_factor(pose_key(number, int(index)), bias, direction, noise))
    if weak and len(chain.gravity.index) == 0 and chain.gnss is not None:
        up = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
        level = chain.T_world_odom[:3, :3] @ chain.T_odom_lidar[0, :3, :3]
        direction = gtsam.Unit3(level.T @ np.array([0.0, 0.0, 1.0]))
        graph.add(gtsam.AttitudeFactorPose3(pose_key(number, 0), up, _diagonal(np.full(2, 0.05)), direction))


def _gravity_factor(pose: int, bias: int, direction: Floats, noise: Any) -> Any:
    """Return the factor ``direction - up - bias`` (3,) in ``lidar_link``; gtsam has none of both unknowns."""

    def error(_: Any, values: Any, jacobians: Any) -> Floats:
        up = values.atPose3(pose).rotation().matrix()[2]
        if jacobians is not None:
            jacobians[0] = np.hstack([-gtsam.SO3.Hat(up), np.zeros((3, 3))])
            jacobians[1] = -np.eye(3)
        return np.asarray(direction - up - values.atPoint3(bias))

    return gtsam.CustomFactor(noise, [pose, bias], error)


def add_walls(graph: Any, number: int, chain: Chain, start: int = 0) -> None:
    """Add that walls are vertical."""
    unit = _diagonal(np.ones(3))
    for index, root in zip(chain.walls.index[start:], chain.walls.root[start:], strict=True):
        if root.any():
            graph.add(_wall_factor(pose_key(number, int(index)), root, unit))


def _wall_factor(pose: int, root: Floats, noise: Any) -> Any:
    """Return the factor ``root @ up`` (3,)."""

    def error(_: Any, values: Any, jacobians: Any) -> Floats:
        up = values.atPose3(pose).rotation().matrix()[2]
        if jacobians is not None:
            jacobians[0] = np.hstack([root @ gtsam.SO3.Hat(up), np.zeros((3, 3))])
        return np.asarray(root @ up)

    return gtsam.CustomFactor(noise, [pose], error)


def add_anchor(graph: Any, number: int, chain: Chain) -> None:
    """Hold the start of a chain that nothing else places; its tilt only as far as gravity is unknown."""
    loose = 0.5 if len(chain.gravity.index) else 1e-4
    sigmas = np.array([loose, loose, 1e-4, 1e-3, 1e-3, 1e-3])
    first = as_pose(chain.T_world_odom @ chain.T_odom_lidar[0])
    graph.add(gtsam.PriorFactorPose3(pose_key(number, 0), first, _diagonal(sigmas)))


def add_heading(graph: Any, number: int, chain: Chain, poses: Floats, start: int = 0) -> None:
    """Add the antenna baseline's yaw about the vertical at the present ``poses`` (S, 4, 4)."""
    if chain.heading is None:
        return
    heading = chain.heading
    huber = gtsam.noiseModel.mEstimator.Huber.Create(2.0)
    rotations = poses[heading.index, :3, :3]
    base = rotations @ heading.R_lidar_base
    off = heading.yaw - np.arctan2(base[:, 1, 0], base[:, 0, 0])
    measured = Rotation.from_rotvec(np.outer(off, [0.0, 0.0, 1.0])).as_matrix() @ rotations
    for k in range(start, len(heading.index)):
        axis = np.outer(rotations[k, 2], rotations[k, 2])  # the vertical in lidar_link
        covariance = heading.sigma[k] ** 2 * axis + _FREE**2 * (np.eye(3) - axis)
        noise = _robust(huber, covariance)
        key = pose_key(number, int(heading.index[k]))
        graph.add(gtsam.PoseRotationPrior3D(key, gtsam.Rot3(measured[k]), noise))


def add_fixes(
    graph: Any,
    values: Any,
    number: int,
    chain: Chain,
    poses: Floats,
    config: GnssConfig,
    make: MakeKernel,
    *,
    offset: bool = False,
) -> None:
    """Add the fixes, with the slow part of their errors as states of their own.

    With ``offset`` the slow errors scatter about the common offset instead of zero.

    With slow errors a fix is ``antenna - fix = slow + white``. gtsam has no such factor of three
    variables, so the antenna is one (tied to pose and lever arm), and so is the lever arm.
    """
    if chain.gnss is None:
        return
    gnss, slow = chain.gnss, slow_errors(chain.gnss, config)
    kernel = make(config.kernel)
    if slow is None:
        _add_plain_fixes(graph, number, gnss, kernel, 1.0)
        return
    _add_slow_errors(graph, values, number, slow, offset=offset)
    tight = _diagonal(np.full(3, _LEVER_SIGMA))
    at = poses[gnss.index]
    antennas = np.einsum("nij,nj->ni", at[:, :3, :3], gnss.levers) + at[:, :3, 3]
    for i, index in enumerate(gnss.index):
        antenna, lever = _antenna_key(number, i), _lever_key(number, i)
        values.insert(antenna, antennas[i])
        values.insert(lever, gnss.levers[i])
        graph.add(gtsam.PriorFactorPoint3(lever, gnss.levers[i], tight))
        pose = pose_key(number, int(index))
        graph.add(gtsam.ReferenceFrameFactorPoint3Pose3(lever, pose, antenna, tight))
        noise = _robust(kernel, (1.0 - config.correlated_share) * gnss.covariance[i])
        of_knot = slow_key(number, int(slow.knot[i]))
        graph.add(gtsam.BetweenFactorPoint3(of_knot, antenna, gnss.enu[i], noise))


def _add_plain_fixes(
    graph: Any, number: int, gnss: GnssPriors, kernel: Any, inflation: float, start: int = 0
) -> None:
    for i in range(start, len(gnss.index)):
        noise = _robust(kernel, inflation * gnss.covariance[i])
        key = pose_key(number, int(gnss.index[i]))
        graph.add(gtsam.GPSFactorArm(key, gnss.enu[i], gnss.levers[i], noise))


def add_white_fixes(graph: Any, number: int, chain: Chain, config: GnssConfig, start: int) -> None:
    """Add fixes ``start`` and later as white errors of the same density; outliers are judged as ever."""
    assert chain.gnss is not None
    gnss = chain.gnss
    if len(gnss.index) <= start:
        return
    span = max(float(gnss.times_ns[-1] - gnss.times_ns[0]) * 1e-9, 1e-3)
    slow = max(2 * config.correlation_time * len(gnss.index) / span, 1.0)
    inflation = 1.0 - config.correlated_share + config.correlated_share * slow
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(config.kernel / np.sqrt(inflation))
    _add_plain_fixes(graph, number, gnss, kernel, inflation, start)


def _add_slow_errors(graph: Any, values: Any, number: int, slow: Any, *, offset: bool) -> None:
    zero = np.zeros(3)
    following = np.append(slow.step[1:], 0.0)
    for k in range(len(slow)):
        key = slow_key(number, k)
        values.insert(key, zero)
        own = slow.sigma[k] / np.sqrt(own_precision(slow.step[k], following[k]))
        if offset:
            graph.add(gtsam.BetweenFactorPoint3(OFFSET_KEY, key, zero, _diagonal(own)))
        else:
            graph.add(gtsam.PriorFactorPoint3(key, zero, _diagonal(own)))
        if slow.step[k] > 0:
            link = slow.sigma[k] / np.sqrt(link_precision(slow.step[k]))
            graph.add(gtsam.BetweenFactorPoint3(key - 1, key, zero, _diagonal(link)))


def add_loops(graph: Any, loops: Sequence[LoopEdge], kernel: Any) -> None:
    """Add places seen twice."""
    for loop in loops:
        noise = _robust(kernel, loop.covariance)
        keys = pose_key(*loop.first), pose_key(*loop.second)
        graph.add(gtsam.BetweenFactorPose3(*keys, as_pose(loop.T_first_second), noise))
