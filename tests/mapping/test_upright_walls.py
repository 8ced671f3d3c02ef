"""The vertical from an accelerometer with a bias, and from walls."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import make_pose
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.measurements import Extrinsics, OdometryPose
from subiaco_mapping.pose_graph.config import GnssConfig, GraphConfig
from subiaco_mapping.pose_graph.incremental import LiveGraph
from subiaco_mapping.pose_graph.records import Chain, GnssPriors, GravityPriors, WallPriors
from subiaco_mapping.pose_graph.solver import solve
from subiaco_mapping.pose_graph.upright_walls import WallPieces, wall_pieces, wall_priors
from subiaco_mapping.sequences import SequenceRecord
from subiaco_mapping.survey_graph.sequence_chains import chain_of

SECOND = 10**9
UP = np.array([0.0, 0.0, 1.0])
SIGMA = 0.02


def facade(y: float, length: float, seed: int, lean: float = 0.0) -> np.ndarray:
    """Points (N, 3) of a wall along x at ``y``, 6 m high from 2 m below, leaning by ``lean`` [rad]."""
    rng = np.random.default_rng(seed)
    x, z = np.meshgrid(np.arange(0, length, 0.4), np.arange(-2.0, 4.0, 0.4))
    points = np.column_stack([x.ravel(), np.full(x.size, y), z.ravel()])
    points[:, 1] += lean * points[:, 2]
    return points + rng.normal(0, 0.01, points.shape)


def tilt(prior: WallPriors) -> tuple[np.ndarray, np.ndarray]:
    """The direction that all roots leave free (3,), and the sigmas of the two others [rad]."""
    values, vectors = np.linalg.eigh(np.einsum("kji,kjl->il", prior.root, prior.root))
    return vectors[:, 0] * np.sign(vectors[2, 0]), 1.0 / np.sqrt(values[1:])


@settings(max_examples=20, deadline=None)
@given(st.floats(-3, 3), st.floats(-2, 2), st.floats(-180, 180))
def test_two_crossing_facades_give_the_vertical(roll: float, pitch: float, yaw: float) -> None:
    turn = Rotation.from_euler("zyx", [yaw, pitch, roll], degrees=True).as_matrix()
    walls = np.concatenate([facade(8.0, 24.0, 1), facade(-9.0, 24.0, 2), facade(30.0, 18.0, 3)[:, [1, 0, 2]]])
    prior = wall_priors(
        [wall_pieces(walls @ turn)], np.zeros(1, np.int64), np.eye(3)[None], turn.T @ UP, SIGMA
    )
    up, sigmas = tilt(prior)
    assert np.degrees(np.arccos(min(up @ turn.T @ UP, 1.0))) < 0.2
    assert np.all(sigmas > SIGMA / np.sqrt(6))  # three walls, however many pieces they have


def test_a_long_facade_counts_as_one_wall() -> None:
    long, short = (
        wall_priors([wall_pieces(facade(8.0, n, 4))], np.zeros(1, np.int64), np.eye(3)[None], UP, SIGMA)
        for n in (12.0, 60.0)
    )
    assert np.linalg.norm(long.root) == pytest.approx(np.linalg.norm(short.root), rel=0.3)
    assert np.linalg.norm(long.root) <= 1.5 / SIGMA


def test_a_leaning_wall_among_upright_ones_hardly_counts() -> None:
    walls = [facade(8.0 + 3 * k, 15.0, k) for k in range(6)]
    walls.append(facade(-8.0, 15.0, 9, lean=0.09))
    prior = wall_priors(
        [wall_pieces(np.concatenate(walls))], np.zeros(1, np.int64), np.eye(3)[None], UP, SIGMA
    )
    _, vectors = np.linalg.eigh(prior.root[0].T @ prior.root[0])
    assert np.degrees(np.arcsin(abs(vectors[2, 2]))) < 0.15


def test_hedges_and_ground_are_no_walls() -> None:
    rng = np.random.default_rng(5)
    hedge = facade(8.0, 24.0, 6) + rng.normal(0, 0.15, (900, 3))
    ground = np.column_stack([rng.uniform(-20, 20, (4000, 2)), rng.normal(-2, 0.01, 4000)])
    pieces = wall_pieces(np.concatenate([hedge, ground]))
    assert not np.any(np.abs(pieces.normal[:, 2]) < 0.5)


def test_without_walls_the_vertical_stays_open() -> None:
    nothing = WallPieces(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert not wall_priors([nothing], np.zeros(1, np.int64), np.eye(3)[None], UP, SIGMA).root.any()
    assert len(wall_priors([], np.zeros(0, np.int64), np.zeros((0, 3, 3)), UP, SIGMA).index) == 0


def straight_drive(bias: float, seed: int = 1) -> Chain:
    """100 m along x in 100 scans with fixes of 2 cm; the accelerometer sees *up* rolled by ``bias`` [rad]."""
    rng, count = np.random.default_rng(seed), 100
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count)
    stamps = np.arange(count) * SECOND
    seen = np.array([0.0, np.sin(bias), np.cos(bias)])
    return Chain(
        stamps_ns=stamps,
        T_odom_lidar=poses,
        covariance=np.tile(np.diag([1e-8] * 3 + [1e-6] * 3), (count, 1, 1)),
        held=np.ones(count, bool),
        segment=np.zeros(count, np.int64),
        T_world_odom=np.eye(4),
        gravity=GravityPriors(np.arange(count), seen + rng.normal(0, 0.003, (count, 3))),
        gnss=GnssPriors(
            index=np.arange(count),
            times_ns=stamps,
            enu=poses[:, :3, 3] + rng.normal(0, 0.02, (count, 3)),
            levers=np.zeros((count, 3)),
            covariance=np.tile(np.eye(3) * 0.02**2, (count, 1, 1)),
            status=np.full(count, 2),
        ),
    )


def roll(poses: np.ndarray) -> float:
    """The roll [rad] of the middle pose of (S, 4, 4)."""
    return float(np.arcsin(poses[len(poses) // 2, 2, 1]))


def test_a_hundred_windows_of_a_biased_accelerometer_do_not_claim_the_roll() -> None:
    """0.7 degrees of bias: what is stated is the bias that is assumed, and not a tenth of one window."""
    found = solve({0: straight_drive(0.012)}, GraphConfig(), GnssConfig()).chains[0]
    sigma = np.sqrt(found.covariance[50, 0, 0])
    assert abs(roll(found.T_world_lidar)) == pytest.approx(0.012, abs=0.002)
    assert sigma == pytest.approx(GraphConfig().sigma_accelerometer_bias / 9.8, rel=0.1)
    assert np.sqrt(found.covariance[50, 1, 1]) < 0.001  # fixes hold the pitch


@pytest.mark.parametrize("live", [False, True])
def test_walls_correct_the_roll_that_fixes_leave_open(live: bool) -> None:
    root = np.zeros((10, 3, 3))
    root[:, 0, 1] = 3.0 / 0.02  # nine walls along the way at every submap
    chain = replace(straight_drive(0.012), walls=WallPriors(np.arange(5, 100, 10), root))
    if live:
        graph = LiveGraph(GraphConfig(), GnssConfig())
        graph.update({0: chain})
        poses, sigma = graph.update({0: chain})[0], np.sqrt(graph.covariance(0, 50)[0, 0])
    else:
        found = solve({0: chain}, GraphConfig(), GnssConfig()).chains[0]
        poses, sigma = found.T_world_lidar, np.sqrt(found.covariance[50, 0, 0])
    assert abs(roll(poses)) < 0.001
    assert sigma < 0.004


def test_a_bias_shows_where_the_drive_turns() -> None:
    """Driven back on the same street, the bias rolls the other way, and one roll fits both."""
    chain = straight_drive(0.012)
    back = Rotation.from_euler("z", 180, degrees=True).as_matrix()
    poses = chain.T_odom_lidar.copy()
    poses[50:, :3, :3] = back
    enu = poses[:, :3, 3] + np.random.default_rng(3).normal(0, 0.02, (100, 3))
    assert chain.gnss is not None
    turned = replace(chain, T_odom_lidar=poses, gnss=replace(chain.gnss, enu=enu))
    found = solve({0: turned}, GraphConfig(), GnssConfig()).chains[0]
    assert abs(roll(found.T_world_lidar)) < 0.002
    assert np.sqrt(found.covariance[50, 0, 0]) < 0.003


@pytest.mark.parametrize("accelerometer", [False, True])
def test_walls_level_no_local_map_whose_vertical_is_that_of_its_first_scan(accelerometer: bool) -> None:
    """Held at both ends, by the anchor and by walls that lean in its frame, a local map would be twisted."""
    poses = [
        OdometryPose(
            k * SECOND // 10, make_pose(np.eye(3), [0.5 * k, 0.0, 0.0]), np.eye(6) * 1e-6, 500, 0.02, False, 0
        )
        for k in range(30)
    ]
    record = SequenceRecord("drive", Extrinsics(np.eye(4), None, None), spool=SimpleNamespace())
    record.poses = poses
    record.accel = [np.array([0.0, 0.0, 9.8]) if accelerometer else np.full(3, np.nan)] * len(poses)
    walls = wall_pieces(facade(8.0, 24.0, 7, lean=0.03))
    record.submaps = SimpleNamespace(done=[SimpleNamespace(anchor=15, wall_pieces=walls)])
    chain = chain_of(record, None, MappingConfig(), placed=True)
    assert chain.walls.root.any() == accelerometer
