"""Places seen twice: descriptors, overlay, registration, consistency, joining without GNSS."""

from pathlib import Path

import numpy as np
import pytest
from mapping_scenes import START_NS
from scipy.spatial.transform import Rotation

from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3, invert_pose, make_pose, rotation_angle, transform_points
from subiaco_mapping.backend import MappingBackend
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.loop_closure.config import LoopConfig
from subiaco_mapping.loop_closure.consistency import consistent_set, disagreement
from subiaco_mapping.loop_closure.overlay import overlay
from subiaco_mapping.loop_closure.places import SubmapPlace
from subiaco_mapping.loop_closure.scan_context import SECTORS, compare, describe
from subiaco_mapping.loop_closure.submap_registration import PreparedSubmap, register
from subiaco_mapping.loop_closure.submaps import Submap, SubmapBuilder
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, OdometryPose
from subiaco_mapping.pose_graph.records import LoopEdge

CONFIG = LoopConfig()


def street(seed: int, length: float = 300.0) -> np.ndarray:
    """Points (N, 3) of a street along x: ground, house fronts of many heights and set-backs, trees."""
    rng = np.random.default_rng(seed)
    count = int(length * 160)
    parts = [rng.uniform([-40, -25, 0], [length + 40, 25, 0.02], (count, 3))]
    for side in (-1, 1):
        x = -40.0
        while x < length + 40:
            width, gap = rng.uniform(6, 16), rng.uniform(1, 8)
            front, height = rng.uniform(8, 14), rng.uniform(3, 11)
            n = int(width * height * 5)
            parts.append(rng.uniform([x, side * front, 0], [x + width, side * front, height], (n, 3)))
            flank = rng.uniform([x, 0, 0], [x, 10, height], (int(50 * height), 3))
            parts.append(flank * [1, side, 1] + [0, side * front, 0])
            tree = [x + width + gap / 2, side * rng.uniform(5, 8), rng.uniform(3, 6)]
            parts.append(rng.normal(tree, [1.2, 1.2, 1.0], (300, 3)))
            x += width + gap
    return np.concatenate(parts)


def at(x: float, y: float, yaw_deg: float) -> np.ndarray:
    """A pose 2 m above the street."""
    return make_pose(Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix(), [x, y, 2.0])


def seen(world: np.ndarray, pose: np.ndarray, seed: int = 0, reach: float = 40.0) -> np.ndarray:
    """A third of the points within reach, in the frame of the pose, with noise of 1 cm."""
    local = transform_points(invert_pose(pose), world)
    local = local[(local**2).sum(axis=1) < reach**2]
    rng = np.random.default_rng(seed)
    return local[rng.uniform(size=len(local)) < 0.34] + rng.normal(0, 0.01, (1, 3))


@pytest.mark.parametrize("turn", [0, 6, 90, 180, 354])
def test_a_turned_vehicle_has_the_same_descriptor_and_the_turn_is_told(turn: int) -> None:
    world = street(1)
    one = describe(seen(world, at(100, -1.7, 0)), CONFIG.radius)
    other = describe(seen(world, at(100, -1.7, turn), seed=1), CONFIG.radius)
    distance, yaw = compare(one, [other])
    assert distance[0] < 0.15
    off = (yaw[0] - np.radians(turn) + np.pi) % (2 * np.pi) - np.pi
    assert abs(off) <= 2 * np.pi / SECTORS + 1e-9


def test_the_other_lane_driven_the_other_way_is_nearer_than_every_other_place() -> None:
    world = street(2)
    mine = describe(seen(world, at(150, -1.7, 0)), CONFIG.radius)
    places = [describe(seen(world, at(x, 1.7, 180), seed=x), CONFIG.radius) for x in range(30, 290, 10)]
    distance, yaw = compare(mine, places)
    assert distance.argmin() == 12
    assert abs(abs(yaw[12]) - np.pi) < 0.2
    assert np.delete(distance, [11, 12, 13]).min() > distance[12] + 0.1


def test_an_empty_database_proposes_nothing() -> None:
    distance, yaw = compare(describe(seen(street(1), at(100, 0, 0)), CONFIG.radius), [])
    assert len(distance) == len(yaw) == 0


@pytest.mark.parametrize("second", [(104, 1.7, 180), (94, -1.7, 3), (100, 1.7, 187)])
def test_overlay_and_registration_find_a_place_from_its_turn_alone(second: tuple[float, ...]) -> None:
    world = street(3)
    poses = at(100, -1.7, 0), at(*second)
    one, other = (seen(world, pose, k) for k, pose in enumerate(poses))
    true = invert_pose(poses[0]) @ poses[1]
    nearest_sector = np.radians(round(second[2] / 6) * 6)
    laid = overlay(one, other, nearest_sector)
    assert np.linalg.norm(laid[:2, 3] - true[:2, 3]) < 1.0
    found = register(PreparedSubmap(one), PreparedSubmap(other), laid, CONFIG)
    off = invert_pose(true) @ found.T_target_source
    assert np.linalg.norm(off[:3, 3]) < 0.05
    assert np.degrees(rotation_angle(off)) < 0.1
    assert found.refused(CONFIG) is None


def test_places_that_are_not_one_are_refused_by_geometry() -> None:
    world = street(4)
    one, other = (PreparedSubmap(seen(world, at(x, -1.7, 0))) for x in (60, 200))
    laid = overlay(one.points, other.points, 0.0)
    assert register(one, other, laid, CONFIG).refused(CONFIG) in ("overlap", "residual")


def test_a_bare_tunnel_holds_nothing_along_and_is_refused_as_degenerate() -> None:
    rng = np.random.default_rng(5)
    angle = rng.uniform(0, 2 * np.pi, 20_000)
    tube = np.stack([rng.uniform(-40, 40, 20_000), 4 * np.cos(angle), 4 * np.sin(angle)], axis=1)
    found = register(PreparedSubmap(tube[::2]), PreparedSubmap(tube[1::2]), np.eye(4), CONFIG)
    assert found.refused(CONFIG) == "degenerate"


def place(number: int, pose: np.ndarray, sigma: float) -> SubmapPlace:
    """A place of its own chain."""
    submap = Submap(0, 0.0, Path("none.npy"))
    return SubmapPlace((number, 0), submap, np.eye(3), pose, np.diag(np.repeat([1e-3, sigma], 3)) ** 2)


def test_a_loop_that_the_estimate_rules_out_has_a_large_chi_square() -> None:
    first, second = place(0, at(0, 0, 0), 0.05), place(1, at(4, 3, 180), 0.05)
    true = invert_pose(at(0, 0, 0)) @ at(4, 3, 180)
    covariance = np.diag(np.repeat([1e-3, 0.02], 3)) ** 2
    good = LoopEdge((0, 0), (1, 0), true @ exp_se3([0, 0, 1e-3, 0.03, -0.03, 0.02]), covariance)
    wrong = LoopEdge((0, 0), (1, 0), true @ exp_se3([0, 0, 0, 15.0, 0, 0]), covariance)
    assert disagreement(good, first, second) < 5
    assert disagreement(wrong, first, second) > 1e4
    lost = place(1, at(4, 3, 180), 10.0)
    assert disagreement(wrong, first, lost) < CONFIG.gate  # nobody knows better


def test_the_largest_set_of_agreeing_loops_wins_over_a_gang_of_false_ones() -> None:
    rng = np.random.default_rng(6)
    anchors = rng.uniform(-200, 200, (14, 3)) * [1, 1, 0.01]
    true, alias = at(30, 5, 40), at(45, 5, 40)  # a house further
    placements = [true @ exp_se3(np.concatenate([[0, 0, 0], rng.normal(0, 0.05, 3)])) for _ in range(7)]
    placements += [alias] * 4 + [at(*rng.uniform(-90, 90, 3)) for _ in range(3)]
    assert consistent_set(placements, anchors) == [0, 1, 2, 3, 4, 5, 6]


def test_submaps_cover_the_way_and_a_break_starts_a_new_one(tmp_path: Path) -> None:
    builder = SubmapBuilder(LoopConfig(submap_length=10.0), tmp_path)
    points = seen(street(7), at(0, 0, 0))[:2000]
    for k in range(50):
        segment = int(k >= 25)
        pose = OdometryPose(k, at(float(k), 0, 0), np.eye(6), 100, 0.02, False, segment)
        builder.add(pose, DeskewedScan(k, points, np.zeros(len(points), np.float32), "gyro"))
    assert [submap.way for submap in builder.done] == pytest.approx([5, 15, 30, 40], abs=2)
    assert all(abs(submap.anchor - submap.way) < 1e-9 for submap in builder.done)
    assert (np.abs(builder.done[0].points()) < 60).all()


def feed(backend: MappingBackend, name: str, world: np.ndarray, poses: np.ndarray, seed: int) -> None:
    """Drive along poses with perfect odometry from its own origin."""
    backend.start_sequence(name, Extrinsics())
    start = invert_pose(poses[0])
    covariance = np.diag(np.repeat([4e-4, 0.008], 3)) ** 2
    for k, pose in enumerate(poses):
        stamp = START_NS + (seed * 10_000 + k) * 10**8
        xyz = seen(world, pose, seed * 10_000 + k)
        backend.on_odometry(
            OdometryPose(stamp, start @ pose, covariance, 100, 0.02, False, 0),
            DeskewedScan(stamp, xyz, np.zeros(len(xyz), np.float32), "gyro"),
        )


def drives(backend: MappingBackend, worlds: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Two drives of 80 m without GNSS, opposite ways, overlapping by 60 m."""
    there = np.array([at(x, -1.7, 0) for x in np.arange(40, 120, 3.0)])
    back = np.array([at(x, 1.7, 180) for x in np.arange(140, 60, -3.0)])
    feed(backend, "there", worlds[0], there, 1)
    feed(backend, "back", worlds[1], back, 2)
    return there, back


def test_two_drives_without_gnss_are_joined_by_what_both_saw(tmp_path: Path) -> None:
    backend = MappingBackend(MappingConfig(), Extrinsics(), tmp_path)
    world = street(8, 180)
    there, back = drives(backend, (world, world))
    solution = backend.optimize()
    assert solution.frame is None
    found = [solved.T_local_lidar for solved in solution.sequences]
    off = invert_pose(there[0]) @ back - invert_pose(found[0][0]) @ found[1]
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.15
    live = backend.preview()  # of the first alone: the second waits for the batch to be joined
    assert [sequence.name for sequence in live.sequences] == ["there"]
    facts = solution.loops.described()
    assert facts["between"]["loops"] >= 3
    assert facts["between"]["seam_median_m"] < 0.05


def test_drives_of_different_streets_without_gnss_are_not_joined(tmp_path: Path) -> None:
    backend = MappingBackend(MappingConfig(), Extrinsics(), tmp_path)
    drives(backend, (street(8, 180), street(9, 180)))
    with pytest.raises(InputError, match="back: cannot be georeferenced"):
        backend.optimize()
